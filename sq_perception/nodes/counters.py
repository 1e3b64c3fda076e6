"""Counts and latencies of a node, and words for them.

Every received frame ends as exactly one of answered, dropped (a newer one came first, or the node is disabled) and
refused (bad input); the rest is in work.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from time import monotonic

import numpy as np

_WINDOW = 300
"""Frames that the medians are taken over."""
_RATE_SECONDS = 5.0
_MOST_KEYS = 64


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


class Throttle:
    """Lets a text of a kind through once in a while and counts the ones that it holds back."""

    def __init__(self, seconds: float = 5.0) -> None:
        self._seconds = seconds
        self._lock = threading.Lock()
        self._last: dict[str, tuple[float, int]] = {}

    def passes(self, kind: str) -> str | None:
        """None to hold back; otherwise a remark on how many were held back since the last time, mostly empty."""
        with self._lock:
            now = monotonic()
            last, held = self._last.get(kind, (-np.inf, 0))
            if now - last < self._seconds:
                self._last[kind] = last, held + 1
                return None
            if len(self._last) >= _MOST_KEYS:
                self._last.clear()
            self._last[kind] = now, 0
            return f" ({held} more since)" if held else ""
