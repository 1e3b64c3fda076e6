"""Nodes as child processes: started together, watched, and stopped without leftovers.

Not `ros2 launch`: it is in no wheel, so that the demonstration of a pip installation would have none, and it does not
hand its terminal to a live table.  Where there is one, launch_scripts/*.launch.py are for it.

Every child leads a process group of its own, so that a Ctrl-C in the terminal reaches the parent alone, which then
stops the children in order: SIGINT, patience, SIGKILL.  Children import the very package that the parent runs from,
installed or source tree, whatever the working directory.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType, TracebackType

NODES = ("recover_node", "recover_cameras", "fitter_node", "synthetic_depth_node")
"""Of :mod:`sq_perception.nodes.executables`."""

_KEPT_LINES = 40
_ROOT = str(Path(__file__).resolve().parent.parent.parent)
_CODE = "import sys; sys.path[:1] = [{root!r}]; from sq_perception.nodes import executables as e; sys.exit(e.{node}())"


class Child:
    """One running node."""

    def __init__(
        self, node: str, arguments: Sequence[str], environment: Mapping[str, str], *, echo: bool = False
    ) -> None:
        self.name = node
        self._echo = echo
        self._lines: deque[str] = deque(maxlen=_KEPT_LINES)
        self._process = subprocess.Popen(
            command(node, arguments),
            env={**environment, "PYTHONUNBUFFERED": "1"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            start_new_session=True,
        )
        self._reader = threading.Thread(target=self._read, name=f"output of {node}", daemon=True)
        self._reader.start()

    @property
    def pid(self) -> int:
        """Its process id, and that of its group."""
        return self._process.pid

    @property
    def exit_code(self) -> int | None:
        """None while it runs."""
        return self._process.poll()

    def last_lines(self, count: int = 15) -> list[str]:
        """What it said last, standard output and error together."""
        if self.exit_code is not None:
            self._reader.join(timeout=1.0)
        return list(self._lines)[-count:]

    def interrupt(self) -> None:
        """Ask it to stop, as Ctrl-C does."""
        self._signal(signal.SIGINT)

    def wait(self, seconds: float) -> bool:
        """Whether it has ended within some seconds."""
        try:
            self._process.wait(timeout=max(seconds, 0.0))
        except subprocess.TimeoutExpired:
            return False
        return True

    def kill(self) -> None:
        """End it and all that it started."""
        self._signal(signal.SIGKILL)
        self._process.wait()

    def _signal(self, number: int) -> None:
        if self.exit_code is not None:
            return
        try:
            os.killpg(self.pid, number)
        except ProcessLookupError:
            return

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._lines.append(line.rstrip())
            if self._echo:
                print(f"[{self.name}] {line}", end="", flush=True)


class Children:
    """Nodes that live as long as a ``with`` block."""

    def __init__(self, environment: Mapping[str, str], *, patience: float = 8.0, echo: bool = False) -> None:
        self._environment = dict(environment)
        self._patience = patience
        self._echo = echo
        self._running: list[Child] = []
        self.killed: list[str] = []
        """Names of those that did not stop when asked to."""

    def __enter__(self) -> Children:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def start(self, node: str, arguments: Sequence[str] = ()) -> Child:
        """Start one node."""
        child = Child(node, arguments, self._environment, echo=self._echo)
        self._running.append(child)
        return child

    def dead(self) -> Child | None:
        """The first one that has ended by itself, if any."""
        return next((child for child in self._running if child.exit_code is not None), None)

    def words(self) -> str:
        """What the nodes said last, for a report."""
        return "\n".join(f"[{child.name}] {line}" for child in self._running for line in child.last_lines(8))

    def until_stopped(self) -> int:
        """Wait for Ctrl-C or SIGTERM (0), or for a node that ends by itself (its exit code)."""
        with interruptible():
            try:
                while (ended := self.dead()) is None:
                    time.sleep(0.2)
            except KeyboardInterrupt:
                return 0
        return ended.exit_code or 0

    def stop(self) -> None:
        """Interrupt all, wait, and kill those that do not listen.  A second Ctrl-C must not leave one behind."""
        previous = {}
        if threading.current_thread() is threading.main_thread():
            previous = {number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            for child in self._running:
                child.interrupt()
            deadline = time.monotonic() + self._patience
            for child in self._running:
                if not child.wait(deadline - time.monotonic()):
                    child.kill()
                    self.killed.append(child.name)
            self._running.clear()
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)


def command(node: str, arguments: Sequence[str] = ()) -> list[str]:
    """The command line that runs a node by this interpreter, from this package.

    Raises
    ------
    ValueError
        If there is no node of that name.
    """
    if node not in NODES:
        raise ValueError(f"node: expected one of {', '.join(NODES)}, got {node!r}")
    return [sys.executable, "-c", _CODE.format(root=_ROOT, node=node), *arguments]


@contextmanager
def interruptible() -> Iterator[None]:
    """Within the block, SIGTERM and SIGHUP raise KeyboardInterrupt as Ctrl-C does; call it in the main thread."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    previous = {number: signal.signal(number, interrupt) for number in numbers}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def parameter_arguments(parameters: Mapping[str, object]) -> list[str]:
    """Command line arguments that set ROS parameters; JSON is the YAML that ROS expects there."""
    arguments = ["--ros-args"]
    for name, value in parameters.items():
        arguments += ["-p", f"{name}:={json.dumps(value)}"]
    return arguments
