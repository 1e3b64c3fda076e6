"""Words and numbers about a node's state: diagnostics, summaries, publishers and their quality of service."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible
from rclpy.topic_endpoint_info import TopicEndpointInfo

from sq_perception.fitting.fit import Status
from sq_perception.nodes.counters import Snapshot
from sq_perception.recovery.recoverer import FrameRecovery
from sq_perception.tracking.session import Tally


@dataclass(frozen=True)
class Condition:
    """What a node is like, beside its counts.

    Attributes
    ----------
    state
        Of its lifecycle.
    fault
        Why a transition or a change of the model came to nothing; empty if all went well.
    silent
        Whether images are expected and stay away.
    enabled
        Whether images are processed.
    engine
        What computes, in a few words.
    absent
        Packages that outputs are asked for and that are not there.
    tally
        Of the tracking session; None where nothing is tracked.
    """

    state: str = "active"
    fault: str = ""
    silent: bool = False
    enabled: bool = True
    engine: str = ""
    absent: tuple[str, ...] = ()
    tally: Tally | None = None


def status(name: str, now: Snapshot, before: Snapshot, condition: Condition) -> DiagnosticStatus:
    """The diagnostics of a node.

    ERROR where it cannot work, WARN where frames stay away, get lost or were refused since the last report, or a
    change came to nothing.
    """
    level, message = DiagnosticStatus.OK, f"{now.rate:.1f} Hz"
    if condition.state != "active":
        level = DiagnosticStatus.ERROR if condition.fault else DiagnosticStatus.OK
        message = condition.state + (f": {condition.fault}" if condition.fault else "")
    elif condition.fault:
        level, message = DiagnosticStatus.WARN, condition.fault
    elif not condition.enabled:
        message = "disabled"
    elif condition.silent:
        level, message = DiagnosticStatus.WARN, "no depth images arrive"
    elif now.refused > before.refused:
        level, message = DiagnosticStatus.WARN, f"refused a frame: {now.last_error}"
    elif now.lost > before.lost:
        level, message = DiagnosticStatus.WARN, f"{now.lost - before.lost} messages lost before they arrived"
    values = {
        "rate [Hz]": f"{now.rate:.2f}",
        "received": str(now.received),
        "answered": str(now.answered),
        "dropped": str(now.dropped),
        "refused": str(now.refused),
        "in work": str(now.in_work),
        "lost": str(now.lost),
        "state": condition.state,
        "enabled": str(condition.enabled).lower(),
        "engine": condition.engine,
        "last error": now.last_error,
    }
    if condition.absent:
        values["missing packages"] = " ".join(condition.absent)
    tally = condition.tally
    if tally is not None:
        values["tracks"] = str(tally.tracks)
        values["track ids given"] = str(tally.births)
        values["track resets"] = str(tally.resets)
        values["frames without camera pose"] = str(tally.without_pose)
    for stage, (median, high) in now.latency.items():
        values[f"{stage}: median [ms]"] = f"{median:.2f}"
        values[f"{stage}: p95 [ms]"] = f"{high:.2f}"
    pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
    return DiagnosticStatus(
        level=level, name=f"{name.lstrip('/')}: frames", message=message, hardware_id=name, values=pairs
    )


def summary(recovery: FrameRecovery, ids: Sequence[int]) -> str:
    """One frame's results in a line, with the ids of its bodies."""
    took = f"in {recovery.milliseconds.get('total', 0.0):.0f} ms"
    if not recovery.bodies:
        return f"no bodies {took}" + (f": {recovery.message}" if recovery.message else "")
    parts = []
    for one, number in zip(recovery.bodies, ids, strict=True):
        if one.status == Status.FAILED:
            parts.append(f"{number}: failed, {one.message}")
            continue
        size, shape = one.superquadric.size, one.superquadric.shape
        parts.append(
            f"{number}: a = {size[0]:.4f} {size[1]:.4f} {size[2]:.4f}, e = {shape[0]:.2f} {shape[1]:.2f}, "
            f"score {one.score:.2f}"
        )
    count = len(recovery.bodies)
    return f"{count} {'body' if count == 1 else 'bodies'} {took}; " + "; ".join(parts)


def publishers(offered: Sequence[TopicEndpointInfo], wanted: QoSProfile) -> str:
    """Who publishes a topic, with which quality of service, and whether a subscription can hear it."""
    if not offered:
        return "nobody publishes it"
    parts = []
    for one in offered:
        profile = one.qos_profile
        verdict, why = qos_check_compatible(profile, wanted)
        said = f"{_name(profile.reliability)}, {_name(profile.durability)}"
        namespace = one.node_namespace.rstrip("/")
        note = f"; INCOMPATIBLE: {why.strip().rstrip(';')}" if verdict == QoSCompatibility.ERROR else ""
        parts.append(f"{namespace}/{one.node_name} ({one.topic_type}, {said}{note})")
    count = len(parts)
    return f"{count} publisher{'s' if count > 1 else ''}: " + ", ".join(parts)


def _name(policy: object) -> str:
    return str(getattr(policy, "name", policy)).lower().replace("_", " ")
