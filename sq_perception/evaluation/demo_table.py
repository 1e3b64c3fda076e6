"""The table of the demonstration: recovered bodies beside true ones, who is whom, and in comparable numbers.

Bodies are paired so that the sum of the distances of their centres is least; a pair farther apart than the sum of their
largest half sizes is none.  Of the 8 parameter vectors of one body, the one most like the truth is shown:

    least  | log size - log true size | + angle between the rotations      (natural logarithm, radians)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from rich.console import Group
from rich.table import Table
from rich.text import Text
from scipy.optimize import linear_sum_assignment

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.metrics import volume_iou
from sq_perception.geometry.superquadric import Superquadric

TITLES = {"recover_node": "CNN + fit", "fitter_node": "classic fit"}
"""Titles of the methods, by the node."""
_GOOD_OVERLAP = 0.9
"""IoU of a body that is shown in green."""
_POINTS = 48
"""Points along each edge of the box in which an overlap is counted: fewer than for figures, as every frame is shown."""


@dataclass(frozen=True, eq=False)
class Pair:
    """One object: what it is and what was made of it; at least one of both is there.

    Attributes
    ----------
    truth, recovered
        Indices into the batches, or None.
    iou
        Volume overlap of whole bodies, 0 to 1; None without a partner.
    """

    truth: int | None
    recovered: int | None
    iou: float | None = None


def pair(truth: Superquadric, recovered: Superquadric) -> list[Pair]:
    """Pairs of two batches (n,) and (m,): every true body in order, then what was recovered without being there."""
    distance = np.linalg.norm(truth.translation[:, None] - recovered.translation[None], axis=-1)
    i, k = linear_sum_assignment(distance)
    is_near = distance[i, k] <= truth.size[i].max(axis=1) + recovered.size[k].max(axis=1)
    i, k = i[is_near], k[is_near]
    overlap = volume_iou(recovered[k], truth[i], _POINTS) if len(i) else np.empty(0)
    near = (Pair(*one) for one in zip(i.tolist(), k.tolist(), overlap.tolist(), strict=True))
    partners = {one.truth: one for one in near}
    pairs = [partners.get(number, Pair(number, None)) for number in range(len(truth))]
    return pairs + [Pair(None, number) for number in range(len(recovered)) if number not in k]


def alike(body: Superquadric, model: Superquadric) -> Superquadric:
    """The parameter vector of ``body`` that is most like that of ``model``; both single."""
    forms = body.equivalent_forms()
    stretch = np.linalg.norm(np.log(forms.size / model.size), axis=-1)
    turn = quaternions.geodesic_angle(forms.rotation, np.broadcast_to(model.rotation, forms.rotation.shape))
    return forms[int(np.argmin(stretch + turn))]


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
