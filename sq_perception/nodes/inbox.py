"""What has come and waits for the worker: depth images with what belongs to them; the newest complete one wins.

Callbacks of the executor put, one worker thread takes. A depth image is complete with the camera_info of its own
stamp, or else the latest one of its size, and, where masks are expected, with the mask of its own stamp. What is
missing may come a moment later: the image waits for it for ``patience`` seconds, beside newer images. As soon as an
image is complete, or its patience is at an end, it takes the place of every older one.

So a frame is never computed without its mask only because the network that makes the mask is slower than the camera,
and nobody who has the turn to compute waits for a message.
"""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass
from time import monotonic

from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from sq_msgs_py.depth_image import size_mismatch
from sq_perception.imaging.calibration import Calibration
from sq_perception.nodes.frame import Refused, size_of

Stamp = tuple[int, int]

_INFOS = 16
_MASKS = 8
_WAITING = 64
"""Images that wait for their companions at the same time; older ones are dropped."""


class NoCameraInfo(Refused):
    """A frame without a usable camera_info."""


@dataclass(frozen=True)
class Arrival:
    """A depth image, when it came, in seconds of the monotonic clock, and its mask if one came."""

    message: Image | CompressedImage
    time: float
    mask: Image | None = None


@dataclass(frozen=True)
class _Info:
    stamp: Stamp
    size: tuple[int, int]
    calibration: Calibration | None
    fault: str


class Inbox:
    """Thread-safe; see the module.

    Parameters
    ----------
    calibrate
        Makes the calibration of a camera_info, or raises ValueError.  None: images need no camera_info.
    needs_mask
        Asked for each image as it comes: whether to wait for its mask.
    patience
        Asked for each image as it comes: seconds to wait for what is missing.
    dropped
        Told how many images were replaced by newer ones.
    """

    def __init__(
        self,
        calibrate: Callable[[CameraInfo], Calibration] | None,
        *,
        needs_mask: Callable[[], bool] = lambda: False,
        patience: Callable[[], float] = lambda: 0.25,
        dropped: Callable[[int], None] = lambda _: None,
    ) -> None:
        self._calibrate, self._needs_mask = calibrate, needs_mask
        self._patience, self._dropped = patience, dropped
        self._changed = threading.Condition()
        self._waiting: deque[_Waiting] = deque()
        self._ready: Arrival | None = None
        self._infos: deque[_Info] = deque(maxlen=_INFOS)
        self._masks: OrderedDict[Stamp, Image] = OrderedDict()
        self._closed = False

    def put_image(self, message: Image | CompressedImage) -> None:
        """Offer a depth image."""
        now = monotonic()
        waiting = _Waiting(message, _size(message), now, now + self._patience(), self._needs_mask())
        with self._changed:
            if self._closed:
                self._dropped(1)
                return
            self._waiting.append(waiting)
            self._promote(now)

    def put_info(self, message: CameraInfo) -> None:
        """Keep a camera_info; a useless one is kept as the reason for refusing frames of its size."""
        if self._calibrate is None:
            return
        size, calibration, fault = (int(message.width), int(message.height)), None, ""
        try:
            calibration = self._calibrate(message)
            size = calibration.size
        except ValueError as error:
            fault = str(error)
        with self._changed:
            self._infos.append(_Info(stamp_of(message), size, calibration, fault))
            self._promote(monotonic())

    def put_mask(self, message: Image) -> None:
        """Keep a label image for the depth image of the same stamp; one without a stamp belongs to none."""
        if stamp_of(message) == (0, 0):
            return
        with self._changed:
            self._masks[stamp_of(message)] = message
            while len(self._masks) > _MASKS:
                self._masks.popitem(last=False)
            self._promote(monotonic())

    def close(self) -> int:
        """Let the worker go, and how many images it leaves behind."""
        with self._changed:
            self._closed = True
            left = len(self._waiting) + (self._ready is not None)
            self._waiting.clear()
            self._ready = None
            self._changed.notify_all()
            return left

    def wait(self) -> bool:
        """Wait until an image can be taken; False once the inbox is closed."""
        with self._changed:
            while not self._closed:
                now = monotonic()
                self._promote(now)
                if self._ready is not None:
                    return True
                deadline = min((one.deadline for one in self._waiting), default=None)
                self._changed.wait(None if deadline is None else max(deadline - now, 0.0))
            return False

    def take(self) -> Arrival | None:
        """The image that :meth:`wait` waited for, or a newer one; None if there is none."""
        with self._changed:
            self._promote(monotonic())
            arrival, self._ready = self._ready, None
            return arrival

    def calibration_of(self, image: Image | CompressedImage) -> Calibration:
        """The calibration of a depth image.

        Raises
        ------
        NoCameraInfo
            If no usable one of the image's size has come.
        """
        size = size_of(image)
        with self._changed:
            info = self._info(size, stamp_of(image))
            if info is None:
                raise NoCameraInfo(self._why_no_info(size))
            if info.calibration is None:
                raise NoCameraInfo(info.fault)
            return info.calibration

    def _promote(self, now: float) -> None:
        """Make the newest image ready that is complete or has waited long enough."""
        chosen = -1
        for k, one in enumerate(self._waiting):
            if one.deadline <= now or self._is_complete(one):
                chosen = k
        dropped = 0
        if chosen >= 0:
            one = self._waiting[chosen]
            dropped = chosen + (self._ready is not None)
            self._ready = Arrival(one.message, one.time, self._masks.pop(stamp_of(one.message), None))
            for _ in range(chosen + 1):
                self._waiting.popleft()
        while len(self._waiting) > _WAITING:
            self._waiting.popleft()
            dropped += 1
        if dropped:
            self._dropped(dropped)
        self._changed.notify_all()

    def _is_complete(self, one: _Waiting) -> bool:
        stamp = stamp_of(one.message)
        if one.size is None:  # no image: to be refused at once
            return True
        has_info = self._calibrate is None or self._info(one.size, stamp) is not None
        return has_info and (not one.needs_mask or stamp in self._masks)

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
        why = last.fault or size_mismatch(size, last.size)
        return f"{wanted}, the last one is for {last.size[0]} x {last.size[1]} ({why})"


@dataclass(frozen=True)
class _Waiting:
    message: Image | CompressedImage
    size: tuple[int, int] | None
    time: float
    deadline: float
    needs_mask: bool


def stamp_of(message: Image | CompressedImage | CameraInfo) -> Stamp:
    """Seconds and nanoseconds of the header."""
    return int(message.header.stamp.sec), int(message.header.stamp.nanosec)


def _size(message: Image | CompressedImage) -> tuple[int, int] | None:
    try:
        return size_of(message)
    except ValueError:
        return None
