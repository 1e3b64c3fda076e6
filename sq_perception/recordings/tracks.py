"""Ids for bodies of recorded frames: a tracking session over each sequence that a user names, or over one still scene.

A sequence is a topic of a bag, or the frames of one folder, in their order, of a camera that stands still.  Where
frames have no stamp they are taken to be INTERVAL apart.  With camera poses all frames show one scene that rests,
whatever their cameras and stamps are.  Poses are read from a text file with a line a frame as in TUM RGB-D's
trajectories:

    NAME tx ty tz qx qy qz qw

NAME is the frame's file (with or without its folders and suffix), its topic, or its stamp in seconds, to the
millisecond.  The pose leads from the frame's optical frame to a world that all share: p_world = R(q) p + t, metres.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from sq_perception.recordings.frame_file import FrameError, RecordedFrame
from sq_perception.recovery.recoverer import FrameRecovery
from sq_perception.tracking.session import Followed, TrackingSession
from sq_perception.tracking.state import parse_pose
from sq_perception.tracking.tracker import Track

Pose = tuple[np.ndarray, np.ndarray]
"""Quaternion x y z w (4,), translation (3,)."""


class CameraPoses:
    """The poses of a file.

    Raises OSError if it cannot be read; ValueError if it is no such file; the message has the line.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._poses: dict[str, Pose] = {}
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            words = line.partition("#")[0].split()
            if not words:
                continue
            try:
                name, values = words[0], [float(word) for word in words[1:]]
                pose = parse_pose((values[3:], values[:3]))
            except ValueError as error:
                expected = f"{path}: line {number}: expected a name, tx ty tz and a rotation qx qy qz qw, got {line!r}"
                raise ValueError(expected) from error
            if self._poses.setdefault(_key(name), pose) is not pose:
                raise ValueError(f"{path}: line {number}: {name} has a pose already")

    def of(self, file: str, frame: RecordedFrame) -> Pose:
        """Return the pose of a frame of this source; a FrameError if the file has none."""
        path = Path(file)
        names = [file, path.name, path.stem, frame.topic]
        names += [] if frame.stamp is None else [str(frame.stamp.sec + 1e-9 * frame.stamp.nanosec)]
        for name in names:
            if name and (pose := self._poses.get(_key(name))) is not None:
                return pose
        raise FrameError(f"{file}: {frame.name}: {self._path} has no pose for it")


def _key(name: str) -> str:
    """Return the name, of a number to the millisecond."""
    try:
        return f"{float(name):.3f}"
    except ValueError:
        return name


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
        """Return each body that did not fail, in their order, as its track knows it; ``file`` is the frame's source.

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
