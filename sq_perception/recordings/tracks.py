"""Ids for bodies of recorded frames: a tracking session over each sequence that a user names.

A sequence is a topic of a bag, or the frames of one folder, in their order, of a camera that stands still.  Where
frames have no stamp they are taken to be INTERVAL apart.  With camera poses all frames show one scene that rests,
whatever their cameras and stamps are.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from sq_perception.recordings.camera_poses import CameraPoses
from sq_perception.recordings.frame_file import RecordedFrame
from sq_perception.recovery.recoverer import FrameRecovery
from sq_perception.tracking.session import Followed, TrackingSession
from sq_perception.tracking.tracker import Track

INTERVAL = 0.1
"""Seconds."""


def sequence_of(file: str, frame: RecordedFrame) -> tuple[str, str]:
    """A key that the frames of one sequence share: their bag and topic, or their folder; ``file`` is the source."""
    return (file, frame.topic) if frame.topic else (str(Path(file).parent), "")


class RecordedTracks:
    """Follows the bodies of one sequence after the other; ``warn`` is called once where stamps are missing."""

    def __init__(self, warn: Callable[[str], None], poses: CameraPoses | None = None) -> None:
        self._warn, self._poses = warn, poses
        self._session = TrackingSession()
        self._sequence: tuple[str, str] | None = None
        self._number = 0
        self._warned = False

    def follow(self, file: str, frame: RecordedFrame, recovery: FrameRecovery) -> tuple[Followed, ...]:
        """Each body that did not fail, in their order, as its track knows it; ``file`` is the frame's source.

        Raises FrameError for a frame without a pose, where there are poses.
        """
        if self._poses is not None:
            pose = self._poses.of(file, frame)
            return self._session.follow(recovery.recovered, 0.0, pose, camera=frame.camera, depth=frame.depth)
        sequence = sequence_of(file, frame)
        if sequence != self._sequence:
            self._session.reset()
            self._sequence, self._number = sequence, 0
        stamp = self._number * INTERVAL if frame.stamp is None else frame.stamp.sec + 1e-9 * frame.stamp.nanosec
        self._number += 1
        if frame.stamp is None and not self._warned:
            self._warn(f"{file}: no stamp; such frames are taken to be {INTERVAL:g} s apart")
            self._warned = True
        return self._session.follow(recovery.recovered, stamp, camera=frame.camera, depth=frame.depth)

    @property
    def scene(self) -> tuple[Track, ...]:
        """The bodies of the whole scene in its world, with camera poses; empty without."""
        return self._session.tracks if self._poses is not None else ()
