"""Measured points of a sensor_msgs/PointCloud2: x, y, z in metres, one a pixel where the cloud is organised.

Another field, whatever its type, may hold the object that each point belongs to.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sq_msgs_py.columns import FLOAT32, UINT32, cloud_points

if TYPE_CHECKING:
    from sensor_msgs.msg import PointCloud2


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


def labels_of_points(message: PointCloud2, fields: Sequence[str]) -> np.ndarray | None:
    """Labels (height, width) as they stand in the first of these fields that is there; None without one.

    Raises
    ------
    MessageError
        As :func:`points_from_message`.
    """
    present = {field.name for field in message.fields}
    name = next((name for name in fields if name in present), None)
    if name is None:
        return None
    found = cloud_points(message, [(name, UINT32)], [name])[name]
    return found.reshape(int(message.height), int(message.width))
