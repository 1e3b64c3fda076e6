"""The process of one or several nodes: start, spin and stop without a traceback.

Exit code 0 after Ctrl-C, SIGTERM or the end of the terminal, also twice or while a node starts; 1 with one line of
explanation if a node cannot start.  One thread spins all nodes: callbacks only store messages, others do the work.

The shipped Fast DDS profile, which prevents the loss of large images, is used unless the user has set one.  Fast DDS 2
of Jazzy reads FASTRTPS_DEFAULT_PROFILES_FILE when the first participant of a process is created, so the variable must
be set before rclpy.init; it ignores its successor's variable, FASTDDS_DEFAULT_PROFILES_FILE.

Garbage collection: numba and SciPy make 100 000 objects that live as long as the process; with them a full collection
takes 60 ms, in the middle of a frame.  So it is off while a node starts, and later excludes the objects of the start.
"""

from __future__ import annotations

import ctypes
import gc
import importlib.util
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

if TYPE_CHECKING:
    from rclpy.executors import Executor

PROFILE = "FASTRTPS_DEFAULT_PROFILES_FILE"
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_THREADS = {"OMP_WAIT_POLICY": "PASSIVE", "OPENBLAS_NUM_THREADS": "1", "OPENCV_FOR_THREADS_NUM": "1"}
"""Spinning threads take cores from other nodes, and small solves and images gain nothing from a second thread."""

_Node = TypeVar("_Node", bound="Stoppable")
REMEDY = "pip install 'sq_perception[ros]', or source a ROS 2 Jazzy installation"  # advice if rclpy is missing


class Stoppable(Protocol):
    """An rclpy node that may fail to start, and must be stopped before it is destroyed."""

    start_failure: str  # why the node cannot start, once known; its process then ends

    def close(self) -> bool:
        """Stop threads; called once, before destroy_node.  False if one of them could not be stopped."""

    def destroy_node(self) -> None: ...

    def get_fully_qualified_name(self) -> str: ...


def run(name: str, create: Callable[[], Iterable[Stoppable]], arguments: Sequence[str] | None = None) -> int:
    """Create nodes and spin them until they are asked to stop; return the exit code.  ``create`` imports what they
    need, so that signals are handled meanwhile; what it has yielded is closed even if a later one fails."""
    if importlib.util.find_spec("rclpy") is None:
        print(f"{name} needs ROS 2 in Python: {REMEDY}", file=sys.stderr)
        return 1
    stop = _Stop()
    for number in _SIGNALS:
        if number != signal.SIGHUP or signal.getsignal(number) == signal.SIG_DFL:  # it is ignored under nohup
            signal.signal(number, stop)
    nodes: list[Stoppable] = []
    code = 1
    try:
        try:
            # Libraries read these when they are loaded, rclpy already loads numpy.
            for variable, value in {**_THREADS, **additions()}.items():
                os.environ.setdefault(variable, value)
            share_heaps()
            gc.disable()
            import rclpy
            from rclpy.executors import SingleThreadedExecutor
            from rclpy.signals import SignalHandlerOptions

            from sq_perception.geometry.threads import TURN

            sys.setswitchinterval(TURN)  # services waited behind the threads that fit

            # rclpy's own handlers end the context from another thread, and give way to the default action for an
            # instant when they go: a second Ctrl-C then killed the process.
            quietly = SignalHandlerOptions.NO
            rclpy.init(args=None if arguments is None else list(arguments), signal_handler_options=quietly)
            # Before the node announces itself: an executor whose creation a signal interrupts complains when it is
            # deleted.
            executor = SingleThreadedExecutor()
            nodes.extend(create())
            gc.freeze()
            gc.enable()
            stop.starting = False
            code = _spin(nodes, executor, stop)
        except Exception as error:
            if stop.received:
                # Whatever was going on has failed because of the signal.
                code = 0
            elif stop.starting and not isinstance(error, ImportError) and isinstance(error, _start_errors()):
                _explain(name, str(error))
            else:
                # Here and not by the interpreter, which may not come to it: see _finish.
                traceback.print_exc()
    except KeyboardInterrupt:
        # Around the handling of failures too.
        code = 0
    finally:
        gc.enable()
        # A second Ctrl-C (launch sends one) must not interrupt the end.
        for number in _SIGNALS:
            signal.signal(number, signal.SIG_IGN)
        _finish(nodes, code)
    return code


