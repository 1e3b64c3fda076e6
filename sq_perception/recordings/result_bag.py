"""Results of recorded frames as a bag: one MCAP file that Foxglove, ``ros2 bag play`` and RViz open; needs no ROS.

| topic | type | |
| --- | --- | --- |
| `/recover_node/superquadrics` | sensor_msgs/PointCloud2 | as recover_node publishes them |
| `/recover_node/markers` | visualization_msgs/MarkerArray | likewise; markers of bodies that are gone are deleted |
| the input's, or `/depth/image` | sensor_msgs/Image | the depth that was read, in the input's encoding |
| `camera_info` beside it | sensor_msgs/CameraInfo | the camera that was used: rectified, without distortion |
| `/recover_node/rendered_depth` | sensor_msgs/Image | on request: the recovered bodies |
| `/mask/image` | sensor_msgs/Image | on request: the labels that bodies were recovered from |

Depth that was read with another scale than its encoding's is written in 32FC1.

Every message of a frame has its stamp and frame id.  Of a frame without a stamp it is INTERVAL after that of the frame
before, the first one at INTERVAL, as time 0 means "unknown" in ROS: the same input gives the same times.  A frame that
was no message has the frame id of the synthetic camera.  Messages are logged when the bag received the image; failing
that, at the stamp.

The file is written as ``<name>.partial`` and takes its name when it is whole (:mod:`sq_perception.files.output_file`).
It is closed properly with what there is where the run is interrupted or the disk is full, and then leaves an older file
alone; where even that fails the partial file stays, from which ``mcap recover`` makes a file.  Frames are held in
memory until they fill a chunk, whatever the length of the recording.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from sq_msgs_py import depth_image
from sq_msgs_py.superquadrics import to_message
from sq_perception.files.output_file import OutputFile
from sq_perception.imaging.calibration import intrinsics
from sq_perception.recordings import publication
from sq_perception.recordings.bag_reader import camera_info_topic, raw_topic
from sq_perception.recordings.frame_file import FrameError, RecordedFrame, Stamp
from sq_perception.recordings.publication import CAMERA_FRAME, CUBE_FRAME, Findings, Identified
from sq_perception.recordings.tracks import INTERVAL
from sq_perception.recovery.recoverer import FrameRecovery, render_recovery
from sq_perception.tracking.session import Followed

try:
    from sq_perception.recordings import bag_messages
    from sq_perception.recordings.mcap_file import LATEST, McapFile
except ImportError as missing:
    module = (missing.name or "").partition(".")[0]
    raise ImportError(f"writing bags needs the module {module!r}: pip install 'sq_perception[bags]'") from missing

BagImage = Literal["depth", "rendered", "labels"]
SUFFIX = ".mcap"

SUPERQUADRICS, MARKERS = "/recover_node/superquadrics", "/recover_node/markers"
RENDERED, LABELS, DEPTH = "/recover_node/rendered_depth", "/mask/image", "/depth/image"
LONGEST_NAME = 255
"""Letters of a topic or frame id: a damaged recording's must not be copied into every marker."""

_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_SECOND = 10**9
_LAST_SECOND = 2**31 - 1


