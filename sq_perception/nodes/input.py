"""The input of a frame node: its subscriptions, the images that wait for the worker, and their frames.

Callbacks of the executor store messages; one worker thread takes the newest complete depth image.  An image is complete
with the camera_info of its stamp, or else the latest of its size, and, if masks are expected, with the mask of its
stamp, for which it waits ``patience`` seconds while newer images arrive.  Then it replaces every older one.
"""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from time import monotonic

from rclpy.node import Node
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2

from sq_msgs_py.depth_image import size_mismatch
from sq_perception.imaging.calibration import Calibration
from sq_perception.nodes import frame as frames
from sq_perception.nodes.frame import DepthMessage, Frame, MaskMessage, stamp_of
from sq_perception.nodes.listener import Listener
from sq_perception.nodes.managed_node import optional
from sq_perception.nodes.parameters import POINTS, RAW, LiveParameters, RecoverParameters
from sq_perception.nodes.statistics import THROTTLE, WITHOUT_MASK, Statistics
from sq_perception.nodes.tracking import Pose
from sq_perception.recordings.cloud_file import LABEL_FIELDS, UNORGANISED
from sq_perception.recordings.publication import size_of

_WAITING = 64
"""Images that wait for camera_info or mask at the same time; beyond them the oldest stops waiting. If it were dropped
instead, a camera that sends so many within ``patience`` would never get an answer."""


@dataclass(frozen=True)
class Arrival:
    """A depth image with its camera_info and mask; ``size`` is None for a message that is no image and is refused at
    once.  ``time`` is its arrival, ``deadline`` the end of its wait, seconds of the monotonic clock."""

    message: DepthMessage
    size: tuple[int, int] | None
    time: float
    deadline: float
    needs_mask: bool
    mask: MaskMessage | None = None


@dataclass(frozen=True)
class _Info:
    stamp: int
    size: tuple[int, int]
    calibration: Calibration | None
    fault: str


