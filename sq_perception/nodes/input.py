"""The input of a frame node: its subscriptions, and what has come and waits for the worker.

Callbacks of the executor put, one worker thread takes; the newest complete depth image wins. One is complete with the
camera_info of its own stamp, or else the latest one of its size, and, where masks are expected, with the mask of its
own stamp. What is missing may come a moment later: the image waits for it for ``patience`` seconds, beside newer
images. As soon as an image is complete, or its patience is at an end, it takes the place of every older one.

So a frame is never computed without its mask only because the network that makes the mask is slower than the camera,
and nobody who has the turn to compute waits for a message.
"""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass
from time import monotonic
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from sq_msgs_py.depth_image import size_mismatch
from sq_perception.imaging.calibration import Calibration
from sq_perception.nodes.frame import Frame, Refused, decode, image_topic, size_of
from sq_perception.nodes.parameters import RAW, FrameParameters
from sq_perception.nodes.statistics import THROTTLE, Statistics, publishers

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
    """What has come and waits; thread-safe.

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


class Input:
    """The subscriptions of an active node, whose messages go into an inbox, and the frames that are made of them.

    Inputs are best effort, keep last 1: a slow subscriber with a queue answers old images.

    Parameters
    ----------
    node
        Subscribes.
    parameters
        Asked for those in force.
    is_wanted
        Asked for each image: whether it is processed, or dropped at once.
    statistics
        Counts received, dropped and lost messages.
    """

    def __init__(
        self,
        node: Node,
        parameters: Callable[[], FrameParameters],
        is_wanted: Callable[[], bool],
        statistics: Statistics,
    ) -> None:
        self._node, self._parameters, self._is_wanted, self._statistics = node, parameters, is_wanted, statistics
        self._note = ""
        self._last_image = monotonic()
        self._is_pinhole = parameters().projection == "pinhole"
        self._transport = parameters().image_transport
        self.topic = image_topic(node, "depth/image", self._transport)
        """Of the depth images."""
        self.inbox = Inbox(
            self._calibrated if self._is_pinhole else None,
            needs_mask=self._expects_mask,
            patience=lambda: self._parameters().patience,
            dropped=lambda number: statistics.count("dropped", number),
        )
        self._info: Subscription | None = None
        self._mask: Subscription | None = None
        self._image: Subscription | None = None

    def open(self) -> None:
        """Subscribe."""
        # Subscriptions are served in this order: what an image needs is there before the image.
        if self._is_pinhole:
            self._info = self._listen(CameraInfo, "depth/camera_info", self.inbox.put_info)
        self._mask = self._listen(Image, "mask/image", self.inbox.put_mask)
        kind = Image if self._transport == RAW else CompressedImage
        self._image = self._listen(kind, self.topic, self._on_image)

    @property
    def silence(self) -> float:
        """Seconds since the last depth image."""
        return monotonic() - self._last_image

    @property
    def heard(self) -> str:
        """Who publishes depth images, and whether they can be heard."""
        return self._publishers_of(self._image)

    def close(self) -> None:
        """Listen no more, and let the worker go; what waits is dropped."""
        for one in (self._image, self._mask, self._info):
            if one is not None:
                self._node.destroy_subscription(one)
        self._statistics.count("dropped", self.inbox.close())

    def frame(self, arrival: Arrival, parameters: FrameParameters) -> Frame:
        """The frame of an image with what belongs to it.

        Raises
        ------
        ValueError
            For anything that keeps it from being processed.
        """
        message = arrival.message
        if parameters.projection == "orthographic":
            frame = decode(message, None)
        else:
            try:
                frame = decode(message, lambda: self.inbox.calibration_of(message))
            except NoCameraInfo as error:
                topic = self._info.topic_name if self._info is not None else "depth/camera_info"
                raise Refused(f"{error}, on {topic}: {self._publishers_of(self._info)}") from error
        if parameters.use_masks == "always" and arrival.mask is None:
            where = f" on {self._mask.topic_name}" if self._mask is not None else ""
            raise Refused(f"mask: expected one with the stamp of the image (use_masks is always), none came{where}")
        return frame.with_mask(arrival.mask if parameters.use_masks != "never" else None)

    # Callbacks, in the executor's thread: quick, and nothing in them can fail on a message's content

    def _on_image(self, message: Image | CompressedImage) -> None:
        self._last_image = monotonic()
        self._statistics.count("received")
        if self._is_wanted():
            self.inbox.put_image(message)
        else:
            self._statistics.count("dropped")

    def _calibrated(self, info: CameraInfo) -> Calibration:
        calibration = Calibration.of(info, self.topic, self._parameters().distortion)
        if calibration.note != self._note:
            self._note = calibration.note
            said = f"{self.topic}: {calibration.note or 'no distortion'}"
            self._node.get_logger().info(said, throttle_duration_sec=THROTTLE)
        return calibration

    def _expects_mask(self) -> bool:
        if self._mask is None:
            return False
        use = self._parameters().use_masks
        return use == "always" or (use == "auto" and bool(self._node.count_publishers(self._mask.topic_name)))

    def _on_lost(self, event: Any) -> None:
        self._statistics.count("lost", event.total_count_change)
        self._node.get_logger().warning(
            f"{event.total_count} messages lost before they arrived: best effort images need more shared memory than "
            "Fast DDS reserves by default. Remedy: start the PUBLISHER (the camera driver) with "
            "FASTRTPS_DEFAULT_PROFILES_FILE set to the profile that ships in this package's config folder",
            throttle_duration_sec=THROTTLE,
        )

    def _listen(self, kind: type[Any], topic: str, callback: Callable[[Any], None]) -> Subscription:
        return self._node.create_subscription(
            kind,
            topic,
            callback,
            QoSProfile(depth=1, history=QoSHistoryPolicy.KEEP_LAST, reliability=QoSReliabilityPolicy.BEST_EFFORT),
            event_callbacks=SubscriptionEventCallbacks(message_lost=self._on_lost),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    def _publishers_of(self, subscription: Subscription | None) -> str:
        if subscription is None:
            return "nothing is subscribed to"
        offered = self._node.get_publishers_info_by_topic(subscription.topic_name)
        return publishers(offered, subscription.qos_profile)
