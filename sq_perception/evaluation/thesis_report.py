"""The report of an evaluation: tables and pictures as Markdown, every figure as JSON, the pictures as PNG.

Tables are 6.1 to 6.3 and 7.1 to 7.4 of the thesis, with our figures and the thesis' own beside them.  A row of the
thesis is answered by every network that was trained by its loss, and the iterative method by the classic fit.  Where
there is none, the cells are marked.  Rows that the thesis does not have (least squares with free space) are at the end.
The thesis' figures were measured there, on its own images, and on a GPU where a time belongs to a network.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sq_perception.evaluation import evaluation_pictures as pictures
from sq_perception.evaluation import plots
from sq_perception.evaluation.contest import Outcome, ThesisImages

Entry = Mapping[str, Any]
"""A contestant as results.json has it: name, loss (None for fits), and the summary of its figures."""
NOTHING = "none given"  # what stands in the cells of a row of the thesis that no contestant answers
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
class _Row:
    """A row of the thesis: its label, the loss of the networks that answer it, and the thesis' cells by column."""

    label: str
    loss: str
    thesis: Mapping[str, str]


_IOU, _TIME = "IoU", "Execution time [ms]"
_ERRORS = ("ΔA", "ΔE", "ΔT")
_SPREAD = ("min", "max", "over 85 %")
_ITERATIVE = _Row("Iterative (Solina and Bajcsy)", "", {
    _IOU: "84.51 ± 8.89 %", _TIME: "690.52 ± 275.62",
    "ΔA": "-10.30 %", "ΔE": "+6.07 %", "ΔT": "(+0.00 %, +0.00 %, +1.56 %)",
})  # fmt: skip
_OCCUPANCY = _Row("supervised, L_OC", "occupancy", {
    _IOU: "94.62 ± 3.18 %", _TIME: "2.88 ± 0.92", "min": "52.71 %", "max": "99.24 %", "over 85 %": "99.06 %",
    "ΔA": "+0.14 %", "ΔE": "-0.36 %", "ΔT": "(+0.01 %, +0.01 %, -0.03 %)",
})  # fmt: skip
_LEAST_SQUARES = _Row("unsupervised, L_LS", "least_squares", {
    _IOU: "74.82 ± 14.50 %", _TIME: "2.83 ± 0.22",
    "ΔA": "+13.69 %", "ΔE": "-19.27 %", "ΔT": "(+0.41 %, -0.05 %, -2.67 %)",
})  # fmt: skip
_RENDER = _Row("unsupervised, L_DR", "render", {
    _IOU: "85.64 ± 5.72 %", _TIME: "2.77 ± 0.16", "min": "44.18 %", "max": "95.25 %",
    "ΔA": "+8.22 %", "ΔE": "+4.01 %", "ΔT": "(+0.76 %, -0.63 %, -0.12 %)",
})  # fmt: skip
_UNSUPERVISED = (_LEAST_SQUARES, _RENDER, _Row("unsupervised, L_LS and free space", "least_squares_free", {}))

_COLUMNS: Mapping[str, Callable[[Mapping[str, Any]], str]] = {
    _IOU: lambda s: spread(s["iou_mean"], s["iou_std"]),
    "min": lambda s: percent(s["iou_min"]),
    "median": lambda s: percent(s["iou_median"]),
    "max": lambda s: percent(s["iou_max"]),
    "over 85 %": lambda s: percent(s["over_85"]),
    "volume IoU": lambda s: spread(s["volume_iou_mean"], s["volume_iou_std"]),
    "recovered": lambda s: f"{s['recovered']} of {s['bodies']}",
    "ΔA": lambda s: signed(s["delta_a"]),
    "ΔE": lambda s: signed(s["delta_e"]),
    "ΔT": lambda s: f"({', '.join(signed(value) for value in s['delta_t'])})",
    "quarter turns": lambda s: percent(s["quarter_turns"], 1),
    "angle": lambda s: _degrees(s["symmetric_angle_median"]),
    "axes in any order": lambda s: _degrees(s["any_order_angle_median"]),
    "ms median / p95": lambda s: (
        f"{s['milliseconds_median']:.1f} / {s['milliseconds_p95']:.1f}" if s["timed"] else "not timed"
    ),
    _TIME: lambda s: f"{s['milliseconds_mean']:.2f} ± {s['milliseconds_std']:.2f}" if s["timed"] else "not timed",
    "timed": lambda s: str(s["timed"]),
}
"""The cell of a contestant in each column, by the column's title."""


