"""Poses of superquadrics and of planes as geometry_msgs, transforms and detections, and arrays in another frame.

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

from sq_msgs_py.message_types import MessageTypes, find_type
from sq_msgs_py.superquadrics import FAILED, SuperquadricArray

if TYPE_CHECKING:
    from geometry_msgs.msg import Pose, PoseStamped, TransformStamped
    from vision_msgs.msg import Detection3DArray


def pose_messages(superquadrics: SuperquadricArray) -> list[Pose]:
    """Return the pose of each of n bodies in the frame of their header; ValueError for a quaternion of length 0."""
    return poses_at(superquadrics.translation, unit_quaternions(superquadrics.rotation))


def poses_at(places: np.ndarray, turns: np.ndarray, types: MessageTypes = find_type) -> list[Pose]:
    """Return poses at places (n, 3), turned by unit quaternions (n, 4)."""
    pose, point, quaternion = (types(f"geometry_msgs/msg/{name}") for name in ("Pose", "Point", "Quaternion"))
    return [
        pose(position=point(x=x, y=y, z=z), orientation=quaternion(x=qx, y=qy, z=qz, w=qw))
        for (x, y, z), (qx, qy, qz, qw) in zip(places.astype(float).tolist(), turns.tolist(), strict=True)
    ]


def move(superquadrics: SuperquadricArray, rotation: np.ndarray, translation: np.ndarray) -> SuperquadricArray:
    """Return the same bodies in another frame; ValueError if the motion is not finite or a quaternion no rotation.

    Columns are float32: 10 km from the origin of the new frame a centre is exact to 0.5 mm, at the 500 km of a UTM grid
    to 16 mm.
    """
    turn, shift = _motion(rotation, translation)
    return replace(
        superquadrics, translation=superquadrics.translation.astype(float) @ matrices(turn).T + shift,
        rotation=product(turn, unit_quaternions(superquadrics.rotation)),
    )


def plane_message(plane: np.ndarray, header: Any) -> PoseStamped:
    """Return a plane n.p + d = 0 (4,) as a pose: z is n, the origin is the point next to that of the header's frame.
    The x axis is that of the header's frame laid into the plane, or its y axis where the plane is across x."""
    from geometry_msgs.msg import PoseStamped

    normal, offset = np.asarray(plane[:3], dtype=float), float(plane[3])
    length = float(np.linalg.norm(normal))
    normal, offset = normal / length, offset / length
    axis = np.eye(3)[0 if abs(normal[0]) < 0.9 else 1]
    along = np.cross(np.cross(normal, axis), normal)
    along /= np.linalg.norm(along)
    turn = _quaternion(np.column_stack([along, np.cross(normal, along), normal]))
    (pose,) = poses_at((-offset * normal)[None], turn[None])
    return PoseStamped(header=header, pose=pose)


def plane_of(message: PoseStamped) -> np.ndarray:
    """Return the plane (4,), n of length 1, n.p + d = 0, of a pose: the inverse of :func:`plane_message`."""
    turn, centre = message.pose.orientation, message.pose.position
    normal = matrices(unit_quaternions(np.array([turn.x, turn.y, turn.z, turn.w])))[:, 2]
    return np.append(normal, -normal @ [centre.x, centre.y, centre.z])


