"""Nodes as child processes: started together, watched, and stopped without leftovers.

Every child leads a process group of its own and imports the very package that the parent runs from, installed or source
tree, whatever the working directory.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import sq_perception

_PATIENCE = 8.0
"""Seconds for all children together to end after an interrupt: a lifecycle node waits 4 s for its transition."""
_ROOT = str(Path(sq_perception.__file__).resolve().parent.parent)
_CODE = "import sys; sys.path[:1] = [{root!r}]; from sq_perception.nodes import executables as e; sys.exit(e.{node}())"


class Child(subprocess.Popen[bytes]):
    """One running node of :mod:`sq_perception.nodes.executables`, or other ``code``.

    The environment is this process's if not given.
    """

    def __init__(
        self, node: str, arguments: Sequence[str], environment: Mapping[str, str] | None = None, code: str = ""
    ) -> None:
        self.name = node
        self._output = tempfile.TemporaryFile()  # noqa: SIM115 - as long as the child
        super().__init__(
            [sys.executable, "-c", code or _CODE.format(root=_ROOT, node=node), *arguments],
            env={**(os.environ if environment is None else environment), "PYTHONUNBUFFERED": "1"},
            stdin=subprocess.DEVNULL, stdout=self._output, stderr=subprocess.STDOUT, start_new_session=True,
        )

    @property
    def exit_code(self) -> int | None:
        return self.poll()

    def output(self) -> str:
        return os.pread(self._output.fileno(), 2**24, 0).decode(errors="replace")

    def last_lines(self) -> list[str]:
        return self.output().splitlines()[-15:]

    def interrupt(self) -> None:
        self.send_signal(signal.SIGINT)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)
        self.wait()

    def send_signal(self, sig: int) -> None:
        """Send a signal to the process group that it leads, if it still runs."""
        if self.exit_code is None:
            with suppress(ProcessLookupError):
                os.killpg(self.pid, sig)

    def close(self) -> None:
        self._output.close()


class Children:
    def __init__(self, environment: Mapping[str, str] | None = None) -> None:
        self._environment = environment
        self._running: list[Child] = []

    def __enter__(self) -> Children:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        """Interrupt all, wait, and kill those that go on."""
        for child in self._running:
            child.interrupt()
        deadline = time.monotonic() + _PATIENCE
        for child in self._running:
            try:
                child.wait(max(deadline - time.monotonic(), 0.0))
            except subprocess.TimeoutExpired:
                child.kill()
            child.close()
        self._running.clear()

    def start(self, node: str, arguments: Sequence[str] = ()) -> Child:
        child = Child(node, arguments, self._environment)
        self._running.append(child)
        return child
