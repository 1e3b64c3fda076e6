"""Results of recorded frames as a bag: one MCAP file that Foxglove, ``ros2 bag play`` and RViz open; needs no ROS.

| topic | type | |
| --- | --- | --- |
| `/recover_node/superquadrics` | sensor_msgs/PointCloud2 | as recover_node publishes them |
| `/recover_node/markers` | visualization_msgs/MarkerArray | likewise |
| the input's, or `/depth/image` | sensor_msgs/Image | the depth that was read, in the input's encoding |
| `camera_info` beside it | sensor_msgs/CameraInfo | the camera that was used: rectified, without distortion |
| `/recover_node/rendered_depth` | sensor_msgs/Image | on request: the recovered bodies |
| `/mask/image` | sensor_msgs/Image | on request: the labels that bodies were recovered from |

Depth that was read with another scale than its encoding's is written in 32FC1.

Every message of a frame has its stamp and frame id.  Of a frame without a stamp it is INTERVAL after that of the frame
before, the first one at INTERVAL, as time 0 means "unknown" in ROS: the same input gives the same times.  A frame that
was no message has the frame id of the synthetic camera.  Messages are logged when the bag received the image; failing
that, at the stamp.

An interrupted run leaves a whole file of fewer frames; a full disk leaves one without an index, from which
``mcap recover`` makes a file.  rosbags' classes of messages want every field, and arrays of NumPy.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache
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
from sq_perception.recordings.inputs import INTERVAL
from sq_perception.recordings.publication import CAMERA_FRAME, CUBE_FRAME, Findings, Identified
from sq_perception.recovery.recoverer import FrameRecovery, render_recovery
from sq_perception.tracking.session import Followed

try:
    from mcap.writer import Writer
    from rosbags.interfaces import Nodetype
    from rosbags.typesys import Stores, get_typestore
except ImportError as missing:
    module = (missing.name or "").partition(".")[0]
    raise ImportError(f"writing bags needs the module {module!r}: pip install 'sq_perception[bags]'") from missing

BagImage = Literal["depth", "rendered", "labels"]
SUFFIX = ".mcap"
CHUNK_BYTES = 4 * 2**20  # bytes of messages in a chunk: enough to pack well, little to lose
SUPERQUADRICS, MARKERS = "/recover_node/superquadrics", "/recover_node/markers"
RENDERED, LABELS, DEPTH = "/recover_node/rendered_depth", "/mask/image", "/depth/image"
_SECOND = 10**9
_STORE: Any = get_typestore(Stores.ROS2_JAZZY)


class ResultBag:
    """A bag that takes one frame after the other; close it, or use it as a context manager.

    ``path``: a name that ends in SUFFIX; a file that is there is replaced when this one is whole.  ``images``: which
    images to write beside the results.  Raises OSError if the file cannot be written; the message names what became of
    it; ValueError for a wrong path or kind of image.
    """

    def __init__(self, path: str | Path, images: Sequence[BagImage] = ("depth",)) -> None:
        unknown = [image for image in images if image not in get_args(BagImage)]
        if unknown:
            raise ValueError(f"images: expected {', '.join(get_args(BagImage))}, got {', '.join(unknown)}")
        if Path(path).suffix.lower() != SUFFIX or Path(path).is_dir():
            raise ValueError(f"{path}: expected the name of a file that ends in {SUFFIX}")
        self._images = set(images)
        self._frames = 0
        self._last = Stamp(0, 0)
        self._output = OutputFile(path)
        self._file = self._output.partial.open("wb")
        self._writer = Writer(self._file, CHUNK_BYTES)
        self._writer.start("ros2", "sq_perception")
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}
        # Apart from the main thread, whose interrupt then finds no half message.
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="mcap")

    def __enter__(self) -> ResultBag:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.close(whole=kind is None)

    def add(self, frame: RecordedFrame, recovery: FrameRecovery, tracks: Sequence[Followed] | None) -> None:
        """Write a frame, its recovery, and the ``tracks`` of the bodies that did not fail, None without tracking.
        Raises FrameError for a name too long for a message; OSError if the disk is full, after which the file is
        closed."""
        found = publication.identify(recovery, tracks)
        stamp = self._stamp(frame)
        received = frame.received if frame.received is not None else stamp.sec * _SECOND + stamp.nanosec
        shown = publication.findings(found, self._header(frame, stamp), frame.is_cube)
        messages = self._messages(frame, found, shown)
        self._run(self._write, messages, min(max(received, 0), 2**63 - 1))
        self._frames, self._last = self._frames + 1, stamp

    def close(self, whole: bool = True) -> Path | None:
        """Finish the file and give it its name; return where it is, None without a frame.  If it is not ``whole``, a
        file that is there stays and this one is put beside it."""
        if self._file.closed:
            return None
        if not self._frames:
            self._file.close()
            self._output.discard()
            return None
        self._run(self._writer.finish)
        self._run(self._file.close)
        self._thread.shutdown()
        return self._output.commit(whole)

    def _run(self, action: Callable[..., None], *arguments: Any) -> None:
        """Run an action in the thread; if it fails, keep what the file has.  The writer cannot take anything back."""
        try:
            self._thread.submit(action, *arguments).result()
        except OSError as error:
            with suppress(OSError):  # what was left in its buffer has no more room
                self._file.close()
            kept = "kept without an index, from which 'mcap recover' makes a file"
            raise OSError(error.errno, f"{error.strerror or error}; {kept}", str(self._output.keep())) from error

    def _write(self, messages: Sequence[tuple[str, Any]], time: int) -> None:
        for topic, message in messages:
            kind = message.__msgtype__
            if kind not in self._schemas:
                self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", definition(kind).encode())
            if (topic, kind) not in self._channels:
                self._channels[topic, kind] = self._writer.register_channel(topic, "cdr", self._schemas[kind])
            self._writer.add_message(self._channels[topic, kind], time, as_cdr(message), time)

    def _messages(self, frame: RecordedFrame, found: Identified, shown: Findings) -> list[tuple[str, Any]]:
        """Return topics and messages of a frame."""
        header, messages = shown.header, []
        encoding = frame.encoding or ("mono16" if frame.is_cube else "32FC1")
        if "depth" in self._images:
            topic = raw_topic(frame.topic)
            results = (SUPERQUADRICS, MARKERS, RENDERED, LABELS)
            if not re.fullmatch(r"(/[A-Za-z_][A-Za-z0-9_]*)+", topic) or len(topic) > 255 or topic in results:
                topic = DEPTH
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
        messages.append((MARKERS, shown.markers(types=types)))
        if "rendered" in self._images:
            depth, _ = render_recovery(found.recovery, frame.camera)
            messages.append((RENDERED, publication.depth_message(depth, header, encoding, types)))
        return messages

    def _header(self, frame: RecordedFrame, stamp: Stamp) -> Any:
        frame_id = frame.frame_id if frame.topic else (CUBE_FRAME if frame.is_cube else CAMERA_FRAME)
        if len(frame_id) > 255:  # a damaged recording's must not be copied into every marker
            raise FrameError(f"{frame.name}: frame_id: expected at most 255 letters, got {len(frame_id)}")
        time = types("builtin_interfaces/msg/Time")(sec=stamp.sec, nanosec=stamp.nanosec)
        return types("std_msgs/msg/Header")(stamp=time, frame_id=frame_id)

    def _stamp(self, frame: RecordedFrame) -> Stamp:
        """Return the frame's stamp, or one after the last where it has none that a message can hold."""
        latest = 2**31 - 1
        if frame.stamp is not None and frame.stamp.sec <= latest:
            return frame.stamp
        last = self._last.sec * _SECOND + self._last.nanosec
        return Stamp(*divmod(min(last + round(INTERVAL * _SECOND), latest * _SECOND), _SECOND))


