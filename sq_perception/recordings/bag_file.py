"""Depth images from rosbag2 recordings, without a ROS installation.

A bag is a folder with ``metadata.yaml``, or a lone ``.mcap`` or ``.db3`` file.  The images come from one topic, found
by type and encoding:

| type | encoding | depth |
| --- | --- | --- |
| sensor_msgs/Image | 16UC1, 32FC1 | millimetres, metres (REP 118) |
| sensor_msgs/CompressedImage | 16UC1, 32FC1 of the compressedDepth transport, PNG or RVL | likewise |
| sensor_msgs/Image, orthographic | mono8, mono16 | grey values of the unit cube |

Label images on the one topic that is called ``mask/image``, with or without a name before it, are the masks of the
images with their stamps; they may have been recorded later.

The camera is that of the sibling topic ``camera_info``, as image_transport pairs them: the message with the image's
stamp; failing that, the last one before the image; failing that, the bag's first, however late.  The name of their
topic decides whether images are raw and have to be rectified (:mod:`sq_perception.imaging.calibration`).

A bag may be damaged or hostile.  Its message definitions are not used: they would become Python code, and the three
types read here are the same in every ROS 2.  What unpacks is bounded before it unpacks, and pixels are only allocated
for data that is there.

Reference: rosbags, https://ternaris.gitlab.io/rosbags; MCAP, https://mcap.dev/spec
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from sq_msgs_py import depth_image
from sq_perception.files import plain_yaml
from sq_perception.imaging import compressed_depth, unit_cube
from sq_perception.imaging.calibration import Calibration, Treatment
from sq_perception.imaging.camera import Projection
from sq_perception.recordings.frame_file import MILLIMETRES, FrameError, Reading, RecordedFrame, Stamp

SUFFIXES = (".mcap", ".db3")
LARGEST = 2**29
"""Bytes of one message, or of one unpacked chunk of messages."""

_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_MASKS = "/mask/image"
_PEEKED = 10
"""Messages of a topic after which it shows no depth: the first ones may be damaged."""
_ZSTD = b"\x28\xb5\x2f\xfd"
"""What packed messages begin with; a plain one begins with the byte 0."""


def is_bag(path: str | Path) -> bool:
    """Whether a path looks like a recording, from the outside."""
    path = Path(path)
    return (path / "metadata.yaml").is_file() if path.is_dir() else path.suffix.lower() in SUFFIXES


def raw_topic(topic: str) -> str:
    """The topic that shows the images of a compressedDepth topic as they are; any other topic itself."""
    return topic.removesuffix(f"/{compressed_depth.TRANSPORT}")


def camera_info_topic(topic: str) -> str:
    """The camera_info topic of an image topic."""
    return raw_topic(topic).rpartition("/")[0] + "/camera_info"


class RecordedBag:
    """One depth topic of a bag; iterating gives its frames once, in the order they were recorded.

    A message that cannot be read comes as the FrameError that says why, and the next one follows.  Close it, or use it
    as a context manager.

    Parameters
    ----------
    path
        Of the folder or file.
    topic
        Of the images; needed where several show depth.
    camera_info
        Anything with the fields of sensor_msgs/CameraInfo, or a function of an image's width and height that gives it;
        goes before those in the bag.
    projection
        "orthographic" looks for grey images of the unit cube.
    every, limit
        Every n-th image only, and at most so many.
    distortion
        "auto", "apply" or "ignore", see :mod:`sq_perception.imaging.calibration`.
    reading
        What is taken of each image; masks are files called as the frames are.
    is_done
        Asked with the stamp of each image that counts; where it says yes, the image is neither decoded nor given.

    Raises
    ------
    FrameError
        If the bag cannot be read, or has not exactly one topic to read; the message lists what it has.
    """

    def __init__(
        self,
        path: str | Path,
        topic: str | None = None,
        camera_info: Any = None,
        projection: Projection = "pinhole",
        every: int = 1,
        limit: int | None = None,
        distortion: Treatment = "auto",
        reading: Reading | None = None,
        is_done: Callable[[Stamp], bool] = lambda stamp: False,
    ) -> None:
        if every < 1 or (limit is not None and limit < 1):
            raise ValueError(f"every, limit: expected at least 1, got {every} and {limit}")
        self._path = Path(path)
        self._name = self._path.resolve().name if self._path.is_dir() else self._path.stem
        self._camera_info = camera_info
        self._distortion: Treatment = distortion
        self._orthographic = projection == "orthographic"
        self._every, self._limit = every, limit
        self._reading, self._is_done = reading or Reading(), is_done
        self._reader, self._types = _open(self._path)
        try:
            self.topic = self._chosen(topic)
        except BaseException:
            self.close()
            raise
        self._info_topic = camera_info_topic(self.topic)
        self._masks = self._recorded_masks()
        self._mask = next(self._masks, None)

    def __enter__(self) -> RecordedBag:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Close the files."""
        self._reader.close()
        if hasattr(self, "_masks"):
            self._masks.close()

    def __len__(self) -> int:
        """Images that will be read, as the bag counts them; a damaged bag may count wrong."""
        count = sum(max(0, one.msgcount) for one in self._connections((_IMAGE, _COMPRESSED), self.topic))
        count = -(-count // self._every)
        return count if self._limit is None else min(count, self._limit)

    def __iter__(self) -> Iterator[RecordedFrame | FrameError]:
        needs_info = self._camera_info is None and not self._orthographic
        try:
            latest = self._first_info() if needs_info else None
            waiting: _Message | None = None
            for message in self._selected(needs_info):
                if isinstance(message, FrameError):
                    yield message
                elif message.is_info:
                    if waiting is not None and waiting.stamp <= message.stamp:
                        yield from self._frame(waiting, message if waiting.stamp == message.stamp else latest)
                        waiting = None
                    latest = message
                else:
                    if waiting is not None:
                        yield from self._frame(waiting, latest)
                        waiting = None
                    if not needs_info or (latest is not None and latest.stamp == message.stamp):
                        yield from self._frame(message, latest)
                    else:  # the camera_info of its stamp may come right after it
                        waiting = message
            if waiting is not None:
                yield from self._frame(waiting, latest)
        except FrameError as error:
            yield error

    # topics

    def _connections(self, kinds: tuple[str, ...], topic: str) -> list[Any]:
        return [one for one in self._reader.connections if one.msgtype in kinds and one.topic == topic]

    def _chosen(self, wanted: str | None) -> str:
        """The topic that was asked for, or the one that shows depth."""
        images = sorted({one.topic for one in self._reader.connections if one.msgtype in (_IMAGE, _COMPRESSED)})
        encodings: dict[str, str | None] = {}
        damage: FrameError | None = None
        for topic in images:
            try:
                encodings[topic] = self._encoding(topic)
            except FrameError as error:
                encodings[topic], damage = None, error
        listed = ", ".join(f"{topic} ({encodings[topic] or 'unreadable'})" for topic in images) or "none"
        if wanted is not None:
            wanted = "/" + wanted.lstrip("/")
            if wanted not in images:
                raise FrameError(f"{self._path}: no images on {wanted}; topics with images: {listed}")
            return wanted
        known = depth_image.GREY_ENCODINGS if self._orthographic else depth_image.DEPTH_ENCODINGS
        found = [topic for topic in images if encodings[topic] in known and not topic.endswith(_MASKS)]
        packed = f"/{compressed_depth.TRANSPORT}"
        found = [one for one in found if not (one.endswith(packed) and one.removesuffix(packed) in found)]
        if not found and damage is not None:
            raise damage
        if not found:
            raise FrameError(f"{self._path}: no topic with {' or '.join(known)} images; topics with images: {listed}")
        if len(found) > 1:
            raise FrameError(f"{self._path}: several depth topics, choose one with --topic: {', '.join(found)}")
        return found[0]

    def _encoding(self, topic: str) -> str | None:
        """Of the first readable image of a topic."""
        for message in islice(self._messages(self._connections((_IMAGE, _COMPRESSED), topic)), _PEEKED):
            if isinstance(message, FrameError):
                continue
            if message.is_packed:
                return compressed_depth.encoding(message.content.format) or message.content.format
            return str(message.content.encoding)
        return None

    # messages

    def _first_info(self) -> _Message | None:
        infos = self._messages(self._connections((_CAMERA_INFO,), self._info_topic))
        return next((info for info in infos if not isinstance(info, FrameError)), None)

    def _selected(self, with_infos: bool) -> Iterator[_Message | FrameError]:
        """The images that count, in between all camera_infos."""
        connections = self._connections((_IMAGE, _COMPRESSED), self.topic)
        if with_infos:
            connections += self._connections((_CAMERA_INFO,), self._info_topic)
        yield from self._messages(connections, self._every, self._limit)

    def _messages(
        self, connections: list[Any], every: int = 1, limit: int | None = None
    ) -> Iterator[_Message | FrameError]:
        """Messages in the order they were recorded; of images every n-th, at most ``limit``."""
        if not connections:  # which rosbags would take for all
            return
        stored = self._reader.messages(connections)
        seen = taken = 0
        while True:
            try:
                connection, nanoseconds, data = next(stored)
            except StopIteration:
                return
            except Exception as error:  # whatever damaged indices, chunks and pages lead to
                raise FrameError(f"{self._path}: cannot be read any further: {_said(error)}") from error
            is_info = connection.msgtype == _CAMERA_INFO
            if not is_info:
                seen += 1
                if (seen - 1) % every:
                    continue
                if limit is not None and taken == limit:
                    return
                taken += 1
            try:
                content: Any = self._types.deserialize_cdr(_plain(data), connection.msgtype)
                stamp = Stamp(int(content.header.stamp.sec), int(content.header.stamp.nanosec))
            except Exception as error:  # whatever damaged bytes lead to
                recorded = Stamp(*divmod(nanoseconds, 10**9))
                yield FrameError(
                    f"{self._path}: {connection.topic} recorded at {recorded}: not a readable {connection.msgtype}: "
                    f"{_said(error)}"
                )
                continue
            yield _Message(content, stamp, nanoseconds, is_info, is_packed=connection.msgtype == _COMPRESSED)

    # frames

    def _recorded_masks(self) -> Generator[_Message, None, None]:
        """The messages of the mask topic, in a reading of their own, as they come at any distance from their images."""
        topics = {
            one.topic for one in self._reader.connections if one.msgtype == _IMAGE and one.topic.endswith(_MASKS)
        } - {self.topic}
        if len(topics) != 1:
            return
        with RecordedBag(self._path, topics.pop()) as masks:
            for message in masks._messages(masks._connections((_IMAGE,), masks.topic)):
                if not isinstance(message, FrameError):
                    yield message

    def _labels(self, stamp: Stamp, name: str, image: np.ndarray) -> np.ndarray | None:
        """The masks of an image: from files if there is a folder of them, else from the bag."""
        labels = self._reading.labels(name, image)
        if labels is not None:
            return labels
        while self._mask is not None and self._mask.stamp < stamp:
            self._mask = next(self._masks, None)
        if self._mask is None or self._mask.stamp != stamp:
            return None
        labels = depth_image.labels_from_message(self._mask.content)
        if labels.shape != image.shape:
            raise ValueError(f"mask: expected labels of the depth's shape {image.shape}, got {labels.shape}")
        return labels

    def _frame(self, message: _Message, info: _Message | None) -> Iterator[RecordedFrame | FrameError]:
        """The frame of an image, unless it is done."""
        if self._is_done(message.stamp):
            return
        try:
            yield self._decoded(message, info)
        except (ValueError, MemoryError) as error:
            yield FrameError(f"{self._path}: {self.topic} at {message.stamp}: {_said(error)}")

    def _decoded(self, message: _Message, info: _Message | None) -> RecordedFrame:
        warning = ""
        encoding = str(getattr(message.content, "encoding", ""))
        name, labels = f"{self._name}_{message.stamp}", None
        if self._orthographic:
            grey = depth_image.grey_from_message(message.content)
            depth, camera = unit_cube.depth_from_grey(grey), unit_cube.camera(grey.shape[1], grey.shape[0])
            labels = self._labels(message.stamp, name, depth)
        else:
            if message.is_packed:
                depth = compressed_depth.decode(message.content.format, message.content.data)
                encoding = compressed_depth.encoding(message.content.format) or ""
            else:
                depth = depth_image.depth_from_message(message.content)
            if self._reading.scale is not None:
                depth = depth * np.float32((MILLIMETRES if encoding.startswith("16UC1") else 1.0) / self._reading.scale)
            calibration = self._calibration(info, depth)
            labels = self._labels(message.stamp, name, depth)
            labels = None if labels is None else calibration.rectified_labels(labels)
            depth, camera = calibration.rectified(depth), calibration.camera
            warning = f"{self._path}: {self.topic}: {calibration.note}" if calibration.note else ""
        return self._reading.of(
            RecordedFrame(
                depth,
                camera,
                labels,
                name,
                is_cube=self._orthographic,
                stamp=message.stamp,
                topic=self.topic,
                frame_id=message.content.header.frame_id,
                warning=warning,
                encoding=encoding,
                received=message.received,
            )
        )

    def _calibration(self, info: _Message | None, depth: np.ndarray) -> Calibration:
        if self._camera_info is not None:
            given = self._camera_info
            known = given(depth.shape[1], depth.shape[0]) if callable(given) else given
            return Calibration.of(known, self.topic, self._distortion)
        if info is None:
            raise ValueError(f"no camera_info on {self._info_topic}: name the camera with --camera-info")
        return Calibration.of(info.content, self.topic, self._distortion)


@dataclass(frozen=True, eq=False)
class _Message:
    """A message that could be read as what it claims to be; its fields may still hold anything."""

    content: Any
    stamp: Stamp
    received: int
    is_info: bool
    is_packed: bool


def _open(path: Path) -> tuple[Any, Any]:
    """rosbags' reader of a bag, open, and its table of types."""
    try:
        import apsw
        from rosbags import rosbag2
        from rosbags.rosbag2 import storage_mcap, storage_sqlite3
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise FrameError(
            f"{path}: reading bags needs the module 'rosbags': pip install 'sq_perception[bags]'"
        ) from error
    storage_mcap.DECOMPRESSORS.update({"zstd": _unpacked, "lz4": _unpacked_lz4})
    if path.is_dir():
        _refuse_packed_files(path)
    try:
        reader = rosbag2.Reader(path)
        reader.open()
    except Exception as error:  # whatever damaged files lead to
        raise FrameError(f"{path}: not a readable bag: {_said(error)}") from error
    storages: list[Any] = [reader.storage]
    if isinstance(reader.storage, rosbag2.reader.DirectoryReader):
        # Messages packed one by one would be unpacked without a bound; so they come as they are, for _plain.
        reader.storage.metadata = reader.storage.metadata._replace(compression_mode=None)
        storages = reader.storage.storages
    for storage in storages:
        if isinstance(storage, storage_sqlite3.Sqlite3Reader) and storage.dbconn is not None:
            storage.dbconn.limit(apsw.SQLITE_LIMIT_LENGTH, LARGEST)
    return reader, get_typestore(Stores.ROS2_JAZZY)


def _refuse_packed_files(folder: Path) -> None:
    """rosbags would unpack a bag that was packed as a whole into a temporary folder, whatever its size."""
    try:
        document = plain_yaml.read(folder / "metadata.yaml")
    except plain_yaml.YamlError as error:
        raise FrameError(f"{folder}: metadata.yaml: {_said(error)}") from error
    information = document.get("rosbag2_bagfile_information") if isinstance(document, dict) else None
    if not isinstance(information, dict):
        raise FrameError(f"{folder}: metadata.yaml: expected rosbag2_bagfile_information")
    if str(information.get("compression_mode", "")).lower() == "file":
        raise FrameError(f"{folder}: packed as whole files: unpack them (zstd -d) and name the .mcap or .db3 file")


def _plain(data: bytes) -> bytes:
    """A message's bytes, unpacked where it was packed by itself."""
    return _unpacked(data, LARGEST) if bytes(data[:4]) == _ZSTD else data


def _unpacked(data: bytes, size: int) -> bytes:
    """zstd, never more than ``size`` bytes: a megabyte can claim to be 32 GB."""
    try:
        from compression import zstd  # Python 3.14
    except ImportError:
        from backports import zstd
    return _bounded(zstd.ZstdDecompressor(), data, size)


def _unpacked_lz4(data: bytes, size: int) -> bytes:
    from lz4.frame import LZ4FrameDecompressor

    return _bounded(LZ4FrameDecompressor(), data, size)


def _bounded(decompressor: Any, data: bytes, size: int) -> bytes:
    if size > LARGEST:
        raise ValueError(f"expected at most {LARGEST} bytes unpacked, {size} are announced")
    unpacked: bytes = decompressor.decompress(data, max_length=size + 1)
    if len(unpacked) > size or not decompressor.eof:
        raise ValueError(f"expected at most {size} bytes unpacked and a whole stream")
    return unpacked


def _said(error: Exception) -> str:
    """An error's message in one line, with its kind where it says nothing by itself."""
    text = " ".join(str(error).split())[:300]
    return text if isinstance(error, ValueError) and text else f"{type(error).__name__}: {text}".rstrip(": ")
