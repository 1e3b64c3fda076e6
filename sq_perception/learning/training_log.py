"""What a training reports while it runs: a line of JSON at each validation, and a progress bar."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


@contextmanager
def bar(steps: int, first: int) -> Iterator[Callable[[int, float], None]]:
    """A bar on a terminal, for a run of ``steps`` of which ``first`` are done; called with steps done and a loss."""
    columns = (TextColumn("step"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[note]}"))
    quiet = not sys.stderr.isatty()
    with Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True), disable=quiet) as progress:
        task = progress.add_task("training", total=steps, completed=first, note="")
        yield lambda done, loss: progress.update(task, completed=done, note=f"loss {loss:.4f}")


def append(folder: Path, record: dict[str, Any]) -> None:
    """Add the numbers of a validation, by name, among them ``step``, to the ``log.jsonl`` of a run's folder."""
    with (folder / "log.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps(record) + "\n")
