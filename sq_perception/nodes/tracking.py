"""Tracks of the bodies of each frame, in the camera's frame or a fixed one, and their published numbers.

tf2_ros comes with a ROS installation and is not on PyPI: it is imported, and /tf subscribed to, only once a frame is
requested.  A pose is (quaternion x y z w, translation), p_frame = R p_optical + t, metres.
"""

from __future__ import annotations

import importlib
from collections.abc import Hashable
from typing import Any

import numpy as np
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.time import Time

from sq_perception.nodes.frame import Frame, stamp_of
from sq_perception.nodes.parameters import RecoverParameters
from sq_perception.nodes.statistics import THROTTLE
from sq_perception.recordings.publication import Identified, identify
from sq_perception.recovery.recoverer import FrameRecovery
from sq_perception.tracking.session import Tally, TrackingSession

Pose = tuple[np.ndarray, np.ndarray]
"""Quaternion x y z w (4,) and translation (3,), arrays where :data:`sq_perception.segmentation.options.Pose` has
numbers."""


class PoseError(ValueError):
    """Error with the reason why the pose of a frame is unknown."""


class CameraPoses:
    """Poses of optical frames from tf2; without tf2 every look-up fails with that reason."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._buffer: Any = None
        self._listener: Any = None
        self._missing = ""
        self._stamp = 0

    def listen(self) -> None:
        """Start to listen to /tf once; a buffer knows only what it has received."""
        if self._buffer is not None or self._missing:
            return
        try:
            tf2: Any = importlib.import_module("tf2_ros")
        except ImportError as error:
            self._missing = f"tf2_ros cannot be imported ({error})"
            return
        self._buffer = tf2.Buffer()
        self._listener = tf2.TransformListener(self._buffer, self._node)

    def at(self, header: Any, frame: str, patience: float = 0.1) -> Pose:
        """Return the pose of a header's frame in ``frame`` at its stamp, the newest for a stamp of 0, after
        ``patience`` seconds at most; PoseError if it is unknown.  Not for the executor's thread, in which transforms
        arrive."""
        if header.frame_id == frame:
            return np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3)
        self.listen()
        if self._buffer is None:
            raise PoseError(self._missing)
        if not header.frame_id:
            raise PoseError("the image has no frame_id")
        try:
            stamp, wait = Time.from_msg(header.stamp), Duration(seconds=patience)
            found = self._buffer.lookup_transform(frame, header.frame_id, stamp, wait)
        except Exception as error:  # tf2's exceptions have no common base that is known without tf2
            raise PoseError(str(error)) from error
        turn, shift = found.transform.rotation, found.transform.translation
        quaternion, translation = np.array([turn.x, turn.y, turn.z, turn.w]), np.array([shift.x, shift.y, shift.z])
        length = np.linalg.norm(quaternion)
        if not (np.isfinite(translation).all() and np.isfinite(length) and length > 1e-6):
            raise PoseError(f"the transform from {header.frame_id} to {frame} is no rigid motion")
        return quaternion / length, translation

    def follow(self, stamp: int) -> None:
        """Note the stamp of the next image, nanoseconds, before its pose is requested.  After a jump back the buffer is
        cleared: old transforms would shadow new ones, and tf2 accepts none 10 s older than its newest."""
        if stamp < self._stamp and self._buffer is not None:
            self._buffer.clear()
        self._stamp = stamp

    def close(self) -> None:
        """Stop listening until a frame is requested again."""
        if self._listener is not None:
            self._listener.unregister()
        self._buffer = self._listener = None


class Tracking:
    """Ids of the bodies of a node's frames; used by one thread, except for ``tally``.

    Ids outlive a restart after a fault: a body keeps its name.  ``poses`` are asked only while there is a fixed frame.
    """

    def __init__(self, node: Node, poses: CameraPoses) -> None:
        self._node, self._poses = node, poses
        self._session = TrackingSession()
        self._frame_id = ""
        self._fixed_frame: str | None = None
        self._origin: Hashable = None

    @property
    def tally(self) -> Tally:
        """Return the counts of the tracking session."""
        return self._session.tally

    def identify(
        self, recovery: FrameRecovery, origin: Hashable, frame: Frame, arrival: float, parameters: RecoverParameters
    ) -> Identified:
        """Return bodies with the ids of their tracks, or labels without ``tracking``; a change of ``origin``, method or
        model, ends the tracks.  ``arrival``: seconds, for images without stamp.  Raises ValueError if the tracker
        begins anew."""
        if not parameters.tracking:
            self._session.reset()
            return identify(recovery)
        if self._origin not in (None, origin):
            self._forget("bodies come from another method or model from now on")
        self._origin = origin
        before, self._fixed_frame = self._fixed_frame, parameters.fixed_frame
        if before not in (None, self._fixed_frame):
            self._forget(f"fixed_frame is {self._fixed_frame or 'none'} from now on")
        if not self._fixed_frame and frame.header.frame_id != self._frame_id:
            self._session.reset()  # another camera: its world is another one
            self._frame_id = frame.header.frame_id
        stamp, resets = 1e-9 * stamp_of(frame) or arrival, self._session.tally.resets
        pose, is_known = self._camera_pose(frame, parameters)
        try:
            tracks = self._session.follow(
                recovery.recovered, stamp, pose, is_pose_known=is_known, camera=frame.camera, depth=frame.depth
            )
        except (ValueError, ArithmeticError) as error:
            self._session.reset()
            raise ValueError(f"tracking: {error}") from error
        if self._session.tally.resets > resets:
            self._node.get_logger().info(f"the stamps jumped back to {stamp:.3f} s: tracks are dropped, ids continue")
        return identify(recovery, tracks, self._session.hidden)

    def _camera_pose(self, frame: Frame, parameters: RecoverParameters) -> tuple[Pose | None, bool]:
        """Return the camera's pose in ``fixed_frame``, None without such a frame, False if it is unknown."""
        if not parameters.fixed_frame:
            return None, True
        try:
            return self._poses.at(frame.header, parameters.fixed_frame, parameters.tf_tolerance), True
        except PoseError as error:
            self._node.get_logger().warning(
                f"no camera pose in fixed_frame, nothing is fused: {error}", throttle_duration_sec=THROTTLE
            )
            return None, False

    def _forget(self, why: str) -> None:
        self._session.reset()
        self._node.get_logger().info(f"{why}: tracks are dropped, ids continue")
