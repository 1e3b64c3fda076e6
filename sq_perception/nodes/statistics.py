"""Counts and latencies of a node, and what it says about them: diagnostics, summaries, publishers of its topics.

Every received frame ends as exactly one of answered, dropped (a newer one came first, or the node is disabled) and
refused (bad input); the rest is in work.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import monotonic, perf_counter

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible
from rclpy.topic_endpoint_info import TopicEndpointInfo

from sq_perception.fitting.fit import Status
from sq_perception.recovery.recoverer import FrameRecovery
from sq_perception.tracking.session import Tally

THROTTLE = 5.0
"""Seconds between two messages of the same place in the log."""

_WINDOW = 300
"""Frames that the medians are taken over."""
_RATE_SECONDS = 5.0


@contextmanager
def timed(milliseconds: dict[str, float], stage: str) -> Iterator[None]:
    """Enter the duration of the block."""
    started = perf_counter()
    yield
    milliseconds[stage] = 1e3 * (perf_counter() - started)


@dataclass(frozen=True)
class Snapshot:
    """The state of affairs at one moment.

    Attributes
    ----------
    received, answered, dropped, refused, lost
        Frames since the start; lost ones were never received.
    rate
        Answers per second over the last five seconds.
    latency
        (median, 95th percentile) in milliseconds by stage, over the last 300 answers.
    last_error
        What was wrong with the last refused frame; empty if none was.
    """

    received: int = 0
    answered: int = 0
    dropped: int = 0
    refused: int = 0
    lost: int = 0
    rate: float = 0.0
    latency: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    last_error: str = ""

    @property
    def in_work(self) -> int:
        """Frames that were received and have no verdict yet."""
        return self.received - self.answered - self.dropped - self.refused


class Statistics:
    """Collects from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts = dict.fromkeys(("received", "answered", "dropped", "refused", "lost"), 0)
        self._answers: deque[float] = deque(maxlen=1000)
        self._stages: dict[str, deque[float]] = {}
        self._last_error = ""

    def count(self, what: str, number: int = 1) -> None:
        """Add to received, dropped or lost."""
        with self._lock:
            self._counts[what] += number

    def refuse(self, reason: str) -> None:
        """Count a refused frame."""
        with self._lock:
            self._counts["refused"] += 1
            self._last_error = reason

    def answer(self, milliseconds: Mapping[str, float]) -> None:
        """Count an answered frame with the duration of its stages."""
        with self._lock:
            self._counts["answered"] += 1
            self._answers.append(monotonic())
            self._keep(milliseconds)

    def note(self, milliseconds: Mapping[str, float]) -> None:
        """Keep the duration of stages that follow the answer."""
        with self._lock:
            self._keep(milliseconds)

    def _keep(self, milliseconds: Mapping[str, float]) -> None:
        for stage, duration in milliseconds.items():
            self._stages.setdefault(stage, deque(maxlen=_WINDOW)).append(duration)

    def snapshot(self) -> Snapshot:
        """The state of affairs now."""
        with self._lock:
            counts, error = dict(self._counts), self._last_error
            now = monotonic()
            recent = sum(1 for time in self._answers if now - time <= _RATE_SECONDS)
            stages = {stage: np.array(durations) for stage, durations in self._stages.items()}
        latency = {name: (float(np.median(x)), float(np.percentile(x, 95))) for name, x in stages.items()}
        return Snapshot(**counts, rate=recent / _RATE_SECONDS, latency=latency, last_error=error)


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
