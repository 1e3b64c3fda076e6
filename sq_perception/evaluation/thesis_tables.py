"""Tables 6.1 to 6.3 and 7.1 to 7.4 of the thesis, with our figures and the thesis' own beside them.

A row of the thesis is answered by every network that was trained by its loss, and the iterative method by the classic
fit.  Where there is none, the cells say so.  Rows that the thesis does not have (least squares with free space) follow
at the end.  The thesis' figures were measured there, on its own images, and on a GPU where a time belongs to a network.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from sq_perception.evaluation.figures_of_merit import Summary

NOTHING = "none given"
"""In the cells of a row of the thesis that no contestant answers."""
NOT_IN_THESIS = "not in the thesis"


@dataclass(frozen=True)
class Table:
    """A table of text cells, with a line about what is in it."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def markdown(self) -> str:
        """As Markdown, without the title."""
        escaped = [[cell.replace("|", "\\|") for cell in line] for line in (self.header, *self.rows)]
        lines = [escaped[0], ["---"] * len(self.header), *escaped[1:]]
        return "\n".join("| " + " | ".join(line) + " |" for line in lines)


@dataclass(frozen=True)
class TableEntry:
    """What a table needs to know of a contestant; ``loss`` is empty for fits."""

    name: str
    loss: str
    summary: Summary


@dataclass(frozen=True)
class _Row:
    """A row of the thesis: its label, who answers it, and the thesis' cells."""

    label: str
    answered_by: Callable[[TableEntry], bool]
    iou: str = ""
    time: str = ""
    errors: tuple[str, str, str] = ("", "", "")


def _trained_by(loss: str) -> Callable[[TableEntry], bool]:
    return lambda result: result.loss == loss


_ITERATIVE = _Row(
    "Iterative (Solina and Bajcsy)",
    lambda result: not result.loss and result.name == "classic",
    "84.51 ± 8.89 %",
    "690.52 ± 275.62",
    ("-10.30 %", "+6.07 %", "(+0.00 %, +0.00 %, +1.56 %)"),
)
_OCCUPANCY = _Row(
    "supervised, L_OC",
    _trained_by("occupancy"),
    "94.62 ± 3.18 %",
    "2.88 ± 0.92",
    ("+0.14 %", "-0.36 %", "(+0.01 %, +0.01 %, -0.03 %)"),
)
_OCCUPANCY_7_4 = _Row(_OCCUPANCY.label, _OCCUPANCY.answered_by, _OCCUPANCY.iou, "2.82 ± 0.76")
_LEAST_SQUARES = _Row(
    "unsupervised, L_LS",
    _trained_by("least_squares"),
    "74.82 ± 14.50 %",
    "2.83 ± 0.22",
    ("+13.69 %", "-19.27 %", "(+0.41 %, -0.05 %, -2.67 %)"),
)
_RENDER = _Row(
    "unsupervised, L_DR",
    _trained_by("render"),
    "85.64 ± 5.72 %",
    "2.77 ± 0.16",
    ("+8.22 %", "+4.01 %", "(+0.76 %, -0.63 %, -0.12 %)"),
)
_FREE_SPACE = _Row("unsupervised, L_LS and free space", _trained_by("least_squares_free"))
_DUAL_6_1 = _Row("Model 1, L_DUAL", _trained_by("dual"), "62.76 ± 11.34 %")
_OCCUPANCY_6_1 = _Row("Model 2, L_OC", _trained_by("occupancy"), "94.62 ± 3.18 %")
_ROTATION = _Row("rotation alone, L_OC(q)", _trained_by("occupancy_rotation"), "75.02 %")

_UNSUPERVISED = (_LEAST_SQUARES, _RENDER, _FREE_SPACE)

_DISTRIBUTIONS: Mapping[str, tuple[str, str, str]] = {
    "supervised, L_OC": ("52.71 %", "99.24 %", "99.06 %"),
    "unsupervised, L_DR": ("44.18 %", "95.25 %", ""),
}


def thesis_tables(results: Sequence[TableEntry]) -> list[Table]:
    """All tables of chapters 6 and 7, in order."""
    own = "Rows that the thesis does not have stand last."
    time = (
        "Ours is the whole recovery of one image on this machine, from segmentation to score; the thesis' times of "
        "networks were measured on a GPU."
    )
    return [
        _table("Table 6.1: networks of all 12 parameters, supervised", (_DUAL_6_1, _OCCUPANCY_6_1), results, _iou),
        _table("Section 6.5.2: rotation alone, the other parameters given", (_ROTATION,), results, _iou,
               "A random rotation reaches about 58 % in the thesis."),
        _table("Figures 6.6 and 7.7, in words: how IoU is distributed", (_OCCUPANCY, _RENDER), results, _distribution),
        _table("Table 6.2: errors of each parameter group", (_ITERATIVE, _OCCUPANCY), results, _errors),
        _table("Table 6.3: against the classic method", (_ITERATIVE, _OCCUPANCY), results, _iou_and_time, time),
        _table("Table 7.1: errors under L_LS", (_LEAST_SQUARES,), results, _errors),
        _table("Table 7.2: unsupervised networks", _UNSUPERVISED, results, _iou, own),
        _table("Table 7.3: errors of all", (_ITERATIVE, _OCCUPANCY, *_UNSUPERVISED), results, _errors, own),
        _table("Table 7.4: all in comparison", (_ITERATIVE, _OCCUPANCY_7_4, *_UNSUPERVISED), results, _iou_and_time,
               f"{time} {own}"),
    ]  # fmt: skip


