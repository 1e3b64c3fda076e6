"""A lifecycle node that can start itself, runs its transitions in their own thread, and reports why one failed.

    unconfigured --configure--> inactive --activate--> active
         ^  ^---------cleanup------'  ^----deactivate----'
         '---- errorprocessing <---- an exception in a transition, or a fault while active

Started by :meth:`ManagedNode.start` it configures and activates itself, so that plain ``ros2 run`` works without a
manager.  A transition that takes seconds, such as loading a model, leaves the executor free: services answer meanwhile.

A subclass implements :meth:`_configure`, :meth:`_activate`, :meth:`_deactivate` and :meth:`_cleanup`; any exception
leads through ``errorprocessing``, where everything is released, to ``unconfigured``, from where the node can be
configured again.  :attr:`fault` is the reason until that succeeds.  A fault while active (:meth:`_fail`) does the same;
a node that started itself restarts after a pause, or ends its process if it cannot.

Transitions create and destroy publishers and subscriptions outside of the executor's thread.  rclpy's executors may
then raise InvalidHandle (ros2/rclpy issue 1284), which :mod:`sq_perception.nodes.process` ignores; programs with their
own executor must do so too.

Reference: https://design.ros2.org/articles/node_lifecycle.html
"""

from __future__ import annotations

import queue
import threading
import traceback
from collections.abc import Callable, Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.task import Future

from sq_msgs_py.message_types import find_type
from sq_perception.nodes.statistics import Standing, Statistics

_NAMES = {
    Transition.TRANSITION_CONFIGURE: "configure",
    Transition.TRANSITION_CLEANUP: "cleanup",
    Transition.TRANSITION_ACTIVATE: "activate",
    Transition.TRANSITION_DEACTIVATE: "deactivate",
    Transition.TRANSITION_UNCONFIGURED_SHUTDOWN: "shutdown",
    Transition.TRANSITION_INACTIVE_SHUTDOWN: "shutdown",
    Transition.TRANSITION_ACTIVE_SHUTDOWN: "shutdown",
}
STEADY = Clock(clock_type=ClockType.STEADY_TIME)
"""Clock of timers: simulated time may stand still, which nodes must still report."""
_EXPECTED = (ValueError, OSError, RuntimeError)
"""Errors of a wrong file, parameter or device; any other is a program error and logged with its traceback."""
_PAUSE = 2.0  # seconds before a node that failed while active restarts
_END = 4.0  # seconds that ManagedNode.close waits for a transition


def optional(node: Node, create: Callable[..., Any], name: str, *arguments: Any, **more: Any) -> Any:
    """Return what ``create`` makes of an interface package/msg/Name of sq_msgs; None if it is not installed."""
    try:
        return create(find_type(name), *arguments, **more)
    except ModuleNotFoundError:
        return None
    except Exception as error:  # a package that is there in part fails in other ways
        node.get_logger().warning(f"{name} cannot be used: {type(error).__name__}: {error}")
        return None