def move_plane(plane: np.ndarray, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Return a plane n.p + d = 0 (4,) in another frame; ValueError as :func:`move`."""
    turn, shift = _motion(rotation, translation)
    normal = matrices(turn) @ plane[:3]
    return np.append(normal, plane[3] - normal @ shift)


def turn_covariances(covariances: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return covariances (n, 6, 6) of poses in a frame that is turned by a quaternion (4,), p_new = R p."""
    change = np.kron(np.eye(2), matrices(unit_quaternions(rotation)))
    return change @ np.asarray(covariances, dtype=float) @ change.T


def header_in(header: Any, frame_id: str) -> Any:
    """Return a header of the same stamp in another frame."""
    return type(header)(stamp=header.stamp, frame_id=frame_id)


def unit_quaternions(quaternions: np.ndarray) -> np.ndarray:
    """Return quaternions (..., 4) as float64 of length 1; ValueError where that cannot be."""
    quaternions = np.asarray(quaternions, dtype=float)
    if quaternions.shape[-1:] != (4,):
        raise ValueError(f"rotation: expected quaternions (..., 4), got {quaternions.shape}")
    length = np.linalg.norm(quaternions, axis=-1, keepdims=True)
    if not (np.isfinite(length) & (length > 1e-6)).all():
        raise ValueError(f"rotation: expected quaternions of a length above 0, got {quaternions.tolist()}")
    return quaternions / length


def matrices(quaternions: np.ndarray) -> np.ndarray:
    """Return rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    x, y, z, w = np.moveaxis(quaternions, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _quaternion(matrix: np.ndarray) -> np.ndarray:
    """Return the unit quaternion (4,) of a rotation matrix (3, 3): Bar-Itzhack's eigenvector of 3."""
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
    """Return quaternions (..., 4) of left after right; one of them may be a single one."""
    (one, w), (other, v) = (np.split(quaternion, [3], axis=-1) for quaternion in (left, right))
    return np.concatenate(
        [w * other + v * one + np.cross(one, other), w * v - (one * other).sum(axis=-1, keepdims=True)], axis=-1
    )


PREFIX = "superquadric_"


def body_name(number: int, prefix: str = PREFIX) -> str:
    """Return the name of the body of an id, as a frame, a detection and a collision object."""
    return f"{prefix}{int(number)}"


def prefix_in(namespace: str) -> str:
    """Return the prefix of one of several cameras by its namespace: front/wrist gives front_wrist_superquadric_."""
    return "_".join([*namespace.strip("/").split("/"), PREFIX])


def transforms(superquadrics: SuperquadricArray, header: Any, *, prefix: str = PREFIX) -> list[TransformStamped]:
    """Return a TransformStamped for each body that did not fail, for /tf.

    The child frame ``<prefix><id>`` lies in the body's centre with the body's axes; its parent is the frame of the
    header, its stamp that of the image.  tf2 knows no removal: the newest transform of a body that is gone stays, so
    look at the stamp of the answer.  Two nodes need different prefixes: tf2 allows one parent.

    Raises ValueError if the header has no frame, which tf2 would not accept, or a quaternion names no rotation.
    """
    from geometry_msgs.msg import TransformStamped

    if not header.frame_id:
        raise ValueError("header: expected a frame_id to be the parent, got none")
    bodies = superquadrics.recovered
    messages = []
    for number, pose in zip(bodies.id, pose_messages(bodies), strict=True):
        message = TransformStamped(header=header, child_frame_id=body_name(number, prefix))
        translation, position = message.transform.translation, pose.position
        translation.x, translation.y, translation.z = position.x, position.y, position.z
        message.transform.rotation = pose.orientation
        messages.append(message)
    return messages


def detections(
    superquadrics: SuperquadricArray, header: Any, *, covariances: np.ndarray | None = None, prefix: str = PREFIX
) -> Detection3DArray:
    """Return a Detection3D of vision_msgs 4 for each body that did not fail; ``covariances`` (n, 6, 6) of all bodies.

    | field | what it holds |
    | --- | --- |
    | header | that of the bodies; the same in each detection |
    | id | ``<prefix><id>``, with tracking the same from frame to frame |
    | results[0].hypothesis.class_id | ``superquadric``: a shape was recovered, nothing was classified |
    | results[0].hypothesis.score | score, 0 to 1; 0 where it is unknown |
    | results[0].pose.pose, bbox.center | pose of the body: its centre and its axes |
    | results[0].pose.covariance | of that pose, row by row; all 0 where unknown |
    | bbox.size | FULL sizes 2 a1, 2 a2, 2 a3: the enclosing box with the body's axes |

    Raises ImportError without vision_msgs; ValueError if the covariances have another shape or a quaternion names no
    rotation.
    """
    from vision_msgs.msg import Detection3D, Detection3DArray, ObjectHypothesisWithPose

    count = len(superquadrics)
    known = np.full((count, 6, 6), np.nan) if covariances is None else np.asarray(covariances, dtype=float)
    if known.shape != (count, 6, 6):
        raise ValueError(f"covariances: expected shape ({count}, 6, 6), got {known.shape}")
    known = known[superquadrics.status != FAILED]
    bodies = superquadrics.recovered
    message = Detection3DArray(header=header)
    for k, pose in enumerate(pose_messages(bodies)):
        result = ObjectHypothesisWithPose()
        result.hypothesis.class_id = "superquadric"
        result.hypothesis.score = float(np.nan_to_num(bodies.score[k], nan=0.0, posinf=0.0, neginf=0.0))
        result.pose.pose = pose
        if np.isfinite(known[k]).all():
            result.pose.covariance = known[k].ravel()
        detection = Detection3D(header=header, results=[result], id=body_name(bodies.id[k], prefix))
        detection.bbox.center = pose
        size = detection.bbox.size
        size.x, size.y, size.z = (2.0 * bodies.size[k].astype(float)).tolist()
        message.detections.append(detection)
    return message