def thesis_tables(results: Sequence[Entry]) -> list[Table]:
    """All tables of chapters 6 and 7, in order."""
    own = "Rows that the thesis does not have stand last."
    time = (
        "Ours is the whole recovery of one image on this machine, from segmentation to score; the thesis' times of "
        "networks were measured on a GPU."
    )
    iou, times = (_IOU,), (_IOU, _TIME)
    dual = _Row("Model 1, L_DUAL", "dual", {_IOU: "62.76 ± 11.34 %"}), replace(_OCCUPANCY, label="Model 2, L_OC")
    rotation = _Row("rotation alone, L_OC(q)", "occupancy_rotation", {_IOU: "75.02 %"})
    compared = replace(_OCCUPANCY, thesis={**_OCCUPANCY.thesis, _TIME: "2.82 ± 0.76"})
    return [
        _table("Table 6.1: networks of all 12 parameters, supervised", dual, results, iou),
        _table("Section 6.5.2: rotation alone, the other parameters given", (rotation,), results, iou,
               "A random rotation reaches about 58 % in the thesis."),
        _table("Figures 6.6 and 7.7 as numbers: how IoU is distributed", (_OCCUPANCY, _RENDER), results, _SPREAD),
        _table("Table 6.2: errors of each parameter group", (_ITERATIVE, _OCCUPANCY), results, _ERRORS),
        _table("Table 6.3: against the classic method", (_ITERATIVE, _OCCUPANCY), results, times, time),
        _table("Table 7.1: errors under L_LS", (_LEAST_SQUARES,), results, _ERRORS),
        _table("Table 7.2: unsupervised networks", _UNSUPERVISED, results, iou, own),
        _table("Table 7.3: errors of all", (_ITERATIVE, _OCCUPANCY, *_UNSUPERVISED), results, _ERRORS, own),
        _table("Table 7.4: all in comparison", (_ITERATIVE, compared, *_UNSUPERVISED), results, times,
               f"{time} {own}"),
    ]  # fmt: skip


