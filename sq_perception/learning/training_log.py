"""What a training tells while it runs: a line of JSON and of text at each validation, a progress bar, TensorBoard."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


class TrainingLog:
    """Writes ``log.jsonl`` and, where the package tensorboard is installed, events into a run's folder.

    Parameters
    ----------
    folder
        Of the run; None: say and write nothing, as all processes but the first do.
    steps, first
        Of the whole run, and done before this part of it.
    """

    def __init__(self, folder: Path | None, steps: int, first: int) -> None:
        self._file = (folder / "log.jsonl").open("a", encoding="utf-8") if folder is not None else None
        self._events = _event_writer(folder) if folder is not None else None
        columns = (TextColumn("step"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[note]}"))
        shown = folder is not None and sys.stderr.isatty()
        self._bar = Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True), disable=not shown)
        self._task = self._bar.add_task("training", total=steps, completed=first, note="")
        self._bar.start()

    def step(self, done: int, loss: float) -> None:
        """A step was made."""
        self._bar.update(self._task, completed=done, note=f"loss {loss:.4f}")

    def record(self, record: dict[str, Any]) -> None:
        """A validation was made; ``record`` holds its numbers by name, among them ``step``."""
        if self._file is None:
            return
        print(json.dumps(record), flush=True)
        self._file.write(json.dumps(record) + "\n")
        self._file.flush()
        if self._events is not None:
            for name, value in record.items():
                if name != "step":
                    self._events.add_scalar(name, value, record["step"])

    def close(self) -> None:
        """Finish all files."""
        self._bar.stop()
        if self._file is not None:
            self._file.close()
        if self._events is not None:
            self._events.close()


def _event_writer(folder: Path) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(folder))
