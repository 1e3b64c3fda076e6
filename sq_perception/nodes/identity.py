"""Which track of a node's session each body of a frame belongs to, and what is therefore published of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sq_perception.nodes.camera_poses import CameraPoses, PoseError
from sq_perception.nodes.frame import Frame
from sq_perception.recordings import publication
from sq_perception.recordings.publication import Identified
from sq_perception.recovery.recoverer import FrameRecovery
from sq_perception.tracking.session import Tally, TrackingSession


class Identity:
    """Gives ids; used by one thread, except for ``tally``.

    Parameters
    ----------
    poses
        Where the camera is; asked only while there is a fixed frame.
    warn, inform
        What takes texts for the log; ``warn`` with a kind to throttle by.
    """

    def __init__(self, poses: CameraPoses, warn: Callable[[str, str], None], inform: Callable[[str], None]) -> None:
        self._poses, self._warn, self._inform = poses, warn, inform
        self._session = TrackingSession()
        self._frame_id = ""
        self._fixed_frame: str | None = None
        self._untracked_stamp = 0.0

    @property
    def tally(self) -> Tally:
        """Counts of the tracking session."""
        return self._session.tally

    def untracked(self, recovery: FrameRecovery, frame: Frame) -> Identified:
        """Ids are labels; what was tracked is forgotten."""
        self._session.reset()
        stamp = _seconds(frame.header)
        if stamp < self._untracked_stamp:
            self._poses.clear()  # a recording begins again
        self._untracked_stamp = stamp
        return publication.untracked(recovery)

    def tracked(self, recovery: FrameRecovery, frame: Frame, arrival: float, fixed_frame: str = "") -> Identified:
        """Bodies and ids of their tracks.

        Parameters
        ----------
        arrival
            The time, seconds, of an image without stamp.
        fixed_frame
            Where bodies rest, empty where the camera stands still.  Another one than before is another world.

        Raises
        ------
        ValueError
            If the tracker cannot go on; it begins anew with the next frame.
        """
        if fixed_frame != self._fixed_frame:
            is_first, self._fixed_frame = self._fixed_frame is None, fixed_frame
            if not is_first:
                self._session.reset()
                self._inform(f"fixed_frame is {fixed_frame or 'none'} from now on: tracks are forgotten, ids go on")
        poses = self._poses if self._fixed_frame else None
        if poses is None and frame.header.frame_id != self._frame_id:
            self._session.reset()  # another camera: its world is another one
            self._frame_id = frame.header.frame_id
        stamp, resets = _seconds(frame.header) or arrival, self._session.tally.resets
        pose: Any = None
        is_known = True
        if poses is not None:
            try:
                pose = poses.at(frame.header, self._fixed_frame)
            except PoseError as error:
                is_known = False
                self._warn("camera pose", f"no camera pose in fixed_frame, nothing is fused: {error}")
        try:
            tracks = self._session.follow(
                recovery.recovered, stamp, pose, is_pose_known=is_known, camera=frame.camera, depth=frame.depth
            )
        except (ValueError, ArithmeticError) as error:
            self._session.reset()
            raise ValueError(f"tracking: {error}") from error
        if self._session.tally.resets > resets:
            self._inform(f"the stamps jumped back to {stamp:.3f} s: tracks are forgotten, ids go on")
            self._poses.clear()
        return publication.tracked(recovery, list(tracks), self._session.hidden)


def _seconds(header: Any) -> float:
    return float(header.stamp.sec) + 1e-9 * float(header.stamp.nanosec)
