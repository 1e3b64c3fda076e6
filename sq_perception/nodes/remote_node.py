"""Another node as the page sees it: its parameters, and whether it is there.

Services are called by tasks of the executor; a call without an answer is given up after a while, as the node may have
died.  Parameters are always read as a whole: when the node appears, and again soon after something may have changed.
What is to be shown waits in its order, and the drawing thread takes it with :meth:`RemoteNode.show`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from time import monotonic
from typing import Any

from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.task import Future

from sq_perception.viewing.controls import control
from sq_perception.viewing.page import Page

_PATIENCE = 3.0
"""Seconds until a call is given up."""
_SETTLED = 0.4
"""Seconds until parameters are read after a change: a node that starts sends an event for each."""


class RemoteNode:
    """One node of a fully qualified ``name``; ``node`` asks it."""

    def __init__(self, node: Node, name: str) -> None:
        self.name = name
        self.is_there = False
        self._node = node
        self._parameters = AsyncParameterClient(node, name)
        self._deadlines: dict[Future, float] = {}
        self._load_due: float | None = None
        self._news: deque[Callable[[Page], None]] = deque()

    # In the executor's thread

    def tick(self) -> None:
        """Look after the node; called often."""
        now, executor = monotonic(), self._node.executor
        assert executor is not None, "this is called by its thread"
        for call, deadline in tuple(self._deadlines.items()):
            if now > deadline:
                call.cancel()  # nothing happens to one that is done
        was_there, self.is_there = self.is_there, self._parameters.services_are_ready()
        if self.is_there and not was_there:
            self._load_due = now
        if self._load_due is not None and now >= self._load_due and self.is_there:
            self._load_due = None
            executor.create_task(self._load)

    def reload(self) -> None:
        """Read the parameters again, soon: one may have changed, come or gone."""
        if self._load_due is None:
            self._load_due = monotonic() + _SETTLED

    async def change(self, name: str, value: Any) -> None:
        """Ask for another value of a parameter; the node's answer is shown, and then what it holds."""
        if not self.is_there:
            self._note(f"{name}: {self.name} is not there", False)
            return
        try:
            response = await self._answer(self._parameters.set_parameters([Parameter(name, value=value)]))
        except TimeoutError:
            self._note(f"{name}: no answer from {self.name} within {_PATIENCE:g} s", False)
            return
        result = response.results[0]
        # Not every reason of rclpy's own names its parameter.
        reason = result.reason if name in result.reason else f"{name}: {result.reason or 'refused'}"
        self._note(f"{name} is now {value}" if result.successful else reason, result.successful)
        self.reload()

    async def _load(self) -> None:
        """Names, then descriptors, then values, then controls; all over again where an answer stays away."""
        try:
            listed = await self._answer(self._parameters.list_parameters())
            described = await self._answer(self._parameters.describe_parameters(list(listed.result.names)))
            names = [descriptor.name for descriptor in described.descriptors]
            got = await self._answer(self._parameters.get_parameters(names))
        except TimeoutError:
            self.reload()
            return
        read = [parameter_value_to_python(value) for value in got.values]
        made = (control(*both) for both in zip(described.descriptors, read, strict=True))
        controls = [each for each in made if each is not None]
        self._news.append(lambda page: page.show_controls(self.name, controls))

    async def _answer(self, call: Future) -> Any:
        """The answer of a service.  Raises TimeoutError if there is none."""
        self._deadlines[call] = monotonic() + _PATIENCE
        try:
            answer = await call
        finally:
            del self._deadlines[call]
        if answer is None:
            raise TimeoutError
        return answer

    def _note(self, text: str, good: bool) -> None:
        self._news.append(lambda page: page.show_answer(self.name, text, good))

    # In the drawing thread

    def show(self, page: Page) -> None:
        """Put what is new into the page."""
        while self._news:
            self._news.popleft()(page)
