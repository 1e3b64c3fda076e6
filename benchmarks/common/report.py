"""What every benchmark shares: options, metadata, spread, recorded data, and files of JSON and Markdown."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sq_perception.files import provenance

RESULTS = Path(__file__).resolve().parents[1] / "results"


def parser(documentation: str | None, name: str = "") -> argparse.ArgumentParser:
    """The parser of a benchmark that its docstring describes; ``--name`` where its results have a name."""
    made = argparse.ArgumentParser(description=(documentation or "").split("\n\n")[0])
    if name:
        made.add_argument("--name", default=name, help="of the files of results (%(default)s)")
    return made


def pin() -> None:
    """Keep this process on one processor, where the system can."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def shared_data(folder: str) -> Path | None:
    """A folder of recorded data beside the repository; None, and a line that says so, where there is none.

    SQ_SHARED_DATA names another place for all of it.
    """
    path = Path(os.environ.get("SQ_SHARED_DATA", RESULTS.parents[2] / "shared" / "data")) / folder
    if path.is_dir():
        return path
    print(f"skipped: no recorded data, {path} is missing (set SQ_SHARED_DATA)")
    return None


def spread(values: np.ndarray) -> dict[str, float]:
    """Mean, standard deviation, median, 5th and 95th percentile, minimum of measurements."""
    values = np.asarray(values, dtype=float)
    low, median, high = np.percentile(values, [5, 50, 95])
    names = ("mean", "std", "median", "p5", "p95", "min", "max", "count")
    numbers = (values.mean(), values.std(), median, low, high, values.min(), values.max(), len(values))
    return {name: float(number) for name, number in zip(names, numbers, strict=True)}


def environment() -> dict[str, Any]:
    """Processor, versions, commit and command of this run."""
    return provenance.facts(" ".join(["python", f"benchmarks/{Path(sys.argv[0]).name}", *sys.argv[1:]]), __file__)


def commit() -> str | None:
    """The short hash of this checkout."""
    return provenance.commit(__file__)


def previous(name: str, key: str) -> dict[str, Any]:
    """A part of the results of an earlier run; empty if there is none."""
    path = RESULTS / f"{name}.json"
    return dict(json.loads(path.read_text())[key]) if path.exists() else {}


def write(name: str, result: dict[str, Any], table: str, shown: bool = True) -> None:
    """Write ``results/name.json`` and ``results/name.md``, and print the table if it shall be shown."""
    RESULTS.mkdir(exist_ok=True)
    facts = environment()
    (RESULTS / f"{name}.json").write_text(by_rows({"environment": facts, **result}) + "\n")
    head = f"`{facts['command']}`, {facts['processor']}, {facts['date']}, commit {facts['commit']}"
    (RESULTS / f"{name}.md").write_text(f"{head}\n\n{table}\n")
    if shown:
        print(table)


def by_rows(value: Any, indent: str = "") -> str:
    """JSON in which what holds no list or mapping takes one line."""
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list | tuple) else ()
    if not any(isinstance(part, dict | list | tuple) for part in parts):
        return json.dumps(value)
    names = [f"{json.dumps(name)}: " for name in value] if isinstance(value, dict) else [""] * len(value)
    inner = indent + " "
    lines = [f"{inner}{name}{by_rows(part, inner)}" for name, part in zip(names, parts, strict=True)]
    first, last = "{}" if isinstance(value, dict) else "[]"
    return f"{first}\n" + ",\n".join(lines) + f"\n{indent}{last}"


def table_of(rows: Sequence[Mapping[str, str]]) -> str:
    """A Markdown table of rows that give the cell of each column by its title, in the order of the first row."""
    return table(list(rows[0]), [list(row.values()) for row in rows])


def table(header: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
