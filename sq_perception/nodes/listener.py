"""A subscription that is as reliable as the publishers of its topic allow, and that lists the publishers.

Keep last 1.  A best effort subscription receives every publisher, but loses large messages that do not fit into the
publisher's shared memory: of VGA depth images, four in five.  A reliable subscription loses none, but receives no best
effort publisher.  So a listener is reliable while no publisher of its topic is best effort; it checks again when one
appears or leaves.  DDS cannot change a live subscription: a new one replaces it.  If
``qos_overrides.<topic>.subscription.reliability`` is reliable or best_effort, that takes precedence.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSCompatibility, QoSPolicyKind, QoSReliabilityPolicy, qos_check_compatible
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

from sq_perception.nodes import process
from sq_perception.nodes.frame import newest_qos
from sq_perception.nodes.statistics import THROTTLE, Statistics

_RELIABILITIES = {
    "best_available": None,
    "reliable": QoSReliabilityPolicy.RELIABLE,
    "best_effort": QoSReliabilityPolicy.BEST_EFFORT,
}
"""Values of the override, as rmw names them; None follows the publishers."""


class Listener:
    """A subscription whose ``statistics`` count lost messages.  Call :meth:`follow` each second.  Raises ValueError for
    an override that is no reliability."""

    def __init__(
        self, node: Node, kind: type[Any], topic: str, callback: Callable[[Any], None], statistics: Statistics
    ) -> None:
        self._node, self._kind, self._callback, self._statistics = node, kind, callback, statistics
        # Kept: of a subscription that another thread destroys meanwhile not even the name can be asked.
        self.topic = str(node.resolve_topic_name(topic))  # the resolved name
        self._asked = _reliability_override(node, self.topic)
        self._lock = threading.Lock()
        """Guards the subscription: it is replaced in the executor's thread and closed in another one."""
        self._subscription: Subscription | None = None
        self._subscribe(self._choose_reliability())

    @property
    def publishers(self) -> str:
        """Describe who publishes the topic, with which quality of service, and which of them cannot be received."""
        parts = []
        for publisher in self._node.get_publishers_info_by_topic(self.topic):
            offered = publisher.qos_profile
            verdict, why = qos_check_compatible(offered, self._qos)
            kinds = ", ".join(one.name.lower().replace("_", " ") for one in (offered.reliability, offered.durability))
            note = f"; INCOMPATIBLE: {why.strip().rstrip(';')}" if verdict == QoSCompatibility.ERROR else ""
            name = f"{publisher.node_namespace.rstrip('/')}/{publisher.node_name}"
            parts.append(f"{name} ({publisher.topic_type}, {kinds}{note})")
        count = len(parts)
        return f"{count} publisher{'s' * (count > 1)}: {', '.join(parts)}" if parts else "nobody publishes it"

    def follow(self) -> None:
        """Subscribe as the publishers now offer."""
        wanted = self._choose_reliability()
        with self._lock:
            if (replaced := self._subscription) is not None and wanted != self._qos.reliability:
                self._subscribe(wanted)
                self._node.destroy_subscription(replaced)

    def close(self) -> None:
        """Stop listening."""
        with self._lock:
            if self._subscription is not None:
                self._node.destroy_subscription(self._subscription)
            self._subscription = None

    def _choose_reliability(self) -> QoSReliabilityPolicy:
        offered = [one.qos_profile.reliability for one in self._node.get_publishers_info_by_topic(self.topic)]
        best_effort = QoSReliabilityPolicy.BEST_EFFORT
        return self._asked or (best_effort if best_effort in offered else QoSReliabilityPolicy.RELIABLE)

    def _subscribe(self, reliability: QoSReliabilityPolicy) -> None:
        self._qos = newest_qos()  # rclpy writes the overrides into it
        self._qos.reliability = reliability
        events = SubscriptionEventCallbacks(
            matched=lambda _: self.follow(), incompatible_qos=lambda _: self._on_incompatible(),
            message_lost=self._on_message_lost,
        )
        overridable = QoSOverridingOptions(policy_kinds=(QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH))
        self._subscription = self._node.create_subscription(
            self._kind, self.topic, self._callback, self._qos, event_callbacks=events,
            qos_overriding_options=overridable,
        )

    def _on_incompatible(self) -> None:
        if self._asked is None:
            self.follow()
        else:
            self._node.get_logger().warning(f"{self.topic}: {self.publishers}", throttle_duration_sec=THROTTLE)

    def _on_message_lost(self, event: Any) -> None:
        self._statistics.lose(self.topic, event.total_count_change)
        if self._qos.reliability == QoSReliabilityPolicy.BEST_EFFORT:
            remedy = (
                "best effort messages that do not fit into the shared memory which Fast DDS reserves are lost. Make "
                "the PUBLISHER (the camera driver) reliable, or start it with "
                f"{process.PROFILE}={process.profile_path()}"
            )
        else:
            remedy = (
                "a reliable publisher's queue was full before they were delivered. Raise the depth of the PUBLISHER "
                f"(the camera driver), or set qos_overrides.{self.topic}.subscription.reliability to best_effort"
            )
        text = f"{event.total_count} messages of {self.topic} lost before they arrived: {remedy}"
        self._node.get_logger().warning(text, throttle_duration_sec=THROTTLE)


def _reliability_override(node: Node, topic: str) -> QoSReliabilityPolicy | None:
    """Return the user's choice for a topic; rclpy's own override cannot be told from the default."""
    name = f"qos_overrides.{topic}.subscription.reliability"
    if not node.has_parameter(name):
        about = ParameterDescriptor(
            description=f"{', '.join(_RELIABILITIES)}; the first one follows the publishers", read_only=True
        )
        node.declare_parameter(name, "best_available", about)
    given = str(node.get_parameter(name).value)
    if given not in _RELIABILITIES:
        raise ValueError(f"{name}: expected one of {', '.join(_RELIABILITIES)}, got {given}")
    return _RELIABILITIES[given]
