"""Depth images from rosbag2 recordings, without a ROS installation.

A bag is a folder with ``metadata.yaml``, or a lone ``.mcap`` or ``.db3`` file.  The images come from one topic, found
by type and encoding:

| type | encoding | depth |
| --- | --- | --- |
| sensor_msgs/Image | 16UC1, 32FC1 | millimetres, metres (REP 118) |
| sensor_msgs/CompressedImage | 16UC1, 32FC1 of the compressedDepth transport, PNG or RVL | likewise |
| sensor_msgs/Image, orthographic | mono8, mono16 | grey values of the unit cube |

Label images on the one topic that is called ``mask/image``, with or without a name before it, are the masks of the
images with their stamps; they may have been recorded later, and in another order.  Of several such topics none is
taken, and frames say so.

The camera is that of one topic (:mod:`sq_perception.recordings.bag_reader`): the message with the image's stamp;
failing that, the last one before the image; failing that, the bag's first, however late.  The name of the images' topic
decides whether images are raw and have to be rectified (:mod:`sq_perception.imaging.calibration`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from sq_msgs_py import depth_image
from sq_perception.imaging import compressed_depth, unit_cube
from sq_perception.imaging.calibration import Calibration, Treatment
from sq_perception.imaging.camera import Projection
from sq_perception.recordings import bag_reader, publication
from sq_perception.recordings.bag_reader import CAMERA_INFO, COMPRESSED, IMAGE, BagReader, Message, describe, raw_topic
from sq_perception.recordings.camera_file import read_camera_info
from sq_perception.recordings.frame_file import FrameError, Reading, RecordedFrame, Stamp

SUFFIXES = (".mcap", ".db3")
_MASKS, _RENDERED = "/mask/image", "/rendered_depth"
"""Ends of the topics of labels, and of what was recovered: the latter is read where nothing else shows depth."""


def is_bag(path: str | Path) -> bool:
    """Return whether a path looks like a recording, from the outside."""
    path = Path(path)
    if not path.is_dir():
        return path.suffix.lower() in SUFFIXES
    about = path / "metadata.yaml"
    if not about.is_file():
        return False
    try:
        with about.open("rb") as file:  # data sets have files of this name, too
            head = file.read(4096)
    except OSError:
        return True  # and the reader says what is wrong
    return not head or b"rosbag2_bagfile_information" in head


def frame_name(path: Path, stamp: Stamp) -> str:
    """Return what the frame of a bag with this stamp is called."""
    return f"{path.resolve().name if path.is_dir() else path.stem}_{stamp}"


@dataclass(frozen=True)
class InputOptions:
    """What is read of files, folders and bags, and how.

    ``camera_info``: Intrinsics of images and bags, as :func:`frame_file.read` takes them; go before what a folder or
    bag brings.  ``projection``: "pinhole" or "orthographic", which looks for grey images of the unit cube in bags.
    ``topic``: Topic of the images in bags; needed where several show depth.  ``every``, ``limit``: of each folder and
    bag: every n-th frame only, and at most so many.  ``distortion``: of images and bags: "auto", "apply" or "ignore",
    see :mod:`sq_perception.imaging.calibration`.  ``reading``: what is taken of each image; masks are files called as
    the frames are.  ``camera_info_topic``: Topic of the camera in bags, where it is not beside the images'.  Raises
    ValueError if ``every`` or ``limit`` is below 1.
    """

    camera_info: str | Path | None = None
    projection: Projection = "pinhole"
    topic: str | None = None
    every: int = 1
    limit: int | None = None
    distortion: Treatment = "auto"
    reading: Reading = field(default_factory=Reading)
    camera_info_topic: str | None = None

    def __post_init__(self) -> None:
        if self.every < 1 or (self.limit is not None and self.limit < 1):
            raise ValueError(f"every, limit: expected at least 1, got {self.every} and {self.limit}")


class RecordedBag:
    """One depth topic of a bag; iterating gives its frames once, in the order they were recorded.

    A message that cannot be read comes as a FrameError with the reason, and the next one follows.  Close it, or use it
    as a context manager.

    ``path``: the bag, a folder or file.  ``options``: all of its images by default.  ``is_done``: called with the stamp
    of each image that counts; where it is true, the image is neither decoded nor given.  Raises FrameError if the bag
    cannot be read, or has not exactly one topic to read; the message lists what it has.
    """

    def __init__(
        self, path: str | Path, options: InputOptions | None = None,
        is_done: Callable[[Stamp], bool] = lambda stamp: False,
    ) -> None:
        self._path = Path(path)
        self._options, self._is_done = options or InputOptions(), is_done
        self._orthographic = self._options.projection == "orthographic"
        with ExitStack() as opened:
            self._reader = opened.enter_context(closing(BagReader(self._path)))
            self.topic = self._choose(self._options.topic)
            first = next(self._first_images(self.topic), None)
            self._info_topic = bag_reader.info_topic(self._reader, self.topic, first, self._options.camera_info_topic)
            others = {connection.topic for connection in self._reader.connections(IMAGE)} - {self.topic}
            self._mask_topics = sorted(topic for topic in others if topic.endswith(_MASKS))
            # In a reading of their own, as they come at any distance from their images, and do not fit into memory.
            self._mask_reader = opened.enter_context(closing(BagReader(self._path)))
            self._mask_times: dict[Stamp, int] = {}
            self._unread: FrameError | None = None
            if len(self._mask_topics) == 1 and not self._options.reading.ignore_masks:
                self._index_masks()
            self._opened = opened.pop_all()

    def __enter__(self) -> RecordedBag:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files."""
        self._opened.close()

    def __len__(self) -> int:
        """Return how many images will be read, as the bag counts them; a damaged bag may count wrong."""
        count = sum(
            max(0, connection.msgcount) for connection in self._reader.connections(IMAGE, COMPRESSED, topic=self.topic)
        )
        count = -(-count // self._options.every)
        return count if self._options.limit is None else min(count, self._options.limit)

    def __iter__(self) -> Iterator[RecordedFrame | FrameError]:
        try:
            for found in self._pair():  # pixels are only allocated for data that is there
                if isinstance(found, FrameError):
                    yield found
                elif not self._is_done(found[0].stamp):
                    yield self._frame(*found)
        except FrameError as error:
            yield error

    def _pair(self) -> Iterator[tuple[Message, Message | None] | FrameError]:
        """Return the images in their order, each with its camera_info if one is needed and there is one."""
        needs_info = self._options.camera_info is None and not self._orthographic
        latest: Message | None = None
        waiting: Message | None = None
        connections = self._reader.connections(IMAGE, COMPRESSED, topic=self.topic)
        if needs_info:
            infos = self._reader.connections(CAMERA_INFO, topic=self._info_topic.name)
            latest = next((message for message in self._reader.messages(infos) if isinstance(message, Message)), None)
            connections += infos
        for message in self._reader.messages(connections, self._options.every, self._options.limit):
            if isinstance(message, FrameError):
                yield message
                continue
            is_info = message.kind == CAMERA_INFO
            if waiting is not None and not (is_info and message.stamp < waiting.stamp):
                is_its_own = is_info and message.stamp == waiting.stamp
                yield waiting, message if is_its_own else latest
                waiting = None
            if is_info:
                latest = message
            elif needs_info and (latest is None or latest.stamp != message.stamp):
                waiting = message  # the camera_info of its stamp may come right after it
            else:
                yield message, latest
        if waiting is not None:
            yield waiting, latest

    # topics

    def _choose(self, wanted: str | None) -> str:
        """Return the topic that was asked for, or the one that shows depth."""
        images = sorted({connection.topic for connection in self._reader.connections(IMAGE, COMPRESSED)})
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
        found = [topic for topic in found if not raw_topic(topic).endswith(_RENDERED)] or found
        packed = f"/{compressed_depth.TRANSPORT}"
        found = [topic for topic in found if not (topic.endswith(packed) and topic.removesuffix(packed) in found)]
        if not found and damage is not None:
            raise damage
        if not found:
            raise FrameError(f"{self._path}: no topic with {' or '.join(known)} images; topics with images: {listed}")
        if len(found) > 1:
            raise FrameError(f"{self._path}: several depth topics, choose one with --topic: {', '.join(found)}")
        return found[0]

    def _encoding(self, topic: str) -> str | None:
        """Return the encoding of the first readable image of a topic; None where none of the first ones can be read."""
        message = next(self._first_images(topic), None)
        if message is not None and message.kind == COMPRESSED:
            return compressed_depth.encoding(message.content.format) or str(message.content.format)
        return None if message is None else str(message.content.encoding)

    def _first_images(self, topic: str) -> Iterator[Message]:
        """Return the readable ones of the first images of a topic; some may be damaged."""
        found = islice(self._reader.messages(self._reader.connections(IMAGE, COMPRESSED, topic=topic)), 10)
        return (message for message in found if isinstance(message, Message))

    # frames

    def _read_masks(self, received: int | None = None) -> Iterator[Message | FrameError]:
        connections = self._mask_reader.connections(IMAGE, topic=self._mask_topics[0])
        return self._mask_reader.messages(connections, received=received)

    def _index_masks(self) -> None:
        """Note when each mask was recorded: a segmentation may answer its images in another order."""
        try:
            for message in self._read_masks():
                if isinstance(message, FrameError):
                    self._unread = self._unread or message
                    continue
                self._mask_times.setdefault(message.stamp, message.received)
        except FrameError as error:
            self._unread = error

    def _mask(self, stamp: Stamp) -> Message | None:
        """Return the first mask with this stamp; None without one, and for an image without a stamp, as a node has it.
        Raises ValueError where there is none, and one that cannot be read might be it."""
        if stamp == Stamp(0, 0):
            return None
        if stamp in self._mask_times:
            found = self._read_masks(self._mask_times[stamp])
            return next(one for one in found if isinstance(one, Message) and one.stamp == stamp)
        if self._unread is not None:
            raise ValueError(f"it has no mask, or one that cannot be read: {self._unread}")
        return None

    def _labels(self, stamp: Stamp, name: str, image: np.ndarray) -> np.ndarray | None:
        """Return the masks of an image: from files if there is a folder of them, else from the bag."""
        labels = self._options.reading.labels(name, image)
        if labels is not None or self._options.reading.ignore_masks:
            return labels
        mask = self._mask(stamp)
        if mask is None:
            return None
        labels = depth_image.labels_from_message(mask.content)
        if labels.shape != image.shape:
            raise ValueError(f"mask: expected labels of the depth's shape {image.shape}, got {labels.shape}")
        return labels

    def _frame(self, message: Message, info: Message | None) -> RecordedFrame | FrameError:
        try:
            return self._decode(message, info)
        except (ValueError, MemoryError) as error:
            return FrameError(f"{self._path}: {self.topic} at {message.stamp}: {describe(error)}")

    def _decode(self, message: Message, info: Message | None) -> RecordedFrame:
        name, reading, warnings = frame_name(self._path, message.stamp), self._options.reading, []
        known: Any = None if info is None else info.content
        if self._options.camera_info is not None and not self._orthographic:
            known = read_camera_info(self._options.camera_info, publication.size_of(message.content), name)
        unit = getattr(known, "unit", None)
        found, encoding = publication.depth_of(message.content, self._orthographic, reading.scale, unit)
        depth, notes = found.depth, found.notes
        labels = self._labels(message.stamp, name, depth)
        if self._orthographic:
            camera = unit_cube.camera(depth.shape[1], depth.shape[0])
        else:
            if known is None:
                raise ValueError(self._info_topic.absent)
            calibration = Calibration.of(known, self.topic, self._options.distortion)
            labels = None if labels is None else calibration.rectify_labels(labels)
            camera = calibration.camera
            depth = reading.z(calibration.rectify(depth), camera)
            warnings += [f"{self.topic}: {calibration.note}"] if calibration.note else []
            notes = (*([self._info_topic.note] if info is not None and self._info_topic.note else ()), *notes)
        if len(self._mask_topics) > 1 and reading.masks is None and not reading.ignore_masks:
            warnings.append(f"several topics with masks, none is taken: {', '.join(self._mask_topics)}")
        return reading.of(
            RecordedFrame(
                depth, camera, labels, name, stamp=message.stamp, topic=self.topic,
                frame_id=message.content.header.frame_id,
                warning="; ".join(f"{self._path}: {text}" for text in warnings), notes="; ".join(notes),
                encoding=encoding, received=message.received,
            )
        )
