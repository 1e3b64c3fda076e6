"""Callers of ``~/trigger`` that wait for a frame."""

from __future__ import annotations

import threading
from time import monotonic
from typing import Any

from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

Outcome = tuple[bool, str]
"""Whether a frame was answered, and the summary or the reason."""


class Triggers:
    """Lets service calls wait for the outcome of the next frame; asked in the executor, answered by the worker."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._lock = threading.Lock()
        self._waiting: list[tuple[float, Future]] = []

    def __len__(self) -> int:
        """How many callers wait."""
        return len(self._waiting)

    async def outcome(self, response: Trigger.Response, timeout: float, why_none: Any) -> Trigger.Response:
        """The response with the outcome of the next frame, or what ``why_none()`` says if none comes in time."""
        future: Future = Future(executor=self._node.executor)
        entry = monotonic(), future
        with self._lock:
            self._waiting.append(entry)

        def expire() -> None:
            with self._lock:
                if entry not in self._waiting:
                    return
                self._waiting.remove(entry)
            future.set_result((False, why_none()))

        timer = self._node.create_timer(timeout, expire)
        response.success, response.message = await future
        self._node.destroy_timer(timer)
        return response

    def answer(self, outcome: Outcome, arrived: float = float("inf")) -> None:
        """Answer those that were waiting when the frame arrived, at ``arrived`` of the monotonic clock; or all."""
        with self._lock:
            waiting = [entry for entry in self._waiting if entry[0] <= arrived]
            self._waiting = [entry for entry in self._waiting if entry not in waiting]
        for _, future in waiting:
            future.set_result(outcome)
        if waiting and self._node.executor is not None:
            self._node.executor.wake()
