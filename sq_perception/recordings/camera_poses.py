"""Camera poses of recorded frames, from a text file with a line a frame as in TUM RGB-D's trajectories:

    NAME tx ty tz qx qy qz qw

NAME is the frame's file (with or without its folders and suffix), its topic, or its stamp in seconds, to the
millisecond.  The pose leads from the frame's optical frame to a world that all share: p_world = R(q) p + t, metres.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sq_perception.recordings.frame_file import FrameError, RecordedFrame
from sq_perception.tracking.state import parse_pose

Pose = tuple[np.ndarray, np.ndarray]
"""Quaternion x y z w (4,), translation (3,)."""


class CameraPoses:
    """The poses of a file.

    Raises
    ------
    OSError
        If it cannot be read.
    ValueError
        If it is no such file; the message has the line.
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
        """The pose of a frame of this source; a FrameError if the file has none."""
        path = Path(file)
        names = [file, path.name, path.stem, frame.topic]
        names += [] if frame.stamp is None else [str(frame.stamp.sec + 1e-9 * frame.stamp.nanosec)]
        for name in names:
            if name and (pose := self._poses.get(_key(name))) is not None:
                return pose
        raise FrameError(f"{file}: {frame.name}: {self._path} has no pose for it")


def _key(name: str) -> str:
    """The name, of a number to the millisecond."""
    try:
        return f"{float(name):.3f}"
    except ValueError:
        return name