@cache
def types(name: str) -> Callable[..., Any]:
    """Return what makes messages of ``package/msg/Name`` from keywords; fields left out have ROS's defaults.  Raises
    KeyError for a type that ROS 2 Jazzy's common interfaces do not have."""
    kind, defaults = _STORE.types[name], _defaults(name)
    return lambda **given: kind(**{**defaults, **given})


def definition(name: str) -> str:
    """Return the text of ``package/msg/Name`` and of all that it contains, as rosbag2 stores it beside messages."""
    return str(_STORE.generate_msgdef(name, ros_version=2)[0])


def as_cdr(message: Any) -> bytes:
    """Return a message's bytes, little endian, with their encapsulation header."""
    name = message.__msgtype__
    for field, default in _defaults(name).items():
        if isinstance(default, np.ndarray):
            setattr(message, field, np.asarray(getattr(message, field), default.dtype))
    return bytes(_STORE.serialize_cdr(message, name))


@cache
def _defaults(name: str) -> dict[str, Any]:
    """Return the fields of an empty message, shared between messages: they are written and never changed."""
    declared = {"w": 1.0} if name == "geometry_msgs/msg/Quaternion" else {}  # which rosbags does not keep
    return {field: _default(description) for field, description in _STORE.fielddefs[name][1]} | declared


def _default(description: Any) -> Any:
    node, detail = description
    if node == Nodetype.NAME:
        return types(detail)()
    if node == Nodetype.BASE:
        return "" if detail[0] == "string" else _dtype(detail[0]).type(0).item()
    inner, length = detail
    if inner[0] == Nodetype.BASE and inner[1][0] != "string":
        return np.zeros(length if node == Nodetype.ARRAY else 0, _dtype(inner[1][0]))
    return [_default(inner) for _ in range(length)] if node == Nodetype.ARRAY else []


def _dtype(base: str) -> np.dtype[Any]:
    return np.dtype("uint8" if base in ("byte", "char") else base)
