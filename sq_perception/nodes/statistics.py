"""Counts and latencies of a node, and what it says about them: diagnostics, summaries, publishers of its topics.

Every received frame ends as exactly one of answered, dropped (a newer one came first, or the node is disabled) and
refused (bad input); the rest is in work.  Counts are since the start, rates and latencies of the last seconds.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime, timezone
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

SECONDS = 10.0
"""What rates and latencies are taken over."""
_MOST = 3000
"""Durations that are kept of a stage: more than any camera sends in that time."""
_SLOW = 3.0
"""Seconds after which a frame without a verdict tells of more than a start."""


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
    received, answered, dropped, refused
        Frames since the start.
    lost
        Messages since the start that were never received, by topic.
    recent
        Frames received, answered, dropped and refused in the last :data:`SECONDS`.
    starved
        Seconds since the first of the recent frames came, if none was answered since then; else 0.
    rate
        Answers per second over the last :data:`SECONDS`.
    latency
        (median, 95th percentile) in milliseconds by stage, of the same answers.
    last_error
        What was wrong with the last refused frame; empty if none was.
    last_error_time
        When that was, UTC, to the second.
    last_answer
        The summary of the last answered frame: also why there are no bodies.
    """

    received: int = 0
    answered: int = 0
    dropped: int = 0
    refused: int = 0
    lost: Mapping[str, int] = field(default_factory=dict)
    recent: Mapping[str, int] = field(default_factory=dict)
    starved: float = 0.0
    rate: float = 0.0
    latency: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    last_error: str = ""
    last_error_time: str = ""
    last_answer: str = ""

    @property
    def in_work(self) -> int:
        """Frames that were received and have no verdict yet."""
        return self.received - self.answered - self.dropped - self.refused


class Statistics:
    """Collects from any thread; ``clock`` tells seconds."""

    def __init__(self, clock: Callable[[], float] = monotonic) -> None:
        self._clock, self._started = clock, clock()
        self._lock = threading.Lock()
        self._counts = dict.fromkeys(("received", "answered", "dropped", "refused"), 0)
        self._recent: dict[str, deque[float]] = {what: deque() for what in self._counts}
        self._stages: dict[str, deque[tuple[float, float]]] = {}
        self._lost: dict[str, int] = {}
        self._last_error = self._last_error_time = self._last_answer = ""

    def count(self, what: str, number: int = 1) -> None:
        """Add to received or dropped."""
        with self._lock:
            self._add(what, number)

    def lose(self, topic: str, number: int) -> None:
        """Count messages of a topic that were never received."""
        with self._lock:
            self._lost[topic] = self._lost.get(topic, 0) + number

    def refuse(self, reason: str) -> None:
        """Count a refused frame."""
        with self._lock:
            self._add("refused", 1)
            self._last_error = reason
            self._last_error_time = datetime.now(timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ")

    def answer(self, milliseconds: Mapping[str, float], summary: str = "") -> None:
        """Count an answered frame with the duration of its stages."""
        with self._lock:
            self._add("answered", 1)
            self._last_answer = summary
            self._keep(milliseconds)

    def note(self, milliseconds: Mapping[str, float]) -> None:
        """Keep the duration of stages that follow the answer."""
        with self._lock:
            self._keep(milliseconds)

    def snapshot(self) -> Snapshot:
        """The state of affairs now."""
        with self._lock:
            now = self._clock()
            for times in self._recent.values():
                _forget(times, now)
            for durations in self._stages.values():
                while durations and now - durations[0][0] > SECONDS:
                    durations.popleft()
            counts, lost, recent = dict(self._counts), dict(self._lost), {k: len(v) for k, v in self._recent.items()}
            starved = now - self._recent["received"][0] if recent["received"] and not recent["answered"] else 0.0
            stages = {stage: np.array([took for _, took in kept]) for stage, kept in self._stages.items() if kept}
            last = self._last_error, self._last_error_time, self._last_answer
        latency = {name: (float(np.median(x)), float(np.percentile(x, 95))) for name, x in stages.items()}
        seconds = min(SECONDS, max(now - self._started, 1.0))
        return Snapshot(
            **counts,
            lost=lost,
            recent=recent,
            starved=starved,
            rate=recent["answered"] / seconds,
            latency=latency,
            last_error=last[0],
            last_error_time=last[1],
            last_answer=last[2],
        )

    def _add(self, what: str, number: int) -> None:
        now = self._clock()
        self._counts[what] += number
        self._recent[what].extend([now] * number)
        _forget(self._recent[what], now)

    def _keep(self, milliseconds: Mapping[str, float]) -> None:
        now = self._clock()
        for stage, duration in milliseconds.items():
            kept = self._stages.setdefault(stage, deque(maxlen=_MOST))
            kept.append((now, duration))


def _forget(times: deque[float], now: float) -> None:
    while times and now - times[0] > SECONDS:
        times.popleft()


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

    ERROR where it cannot work, WARN where frames stay away or come and none is answered, get lost or were refused since
    the last report, or a change came to nothing.
    """
    lost = {topic: number - before.lost.get(topic, 0) for topic, number in now.lost.items()}
    lost = {topic: number for topic, number in lost.items() if number}
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
    elif now.starved > _SLOW:
        came = f"{now.recent['received']} frames came within {now.starved:.0f} s, none was answered"
        level, message = DiagnosticStatus.WARN, came
    elif lost:
        parts = ", ".join(f"{number} of {topic}" for topic, number in lost.items())
        level, message = DiagnosticStatus.WARN, f"messages lost before they arrived: {parts}"
    values = {
        "rate [Hz]": f"{now.rate:.2f}",
        "received": str(now.received),
        "answered": str(now.answered),
        "dropped": str(now.dropped),
        "refused": str(now.refused),
        "in work": str(now.in_work),
        "lost": str(sum(now.lost.values())),
        **{f"lost of {topic}": str(number) for topic, number in now.lost.items()},
        "state": condition.state,
        "enabled": str(condition.enabled).lower(),
        "engine": condition.engine,
        "last error": f"{now.last_error_time} {now.last_error}" if now.last_error else "",
        "last answer": now.last_answer,
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
