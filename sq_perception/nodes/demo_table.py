"""The table of the demonstration: truth beside both results, live in a terminal or line by line elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from rich.console import Group
from rich.table import Table
from rich.text import Text

from sq_msgs_py.superquadrics import FAILED, SuperquadricArray
from sq_perception.evaluation.comparison import Pair, alike, pair
from sq_perception.geometry.superquadric import Superquadric

TITLES = {"recover_node": "CNN + fit", "fitter_node": "classic fit"}


@dataclass(frozen=True)
class Cell:
    """What one method says about one object: half sizes, exponents, and how good that is."""

    size: str = "-"
    shape: str = ""
    quality: str = ""
    good: bool | None = None


@dataclass(frozen=True)
class Row:
    """One object: its truth, then the methods in the order of TITLES."""

    truth: Cell
    methods: tuple[Cell, ...]


@dataclass(frozen=True)
class Comparison:
    """All objects of one image, and the overlaps of each method for those that were found."""

    rows: tuple[Row, ...]
    overlaps: dict[str, list[float]]
    has_truth: bool


def bodies(found: SuperquadricArray) -> Superquadric:
    """The batch (n,) of superquadrics of a message, without failed ones."""
    kept = found.status != FAILED
    return Superquadric(found.size[kept], found.shape[kept], found.translation[kept], found.rotation[kept])


def compare(truth: SuperquadricArray | None, results: dict[str, SuperquadricArray], unit: str) -> Comparison:
    """Put results beside the truth, or, where there is none, beside the first result; ``unit`` is "mm" or ""."""
    recovered = {name: bodies(results[name]) for name in TITLES}
    has_truth = truth is not None and len(truth) > 0
    model = bodies(truth) if truth is not None and has_truth else next(iter(recovered.values()))
    pairs = {name: pair(model, found) for name, found in recovered.items()}
    rows = []
    for i in range(len(model)):
        cells = []
        for name, found in recovered.items():
            residual = results[name].residual[results[name].status != FAILED]
            cells.append(_cell(pairs[name][i], model[i], found, residual, has_truth, unit))
        rows.append(Row(_numbers(model[i], unit) if has_truth else Cell(), tuple(cells)))
    for name, found in recovered.items():
        for extra in pairs[name][len(model) :]:
            assert extra.recovered is not None
            cell = _numbers(found[extra.recovered], unit, "not there" if has_truth else "", good=False)
            rows.append(Row(Cell(), tuple(cell if other == name else Cell() for other in TITLES)))
    overlaps = {name: [one.iou or 0.0 for one in pairs[name][: len(model)]] for name in TITLES} if has_truth else {}
    return Comparison(tuple(rows), overlaps, has_truth)


def live(comparison: Comparison, heading: str, latencies: dict[str, list[float]]) -> Group:
    """What a terminal shows."""
    table = Table(title=heading, title_justify="left", header_style="bold", expand=False)
    table.add_column("", justify="right")
    table.add_column("truth\na1 a2 a3", justify="right")
    table.add_column("\ne1 e2", justify="right")
    for title in TITLES.values():
        table.add_column(f"{title}\na1 a2 a3", justify="right")
        table.add_column("\ne1 e2", justify="right")
        table.add_column("\nIoU" if comparison.has_truth else "\nresidual", justify="right")
    for k, row in enumerate(comparison.rows, start=1):
        cells = [row.truth.size, row.truth.shape]
        for cell in row.methods:
            colour = {True: "green", False: "red", None: ""}[cell.good]
            cells += [cell.size, cell.shape, f"[{colour}]{cell.quality}[/]" if colour else cell.quality]
        table.add_row(str(k), *cells)
    return Group(table, Text(delays(latencies)))


def lines(comparison: Comparison, heading: str, latencies: dict[str, list[float]]) -> str:
    """The same for a file or a pipe."""
    text = [heading]
    for k, row in enumerate(comparison.rows, start=1):
        parts = [f"truth {row.truth.size} e {row.truth.shape}"] if comparison.has_truth else []
        for title, cell in zip(TITLES.values(), row.methods, strict=True):
            parts.append(f"{title} {cell.size}" + (f" e {cell.shape} {cell.quality}" if cell.shape else ""))
        text.append(f"  {k}  " + " | ".join(parts))
    return "\n".join([*text, "  " + delays(latencies)])


def delays(latencies: dict[str, list[float]]) -> str:
    """Median time from the image's stamp to the result, per method, over what is given."""
    parts = []
    for name, title in TITLES.items():
        times = latencies.get(name, [])
        parts.append(f"{title} {np.median(times):.0f} ms" if times else f"{title} -")
    return "stamp to result, median: " + ", ".join(parts)


def _cell(
    one: Pair, model: Superquadric, found: Superquadric, residual: Sequence[float], has_truth: bool, unit: str
) -> Cell:
    if one.recovered is None:
        return Cell("not found", good=False)
    body = alike(found[one.recovered], model)
    if has_truth and one.iou is not None:
        return _numbers(body, unit, f"{100 * one.iou:.1f} %", good=one.iou >= 0.9)
    scale, digits = _scale(unit)
    return _numbers(body, unit, f"{scale * residual[one.recovered]:.{digits + 1}f} {unit}".strip())


def _numbers(body: Superquadric, unit: str, quality: str = "", good: bool | None = None) -> Cell:
    scale, digits = _scale(unit)
    size = " ".join(f"{scale * value:.{digits}f}" for value in body.size)
    return Cell(f"{size} {unit}".strip(), " ".join(f"{value:.2f}" for value in body.shape), quality, good)


def _scale(unit: str) -> tuple[float, int]:
    return (1000.0, 0) if unit == "mm" else (1.0, 3)
