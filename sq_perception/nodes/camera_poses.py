"""Where the camera is in other frames, from tf2.

tf2_ros comes with a ROS installation and is not on PyPI: it is imported, and /tf listened to, only once a frame is
asked for; all frames share that one buffer.  Its listener's messages arrive in the node's executor;
:meth:`CameraPoses.at` waits in the thread that calls it and must not be called by the executor's.

A pose is (quaternion x y z w, translation), p_frame = R p_optical + t, metres.
"""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.time import Time

Pose = tuple[np.ndarray, np.ndarray]
_PATIENCE = Duration(seconds=0.1)
"""How long to wait for the transform of a frame that is already here."""
_LEAST_LENGTH = 1e-6


class PoseError(ValueError):
    """The pose of a frame is not known; says why."""


class CameraPoses:
    """Looks up poses of optical frames; without tf2 every look-up fails with that reason."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._buffer: Any = None
        self._listener: Any = None
        self._missing = ""

    def listen(self) -> None:
        """Begin to listen to /tf, if that was not done yet; a buffer knows only what it has heard."""
        if self._buffer is not None or self._missing:
            return
        try:
            tf2: Any = importlib.import_module("tf2_ros")
        except ImportError as error:
            self._missing = f"tf2_ros cannot be imported ({error})"
            return
        self._buffer = tf2.Buffer()
        self._listener = tf2.TransformListener(self._buffer, self._node)

    def at(self, header: Any, frame: str) -> Pose:
        """The pose of a header's frame in ``frame`` at its stamp, the newest for a stamp of 0.

        Raises
        ------
        PoseError
            If it is not known.
        """
        if header.frame_id == frame:
            return np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3)
        self.listen()
        if self._buffer is None:
            raise PoseError(self._missing)
        if not header.frame_id:
            raise PoseError("the image has no frame_id")
        try:
            found = self._buffer.lookup_transform(frame, header.frame_id, Time.from_msg(header.stamp), _PATIENCE)
        except Exception as error:  # tf2's exceptions have no common base that is known without tf2
            raise PoseError(str(error)) from error
        turn, shift = found.transform.rotation, found.transform.translation
        quaternion, translation = np.array([turn.x, turn.y, turn.z, turn.w]), np.array([shift.x, shift.y, shift.z])
        length = np.linalg.norm(quaternion)
        if not (np.isfinite(translation).all() and np.isfinite(length) and length > _LEAST_LENGTH):
            raise PoseError(f"the transform from {header.frame_id} to {frame} is no rigid motion")
        return quaternion / length, translation

    def clear(self) -> None:
        """Forget what was heard: after a jump back in time, transforms of the old time would shadow the new ones."""
        if self._buffer is not None:
            self._buffer.clear()

    def close(self) -> None:
        """Listen no more, until a frame is asked for again."""
        if self._listener is not None:
            self._listener.unregister()
        self._buffer = self._listener = None
