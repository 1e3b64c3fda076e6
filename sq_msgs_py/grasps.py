"""Grasps in a sensor_msgs/PointCloud2: one point a grasp, one named field a number, the most probable first.

Fields
------
x y z           tool centre point, midway between the pads, metres, in the frame of the header
qx qy qz qw     unit quaternion, gripper to header frame: z the way of the approach, y the way of the fingers
opening         between the pads before they close, metres
width           of the body between them, metres
score           0 to 1: the probability that it holds
id              of the body, as in the cloud of the superquadrics (uint32; the others are float32)
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from sq_msgs_py import columns
from sq_msgs_py.columns import FLOAT32, UINT32, Columns, column
from sq_msgs_py.message_types import MessageTypes, find_type
from sq_msgs_py.poses import poses_at

if TYPE_CHECKING:
    from geometry_msgs.msg import PoseArray
    from sensor_msgs.msg import PointCloud2

FIELDS: tuple[tuple[str, int], ...] = (
    *((name, FLOAT32) for name in ("x", "y", "z", "qx", "qy", "qz", "qw", "opening", "width", "score")),
    ("id", UINT32),
)
"""Name and PointField datatype of every field, in the order of the message."""


@dataclass(frozen=True, eq=False)
class GraspArray(Columns):
    """n grasps, column by column; see the module for units and conventions.

    Raises ValueError as :class:`~sq_msgs_py.columns.Columns` does.
    """

    FIELDS = FIELDS

    position: np.ndarray = field(metadata=column("x", "y", "z", is_finite=True))
    rotation: np.ndarray = field(metadata=column("qx", "qy", "qz", "qw", is_finite=True))
    opening: np.ndarray = field(metadata=column("opening"))
    width: np.ndarray = field(metadata=column("width"))
    score: np.ndarray = field(metadata=column("score"))
    id: np.ndarray = field(metadata=column("id"))


def to_message(grasps: GraspArray, header: Any, types: MessageTypes = find_type) -> PointCloud2:
    """Return the message of n grasps (n may be 0) with the given std_msgs/Header, of the classes in ``types``."""
    return columns.to_message(grasps, header, types)


def from_message(message: PointCloud2) -> GraspArray:
    """Return the grasps of a message; fields are found by name, unknown ones are left aside.

    Raises MessageError as for superquadrics.
    """
    return columns.from_message(GraspArray, message, [name for name, _ in FIELDS])


def poses(grasps: GraspArray, header: Any, types: MessageTypes = find_type) -> PoseArray:
    """Return the poses alone as a geometry_msgs/PoseArray, in the same order."""
    found = poses_at(grasps.position, grasps.rotation, types)
    return types("geometry_msgs/msg/PoseArray")(header=header, poses=found)