class Input:
    """The subscriptions of an active node and their messages.  An image that comes while none ``is_wanted`` is dropped
    at once."""

    def __init__(
        self, node: Node, settings: LiveParameters[RecoverParameters], is_wanted: Callable[[], bool],
        statistics: Statistics,
    ) -> None:
        self._node, self._settings, self._is_wanted, self._statistics = node, settings, is_wanted, statistics
        transport = settings.current.image_transport
        self.topic = frames.image_topic(node, transport)  # topic of the depth images
        self._note = ""
        self._numbers_note: tuple[str, ...] = ()
        self._last_image = monotonic()
        self._changed = threading.Condition()  # guards the following attributes
        self._waiting: deque[Arrival] = deque()
        self._ready: Arrival | None = None
        self._infos: deque[_Info] = deque(maxlen=16)
        self._image_stamp = -1  # stamp of the last image
        self._are_paired = False  # whether an image has had a camera_info of its own stamp
        self._masks: OrderedDict[int, MaskMessage] = OrderedDict()
        self._is_closed = False
        # Subscriptions are served in this order: what an image needs is there before the image.
        self._info: Listener | None = None
        if settings.current.projection == "pinhole" and transport != POINTS:
            self._info = Listener(node, CameraInfo, "depth/camera_info", self._on_info, statistics)
        self._latched: Subscription | None = None
        self._mask = Listener(node, Image, "mask/image", self._on_mask, statistics)
        self._detections: Listener | None = optional(
            node, lambda kind: Listener(node, kind, "mask/detections", self._on_mask, statistics),
            "yolo_msgs/msg/DetectionArray",
        )
        kind = {RAW: Image, POINTS: PointCloud2}.get(transport, CompressedImage)
        self._image = Listener(node, kind, self.topic, self._on_image, statistics)

    def follow_publishers(self) -> None:
        """Adapt to the publishers and to a latched camera_info; called each second."""
        for listener in self._listeners:
            listener.follow()
        topic = self._node.resolve_topic_name("mask/detections")
        if self._detections is None and self._node.count_publishers(topic) > 0:
            text = f"{topic} is not read: yolo_msgs is not installed, or its workspace is not sourced"
            self._node.get_logger().warning(text, throttle_duration_sec=THROTTLE)
        if self._info is not None and self._latched is None and not self._is_closed:
            self._latched = frames.listen_to_latched_info(self._node, self._info.topic, self._on_info)

    @property
    def _listeners(self) -> tuple[Listener, ...]:
        return tuple(one for one in (self._image, self._mask, self._detections, self._info) if one is not None)

    @property
    def silence(self) -> float:
        """Return the seconds since the last depth image."""
        return monotonic() - self._last_image

    @property
    def heard(self) -> str:
        """Describe who publishes depth images, and whether they can be received."""
        return self._image.publishers

    def close(self) -> None:
        """Stop listening and release the worker; drop what waits."""
        with self._changed:
            self._is_closed = True
            left = len(self._waiting) + (self._ready is not None)
            self._waiting.clear()
            self._ready = None
            self._changed.notify_all()
        self._statistics.count("dropped", left)
        for listener in self._listeners:
            listener.close()
        if self._latched is not None:
            self._node.destroy_subscription(self._latched)

    # For the worker

    def wait(self) -> bool:
        """Wait until an image can be taken; False once the input is closed."""
        with self._changed:
            while not self._is_closed:
                now = monotonic()
                self._promote(now)
                if self._ready is not None:
                    return True
                deadline = min((arrival.deadline for arrival in self._waiting), default=None)
                self._changed.wait(None if deadline is None else max(deadline - now, 0.0))
            return False

    def take(self) -> Arrival | None:
        """Return the image that :meth:`wait` waited for, or a newer one; None if there is none."""
        with self._changed:
            self._promote(monotonic())
            arrival, self._ready = self._ready, None
            if arrival is not None and arrival.mask is None:  # it may have come since, beyond the patience
                arrival = replace(arrival, mask=self._masks.pop(stamp_of(arrival.message), None))
            return arrival

    def frame(self, arrival: Arrival, parameters: RecoverParameters, view: tuple[str, Pose] | None = None) -> Frame:
        """Decode an image with its camera_info and mask; points are moved into the frame of a ``view``.  Raises
        ValueError for anything that keeps it from being processed."""
        message, use, source = arrival.message, parameters.use_masks, self._info
        frame = frames.decode(
            message, None if source is None else lambda: self._calibration_of(message, source),
            parameters.depth_scale or None, parameters.depth_kind, view,
        )
        if use == "never" and frame.labels is not None:
            frame = replace(frame, labels=None)
        if frame.notes and frame.notes != self._numbers_note:
            self._numbers_note = frame.notes
            self._node.get_logger().info(f"{self.topic}: {'; '.join(frame.notes)}", throttle_duration_sec=THROTTLE)
        if not frame.has_free_space:
            self._node.get_logger().warning(f"{self.topic}: {UNORGANISED}", throttle_duration_sec=THROTTLE)
            if use == "always" and frame.labels is None:
                raise ValueError("mask: expected an image or an organised cloud (use_masks is always), got another one")
            return frame  # whose pixels are those of no mask
        if use == "always" and arrival.mask is None and frame.labels is None:
            expected = "expected one with the stamp of the image (use_masks is always)"
            raise ValueError(f"mask: {expected}, none came on {self._mask.topic} or mask/detections")
        if use == "auto" and arrival.needs_mask and arrival.mask is None:
            self._statistics.count(WITHOUT_MASK)
            self._node.get_logger().warning(
                f"{self._mask.topic}: no mask with the stamp of the image within {parameters.patience:g} s (patience): "
                "segmented here",
                throttle_duration_sec=THROTTLE,
            )
        return frame if arrival.mask is None or use == "never" else frame.with_mask(arrival.mask)

    def _calibration_of(self, image: DepthMessage, source: Listener) -> Calibration:
        size = size_of(image)
        with self._changed:
            info, _ = self._info_for(size, stamp_of(image))
            last = self._infos[-1] if self._infos else None
        if info is not None and info.calibration is not None:
            return info.calibration
        wanted = f"camera_info: expected one for {size[0]} x {size[1]} pixels"
        if info is not None:
            fault = info.fault
        elif last is None:
            fault = f"{wanted}, none came"
        else:
            why = last.fault or size_mismatch(size, last.size)
            fault = f"{wanted}, the last one is for {last.size[0]} x {last.size[1]} ({why})"
        raise ValueError(f"{fault}, on {source.topic}: {source.publishers}")

    # Callbacks, in the executor's thread: quick, and nothing in them can fail on a message's content

    def _on_image(self, message: DepthMessage) -> None:
        now = self._last_image = monotonic()
        self._statistics.count("received")
        if not self._is_wanted():
            self._statistics.count("dropped")
            return
        parameters = self._settings.current
        try:
            size = size_of(message)
        except ValueError:
            size = None
        use, deadline = parameters.use_masks, now + parameters.patience
        topics = [one.topic for one in (self._mask, self._detections) if one is not None]
        has_publisher = any(self._node.count_publishers(topic) > 0 for topic in topics)
        has_labels = isinstance(message, PointCloud2) and any(one.name in LABEL_FIELDS for one in message.fields)
        needs_mask = not has_labels and (use == "always" or (use == "auto" and has_publisher))
        with self._changed:
            if self._is_closed:
                self._statistics.count("dropped")
                return
            self._image_stamp = stamp_of(message)
            self._are_paired |= any(info.stamp == self._image_stamp for info in self._infos)
            self._waiting.append(Arrival(message, size, now, deadline, needs_mask))
            self._promote(now)

    def _on_info(self, message: CameraInfo) -> None:
        """Store a camera_info; an invalid one is stored as the reason for refusing frames of its size."""
        size, calibration, fault = (int(message.width), int(message.height)), None, ""
        try:
            calibration = Calibration.of(message, self.topic, self._settings.current.distortion)
            size = calibration.size
            if calibration.note != self._note:
                self._note = calibration.note
                text = f"{self.topic}: {calibration.note or 'no distortion'}"
                self._node.get_logger().info(text, throttle_duration_sec=THROTTLE)
        except ValueError as error:
            fault = str(error)
        with self._changed:
            self._infos.append(_Info(stamp_of(message), size, calibration, fault))
            self._are_paired |= stamp_of(message) == self._image_stamp
            self._promote(monotonic())

    def _on_mask(self, message: MaskMessage) -> None:
        """Store masks for the depth image with its stamp; ignore one without a stamp."""
        if stamp_of(message) == 0:
            return
        with self._changed:
            self._masks[stamp_of(message)] = message
            while len(self._masks) > 8:
                self._masks.popitem(last=False)
            self._promote(monotonic())

    # What waits, with the lock held

    def _promote(self, now: float) -> None:
        """Make the newest image ready that is complete or has waited long enough; it replaces older ones."""
        ready = [k for k, arrival in enumerate(self._waiting) if arrival.deadline <= now or self._is_complete(arrival)]
        if not ready and len(self._waiting) > _WAITING:
            ready = [0]
        if ready:
            gone = [self._waiting.popleft() for _ in range(ready[-1] + 1)]
            arrival = gone.pop()
            gone += [self._ready] if self._ready is not None else []
            self._ready = replace(arrival, mask=self._masks.pop(stamp_of(arrival.message), None))
            self._statistics.count("dropped", len(gone))
        self._changed.notify_all()

    def _is_complete(self, arrival: Arrival) -> bool:
        if arrival.size is None:
            return True
        stamp = stamp_of(arrival.message)
        has_info = self._info is None or self._info_for(arrival.size, stamp)[1]
        return has_info and (not arrival.needs_mask or stamp in self._masks)

    def _info_for(self, size: tuple[int, int], stamp: int) -> tuple[_Info | None, bool]:
        """Return the camera_info of an image, or the latest of its size, and whether the image need not wait: drivers
        publish it later, and where it changes another one's would shift every body."""
        fitting = [info for info in self._infos if info.size == size]
        if own := [info for info in fitting if info.stamp == stamp]:
            return own[-1], True
        if not fitting:
            return None, False
        return fitting[-1], not self._are_paired or all(one.calibration == fitting[0].calibration for one in fitting)
