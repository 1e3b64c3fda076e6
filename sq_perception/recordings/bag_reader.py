"""The messages of a rosbag2 recording, by rosbags: bounded whatever the file claims, and errors in their place.

The message definitions of a bag are not used: they would become Python code, and the types read here are the same in
every ROS 2.

Reference: rosbags, https://ternaris.gitlab.io/rosbags; MCAP, https://mcap.dev/spec

The camera_info topic of images is the sibling of their topic, as image_transport pairs them; without it the one that
has the images' size: not a colour camera's, and of several the one with the images' frame and stamp.  Where that leaves
none or several, all are listed and one can be named.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sq_perception.files.unpacking import MOST_BYTES, UnpackingError, read_yaml
from sq_perception.imaging import compressed_depth
from sq_perception.recordings import publication
from sq_perception.recordings.frame_file import FrameError, Stamp

LARGEST = MOST_BYTES  # bytes of one message, or of one unpacked chunk of messages
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_ZSTD = b"\x28\xb5\x2f\xfd"  # what a message that was packed by itself begins with; a plain one begins with the byte 0
_COLOUR = re.compile(r"colou?r|rgb(?!d)")


@dataclass(frozen=True)
class InfoTopic:
    """A camera_info topic: its name; why it was taken, where it is no sibling; what to say where it holds nothing."""

    name: str
    note: str = ""
    absent: str = ""


def raw_topic(topic: str) -> str:
    """Return the topic that shows the images of a compressedDepth topic as they are; any other topic itself."""
    return topic.removesuffix(f"/{compressed_depth.TRANSPORT}")


def camera_info_topic(topic: str) -> str:
    """Return the camera_info topic of an image topic: the one in its name space."""
    space, slash, _ = raw_topic(topic).rpartition("/")
    return f"{space}{slash}camera_info"


def info_topic(reader: BagReader, topic: str, image: Message | None, wanted: str | None) -> InfoTopic:
    """Return the camera_info topic for the images of a topic, of which one is given, or the one that was asked for.
    Raises FrameError if the bag has not the one that was asked for."""
    names = sorted({connection.topic for connection in reader.connections(CAMERA_INFO)})
    listed = ", ".join(names) or "none"
    if wanted is not None:
        wanted = "/" + wanted.lstrip("/")
        if wanted not in names:
            raise FrameError(f"{reader.path}: no camera_info on {wanted}; camera_info topics: {listed}")
        return InfoTopic(wanted)
    own = camera_info_topic(topic)
    choice = "choose one with --camera-info-topic, or name" if names else "name"
    absent = f"no camera_info on {own} (camera_info topics: {listed}): {choice} the camera with --camera-info"
    if own in names or image is None:
        return InfoTopic(own, absent=absent)
    size, header = publication.size_of(image.content), image.content.header
    found: dict[str, Message] = {}
    for name in names:
        if _COLOUR.search(name.lower()) and not _COLOUR.search(topic.lower()):
            continue
        infos = reader.messages(reader.connections(CAMERA_INFO, topic=name))
        first = next((info for info in infos if isinstance(info, Message)), None)
        if first is not None and (first.content.width, first.content.height) == size:
            found[name] = first
    preferences: tuple[Callable[[Message], bool], ...] = (
        lambda info: info.content.header.frame_id == header.frame_id,
        lambda info: info.stamp == image.stamp,
    )
    for fits in preferences:
        found = {name: info for name, info in found.items() if fits(info)} or found
    if len(found) != 1:
        return InfoTopic(own, absent=absent)
    (name,) = found
    return InfoTopic(name, f"the camera is that of {name}, as {own} is not there and it has the size of the images")


@dataclass(frozen=True, eq=False)
class Message:
    """A message that could be read as what it claims to be; its fields may still hold anything."""

    content: Any
    kind: str
    stamp: Stamp
    received: int


class BagReader:
    """An open bag; raises FrameError if it cannot be read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._reader, self._types = _open(path)

    def close(self) -> None:
        """Close the files."""
        self._reader.close()

    def connections(self, *kinds: str, topic: str | None = None) -> list[Any]:
        """rosbags' connections of these types, of one topic or of all."""
        return [each for each in self._reader.connections if each.msgtype in kinds and topic in (None, each.topic)]

    def messages(
        self, connections: list[Any], every: int = 1, limit: int | None = None, received: int | None = None
    ) -> Iterator[Message | FrameError]:
        """Yield messages in the order they were recorded; of images every n-th, at most ``limit``.

        ``received``: only those of this time, nanoseconds.
        """
        if not connections:  # which rosbags would take for all
            return
        span = () if received is None else (received, received + 1)
        stored = self._reader.messages(connections, *span)
        seen = 0
        while True:
            try:
                connection, nanoseconds, data = next(stored)
            except StopIteration:
                return
            except Exception as error:  # whatever damaged indices, chunks and pages lead to
                raise FrameError(f"{self.path}: cannot be read any further: {describe(error)}") from error
            if connection.msgtype != CAMERA_INFO:
                before, seen = seen, seen + 1
                if before % every:
                    continue
                if limit is not None and before // every == limit:
                    return
            try:
                plain = _unpack(data, LARGEST) if bytes(data[:4]) == _ZSTD else data
                content: Any = self._types.deserialize_cdr(plain, connection.msgtype)
                stamp = Stamp(int(content.header.stamp.sec), int(content.header.stamp.nanosec))
            except Exception as error:  # whatever damaged bytes lead to
                recorded = Stamp(*divmod(nanoseconds, 10**9))
                yield FrameError(
                    f"{self.path}: {connection.topic} recorded at {recorded}: not a readable {connection.msgtype}: "
                    f"{describe(error)}"
                )
                continue
            yield Message(content, connection.msgtype, stamp, nanoseconds)


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
    storage_mcap.DECOMPRESSORS.update({"zstd": _unpack, "lz4": _unpack_lz4})
    if path.is_dir():
        _refuse_packed_files(path)
    try:
        reader = rosbag2.Reader(path)
        reader.open()
    except Exception as error:  # whatever damaged files lead to
        is_cut = "end magic" in str(error).lower()  # as rosbags says of an MCAP without its end
        cut = " (of a recording that was cut short, mcap recover saves what is there)" * is_cut
        raise FrameError(f"{path}: not a readable bag: {describe(error)}{cut}") from error
    storages: list[Any] = [reader.storage]
    if isinstance(reader.storage, rosbag2.reader.DirectoryReader):
        # Messages packed one by one would be unpacked without a bound; so they come as they are, and are unpacked here.
        reader.storage.metadata = reader.storage.metadata._replace(compression_mode=None)
        storages = reader.storage.storages
    for storage in storages:
        if isinstance(storage, storage_sqlite3.Sqlite3Reader) and storage.dbconn is not None:
            storage.dbconn.limit(apsw.SQLITE_LIMIT_LENGTH, LARGEST)
    return reader, get_typestore(Stores.ROS2_JAZZY)


