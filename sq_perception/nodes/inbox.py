"""What has arrived and waits for the worker: the newest depth image, recent camera_infos and masks.

Callbacks of the executor put, one worker thread takes.  A newer depth image replaces one that nobody has taken yet.  A
depth image is joined with the camera_info of its own stamp, or else the latest one of its size, and with the mask of
its own stamp; either may arrive a moment later than the image, so that the worker waits for it a little.
"""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass
from time import monotonic

from sensor_msgs.msg import CameraInfo, Image

from sq_msgs_py.depth_image import intrinsics_from_message
from sq_perception.imaging.camera import Camera

Stamp = tuple[int, int]

_INFOS = 16
_MASKS = 4


class Refused(ValueError):  # noqa: N818 - a verdict on a frame rather than a defect
    """A frame that cannot be processed; says what was expected and what arrived."""


@dataclass(frozen=True)
class Arrival:
    """A depth image and when it came, in seconds of the monotonic clock."""

    message: Image
    time: float


@dataclass(frozen=True)
class _Info:
    stamp: Stamp
    size: tuple[int, int]
    camera: Camera | None
    fault: str


class Inbox:
    """Thread-safe; see the module."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._image: Arrival | None = None
        self._infos: deque[_Info] = deque(maxlen=_INFOS)
        self._masks: OrderedDict[Stamp, Image] = OrderedDict()
        self._closed = False

    def put_image(self, message: Image) -> bool:
        """Offer a depth image; True if it replaced one that had not been taken."""
        with self._changed:
            replaced = self._image is not None
            self._image = Arrival(message, monotonic())
            self._changed.notify_all()
            return replaced

    def put_info(self, message: CameraInfo) -> None:
        """Keep a camera_info; a useless one is kept as the reason for refusing frames of its size."""
        size, camera, fault = (int(message.width), int(message.height)), None, ""
        try:
            known = intrinsics_from_message(message)
            size = known.width, known.height
            camera = Camera(known.width, known.height, known.fx, known.fy, known.cx, known.cy)
        except ValueError as error:
            fault = str(error)
        with self._changed:
            self._infos.append(_Info(stamp_of(message), size, camera, fault))
            self._changed.notify_all()

    def put_mask(self, message: Image) -> None:
        """Keep a label image for the depth image of the same stamp."""
        with self._changed:
            self._masks[stamp_of(message)] = message
            while len(self._masks) > _MASKS:
                self._masks.popitem(last=False)
            self._changed.notify_all()

    def close(self) -> None:
        """Let the worker go: every take from now on answers None."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def take(self) -> Arrival | None:
        """Wait for a depth image; None once the inbox is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._image is not None)
            if self._closed:
                return None
            arrival, self._image = self._image, None
            return arrival

    def camera_of(self, image: Image, patience: float) -> Camera:
        """The camera of a depth image.

        Raises
        ------
        Refused
            If no usable camera_info of the image's size has come, ``patience`` seconds included.
        """
        size = int(image.width), int(image.height)
        with self._changed:
            self._wait(lambda: self._info(size, stamp_of(image)) is not None, patience)
            info = self._info(size, stamp_of(image))
            if info is None:
                raise Refused(self._why_no_info(size))
            if info.camera is None:
                raise Refused(info.fault)
            return info.camera

    def mask_of(self, image: Image, patience: float) -> Image | None:
        """The mask of a depth image; None if none came, ``patience`` seconds included."""
        with self._changed:
            self._wait(lambda: stamp_of(image) in self._masks, patience)
            return self._masks.pop(stamp_of(image), None)

    def _wait(self, arrived: Callable[[], bool], patience: float) -> None:
        """Wait for a companion of the frame at hand, but not while a newer frame waits already."""
        self._changed.wait_for(lambda: arrived() or self._closed or self._image is not None, patience)

    def _info(self, size: tuple[int, int], stamp: Stamp) -> _Info | None:
        fitting = [info for info in self._infos if info.size == size]
        same_time = [info for info in fitting if info.stamp == stamp]
        best = same_time or fitting
        return best[-1] if best else None

    def _why_no_info(self, size: tuple[int, int]) -> str:
        wanted = f"camera_info: expected one for {size[0]} x {size[1]} pixels"
        if not self._infos:
            return f"{wanted}, none came"
        last = self._infos[-1]
        return f"{wanted}, the last one is for {last.size[0]} x {last.size[1]}" + (
            f" ({last.fault})" if last.fault else ""
        )


def stamp_of(message: Image | CameraInfo) -> Stamp:
    """Seconds and nanoseconds of the header."""
    return int(message.header.stamp.sec), int(message.header.stamp.nanosec)
