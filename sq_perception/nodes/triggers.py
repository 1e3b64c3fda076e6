"""Callers of ``~/trigger`` that wait for a frame."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from time import monotonic

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

Outcome = tuple[bool, str]
"""Whether a frame was answered, and the summary or the reason."""


_TICK = 0.05
"""Seconds between two looks at whether somebody has waited long enough."""


@dataclass(frozen=True, eq=False)
class _Caller:
    since: float
    until: float
    why_none: Callable[[], str]
    outcome: Future


class Triggers:
    """Lets service calls wait for the outcome of the next frame; asked in the executor, answered by the worker."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._lock = threading.Lock()
        self._waiting: list[_Caller] = []
        # One for all, and on a steady clock: simulated time may stand still.
        self._timer = node.create_timer(_TICK, self._expire, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._timer.cancel()

    def __len__(self) -> int:
        """How many callers wait."""
        return len(self._waiting)

    async def outcome(
        self, response: Trigger.Response, timeout: float, why_none: Callable[[], str]
    ) -> Trigger.Response:
        """The response with the outcome of the next frame, or what ``why_none()`` says if none comes in time."""
        now = monotonic()
        caller = _Caller(now, now + timeout, why_none, Future(executor=self._node.executor))
        with self._lock:
            self._waiting.append(caller)
            self._timer.reset()
        response.success, response.message = await caller.outcome
        return response

    def answer(self, outcome: Outcome, arrived: float = float("inf")) -> None:
        """Answer those that were waiting when the frame arrived, at ``arrived`` of the monotonic clock; or all."""
        with self._lock:
            waiting = [one for one in self._waiting if one.since <= arrived]
            self._waiting = [one for one in self._waiting if one not in waiting]
        for one in waiting:
            one.outcome.set_result(outcome)
        if waiting and self._node.executor is not None:
            self._node.executor.wake()

    def _expire(self) -> None:
        now = monotonic()
        with self._lock:
            late = [one for one in self._waiting if one.until <= now]
            self._waiting = [one for one in self._waiting if one not in late]
            if not self._waiting:
                self._timer.cancel()
        for one in late:
            one.outcome.set_result((False, one.why_none()))
