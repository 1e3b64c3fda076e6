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
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

_PATIENCE = 8.0
"""Seconds for all children together to end after an interrupt: a lifecycle node waits 4 s for its transition."""
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""What ends the parent, and has to end the children first."""
_TAIL = 2**14
"""Bytes of a node's output that are looked at."""
_ROOT = str(Path(__file__).resolve().parent.parent.parent)
_CODE = "import sys; sys.path[:1] = [{root!r}]; from sq_perception.nodes import executables as e; sys.exit(e.{node}())"


class Child(subprocess.Popen[bytes]):
    """One running node of :mod:`sq_perception.nodes.executables`; the environment is this process's if not given."""

    def __init__(self, node: str, arguments: Sequence[str], environment: Mapping[str, str] | None = None) -> None:
        self.name = node
        self._output = tempfile.TemporaryFile()  # noqa: SIM115 - as long as the child
        super().__init__(
            command(node, arguments),
            env={**(os.environ if environment is None else environment), "PYTHONUNBUFFERED": "1"},
            stdin=subprocess.DEVNULL,
            stdout=self._output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )

    @property
    def exit_code(self) -> int | None:
        """None while it runs."""
        return self.poll()

    def last_lines(self) -> list[str]:
        """The last lines of its standard output and error."""
        number = self._output.fileno()
        tail = os.pread(number, _TAIL, max(0, os.fstat(number).st_size - _TAIL))
        return tail.decode(errors="replace").splitlines()[-15:]

    def interrupt(self) -> None:
        """Interrupt it and all that it started, as Ctrl-C does."""
        self.send_signal(signal.SIGINT)

    def kill(self) -> None:
        """End it and all that it started."""
        self.send_signal(signal.SIGKILL)
        self.wait()

    def send_signal(self, sig: int) -> None:
        """Send a signal to the process group that it leads, if it still runs."""
        if self.exit_code is None:
            with suppress(ProcessLookupError):
                os.killpg(self.pid, sig)

    def close(self) -> None:
        """Forget what it said; for one that has ended."""
        self._output.close()


class Children:
    """Nodes that live as long as a ``with`` block of the main thread."""

    def __init__(self, environment: Mapping[str, str] | None = None) -> None:
        self._environment = environment
        self._running: list[Child] = []
        self._interrupted = self._starting = False
        self._before: dict[signal.Signals, Any] = {}
        self.killed: list[str] = []
        """Names of those that did not stop when interrupted."""

    def __enter__(self) -> Children:
        self._before = {number: signal.signal(number, self._interrupt) for number in _SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _interrupt(self, *_: object) -> None:
        self._interrupted = True
        if not self._starting:
            raise KeyboardInterrupt

    def start(self, node: str, arguments: Sequence[str] = ()) -> Child:
        """Start one node; a Ctrl-C meanwhile waits until it is known, as nobody would stop it otherwise."""
        self._starting = True
        try:
            child = Child(node, arguments, self._environment)
            self._running.append(child)
        finally:
            self._starting = False
        if self._interrupted:
            raise KeyboardInterrupt
        return child

    def dead(self) -> Child | None:
        """The first one that has ended by itself, if any; a Ctrl-C that got lost is raised here again.

        Python prints and forgets what is raised in a callback of a weak reference, such as imports have.
        """
        if self._interrupted:
            raise KeyboardInterrupt
        return next((child for child in self._running if child.exit_code is not None), None)

    def stop(self) -> None:
        """Interrupt all, wait, and kill those that go on.  A second Ctrl-C must not leave one behind."""
        previous = {number: signal.signal(number, signal.SIG_IGN) for number in _SIGNALS}
        try:
            for child in self._running:
                child.interrupt()
            deadline = time.monotonic() + _PATIENCE
            for child in self._running:
                try:
                    child.wait(max(deadline - time.monotonic(), 0.0))
                except subprocess.TimeoutExpired:
                    child.kill()
                    self.killed.append(child.name)
                child.close()
            self._running.clear()
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)


def command(node: str, arguments: Sequence[str] = ()) -> list[str]:
    """The command line that runs a node by this interpreter, from this package."""
    return [sys.executable, "-c", _CODE.format(root=_ROOT, node=node), *arguments]


def parameter_arguments(parameters: Mapping[str, object]) -> list[str]:
    """Command line arguments that set ROS parameters; JSON is the YAML that ROS expects there."""
    settings = [("-p", f"{name}:={json.dumps(value)}") for name, value in parameters.items()]
    return ["--ros-args", *(word for setting in settings for word in setting)]
