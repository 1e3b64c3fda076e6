"""Counts and latencies of a node, and their summary for diagnostics.

Every received frame ends as exactly one of answered, dropped (a newer one came first, or the node is disabled) and
refused (bad input); the rest is in progress.  Counts run from the start; rates and latencies cover the last seconds.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable, Mapping
from datetime import datetime, timezone
from time import monotonic

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

THROTTLE = 5.0  # seconds between two log messages of the same place
OLDEST = 3600.0
"""Seconds; older messages, or ones from the future, come from a bag or another clock, and their age is ignored."""
SECONDS = 10.0  # window of rates and latencies, seconds
WITHOUT_MASK = "without mask"  # frames that the node segmented although masks are published
DOUBTED = "doubted"  # frames that seem to have another unit or kind
_OUTCOMES = ("answered", "dropped", "refused")
Standing = tuple[bytes, str]  # level and message of a DiagnosticStatus


class Statistics:
    """Counts and durations from any thread; ``clock`` gives seconds, ``what`` names what is counted."""

    def __init__(self, clock: Callable[[], float] = monotonic, what: str = "frame") -> None:
        self._clock, self._started, self._what = clock, clock(), what
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._recent: deque[tuple[float, str]] = deque(maxlen=5000)
        self._stages: deque[tuple[float, Mapping[str, float]]] = deque(maxlen=5000)
        self._lost: Counter[str] = Counter()
        self._reported: tuple[Counter[str], Counter[str]] = Counter(), Counter()
        """Counts and lost messages at the last status."""
        self._stood = self._started
        """Time of the last report about something other than frames, such as that the node is disabled."""
        self._last_error = self._last_answer = self._last_doubt = ""

    def count(self, what: str, number: int = 1) -> None:
        """Count a received or dropped frame, or one of WITHOUT_MASK."""
        with self._lock:
            self._counts[what] += number
            self._recent.extend([(self._clock(), what)] * number)

    def lose(self, topic: str, number: int) -> None:
        """Count messages of a topic that were never received."""
        with self._lock:
            self._lost[topic] += number

    def refuse(self, reason: str) -> None:
        """Count a refused frame."""
        self._last_error = f"{datetime.now(timezone.utc):%Y-%m-%dT%H:%M:%SZ} {reason}"
        self.count("refused")

    def doubt(self, reason: str) -> None:
        """Count an answered frame whose image seems to have another unit or kind."""
        self._last_doubt = reason
        self.count(DOUBTED)

    def answer(self, milliseconds: Mapping[str, float], summary: str = "") -> None:
        """Count an answered frame with its stage durations; ``summary`` also explains a lack of bodies."""
        self._last_answer = summary
        with self._lock:
            self._stages.append((self._clock(), milliseconds))
        self.count("answered")

    def status(self, name: str, standing: Standing | None, more: Mapping[str, str]) -> DiagnosticStatus:
        """Return the diagnostics of a node, with ``more`` facts.  ``standing`` goes first; without it WARN where frames
        come and none is answered, or some were refused, doubted, lost or left without a mask since the last status."""
        with self._lock:
            now = self._clock()
            counts, lost = Counter(self._counts), Counter(self._lost)
            recent = [(time, what) for time, what in self._recent if time >= now - SECONDS]
            stages = [took for time, took in self._stages if time >= now - SECONDS]
            last_error, last_answer = self._last_error, self._last_answer
        recently = Counter(what for _, what in recent)
        rate = recently["answered"] / min(SECONDS, max(now - self._started, 1.0))
        came = [time for time, what in recent if what == "received" and time > self._stood]
        since = now - min(came, default=now)
        (before, known), self._reported = self._reported, (counts, lost)
        level, message = DiagnosticStatus.WARN, ""
        if standing is not None:
            level, message = standing
            self._stood = now
        elif counts["refused"] > before["refused"]:
            message = f"refused a {self._what}: {last_error.partition(' ')[2]}"
        elif counts[DOUBTED] > before[DOUBTED]:
            message = self._last_doubt
        elif since > 3.0 and not recently["answered"]:
            message = f"{len(came)} {self._what}s came within {since:.0f} s, none was answered"
        elif new := lost - known:
            parts = ", ".join(f"{number} of {topic}" for topic, number in new.items())
            message = f"messages lost before they arrived: {parts}"
        elif unmasked := counts[WITHOUT_MASK] - before[WITHOUT_MASK]:
            message = f"no mask came for {unmasked} frames: their objects are the node's own segments"
        else:
            level, message = DiagnosticStatus.OK, f"{rate:.1f} Hz"
        values = {
            "rate [Hz]": f"{rate:.2f}",
            **{what: str(counts[what]) for what in ("received", *_OUTCOMES)},
            "in work": str(counts["received"] - sum(counts[what] for what in _OUTCOMES)),
            WITHOUT_MASK: str(counts[WITHOUT_MASK]),
            DOUBTED: str(counts[DOUBTED]),
            "lost": str(lost.total()),
            **{f"lost of {topic}": str(number) for topic, number in lost.items()},
            "last error": last_error,
            "last answer": last_answer,
            **more,
        }
        for stage in dict.fromkeys(stage for took in stages for stage in took):
            median, high = np.percentile([took[stage] for took in stages if stage in took], (50, 95))
            values |= {f"{stage}: median [ms]": f"{median:.2f}", f"{stage}: p95 [ms]": f"{high:.2f}"}
        pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
        about = f"{name.lstrip('/')}: {self._what}s"
        return DiagnosticStatus(level=level, name=about, message=message, hardware_id=name, values=pairs)