def overview(results: Sequence[Entry]) -> list[Table]:
    """Every contestant: how well the bodies overlap, and what is wrong about them, with the time it took."""

    def listed(title: str, columns: Sequence[str], note: str = "") -> Table:
        rows = tuple((entry["name"], *(_COLUMNS[name](entry["summary"]) for name in columns)) for entry in results)
        return Table(title, ("Contestant", *columns), rows, note)

    return [
        listed("All contestants: IoU", (_IOU, "min", "median", "max", "over 85 %", "volume IoU", "recovered")),
        listed(
            "All contestants: errors, rotations and times",
            (*_ERRORS, "quarter turns", "angle", "axes in any order", "ms median / p95", "timed"),
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


def _table(title: str, rows: Sequence[_Row], results: Sequence[Entry], columns: Sequence[str], note: str = "") -> Table:
    """Our cells beside the thesis'."""
    header = ["Method", "Contestant"]
    for name in columns:
        header += [name, f"{name}, thesis"]
    lines = []
    for row in rows:
        if row.loss:
            answers: list[Entry | None] = [result for result in results if result["loss"] == row.loss]
        else:
            answers = [result for result in results if not result["loss"] and result["name"] == "classic"]
        for result in answers or [None]:
            cells = [row.label, result["name"] if result else NOTHING]
            for name in columns:
                ours = _COLUMNS[name](result["summary"]) if result else NOTHING
                cells += [ours, row.thesis.get(name, NOT_IN_THESIS)]
            lines.append(tuple(cells))
    return Table(title, tuple(header), tuple(lines), note)


def _degrees(radians: float) -> str:
    return f"{math.degrees(radians):.1f}°" if math.isfinite(radians) else "unknown"


FORMAT = "sq_perception.evaluation"
VERSION = 1
_CAPTIONS = {
    "distributions": "Left: IoU (figures 6.6, 7.3 and 7.7 of the thesis), bins of one per cent; where every body is "
    "above 95 %, that part only. Middle: the shortest arc as in figure 6.3, from the predicted to the label's "
    "quaternion with their signs as they are: 0, π and 2π are the same body where the axis is one of the body's own. "
    "Right: the least angle over the 8 parameter vectors of the label's body (filled), and over all 24 ways to list "
    "its axes (line), which forgives the exchange of z where e1 is about e2.",
    "examples": "The three bodies of largest IoU, three about the median, and the three of least IoU. Of each, the "
    "input and the prediction rendered from the same place, both cropped, and the prediction seen from aside, the true "
    "body as wires.",
}


def write(
    folder: Path, outcomes: Sequence[Outcome], images: ThesisImages, facts: dict[str, Any], failures: Sequence[str] = ()
) -> tuple[Path, list[Entry]]:
    """Write report.md, results.json and the PNGs into a folder; returns report.md, and the contestants.  ``facts`` are
    JSON values about the run, ``failures`` why contestants are missing."""
    entries: list[Entry] = []
    for outcome in outcomes:
        contestant, name = outcome.contestant, outcome.contestant.name
        plots.save(pictures.distributions(outcome), folder / _file(name, "distributions"))
        plots.save(pictures.examples(outcome, images), folder / _file(name, "examples"))
        entries.append(
            {
                "name": name,
                "description": contestant.description,
                "loss": contestant.loss or None,
                "summary": outcome.figures.summary(),
                "examples": pictures.rank(outcome),
                "pictures": [_file(name, kind) for kind in _CAPTIONS],
                **contestant.notes,
            }
        )
    found = {"format": FORMAT, "version": VERSION, "facts": facts, "failures": list(failures), "contestants": entries}
    finite = json.loads(json.dumps(found), parse_constant=lambda _: None)  # JSON knows neither NaN nor infinity
    text = json.dumps(finite, indent=1, allow_nan=False, ensure_ascii=False)
    (folder / "results.json").write_text(text + "\n", encoding="utf-8")
    path = folder / "report.md"
    path.write_text(_markdown(entries, facts, failures), encoding="utf-8")
    return path, entries


def _file(name: str, kind: str) -> str:
    return f"{name}_{kind}.png"


def _facts_line(facts: dict[str, Any]) -> str:
    commit = facts["commit"] or "unknown"
    changed = " with changes" if facts["modified"] else ""
    threads = ", ".join(f"{name} {count}" for name, count in facts["threads"].items())
    versions = ", ".join(f"{name} {version}" for name, version in facts["versions"].items() if version)
    return (
        f"{facts['date']}, {facts['processor']}, threads {threads}, commit {commit}{changed}, "
        f"seed {facts['seed']}, Python {facts['python']}, {versions}"
    )


def _markdown(entries: Sequence[Entry], facts: dict[str, Any], failures: Sequence[str]) -> str:
    bodies = " and ".join(str(count) for count in sorted({entry["summary"]["bodies"] for entry in entries}))
    protocol = (
        f"Bodies of the thesis' protocol that no training has seen, clean 8 bit images of 256 x 256 pixels, {bodies} "
        "of them (the table says who had how many, always the first ones). ΔT is in per cent of the cube's side."
    )
    lines = ["# Evaluation", "", f"`{facts['command']}`", "", _facts_line(facts), "", protocol, ""]
    lines += [f"Left out: {failure}\n" for failure in failures]
    lines += [f"- {entry['name']}: {entry['description']}" for entry in entries]
    for table in (*overview(entries), *thesis_tables(entries)):
        lines += ["", f"## {table.title}", "", table.markdown()]
        if table.note:
            lines += ["", table.note]
    for kind, caption in _CAPTIONS.items():
        lines += ["", f"## {kind.capitalize()}", "", caption]
        for entry in entries:
            lines += ["", f"{entry['name']}:", "", f"![{kind}](<{_file(entry['name'], kind)}>)"]
    return "\n".join(lines) + "\n"