def _refuse_packed_files(folder: Path) -> None:
    """rosbags would unpack a bag that was packed as a whole into a temporary folder, whatever its size."""
    try:
        document = read_yaml(folder / "metadata.yaml")
    except UnpackingError as error:
        raise FrameError(f"{folder}: metadata.yaml: {describe(error)}") from error
    information = document.get("rosbag2_bagfile_information") if isinstance(document, dict) else None
    if not isinstance(information, dict):
        raise FrameError(f"{folder}: metadata.yaml: expected rosbag2_bagfile_information")
    if str(information.get("compression_mode", "")).lower() == "file":
        raise FrameError(f"{folder}: packed as whole files: unpack them (zstd -d) and name the .mcap or .db3 file")


def _unpack(data: bytes, size: int) -> bytes:
    """zstd, never more than ``size`` bytes: a megabyte can claim to be 32 GB."""
    try:
        from compression import zstd  # Python 3.14
    except ImportError:
        from backports import zstd
    return _bound(zstd.ZstdDecompressor(), data, size)


def _unpack_lz4(data: bytes, size: int) -> bytes:
    from lz4.frame import LZ4FrameDecompressor

    return _bound(LZ4FrameDecompressor(), data, size)


def _bound(decompressor: Any, data: bytes, size: int) -> bytes:
    if size > LARGEST:
        raise ValueError(f"expected at most {LARGEST} bytes unpacked, {size} are announced")
    unpacked: bytes = decompressor.decompress(data, max_length=size + 1)
    if len(unpacked) > size or not decompressor.eof:
        raise ValueError(f"expected at most {size} bytes unpacked and a whole stream")
    return unpacked


def describe(error: Exception) -> str:
    """Return an error's message in one line, with its kind where that alone is informative."""
    text = " ".join(str(error).split())[:300]
    return text if isinstance(error, ValueError) and text else f"{type(error).__name__}: {text}".rstrip(": ")
