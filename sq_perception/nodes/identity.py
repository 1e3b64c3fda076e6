"""What a node publishes as the id of each body, and the bodies themselves: with tracking those of the tracks.

Without tracking ids are mask labels and the bodies are those of the frame.  Residual, score and status are always the
frame's own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from sq_perception.fitting.fit import Status
from sq_perception.nodes.camera_poses import CameraPoses, PoseError
from sq_perception.nodes.frame import Frame
from sq_perception.recovery import FrameRecovery
from sq_perception.tracking.session import FIRST_FAILED_ID, Tally, TrackingSession


@dataclass(frozen=True, eq=False)
class Identified:
    """The objects of a frame as they are published, the id of each, and ids of tracks that the frame does not show."""

    recovery: FrameRecovery
    ids: tuple[int, ...]
    hidden: tuple[int, ...] = ()


class Identity:
    """Gives ids; used by one thread, except for ``tally``.

    Parameters
    ----------
    poses
        Where the camera is; asked only while there is a fixed frame.
    warn, inform
        What takes texts for the log; ``warn`` with a kind to throttle by.
    fixed_frame
        Where bodies rest at first; empty where the camera stands still.
    """

    def __init__(
        self,
        poses: CameraPoses,
        warn: Callable[[str, str], None],
        inform: Callable[[str], None],
        fixed_frame: str = "",
    ) -> None:
        self._poses, self._warn, self._inform = poses, warn, inform
        self._session = TrackingSession()
        self._frame_id = ""
        self._fixed_frame = fixed_frame

    @property
    def tally(self) -> Tally:
        """Counts of the tracking session."""
        return self._session.tally

    def untracked(self, recovery: FrameRecovery) -> Identified:
        """Ids are labels; what was tracked is forgotten."""
        self._session.reset()
        return Identified(recovery, tuple(one.label for one in recovery.bodies))

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
            self._session.reset()
            self._fixed_frame = fixed_frame
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
            tracks = iter(
                self._session.follow(
                    recovery.recovered, stamp, pose, is_pose_known=is_known, camera=frame.camera, depth=frame.depth
                )
            )
        except (ValueError, ArithmeticError) as error:
            self._session.reset()
            raise ValueError(f"tracking: {error}") from error
        if self._session.tally.resets > resets:
            self._inform(f"the stamps jumped back to {stamp:.3f} s: tracks are forgotten, ids go on")
            self._poses.clear()
        bodies, ids = [], []
        for one in recovery.bodies:
            if one.status == Status.FAILED:
                bodies.append(one)
                ids.append(FIRST_FAILED_ID + one.label)
                continue
            track = next(tracks)
            covariance, sigma = track.covariance, track.sigma_size
            bodies.append(replace(one, superquadric=track.superquadric, covariance=covariance, sigma_size=sigma))
            ids.append(track.id)
        return Identified(replace(recovery, bodies=tuple(bodies)), tuple(ids), self._session.hidden)


def _seconds(header: Any) -> float:
    return float(header.stamp.sec) + 1e-9 * float(header.stamp.nanosec)