class ResultBag:
    """Writes frames one after the other; close it, or use it as a context manager.

    Parameters
    ----------
    path
        Of the file, which ends in SUFFIX; one that is there is replaced when this one is whole.
    images
        Which images to write beside the results.

    Raises
    ------
    OSError
        If the file cannot be written; the message names what became of it.
    ValueError
        For a path or kind of image that is none.
    """

    def __init__(self, path: str | Path, images: Sequence[BagImage] = ("depth",)) -> None:
        unknown = [image for image in images if image not in get_args(BagImage)]
        if unknown:
            raise ValueError(f"images: expected {', '.join(get_args(BagImage))}, got {', '.join(unknown)}")
        self._path = Path(path)
        if self._path.suffix.lower() != SUFFIX or self._path.is_dir():
            raise ValueError(f"{path}: expected the name of a file that ends in {SUFFIX}")
        self._images = set(images)
        self._frames = 0
        self._shown_ids: list[int] = []
        self._last = Stamp(0, 0)
        self._output = OutputFile(self._path, f"{self._path.name}.partial")
        self._raw = self._output.partial.open("wb")
        self._file = McapFile(self._raw, "sq_perception", bag_messages.definition)

    def __enter__(self) -> ResultBag:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.close(whole=kind is None)

    def add(self, frame: RecordedFrame, recovery: FrameRecovery, tracks: Sequence[Followed] | None) -> None:
        """Write a frame and what was recovered from it.

        Parameters
        ----------
        frame, recovery
            Of each other.
        tracks
            Of each body that did not fail, in their order; None if bodies are not tracked.

        Raises
        ------
        FrameError
            If a name in the recording is too long to be one.
        OSError
            If the disk is full; the file is then closed with what there is.
        """
        found = publication.identify(recovery, tracks)
        stamp = self._stamp(frame)
        received = frame.received if frame.received is not None else stamp.sec * _SECOND + stamp.nanosec
        shown = publication.findings(found, self._header(frame, stamp), frame.is_cube)
        messages = self._messages(frame, found, shown)
        group = [(topic, message.__msgtype__, bag_messages.as_cdr(message)) for topic, message in messages]
        self._frames += 1
        self._shown_ids, self._last = shown.shown_ids, stamp
        try:
            self._file.add(group, min(max(received, 0), LATEST))
        except OSError as error:
            place = self.close(whole=False)
            written = self._file.groups
            kept = f"the first {written} of {self._frames} frames are kept" if written else "nothing is kept"
            raise OSError(error.errno, f"{_reason(error)}; {kept}", str(place or self._path)) from error

    def close(self, whole: bool = True) -> Path | None:
        """Finish the file and give it its name; returns where it is, None without a frame.

        Parameters
        ----------
        whole
            Whether these are all frames that were to be; if not, a file that is there stays and this one is put beside
            it.

        Raises
        ------
        OSError
            As :meth:`add`.
        """
        if self._raw.closed:
            return None
        if not self._file.groups:
            self._raw.close()
            self._output.discard()
            return None
        try:
            self._file.finish()
            self._raw.close()
        except OSError as error:
            with suppress(OSError):  # what was left in its buffer has no more room
                self._raw.close()
            text = f"{_reason(error)}; kept without an index, from which 'mcap recover' makes a file"
            raise OSError(error.errno, text, str(self._output.keep())) from error
        return self._output.commit(whole)

    # frames

    def _messages(self, frame: RecordedFrame, found: Identified, shown: Findings) -> list[tuple[str, Any]]:
        """Topics and messages of a frame."""
        types, header, messages = bag_messages.types, shown.header, []
        encoding = frame.encoding or ("mono16" if frame.is_cube else "32FC1")
        if "depth" in self._images:
            topic = _depth_topic(frame.topic)
            if not frame.is_cube:
                info = depth_image.intrinsics_to_message(intrinsics(frame.camera), header, types)
                messages.append((camera_info_topic(topic), info))
            messages.append((topic, publication.depth_message(frame.depth, header, encoding, types)))
        if "labels" in self._images:
            labels = np.maximum(found.recovery.labels, 0)
            # Not 16UC1, which would look like depth to whoever reads the file.
            kind = "mono16" if labels.max(initial=0) <= np.iinfo(np.uint16).max else "32SC1"
            messages.append((LABELS, depth_image.labels_to_message(labels, header, kind, types)))
        messages.append((SUPERQUADRICS, to_message(shown.cloud, header, types)))
        messages.append((MARKERS, shown.markers(self._shown_ids, types=types)))
        if "rendered" in self._images:
            depth, _ = render_recovery(found.recovery, frame.camera)
            messages.append((RENDERED, publication.depth_message(depth, header, encoding, types)))
        return messages

    def _header(self, frame: RecordedFrame, stamp: Stamp) -> Any:
        frame_id = frame.frame_id if frame.topic else (CUBE_FRAME if frame.is_cube else CAMERA_FRAME)
        if len(frame_id) > LONGEST_NAME:
            raise FrameError(f"{frame.name}: frame_id: expected at most {LONGEST_NAME} letters, got {len(frame_id)}")
        time = bag_messages.types("builtin_interfaces/msg/Time")(sec=stamp.sec, nanosec=stamp.nanosec)
        return bag_messages.types("std_msgs/msg/Header")(stamp=time, frame_id=frame_id)

    def _stamp(self, frame: RecordedFrame) -> Stamp:
        """The frame's, or one after the last where it has none that a message can hold."""
        if frame.stamp is not None and frame.stamp.sec <= _LAST_SECOND:
            return frame.stamp
        last = self._last.sec * _SECOND + self._last.nanosec
        return Stamp(*divmod(min(last + round(INTERVAL * _SECOND), _LAST_SECOND * _SECOND), _SECOND))


def _reason(error: OSError) -> str:
    return error.strerror or str(error)


def _depth_topic(topic: str) -> str:
    """The input's, unless it is none, or one of the results."""
    topic = raw_topic(topic)
    fits = _TOPIC.fullmatch(topic) is not None and len(topic) <= LONGEST_NAME
    return topic if fits and topic not in (SUPERQUADRICS, MARKERS, RENDERED, LABELS) else DEPTH
