"""geometry_msgs/TransformStamped of superquadrics: one frame per body, for /tf.

The child frame ``<prefix><id>`` lies in the body's centre with the body's axes; its parent is the frame of the header,
its stamp that of the image.  tf2 knows no removal: who asks for the newest transform of a frame that is no longer sent
gets the last one, however old it is.  Ask at the stamp of the results, or look at the stamp of the answer.

With tracking an id is that of a track and its frame follows one body.  Without, ids are labels of masks, and a frame
may be another body's from one image to the next.  Two nodes that name their bodies alike give one child two parents,
which tf2 does not allow: give each its own prefix.
"""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import TransformStamped

from sq_msgs_py.poses import pose_messages
from sq_msgs_py.superquadrics import SuperquadricArray

PREFIX = "superquadric_"


def name(number: int, prefix: str = PREFIX) -> str:
    """What the body of an id is called, as a frame, a detection and a collision object."""
    return f"{prefix}{int(number)}"


def prefix_in(namespace: str) -> str:
    """The prefix of one of several cameras, by its namespace: front/wrist gives front_wrist_superquadric_."""
    return "_".join([*namespace.strip("/").split("/"), PREFIX])


def transforms(superquadrics: SuperquadricArray, header: Any, *, prefix: str = PREFIX) -> list[TransformStamped]:
    """One transform for each body that did not fail.

    Parameters
    ----------
    header
        std_msgs/Header of the bodies.
    prefix
        Of the child frames.

    Raises
    ------
    ValueError
        If the header has no frame, which tf2 would not accept, or a quaternion names no rotation.
    """
    if not header.frame_id:
        raise ValueError("header: expected a frame_id to be the parent, got none")
    bodies = superquadrics.recovered
    messages = []
    for number, pose in zip(bodies.id, pose_messages(bodies), strict=True):
        message = TransformStamped(header=header, child_frame_id=name(number, prefix))
        translation, position = message.transform.translation, pose.position
        translation.x, translation.y, translation.z = position.x, position.y, position.z
        message.transform.rotation = pose.orientation
        messages.append(message)
    return messages
