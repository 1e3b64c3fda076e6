"""Another node as the page sees it: its parameters, its lifecycle state, whether it is there.

All calls of services are made from the executor's thread and waited for by nobody: answers arrive as callbacks, and a
call without an answer is given up after a while, as the node may have died.  What is to be shown waits, and the drawing
thread takes it with :meth:`RemoteNode.show`.
"""

from __future__ import annotations

import importlib
import threading
from collections.abc import Callable
from time import monotonic
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor, ParameterEvent
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.task import Future

from sq_perception.viewing.controls import Control, Description, arranged
from sq_perception.viewing.page import Page

_PATIENCE = 3.0
"""Seconds until a call is given up."""
_LOOK_PERIOD = 0.5
"""Seconds between two looks at whether the node is there, and at its lifecycle state."""
_SETTLED = 0.4
"""Seconds after the last of many parameter events until they are read: a node that starts sends one for each."""
_TRANSITIONS = {"configure": 1, "cleanup": 2, "activate": 3, "deactivate": 4}
"""lifecycle_msgs/Transition."""


class RemoteNode:
    """One node.

    Parameters
    ----------
    node
        Asks.
    name
        Fully qualified, of the node that is asked.
    """

    def __init__(self, node: Node, name: str) -> None:
        self.name = name
        self.is_there = False
        self.lifecycle = ""
        self._node = node
        self._list = node.create_client(ListParameters, f"{name}/list_parameters")
        self._describe = node.create_client(DescribeParameters, f"{name}/describe_parameters")
        self._get = node.create_client(GetParameters, f"{name}/get_parameters")
        self._set = node.create_client(SetParameters, f"{name}/set_parameters")
        self._lifecycle_services: Any = None
        self._state: Client | None = None
        self._transit: Client | None = None
        self._create_lifecycle_clients()
        self._calls: list[tuple[float, Client, Future, Callable[[], None]]] = []
        self._descriptors: list[ParameterDescriptor] = []
        self._floats: set[str] = set()
        self._look_due = 0.0
        self._load_due: float | None = None
        self._lock = threading.Lock()
        self._new_controls: list[Control] | None = None
        self._new_values: dict[str, Any] = {}
        self._new_answer: tuple[str, bool] | None = None

    # In the executor's thread

    def tick(self) -> None:
        """Look after the node; called often."""
        now = monotonic()
        for deadline, client, future, give_up in list(self._calls):
            if future.done():
                self._calls.remove((deadline, client, future, give_up))
            elif now > deadline:
                self._calls.remove((deadline, client, future, give_up))
                client.remove_pending_request(future)
                give_up()
        if now >= self._look_due:
            self._look_due = now + _LOOK_PERIOD
            self._look()
        if self._load_due is not None and now >= self._load_due and self.is_there:
            self._load_due = None
            self._load()

    def on_event(self, event: ParameterEvent) -> None:
        """Follow a message of /parameter_events of this node."""
        known = {one.name for one in self._descriptors}
        if any(one.name not in known for one in event.new_parameters) or event.deleted_parameters:
            self._load_due = monotonic() + _SETTLED
        values = [*event.new_parameters, *event.changed_parameters]
        with self._lock:
            self._new_values.update({one.name: parameter_value_to_python(one.value) for one in values})

    def change(self, name: str, value: Any) -> None:
        """Ask for another value of a parameter; what the node says to it is shown."""
        if not self.is_there:
            self._say(f"{name}: {self.name} is not there", False)
            return
        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])

        def answered(response: SetParameters.Response) -> None:
            result = response.results[0]
            # Not every reason of rclpy's own says which parameter it is about.
            reason = result.reason if name in result.reason else f"{name}: {result.reason or 'refused'}"
            self._say(f"{name} is now {_shown(value)}" if result.successful else reason, result.successful)
            self._read([name])

        self._call(self._set, request, answered, lambda: self._unanswered(name))

    def transit(self, label: str) -> None:
        """Ask for a lifecycle transition."""
        if self._transit is None or label not in _TRANSITIONS:
            return
        request = self._lifecycle_services.ChangeState.Request()
        request.transition.id = _TRANSITIONS[label]

        def answered(response: Any) -> None:
            self._say(f"{label}: {'done' if response.success else 'the node could not'}", response.success)
            self._look_due = 0.0

        # Configuring loads a network and compiles.
        self._call(self._transit, request, answered, lambda: self._say(f"{label}: no answer", False), 60.0)

    def _look(self) -> None:
        was_there, self.is_there = self.is_there, self._get.service_is_ready() and self._list.service_is_ready()
        if self.is_there and not was_there:
            self._load_due = monotonic()
        if not self.is_there:
            self.lifecycle = ""
        elif self._state is not None and self._state.service_is_ready() and not self._is_asked(self._state):

            def answered(response: Any) -> None:
                self.lifecycle = str(response.current_state.label)

            self._call(self._state, self._lifecycle_services.GetState.Request(), answered)

    def _load(self) -> None:
        """Names, then descriptors, then values, then controls."""

        def listed(response: ListParameters.Response) -> None:
            names = list(response.result.names)
            self._call(self._describe, DescribeParameters.Request(names=names), described, self._load_again)

        def described(response: DescribeParameters.Response) -> None:
            descriptors = list(response.descriptors)
            names = [one.name for one in descriptors]

            def got(values: GetParameters.Response) -> None:
                self._descriptors = descriptors
                read = [parameter_value_to_python(one) for one in values.values]
                about = [_description(one, value) for one, value in zip(descriptors, read, strict=True)]
                with self._lock:
                    self._new_controls = arranged(about)
                    self._new_values.clear()

            self._call(self._get, GetParameters.Request(names=names), got, self._load_again)

        self._call(self._list, ListParameters.Request(), listed, self._load_again)

    def _load_again(self) -> None:
        self._load_due = monotonic() + _LOOK_PERIOD

    def _read(self, names: list[str]) -> None:
        """Show what the node holds, whatever was asked for."""

        def got(response: GetParameters.Response) -> None:
            with self._lock:
                for name, value in zip(names, response.values, strict=False):
                    self._new_values[name] = parameter_value_to_python(value)

        self._call(self._get, GetParameters.Request(names=names), got)

    def _unanswered(self, name: str) -> None:
        self._say(f"{name}: no answer from {self.name} within {_PATIENCE:g} s", False)

    def _call(
        self,
        client: Client,
        request: Any,
        answered: Callable[[Any], None],
        give_up: Callable[[], None] = lambda: None,
        patience: float = _PATIENCE,
    ) -> None:
        future = client.call_async(request)

        def done(finished: Future) -> None:
            if finished.cancelled() or finished.exception() is not None or finished.result() is None:
                give_up()
                return
            answered(finished.result())

        future.add_done_callback(done)
        self._calls.append((monotonic() + patience, client, future, give_up))

    def _is_asked(self, client: Client) -> bool:
        return any(one is client and not future.done() for _, one, future, _ in self._calls)

    def _say(self, words: str, good: bool) -> None:
        with self._lock:
            self._new_answer = words, good

    def _create_lifecycle_clients(self) -> None:
        """Where the messages are installed: they come with every ROS, not with the wheels' smallest choice."""
        try:
            self._lifecycle_services = importlib.import_module("lifecycle_msgs.srv")
        except ImportError:
            return
        services = self._lifecycle_services
        self._state = self._node.create_client(services.GetState, f"{self.name}/get_state")
        self._transit = self._node.create_client(services.ChangeState, f"{self.name}/change_state")

    # In the drawing thread

    def show(self, page: Page) -> None:
        """Put what is new into the page."""
        with self._lock:
            controls, self._new_controls = self._new_controls, None
            values, self._new_values = self._new_values, {}
            answer, self._new_answer = self._new_answer, None
        if controls is not None:
            page.show_controls(self.name, controls)
        if values:
            page.show_values(self.name, values)
        if answer is not None:
            page.show_answer(self.name, *answer)


def _description(about: ParameterDescriptor, value: Any) -> Description:
    low = high = None
    step, is_float = 0.0, False
    if about.floating_point_range:
        one = about.floating_point_range[0]
        low, high, step, is_float = float(one.from_value), float(one.to_value), float(one.step), True
    elif about.integer_range:
        one = about.integer_range[0]
        low, high, step = int(one.from_value), int(one.to_value), float(one.step)
    return Description(
        name=about.name,
        value=value,
        text=about.description,
        constraints=about.additional_constraints,
        read_only=about.read_only,
        low=low,
        high=high,
        step=step,
        is_float_range=is_float,
    )


def _shown(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value).lower() if isinstance(value, bool) else str(value)