def overview(results: Sequence[TableEntry]) -> list[Table]:
    """Every contestant: how well the bodies overlap, and what is wrong about them, with the time it took."""
    accuracy, errors = [], []
    for result in results:
        s = result.summary
        accuracy.append(
            (
                result.name,
                spread(s.iou_mean, s.iou_std),
                percent(s.iou_min),
                percent(s.iou_median),
                percent(s.iou_max),
                percent(s.over_85),
                spread(s.volume_iou_mean, s.volume_iou_std),
                f"{s.recovered} of {s.bodies}",
            )
        )
        errors.append(
            (
                result.name,
                signed(s.delta_a),
                signed(s.delta_e),
                _triple(s.delta_t),
                percent(s.quarter_turns, 1),
                _degrees(s.symmetric_angle_median),
                _degrees(s.any_order_angle_median),
                f"{s.milliseconds_median:.1f} / {s.milliseconds_p95:.1f}" if s.timed else "not timed",
                str(s.timed),
            )
        )
    return [
        Table(
            "All contestants: IoU",
            ("Contestant", "IoU", "min", "median", "max", "over 85 %", "volume IoU", "recovered"),
            tuple(accuracy),
        ),
        Table(
            "All contestants: errors, rotations and times",
            ("Contestant", "ΔA", "ΔE", "ΔT", "quarter turns", "angle", "axes in any order", "ms median / p95", "timed"),
            tuple(errors),
            "Angles are medians, symmetries aside; times are those of one image by itself, on so many images.",
        ),
    ]


def percent(value: float, digits: int = 2) -> str:
    """A fraction as per cent."""
    return f"{100 * value:.{digits}f} %" if math.isfinite(value) else "unknown"


def signed(value: float) -> str:
    """A relative error as per cent with its sign; none is -0."""
    return f"{round(100 * value, 2) + 0.0:+.2f} %" if math.isfinite(value) else "unknown"


def spread(mean: float, deviation: float) -> str:
    """Mean and standard deviation of a fraction as per cent."""
    return f"{100 * mean:.2f} ± {100 * deviation:.2f} %" if math.isfinite(mean) else "unknown"


def _table(
    title: str,
    rows: Sequence[_Row],
    results: Sequence[TableEntry],
    columns: Callable[[_Row, TableEntry | None], dict[str, str]],
    note: str = "",
) -> Table:
    lines = []
    header: tuple[str, ...] = ()
    for row in rows:
        answers: list[TableEntry | None] = [result for result in results if row.answered_by(result)]
        for result in answers or [None]:
            cells = {"Method": row.label, "Contestant": result.name if result else NOTHING, **columns(row, result)}
            header = tuple(cells)
            lines.append(tuple(cells.values()))
    return Table(title, header, tuple(lines), note)


def _iou(row: _Row, result: TableEntry | None) -> dict[str, str]:
    s = result.summary if result else None
    return {"IoU": spread(s.iou_mean, s.iou_std) if s else NOTHING, "IoU, thesis": row.iou or NOT_IN_THESIS}


def _iou_and_time(row: _Row, result: TableEntry | None) -> dict[str, str]:
    s = result.summary if result else None
    time = NOTHING
    if s:
        time = f"{s.milliseconds_mean:.2f} ± {s.milliseconds_std:.2f}" if s.timed else "not timed"
    return {
        **_iou(row, result),
        "Execution time [ms]": time,
        "[ms], thesis": row.time or NOT_IN_THESIS,
        "bodies, timed": f"{s.bodies}, {s.timed}" if s else NOTHING,
    }


def _errors(row: _Row, result: TableEntry | None) -> dict[str, str]:
    s = result.summary if result else None
    ours = (signed(s.delta_a), signed(s.delta_e), _triple(s.delta_t)) if s else (NOTHING,) * 3
    cells = {}
    for name, mine, theirs in zip(("ΔA", "ΔE", "ΔT"), ours, row.errors, strict=True):
        cells[name], cells[f"{name}, thesis"] = mine, theirs or NOT_IN_THESIS
    return cells


def _distribution(row: _Row, result: TableEntry | None) -> dict[str, str]:
    s = result.summary if result else None
    ours = [percent(value) for value in (s.iou_min, s.iou_max, s.over_85)] if s else [NOTHING] * 3
    cells = {}
    for name, mine, theirs in zip(("least", "largest", "over 85 %"), ours, _DISTRIBUTIONS[row.label], strict=True):
        cells[name], cells[f"{name}, thesis"] = mine, theirs or NOT_IN_THESIS
    return cells


def _degrees(radians: float) -> str:
    return f"{math.degrees(radians):.1f}°" if math.isfinite(radians) else "unknown"


def _triple(values: Sequence[float]) -> str:
    return f"({', '.join(signed(value) for value in values)})"
