"""The life of a node's process: start, spin, stop, each without a traceback.

Exit code 0 after Ctrl-C or SIGTERM, whether it comes once, twice, or while the node still starts; 1 with one line of
explanation where the node cannot start.  The shipped Fast DDS profile is used unless the user has chosen one.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Sequence
from types import FrameType
from typing import TYPE_CHECKING

from sq_perception.nodes import fast_dds

if TYPE_CHECKING:
    from rclpy.executors import Executor

    from sq_perception.nodes.stoppable_node import StoppableNode

SIGNALS = (signal.SIGINT, signal.SIGTERM)
_THREADS = {"OMP_WAIT_POLICY": "PASSIVE", "OPENBLAS_NUM_THREADS": "1"}
"""Threads that spin while they wait take the cores from the nodes beside them: on two busy cores a frame took 30 ms
with these settings and 50 to 150 ms without.  Small solves gain nothing from a second thread."""


class _Stop:
    """Interrupts the start.  While the node spins, rclpy itself ends the spinning and nothing is left to do here."""

    def __init__(self) -> None:
        self.starting = True
        self.received = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        first, self.received = not self.received, True
        if self.starting and first:
            raise KeyboardInterrupt


def run(name: str, create: Callable[[], StoppableNode], arguments: Sequence[str] | None = None) -> int:
    """Create a node and spin it until it is told to stop; the exit code.

    ``create`` imports what the node needs, so that a signal during seconds of imports finds this function in charge.
    """
    stop = _Stop()
    for number in SIGNALS:
        signal.signal(number, stop)
    node: StoppableNode | None = None
    try:
        try:
            # Libraries read these when they are loaded, rclpy already loads numpy.
            for variable, value in {**_THREADS, **fast_dds.additions()}.items():
                os.environ.setdefault(variable, value)
            import rclpy
            from rclpy.executors import SingleThreadedExecutor

            rclpy.init(args=None if arguments is None else list(arguments))
            # Before the node announces itself: an executor whose creation a signal interrupts complains when it is
            # deleted.
            executor = SingleThreadedExecutor()
            node = create()
            stop.starting = False
            _spin(node, executor)
        except Exception as error:
            if stop.received:
                # rclpy has shut its context down, and whatever was going on has failed because of that.
                return 0
            if not (stop.starting and isinstance(error, _start_errors())):
                raise
            _explain(name, error)
            return 1
    except KeyboardInterrupt:
        # Around the handling of failures too: rclpy's own thread may end the context, and thereby the start, before
        # Python comes to look at the signal.
        return 0
    finally:
        _ignore_signals()
        _finish(node)
    return 0


def _spin(node: StoppableNode, executor: Executor) -> None:
    import rclpy
    from rclpy.executors import ExternalShutdownException

    executor.add_node(node)
    try:
        while rclpy.ok():
            executor.spin_once()
    except ExternalShutdownException:
        return


def _start_errors() -> tuple[type[Exception], ...]:
    """What a wrong argument, parameter, file or name raises; rclpy's own errors are RuntimeErrors or these."""
    from rclpy.exceptions import NameValidationException, ParameterException
    from rclpy.qos_overriding_options import InvalidQosOverridesError

    return (ValueError, OSError, RuntimeError, ParameterException, NameValidationException, InvalidQosOverridesError)


def _explain(name: str, error: Exception) -> None:
    from rclpy.logging import get_logger

    get_logger(name).fatal(f"cannot start: {' '.join(str(error).split())}")


def _finish(node: StoppableNode | None) -> None:
    import rclpy

    if node is not None:
        node.close()
        node.destroy_node()
    rclpy.try_shutdown()
    _ignore_signals()


def _ignore_signals() -> None:
    """A second Ctrl-C (launch sends one) must not interrupt the end; rclpy's shutdown may bring old handlers back."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
