"""Measured points of a sensor_msgs/PointCloud2: x, y, z in metres, one a pixel where the cloud is organised.

A field ``instance`` or ``label``, whatever its type, holds the object that each point belongs to, 0 for none.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sq_msgs_py.columns import FLOAT32, UINT32, cloud_points

if TYPE_CHECKING:
    from sensor_msgs.msg import PointCloud2

LABEL_FIELDS = ("instance", "label")
"""Fields with the object of each point; the first of them that is there counts."""


def points_from_message(message: PointCloud2) -> np.ndarray:
    """Points, float32 (height, width, 3), as they stand in the message: NaN or (0, 0, 0) where nothing was measured.

    Raises
    ------
    MessageError
        As :func:`~sq_msgs_py.superquadrics.from_message`, for the fields x, y, z.
    """
    found = cloud_points(message, [(name, FLOAT32) for name in "xyz"], "xyz")
    with np.errstate(over="ignore"):  # doubles that no camera measures: infinite
        points = np.stack([found[name].astype(np.float32) for name in "xyz"], axis=-1)
    return points.reshape(int(message.height), int(message.width), 3)


def label_field(message: PointCloud2) -> str:
    """The field with the points' labels; empty if there is none."""
    names = {field.name for field in message.fields}
    return next((name for name in LABEL_FIELDS if name in names), "")


def labels_of_points(message: PointCloud2) -> np.ndarray | None:
    """Labels (height, width) as they stand in the message; None without such a field.

    Raises
    ------
    MessageError
        As :func:`points_from_message`.
    """
    name = label_field(message)
    if not name:
        return None
    found = cloud_points(message, [(name, UINT32)], [name])[name]
    return found.reshape(int(message.height), int(message.width))