def configuration_file(name: str) -> Path:
    """Return a shipped file: beside the modules if installed, in ``config/`` of a source tree."""
    package = Path(__file__).resolve().parent.parent
    for folder in (package / "config", package.parent / "config"):
        if (folder / name).is_file():
            return folder / name
    raise FileNotFoundError(f"{name} is missing beside {package}: install the package again")


def profile_path() -> Path:
    """Return the path of the shipped Fast DDS profile."""
    return configuration_file("fast_dds.xml")


def additions() -> dict[str, str]:
    """Return what to add to the environment: the variable of the shipped profile, or nothing if a profile is set."""
    return {} if os.environ.get(PROFILE) else {PROFILE: str(profile_path())}


def make(kind: type[_Node], *arguments: Any, **named: Any) -> _Node:
    """Create a node of this class.  If that fails, the unfinished node is destroyed before the error is raised: its
    shared memory would outlive this process, and a launch file tries again and again."""
    node = kind.__new__(kind)
    try:
        node.__init__(*arguments, **named)  # type: ignore[misc]  # of the class itself
    except BaseException:
        with suppress(Exception):  # there may be nothing yet
            node.destroy_node()
        raise
    return node


def share_heaps() -> None:
    """Let threads allocate from the same heaps; heaps of their own keep what a frame has freed, 25 MB in all.  Changes
    nothing without glibc.  For the start of a process: heaps that are there already stay."""
    with suppress(AttributeError):
        ctypes.CDLL(None).mallopt(-8, 2)  # M_ARENA_MAX of malloc.h; with one heap threads wait for each other


def keep_objects() -> None:
    """Collect garbage once and exclude the rest from further collections, as it lives while a node is configured."""
    gc.collect()
    gc.freeze()


def release_objects() -> None:
    """Collect garbage as :func:`keep_objects`, including objects that were excluded before."""
    gc.unfreeze()
    keep_objects()


class _Stop:
    """Signal handler that interrupts the start, or asks a spinning node to stop."""

    def __init__(self) -> None:
        self.starting = True
        self.received = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        first, self.received = not self.received, True
        if self.starting and first:
            raise KeyboardInterrupt


def _spin(nodes: Sequence[Any], executor: Executor, stop: _Stop) -> int:
    import rclpy
    from rclpy.exceptions import InvalidHandle
    from rclpy.executors import ExternalShutdownException

    for node in nodes:
        executor.add_node(node)
    try:
        while rclpy.ok() and not stop.received:
            with suppress(InvalidHandle):  # ros2/rclpy issue 1284: an entity was destroyed by another thread
                executor.spin_once(timeout_sec=0.1)
            failed = next((node for node in nodes if node.start_failure), None)
            if failed is not None:
                _explain(failed.get_fully_qualified_name().lstrip("/"), failed.start_failure)
                return 1
    except ExternalShutdownException:
        pass
    return 0


def _start_errors() -> tuple[type[Exception], ...]:
    """Return the errors of a wrong argument, parameter, file or name; rclpy's own are RuntimeErrors or these."""
    from rclpy.exceptions import NameValidationException, ParameterException
    from rclpy.qos_overriding_options import InvalidQosOverridesError

    return (ValueError, OSError, RuntimeError, ParameterException, NameValidationException, InvalidQosOverridesError)


def _explain(name: str, reason: str) -> None:
    from rclpy.logging import get_logger

    get_logger(name).fatal(f"cannot start: {' '.join(reason.split())}")


def _finish(nodes: Sequence[Stoppable], code: int) -> None:
    with ThreadPoolExecutor(max(len(nodes), 1)) as pool:  # each may wait for a transition
        closed = list(pool.map(lambda node: node.close(), nodes))
    if all(closed):
        for node in nodes:
            node.destroy_node()
    if rclpy := sys.modules.get("rclpy"):  # it may have been the one that could not be imported
        rclpy.try_shutdown()
    if code or not all(closed):
        # A node that could not be made is half there, and the interpreter would destroy it after its context.  A
        # thread that still compiles or loads cannot be interrupted, and to unload libraries under it would crash.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
