"""Poses of superquadrics and of planes as geometry_msgs, and whole arrays moved from one frame into another.

A rigid motion is (rotation, translation): quaternion x y z w of any length but 0, metres; p_new = R p + t.  It is what
tf2's ``lookup_transform(new_frame, header.frame_id, ...)`` answers.  Half sizes, exponents and their deviations belong
to the body and do not change.

Covariances of poses are (6, 6): x y z in metres, then small rotations about the x, y, z axes of the header's frame,
radians; the order of geometry_msgs/PoseWithCovariance.  NaN where unknown.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sq_msgs_py.message_types import MessageTypes, installed
from sq_msgs_py.superquadrics import SuperquadricArray

if TYPE_CHECKING:
    from geometry_msgs.msg import Pose, PoseStamped

_LEAST_LENGTH = 1e-6
_ACROSS = 0.9
"""Of the x part of a plane's normal: nearer to the x axis than 26 degrees."""


def pose_messages(superquadrics: SuperquadricArray) -> list[Pose]:
    """The pose of each of n bodies in the frame of their header, with unit quaternions.

    Raises
    ------
    ValueError
        If a quaternion names no rotation.
    """
    return poses_at(superquadrics.translation, unit_quaternions(superquadrics.rotation))


def poses_at(places: np.ndarray, turns: np.ndarray, types: MessageTypes = installed) -> list[Pose]:
    """Poses at places (n, 3), turned by unit quaternions (n, 4)."""
    pose, point, quaternion = (types(f"geometry_msgs/msg/{name}") for name in ("Pose", "Point", "Quaternion"))
    return [
        pose(position=point(x=x, y=y, z=z), orientation=quaternion(x=qx, y=qy, z=qz, w=qw))
        for (x, y, z), (qx, qy, qz, qw) in zip(places.astype(float).tolist(), turns.tolist(), strict=True)
    ]


def moved(superquadrics: SuperquadricArray, rotation: np.ndarray, translation: np.ndarray) -> SuperquadricArray:
    """The same bodies in another frame.

    Columns are float32: 10 km from the origin of the new frame a centre is exact to 0.5 mm, at the 500 km of a UTM grid
    to 16 mm.

    Parameters
    ----------
    rotation : (4,)
    translation : (3,)

    Raises
    ------
    ValueError
        If the motion is not finite or a quaternion names no rotation.
    """
    turn, shift = _motion(rotation, translation)
    return replace(
        superquadrics,
        translation=superquadrics.translation.astype(float) @ matrices(turn).T + shift,
        rotation=product(turn, unit_quaternions(superquadrics.rotation)),
    )


def plane_message(plane: np.ndarray, header: Any) -> PoseStamped:
    """A plane n.p + d = 0 (4,) as a pose: z is n, the origin is the point next to that of the header's frame.

    The x axis is that of the header's frame laid into the plane, or its y axis where the plane is across x.
    """
    from geometry_msgs.msg import PoseStamped

    normal, offset = np.asarray(plane[:3], dtype=float), float(plane[3])
    length = float(np.linalg.norm(normal))
    normal, offset = normal / length, offset / length
    axis = np.eye(3)[0 if abs(normal[0]) < _ACROSS else 1]
    along = np.cross(np.cross(normal, axis), normal)
    along /= np.linalg.norm(along)
    turn = _quaternion(np.column_stack([along, np.cross(normal, along), normal]))
    (pose,) = poses_at((-offset * normal)[None], turn[None])
    return PoseStamped(header=header, pose=pose)


def plane_of(message: PoseStamped) -> np.ndarray:
    """The plane (4,), n of length 1, n.p + d = 0, of a pose: the inverse of :func:`plane_message`.

    Raises
    ------
    ValueError
        If the quaternion names no rotation.
    """
    turn, centre = message.pose.orientation, message.pose.position
    normal = matrices(unit_quaternions(np.array([turn.x, turn.y, turn.z, turn.w])))[:, 2]
    return np.append(normal, -normal @ [centre.x, centre.y, centre.z])


def moved_plane(plane: np.ndarray, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """A plane n.p + d = 0 (4,) in another frame; ValueError as :func:`moved`."""
    turn, shift = _motion(rotation, translation)
    normal = matrices(turn) @ plane[:3]
    return np.append(normal, plane[3] - normal @ shift)


def moved_covariances(covariances: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Covariances (n, 6, 6) of poses in a frame that is turned by a quaternion (4,), p_new = R p."""
    change = np.kron(np.eye(2), matrices(unit_quaternions(rotation)))
    return change @ np.asarray(covariances, dtype=float) @ change.T


def header_in(header: Any, frame_id: str) -> Any:
    """A header of the same stamp in another frame."""
    return type(header)(stamp=header.stamp, frame_id=frame_id)


def unit_quaternions(quaternions: np.ndarray) -> np.ndarray:
    """Quaternions (..., 4) as float64 of length 1.

    Raises
    ------
    ValueError
        If one is not finite or has a length near 0.
    """
    quaternions = np.asarray(quaternions, dtype=float)
    if quaternions.shape[-1:] != (4,):
        raise ValueError(f"rotation: expected quaternions (..., 4), got {quaternions.shape}")
    length = np.linalg.norm(quaternions, axis=-1, keepdims=True)
    if not (np.isfinite(length) & (length > _LEAST_LENGTH)).all():
        raise ValueError(f"rotation: expected quaternions of a length above 0, got {quaternions.tolist()}")
    return quaternions / length


def matrices(quaternions: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    x, y, z, w = np.moveaxis(quaternions, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _quaternion(matrix: np.ndarray) -> np.ndarray:
    """Unit quaternion (4,) of a rotation matrix (3, 3): the eigenvector that Bar-Itzhack's matrix has for 3."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = matrix
    symmetric = np.array(
        [
            [xx - yy - zz, xy + yx, xz + zx, zy - yz],
            [xy + yx, yy - xx - zz, yz + zy, xz - zx],
            [xz + zx, yz + zy, zz - xx - yy, yx - xy],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    return np.asarray(np.linalg.eigh(symmetric)[1][:, -1])


def _motion(rotation: np.ndarray, translation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    turn, shift = unit_quaternions(rotation), np.asarray(translation, dtype=float)
    if turn.shape != (4,) or shift.shape != (3,) or not np.isfinite(shift).all():
        raise ValueError(
            f"motion: expected a quaternion (4,) and a finite translation (3,), got {turn.shape} and {shift}"
        )
    return turn, shift


def product(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Quaternions (..., 4) of left after right; one of them may be a single one."""
    (one, w), (other, v) = (np.split(quaternion, [3], axis=-1) for quaternion in (left, right))
    return np.concatenate(
        [w * other + v * one + np.cross(one, other), w * v - (one * other).sum(axis=-1, keepdims=True)], axis=-1
    )
