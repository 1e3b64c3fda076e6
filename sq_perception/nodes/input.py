"""The input of a frame node: its subscriptions, and the frames that are made of their messages."""

from __future__ import annotations

from collections.abc import Callable
from time import monotonic
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import (
    QoSCompatibility,
    QoSDurabilityPolicy,
    QoSHistoryPolicy,
    QoSProfile,
    QoSReliabilityPolicy,
    qos_check_compatible,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from sq_perception.imaging.calibration import Calibration
from sq_perception.nodes import fast_dds
from sq_perception.nodes.frame import Frame, Refused, decode, image_topic
from sq_perception.nodes.inbox import Arrival, Inbox, NoCameraInfo
from sq_perception.nodes.parameters import RAW, RecoverParameters
from sq_perception.nodes.statistics import THROTTLE, Statistics


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
        parameters: Callable[[], RecoverParameters],
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
        self._is_closed = False
        self._info: Subscription | None = None
        self._latched: Subscription | None = None
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

    def look_for_latched(self) -> None:
        """Subscribe to a camera_info that was published once and is kept for late comers, if there is one; each second.

        Not from the start: a driver that keeps nothing would log an incompatible subscription.
        """
        if self._info is None or self._latched is not None or self._is_closed:
            return
        offered = self._node.get_publishers_info_by_topic(self._info.topic_name)
        if any(one.qos_profile.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL for one in offered):
            self._latched = self._node.create_subscription(
                CameraInfo,
                self._info.topic_name,
                self.inbox.put_info,
                QoSProfile(
                    depth=1,
                    reliability=QoSReliabilityPolicy.RELIABLE,
                    durability=QoSDurabilityPolicy.TRANSIENT_LOCAL,
                ),
                # Others on the topic may keep nothing; the plain subscription hears them.
                event_callbacks=SubscriptionEventCallbacks(incompatible_qos=lambda _: None),
            )

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
        self._is_closed = True
        for one in (self._image, self._mask, self._latched, self._info):
            if one is not None:
                self._node.destroy_subscription(one)
        self._statistics.count("dropped", self.inbox.close())

    def frame(self, arrival: Arrival, parameters: RecoverParameters) -> Frame:
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

    def _listen(self, kind: type[Any], topic: str, callback: Callable[[Any], None]) -> Subscription:
        made = self._node.create_subscription(
            kind,
            topic,
            callback,
            QoSProfile(depth=1, history=QoSHistoryPolicy.KEEP_LAST, reliability=QoSReliabilityPolicy.BEST_EFFORT),
            event_callbacks=SubscriptionEventCallbacks(message_lost=lambda event: self._on_lost(made, event)),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
        return made

    def _on_lost(self, subscription: Subscription, event: Any) -> None:
        topic = subscription.topic_name
        self._statistics.lose(topic, event.total_count_change)
        if subscription.qos_profile.reliability == QoSReliabilityPolicy.BEST_EFFORT:
            remedy = (
                "best effort messages that do not fit into the shared memory which Fast DDS reserves are lost. Start "
                f"the PUBLISHER (the camera driver) with {fast_dds.VARIABLE}={fast_dds.profile_path()}, or set "
                f"qos_overrides.{topic}.subscription.reliability to reliable"
            )
        else:
            remedy = (
                "a reliable publisher's queue was full before they were delivered. Raise the depth of the PUBLISHER "
                f"(the camera driver), or set qos_overrides.{topic}.subscription.reliability to best_effort"
            )
        said = f"{event.total_count} messages of {topic} lost before they arrived: {remedy}"
        self._node.get_logger().warning(said, throttle_duration_sec=THROTTLE)

    def _publishers_of(self, subscription: Subscription | None) -> str:
        """Who publishes a topic, with which quality of service, and whether the subscription can hear it."""
        if subscription is None:
            return "nothing is subscribed to"
        parts = []
        for one in self._node.get_publishers_info_by_topic(subscription.topic_name):
            profile = one.qos_profile
            verdict, why = qos_check_compatible(profile, subscription.qos_profile)
            said = ", ".join(
                policy.name.lower().replace("_", " ") for policy in (profile.reliability, profile.durability)
            )
            note = f"; INCOMPATIBLE: {why.strip().rstrip(';')}" if verdict == QoSCompatibility.ERROR else ""
            parts.append(f"{one.node_namespace.rstrip('/')}/{one.node_name} ({one.topic_type}, {said}{note})")
        count = len(parts)
        return f"{count} publisher{'s' * (count > 1)}: {', '.join(parts)}" if parts else "nobody publishes it"
