"""The table of the demonstration: truth beside both results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from rich.console import Group
from rich.table import Table
from rich.text import Text

from sq_perception.evaluation.comparison import alike, pair
from sq_perception.geometry.superquadric import Superquadric

TITLES = {"recover_node": "CNN + fit", "fitter_node": "classic fit"}
"""Of the methods, by the node."""
_GOOD_OVERLAP = 0.9
"""IoU of a body that is shown in green."""


def demo_table(
    truth: Superquadric | None,
    results: Mapping[str, tuple[Superquadric, np.ndarray]],
    unit: str,
    heading: str,
    latencies: Mapping[str, Sequence[float]],
) -> Group:
    """Results beside the truth, or, where there is none, beside the first result.

    Parameters
    ----------
    truth
        Batch (n,).
    results
        Batch (n,) and residuals (n,) by method.
    unit
        "mm" or "".
    latencies
        Milliseconds by method.
    """
    has_truth = truth is not None and len(truth) > 0
    model = truth if truth is not None and has_truth else next(iter(results.values()))[0]
    table = Table(title=heading, title_justify="left", header_style="bold")
    for title in ["", "truth\na1 a2 a3", "\ne1 e2"][: 3 if has_truth else 1]:
        table.add_column(title, justify="right")
    for title in TITLES.values():
        table.add_column(f"{title}\na1 a2 a3", justify="right")
        table.add_column("\ne1 e2", justify="right")
        table.add_column("\nIoU" if has_truth else "\nresidual", justify="right")
    pairs = {name: pair(model, found) for name, (found, _) in results.items()}
    for i in range(len(model)):
        cells = _numbers(model[i], unit) if has_truth else []
        for name, (found, residuals) in results.items():
            partner, overlap = pairs[name][i].recovered, pairs[name][i].iou
            if partner is None:
                cells += ["[red]not found[/]", "", ""]
                continue
            quality = f"{_length(residuals[partner], unit, 1)} {unit}".strip()
            if has_truth and overlap is not None:
                colour = "green" if overlap >= _GOOD_OVERLAP else "red"
                quality = f"[{colour}]{100 * overlap:.1f} %[/]"
            cells += [*_numbers(alike(found[partner], model[i]), unit), quality]
        table.add_row(str(i + 1), *cells)
    for k, (name, (found, _)) in enumerate(results.items()):
        for extra in pairs[name][len(model) :]:
            remark = "[red]not there[/]" if has_truth else ""
            before = [""] * (3 * k + 2 * has_truth)
            table.add_row("", *before, *_numbers(found[extra.recovered], unit), remark)
    return Group(table, Text(delays(latencies)))


def delays(latencies: Mapping[str, Sequence[float]]) -> str:
    """Median time from the image's stamp to the result, per method, over what is given."""
    parts = [
        f"{title} {np.median(latencies[name]):.0f} ms" if latencies.get(name) else f"{title} -"
        for name, title in TITLES.items()
    ]
    return "stamp to result, median: " + ", ".join(parts)


def _numbers(body: Superquadric, unit: str) -> list[str]:
    """Half sizes, and exponents."""
    size = " ".join(_length(value, unit) for value in body.size)
    return [f"{size} {unit}".strip(), " ".join(f"{value:.2f}" for value in body.shape)]


def _length(value: float, unit: str, more: int = 0) -> str:
    return f"{1000 * value:.{more}f}" if unit == "mm" else f"{value:.{3 + more}f}"
