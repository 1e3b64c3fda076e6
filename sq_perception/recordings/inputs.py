"""All frames that a user names: files, folders of files, and bags, one frame after the other.

A folder gives its frames and bags in natural order (frame_2 before frame_10), by their times where all names are times,
NPYs only where it has nothing else, as matrices of calibrations are such files too; one without any gives those of its
subfolders, down to four levels, or of the one called depth.  The camera of an image is one of
``camera_file.CAMERA_FILES`` beside it or in the folder that was named, else the YAML of its own name.  What cannot be
read comes as an error with the reason, in its place.

Bodies get ids by a tracking session over each sequence, a topic of a bag or the frames of one folder, of a camera that
stands still.  Frames without a stamp are taken to be INTERVAL apart.  With camera poses all frames show one scene that
rests, whatever their cameras and stamps are.  Poses are read from a text file with a line a frame as in TUM RGB-D's
trajectories, NAME tx ty tz qx qy qz qw.  NAME is the frame's file (with or without its folders and suffix), its topic,
or its stamp in seconds, to the millisecond.  The pose leads from the frame's optical frame to a world that all share:
p_world = R(q) p + t, metres.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np

from sq_perception.recordings import bag_file, camera_file, frame_file
from sq_perception.recordings.bag_file import InputOptions, RecordedBag
from sq_perception.recordings.camera_file import camera_beside, camera_in
from sq_perception.recordings.frame_file import FrameError, RecordedFrame, Stamp
from sq_perception.recovery.recoverer import FrameRecovery
from sq_perception.tracking.session import Followed, TrackingSession
from sq_perception.tracking.state import parse_pose
from sq_perception.tracking.tracker import Track

SUFFIXES = frame_file.SUFFIXES + bag_file.SUFFIXES

_Source: TypeAlias = tuple[Path, str | Path | None] | tuple[Path, FrameError]
"""A file with its camera, or what cannot be read, and why."""
_log = logging.getLogger(__name__)
ANY_SIZE = (640, 480)  # pixels, of images that nothing is known of yet
INTERVAL = 0.1  # seconds
Pose = tuple[np.ndarray, np.ndarray]  # quaternion x y z w (4,), translation (3,)


class RecordedInput:
    """Frames of the named files, folders and bags; iterating gives pairs of where each came from and what it is.

    ``names``: as the user gave them.  ``options``: all of their images by default.  ``is_done``: called with file,
    topic and stamp of each frame that counts; where it is true, the frame is neither read nor given.  Raises FrameError
    if there is something wrong with the camera_info.
    """

    def __init__(
        self, names: Sequence[str], options: InputOptions | None = None,
        is_done: Callable[[str, str, Stamp | None], bool] = lambda file, topic, stamp: False,
    ) -> None:
        self._options, self._is_done = options or InputOptions(), is_done
        if self._options.camera_info is not None:
            # Auto depends on what the images are called.
            treatment = "ignore" if self._options.distortion == "auto" else self._options.distortion
            camera_file.read_calibration(self._options.camera_info, treatment, size=ANY_SIZE)
        self._sources = [source for name in names for source in self._name(name)]
        self.total = len(self._sources)  # frames to expect; a bag counts as one until it is opened

    @property
    def files(self) -> list[Path]:
        """Files that are read: frames, bags and what is in them, cameras, and masks."""
        sources = [(path, rest) for path, rest in self._sources if not isinstance(rest, FrameError)]
        cameras = dict.fromkeys(Path(rest) for _, rest in sources if rest is not None)
        within = [inner for path, _ in sources if path.is_dir() for inner in sorted(path.iterdir())]
        masks = self._options.reading.masks
        found = [*cameras, *(path for path, _ in sources), *within, *([] if masks is None else sorted(masks.iterdir()))]
        return [path for path in found if path.exists()]

    def __iter__(self) -> Iterator[tuple[str, RecordedFrame | FrameError]]:
        for path, rest in self._sources:
            if isinstance(rest, FrameError):
                yield str(path), rest
            elif bag_file.is_bag(path):
                yield from self._bag(path)
            elif self._is_done(str(path), "", frame_file.stamp_of(path)):
                self.total -= 1
            else:
                yield str(path), self._file(path, rest)

    def _name(self, name: str) -> list[_Source]:
        if not name:  # a variable of a shell that is not set: the current folder is called "."
            return [(Path(), FrameError("expected the name of a file or folder, got an empty one"))]
        path = Path(name)
        try:
            if not path.is_dir() or bag_file.is_bag(path):
                return [(path, self._options.camera_info or camera_beside(path))]
        except OSError as error:  # a folder that may not be looked into, a name that is too long
            return [(path, FrameError(str(error)))]
        self._are_deeper = False
        found = self._in_folders(path, None)
        if self._are_deeper:
            _log.warning("%s: folders in it are looked into for 4 levels, and not farther down", path)
        return found or [(path, FrameError(f"{path}: no frames in it ({', '.join(SUFFIXES)})"))]

    def _in_folders(self, folder: Path, above: str | Path | None, levels: int = 4) -> list[_Source]:
        """List the frames of a folder, or of those in it, with their camera, which may be that of ``above``."""
        try:
            camera_info = self._options.camera_info or camera_in(folder) or above
            if found := in_folder(folder):
                _log.info("%s: %d frames, camera %s", folder, len(found), camera_info or "of the files")
                chosen = found[:: self._options.every][: self._options.limit]
                return [(path, camera_info or camera_beside(path)) for path in chosen]
            folders = [inner for inner in folder.iterdir() if inner.is_dir() and not inner.is_symlink()]
        except OSError as error:
            return [(folder, FrameError(f"{folder}: {error}"))]
        if folders and levels == 0:
            self._are_deeper = True
            return []
        folders = [inner for inner in folders if inner.name.lower() == "depth"] or sorted(folders, key=_natural)
        return [one for inner in folders for one in self._in_folders(inner, camera_info, levels - 1)]

    def _file(self, path: Path, camera_info: str | Path | None) -> RecordedFrame | FrameError:
        try:
            options = self._options
            return frame_file.read(path, camera_info, options.projection, options.distortion, options.reading)
        except FrameError as error:
            return error

    def _bag(self, path: Path) -> Iterator[tuple[str, RecordedFrame | FrameError]]:
        try:
            bag = RecordedBag(path, self._options, lambda stamp: self._is_done(str(path), bag.topic, stamp))
        except FrameError as error:
            yield str(path), error
            return
        with bag:
            self.total += max(len(bag), 1) - 1
            for frame in bag:
                yield str(path), frame


def in_folder(folder: Path) -> list[Path]:
    """Return the frames and bags in a folder: by their times where all names are times, else in natural order."""
    within = sorted(folder.iterdir(), key=_natural)
    is_frame = [path.suffix.lower() in frame_file.SUFFIXES and not path.is_dir() for path in within]  # or a broken link
    found = [path for path, wanted in zip(within, is_frame, strict=True) if wanted or bag_file.is_bag(path)]
    found = [path for path in found if path.suffix.lower() != ".npy"] or found
    times = {path: stamp for path in found if (stamp := frame_file.stamp_of(path))}
    return found if len(times) < len(found) else sorted(found, key=times.__getitem__)


def _natural(path: Path) -> tuple[list[str | int], str]:
    """Return a key of natural order: every second part of a name is a number."""
    parts = re.split(r"(\d+)", path.name.lower())
    return [int(part) if k % 2 else part for k, part in enumerate(parts)], path.name


class CameraPoses:
    """The poses of a file.  Raises OSError if it cannot be read; ValueError if it is no such file; the message has the
    line."""

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


def sequence_of(file: str, frame: RecordedFrame) -> tuple[str, str]:
    """Return a key that the frames of one sequence share: their bag and topic, or the folder of the source."""
    return (file, frame.topic) if frame.topic else (str(Path(file).parent), "")


class RecordedTracks:
    """Follows the bodies of one sequence after the other; ``warn`` is called once where stamps are missing."""

    def __init__(self, warn: Callable[[str], object], poses: CameraPoses | None = None) -> None:
        self._warn, self._poses = warn, poses
        self._session = TrackingSession()
        self._sequence: tuple[str, str] | None = None
        self._number = 0
        self._warned = False

    def follow(self, file: str, frame: RecordedFrame, recovery: FrameRecovery) -> tuple[Followed, ...]:
        """Return each body that did not fail, in their order, as its track knows it; ``file`` is the frame's source.
        Raises FrameError for a frame without a pose, where there are poses."""
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
