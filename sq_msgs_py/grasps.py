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

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from sq_msgs_py import columns
from sq_msgs_py.columns import Columns, column
from sq_msgs_py.message_types import MessageTypes, find_type
from sq_msgs_py.poses import matrices, poses_at, product, unit_quaternions

if TYPE_CHECKING:
    from geometry_msgs.msg import PoseArray
    from moveit_msgs.msg import Grasp
    from sensor_msgs.msg import PointCloud2

FIELDS = columns.field_types("x y z qx qy qz qw opening width score id", unsigned="id")
"""Name and PointField datatype of every field, in the order of the message."""


@dataclass(frozen=True, eq=False)
class GraspArray(Columns):
    """n grasps, column by column; see the module for units and conventions.  Raises ValueError as
    :class:`~sq_msgs_py.columns.Columns` does."""

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
    """Return the grasps of a message; fields are found by name, unknown ones are left aside.  Raises MessageError as
    for superquadrics."""
    return columns.from_message(GraspArray, message)


def poses(grasps: GraspArray, header: Any, types: MessageTypes = find_type) -> PoseArray:
    """Return the poses alone as a geometry_msgs/PoseArray, in the same order."""
    found = poses_at(grasps.position, grasps.rotation, types)
    return types("geometry_msgs/msg/PoseArray")(header=header, poses=found)


def moveit_grasps(
    grasps: GraspArray, header: Any, link: str, link_from_tcp: tuple[Sequence[float], Sequence[float]],
    up: Sequence[float] | None, prefix: str, joints: Sequence[str] = (), types: MessageTypes = find_type,
) -> list[Grasp]:
    """Return a moveit_msgs/Grasp for each, in the same order; its quality is the score.

    ``header``: std_msgs/Header of the grasps.  ``link``, ``link_from_tcp``: the parent link of the end effector and
    position and quaternion of the TCP in it; of :class:`sq_perception.grasping.gripper.Gripper` where that link is the
    gripper's.  ``up`` (3,): Away from the table in the frame of the header, of length 1: the way of the retreat.  None:
    back as it came.  ``prefix``: of the ids of collision objects, which the fingers may touch:
    :data:`sq_msgs_py.poses.PREFIX`.  ``joints``: those of the fingers, each of which moves by half of the opening; none
    leaves both postures empty.  Raises ImportError without moveit_msgs; ValueError if a quaternion names no rotation.
    """
    grasp, translation = types("moveit_msgs/msg/Grasp"), types("moveit_msgs/msg/GripperTranslation")
    stamped, vector = types("geometry_msgs/msg/Vector3Stamped"), types("geometry_msgs/msg/Vector3")
    pose_stamped, empty = types("geometry_msgs/msg/PoseStamped"), types("std_msgs/msg/Header")
    trajectory, point = types("trajectory_msgs/msg/JointTrajectory"), types("trajectory_msgs/msg/JointTrajectoryPoint")

    def straight(frame: Any, way: Sequence[float]) -> Any:
        direction = stamped(header=frame, vector=vector(x=float(way[0]), y=float(way[1]), z=float(way[2])))
        # Metres: what the planner keeps free, and what MoveIt has to find.
        return translation(direction=direction, desired_distance=0.1, min_distance=0.05)

    def posture(opening: float) -> Any:
        if not joints:
            return trajectory()
        return trajectory(joint_names=list(joints), points=[point(positions=[0.5 * opening] * len(joints))])

    shift, turn = np.asarray(link_from_tcp[0], dtype=float), np.asarray(link_from_tcp[1], dtype=float)
    back = unit_quaternions(turn) * [-1.0, -1.0, -1.0, 1.0]
    turns = product(unit_quaternions(grasps.rotation), back)
    places = grasps.position - matrices(turns) @ shift
    placed = GraspArray(places, turns, grasps.opening, grasps.width, grasps.score, grasps.id)
    approach = matrices(unit_quaternions(turn))[:, 2]
    own = empty(frame_id=link)
    retreat = (own, (-approach).tolist()) if up is None else (header, up)
    found = []
    for k, pose in enumerate(poses(placed, header, types).poses):
        found.append(
            grasp(
                id=f"{k}", pre_grasp_posture=posture(float(grasps.opening[k])),
                grasp_posture=posture(float(min(grasps.width[k], grasps.opening[k]))),  # it may be wider than both say
                grasp_pose=pose_stamped(header=header, pose=pose), grasp_quality=float(grasps.score[k]),
                pre_grasp_approach=straight(own, approach.tolist()), post_grasp_retreat=straight(*retreat),
                allowed_touch_objects=[f"{prefix}{int(grasps.id[k])}"],
            )
        )
    return found