class ManagedNode(LifecycleNodeMixin, Node):
    """Lifecycle node that can start itself; see the module.  Its ``statistics`` count what it answers."""

    def __init__(
        self, name: str, statistics: Statistics, *, namespace: str | None = None, context: Any = None
    ) -> None:
        Node.__init__(self, name, namespace=namespace, context=context)
        # Not LifecycleNode, whose services share the default group: none would answer while a transition is awaited.
        LifecycleNodeMixin.__init__(self, callback_group=ReentrantCallbackGroup())
        # rclpy's own callback runs the transition in the executor's thread, where nothing else is served for the
        # seconds that a model takes to load, and raises RCLError for one that the state does not allow, which ends it.
        (service,) = (each for each in self.services if each.srv_type is ChangeState)
        service.callback = self._on_change_state  # type: ignore[assignment]  # executors await it
        self.fault = ""  # why the last transition failed; empty once one has succeeded
        self.start_failure = ""  # why the node could not start itself; its process then ends
        self._starts_itself = False
        self._closing = threading.Event()
        self._tasks: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run_tasks, name="transitions", daemon=True)
        self._thread.start()
        self._statistics = statistics
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_timer(1.0, self._on_second, clock=STEADY)

    @property
    def state(self) -> str:
        """Label of the lifecycle state: unconfigured, inactive, active, finalized, or one of the transitions."""
        # rclpy 7.1 gives the state to callers of ~/get_state only.
        return str(self._state_machine.current_state[1])

    @property
    def is_active(self) -> bool:
        """Whether the node is in the state ``active``."""
        return self.state == "active"

    @property
    def is_configured(self) -> bool:
        """Whether the node is beyond ``unconfigured``, transitions on the way there included."""
        return self.state not in ("unconfigured", "finalized", "unknown")

    def start(self, autostart: bool = True) -> None:
        """Configure and activate, now and after a fault; :attr:`start_failure` holds the reason of a failure.  Without
        ``autostart`` only log that a manager must do so."""
        if not autostart:
            self.get_logger().info(
                "unconfigured, as autostart is false: waiting for a lifecycle manager, or for ros2 lifecycle set "
                f"{self.get_fully_qualified_name()} configure, then activate"
            )
            return
        self._starts_itself = True
        self._tasks.put(self._bring_up)

    def report(self, standing: Standing | None, more: Mapping[str, str]) -> None:
        """Publish diagnostics: ``standing`` or that of the statistics, and ``more`` facts beside those."""
        status = self._statistics.status(self.get_fully_qualified_name(), standing, {"state": self.state, **more})
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)

    def standing(self, fault: str = "") -> Standing | None:
        """Return level and message for diagnostics of a node that is inactive or has a fault; None otherwise."""
        fault = self.fault or fault
        if self.is_active:
            return (DiagnosticStatus.WARN, fault) if fault else None
        level = DiagnosticStatus.ERROR if fault else DiagnosticStatus.OK
        return level, f"{self.state}: {fault}" if fault else self.state

    def close(self) -> bool:
        """Release everything; called once, before destroy_node.  False if a transition does not end in time.  The state
        becomes ``finalized`` where it was one that allows it."""
        self._closing.set()
        self._tasks.put(self._end)
        self._tasks.put(None)
        self._thread.join(_END)
        return not self._thread.is_alive()

    def destroy_node(self) -> None:
        """Destroy the node as rclpy does, and the publisher of the transitions.  rclpy leaves that one to the garbage
        collector: it stayed in the graph for as long as the process lived."""
        super().destroy_node()
        self._state_machine.destroy_when_not_in_use()

    # What a subclass does

    def _on_second(self) -> None:
        """Look after the inputs and :meth:`report`; called each second, in the executor's thread."""

    def _configure(self) -> None:
        """Prepare what takes time or memory."""

    def _activate(self) -> None:
        """Start to listen."""

    def _deactivate(self) -> None:
        """Stop listening."""

    def _cleanup(self) -> None:
        """Release what :meth:`_configure` made, also after a partial configuration; stop what is active."""

    def _fail(self, reason: str) -> None:
        """Leave the active state because of a fault that further frames would repeat; from any thread."""

        def leave() -> None:
            if not self.is_active or self._closing.is_set():
                return
            self.get_logger().error(f"{reason}: trying again in {_PAUSE:g} s" if self._starts_itself else reason)
            self.fault = reason
            self._change("deactivate")
            if self._starts_itself and not self._closing.wait(_PAUSE):
                self._bring_up()

        self._tasks.put(leave)

    # Transitions, all in one thread

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._attempt("configure", self._configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._attempt("activate", self._activate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        if self.fault:
            return TransitionCallbackReturn.ERROR
        return self._attempt("deactivate", self._deactivate)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._attempt("cleanup", self._cleanup)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._attempt("shutdown", self._cleanup)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release everything, so that the node can be configured again; finalized if that fails too."""
        fault = self.fault
        answer = self._attempt("release", self._cleanup)
        self.fault = fault
        return TransitionCallbackReturn.FAILURE if answer == TransitionCallbackReturn.ERROR else answer

    def _attempt(self, name: str, action: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            action()
        except Exception as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            if not isinstance(error, _EXPECTED):
                self.get_logger().error(traceback.format_exc())
                reason = f"{type(error).__name__}: {reason}"
            self.fault = f"cannot {name}: {reason}"
            if not self._closing.is_set():
                self.get_logger().error(self.fault)
            return TransitionCallbackReturn.ERROR
        self.fault = ""
        return TransitionCallbackReturn.SUCCESS

    def _change(self, name: str) -> bool:
        """Perform one transition by name; False if the state does not allow it or it failed."""
        before = self.state
        try:
            answer = getattr(self, f"trigger_{name}")()
        except RuntimeError:
            self.get_logger().warning(f"cannot {name}: the node is {before}")
            return False
        return bool(answer == TransitionCallbackReturn.SUCCESS)

    def _bring_up(self) -> None:
        if not (self._change("configure") and self._change("activate")) and not self._closing.is_set():
            self.start_failure = self.fault or f"the node is {self.state}"

    def _end(self) -> None:
        if self.is_configured or self.state == "unconfigured":
            self._change("shutdown")

    def _run_tasks(self) -> None:
        while (task := self._tasks.get()) is not None:
            try:
                task()
            except Exception:
                if not self._closing.is_set():
                    self.get_logger().error(traceback.format_exc())

    async def _on_change_state(
        self, request: ChangeState.Request, response: ChangeState.Response
    ) -> ChangeState.Response:
        asked = str(request.transition.label) or _NAMES.get(request.transition.id, request.transition.id)
        if asked not in _NAMES.values():
            expected = ", ".join(dict.fromkeys(_NAMES.values()))
            self.get_logger().warning(f"expected one of {expected}, got {asked!r}")
            response.success = False
            return response
        done: Future = Future(executor=self.executor)

        def task() -> None:
            succeeded = False
            try:
                succeeded = self._change(str(asked))
            finally:
                done.set_result(succeeded)
                if self.executor is not None:
                    self.executor.wake()

        self._tasks.put(task)
        response.success = bool(await done)
        return response
