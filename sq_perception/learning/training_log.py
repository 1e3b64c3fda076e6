"""What a training reports while it runs: a line of JSON at each validation, printed and written, and a progress bar."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


class TrainingLog:
    """Writes ``log.jsonl`` into a run's folder.

    Parameters
    ----------
    folder
        Of the run.
    steps, first
        Of the whole run, and done before this part of it.
    """

    def __init__(self, folder: Path, steps: int, first: int) -> None:
        self._file = (folder / "log.jsonl").open("a", encoding="utf-8")
        columns = (TextColumn("step"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[note]}"))
        quiet = not sys.stderr.isatty()
        self._bar = Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True), disable=quiet)
        self._task = self._bar.add_task("training", total=steps, completed=first, note="")
        self._bar.start()

    def step(self, done: int, loss: float) -> None:
        """A step was made."""
        self._bar.update(self._task, completed=done, note=f"loss {loss:.4f}")

    def record(self, record: dict[str, Any]) -> None:
        """A validation was made; ``record`` holds its numbers by name, among them ``step``."""
        print(json.dumps(record), flush=True)
        self._file.write(json.dumps(record) + "\n")
        self._file.flush()

    def close(self) -> None:
        """Finish the bar and the file."""
        self._bar.stop()
        self._file.close()
