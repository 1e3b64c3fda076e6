"""The report of an evaluation: one HTML file that needs no other, the same tables as Markdown, every figure as JSON.

The HTML file holds its style and its pictures (PNG, base64), no script and no address; its policy forbids the browser
to fetch anything.  Texts from outside, such as names of files, are escaped.
"""

from __future__ import annotations

import base64
import html
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from sq_perception.evaluation import evaluation_pictures as pictures
from sq_perception.evaluation import plots, thesis_tables
from sq_perception.evaluation.contest import Outcome
from sq_perception.evaluation.contestants import Network
from sq_perception.evaluation.thesis_images import ThesisImages
from sq_perception.evaluation.thesis_tables import Table, TableEntry
from sq_perception.learning import training_log

FORMAT, VERSION = "sq_perception.evaluation", 1
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #22303c; background: #fff; max-width: 76rem; margin: 2.5rem auto;
       padding: 0 1.5rem; }
h1 { font-size: 1.7rem; margin-bottom: .3rem; }
h2 { font-size: 1.25rem; margin: 2.8rem 0 .6rem; border-bottom: 1px solid #dfe5ea; padding-bottom: .3rem; }
h3 { font-size: 1rem; margin: 1.8rem 0 .4rem; }
p, figcaption { max-width: 62rem; }
.faint, figcaption, td.none { color: #6b7885; }
.faint, figcaption { font-size: .87rem; }
.failure { border-left: 4px solid #d1006c; padding: .3rem .9rem; background: #fbf1f6; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .87rem; font-variant-numeric: tabular-nums; }
th, td { padding: .28rem .6rem; text-align: right; white-space: nowrap; border-bottom: 1px solid #edf0f3; }
th { font-weight: 600; border-bottom: 2px solid #c3ced6; vertical-align: bottom; white-space: normal; }
th:first-child, td:first-child, th:nth-child(2), td:nth-child(2) { text-align: left; }
.overview th:nth-child(2), .overview td:nth-child(2) { text-align: right; }
sub { line-height: 0; }
figure { margin: 1rem 0 1.6rem; }
img { max-width: 100%; height: auto; display: block; }
code { font-size: .85em; background: #f4f6f7; padding: .1rem .3rem; overflow-wrap: anywhere; }
@media print { .scroll { overflow: visible; } table { font-size: .6rem; } figure, tr { break-inside: avoid; } }
"""
_CAPTIONS = {
    "inside_outside": "Figure 3.4 of the thesis: one body three times. Points of a grid around it are coloured by the "
    "inside-outside function F on a logarithmic scale; those inside are opaque, those outside at 15 %.",
    "iou": "Distribution of IoU (figures 6.6, 7.3 and 7.7 of the thesis), bins of one per cent.",
    "distributions": "Left: IoU; where every body is above 95 %, that part only. Middle: the shortest arc as in figure "
    "6.3, from the predicted to the label's quaternion with their signs as they are: 0, π and 2π are the same body "
    "where the axis is one of the body's own. "
    "Right: the least angle over the 8 parameter vectors of the label's body (filled), and over all 24 ways to list "
    "its axes (line), which forgives the exchange of z where e1 is about e2.",
    "examples": "The three bodies of largest IoU, three about the median, and the three of least IoU. Of each, the "
    "input and the prediction rendered from the same place, both cropped, and the prediction seen from aside, the true "
    "body as wires.",
    "training": "From the log.jsonl beside the model file.",
}


@dataclass(frozen=True)
class _Picture:
    kind: str
    file: str
    png: bytes


def write(
    folder: Path, outcomes: Sequence[Outcome], images: ThesisImages, facts: dict[str, Any], failures: Sequence[str] = ()
) -> Path:
    """Write report.html, report.md, results.json and the PNGs into an existing folder; returns report.html.

    Parameters
    ----------
    outcomes
        At least one.
    facts
        JSON values about the run, as :func:`provenance.facts` gives them.
    failures
        Why some contestants are missing; shown at the top.
    """
    if not outcomes:
        raise ValueError("outcomes: expected at least one")
    tables = thesis_tables.thesis_tables(_results(outcomes))
    general = [
        _saved(pictures.iou_overview(outcomes), folder, "iou", "iou"),
        _saved(pictures.inside_outside(), folder, "inside_outside", "inside_outside"),
    ]
    own = {outcome.contestant.name: _own_pictures(outcome, images, folder) for outcome in outcomes}
    entries = [_entry(outcome, [one.file for one in own[outcome.contestant.name]]) for outcome in outcomes]
    document = {
        "format": FORMAT,
        "version": VERSION,
        "facts": facts,
        "failures": list(failures),
        "contestants": entries,
    }
    text = json.dumps(_finite(document), indent=1, allow_nan=False, ensure_ascii=False)
    (folder / "results.json").write_text(text + "\n", encoding="utf-8")
    (folder / "report.md").write_text(_markdown(outcomes, tables, facts, failures), encoding="utf-8")
    path = folder / "report.html"
    path.write_text(_html(outcomes, tables, general, own, facts, failures), encoding="utf-8")
    return path


def overview(outcomes: Sequence[Outcome]) -> list[Table]:
    """All contestants, in everything that is one number."""
    return thesis_tables.overview(_results(outcomes))


def _results(outcomes: Sequence[Outcome]) -> list[TableEntry]:
    return [TableEntry(one.contestant.name, one.contestant.loss, one.figures.summary()) for one in outcomes]


def _own_pictures(outcome: Outcome, images: ThesisImages, folder: Path) -> list[_Picture]:
    name = outcome.contestant.name
    drawn: list[tuple[str, Figure]] = [
        ("distributions", pictures.distributions(outcome)),
        ("examples", pictures.examples(outcome, images)),
    ]
    if isinstance(outcome.contestant, Network):
        records = [one for one in training_log.read(outcome.contestant.path.parent) if "iou" in one]
        if len(records) > 1:
            drawn.append(("training", pictures.training_curves(records)))
    return [_saved(figure, folder, f"{name}_{kind}", kind) for kind, figure in drawn]


def _saved(figure: Figure, folder: Path, stem: str, kind: str) -> _Picture:
    path = plots.save(figure, folder / f"{stem}.png")
    return _Picture(kind, path.name, path.read_bytes())


def _entry(outcome: Outcome, files: list[str]) -> dict[str, Any]:
    contestant = outcome.contestant
    entry: dict[str, Any] = {
        "name": contestant.name,
        "description": contestant.description,
        "loss": contestant.loss or None,
        "summary": asdict(outcome.figures.summary()),
        "examples": pictures.ranked(outcome),
        "pictures": files,
    }
    if isinstance(contestant, Network):
        entry.update(model=str(contestant.path), training=contestant.training, metrics=contestant.metrics)
    return entry


def _finite(value: Any) -> Any:
    """The same values with None for what JSON does not know."""
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _facts_line(facts: dict[str, Any]) -> str:
    commit = facts.get("commit") or "unknown"
    changed = " with changes" if facts.get("modified") else ""
    threads = ", ".join(f"{name} {count}" for name, count in facts.get("threads", {}).items()) or "unknown"
    versions = ", ".join(f"{name} {version}" for name, version in facts.get("versions", {}).items() if version)
    return (
        f"{facts.get('date')}, {facts.get('processor')}, threads {threads}, commit {commit}{changed}, "
        f"seed {facts.get('seed')}, Python {facts.get('python')}, {versions}"
    )


def _protocol(outcomes: Sequence[Outcome]) -> str:
    counts = sorted({len(outcome.figures) for outcome in outcomes})
    bodies = " and ".join(str(count) for count in counts)
    return (
        f"Bodies of the thesis' protocol that no training has seen, clean 8 bit images of 256 x 256 pixels, {bodies} "
        "of them (the table says who had how many, always the first ones). ΔT is in per cent of the cube's side."
    )


def _markdown(
    outcomes: Sequence[Outcome], tables: Sequence[Table], facts: dict[str, Any], failures: Sequence[str]
) -> str:
    lines = ["# Evaluation", "", f"`{facts.get('command')}`", "", _facts_line(facts), "", _protocol(outcomes), ""]
    lines += [f"Left out: {failure}\n" for failure in failures]
    lines += [f"- {one.contestant.name}: {one.contestant.description}" for one in outcomes]
    for table in (*overview(outcomes), *tables):
        lines += ["", f"## {table.title}", "", table.markdown()]
        if table.note:
            lines += ["", table.note]
    return "\n".join(lines) + "\n"


def _html(
    outcomes: Sequence[Outcome],
    tables: Sequence[Table],
    general: Sequence[_Picture],
    own: dict[str, list[_Picture]],
    facts: dict[str, Any],
    failures: Sequence[str],
) -> str:
    e = html.escape
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8">',
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:; '
        "style-src 'unsafe-inline'\">",
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>sq-perception: evaluation</title><style>{_STYLE}</style></head><body>",
        "<h1>Superquadrics from depth images: evaluation</h1>",
        f'<p class="faint">{e(_facts_line(facts))}<br><code>{e(str(facts.get("command")))}</code></p>',
        f"<p>{e(_protocol(outcomes))}</p>",
    ]
    parts += [f'<p class="failure">Left out: {e(failure)}</p>' for failure in failures]
    parts.append("<h2>All contestants</h2><ul>")
    parts += [f"<li><b>{e(one.contestant.name)}</b>: {e(one.contestant.description)}</li>" for one in outcomes]
    parts.append("</ul>")
    parts += [_section(table, "scroll overview") for table in overview(outcomes)]
    parts += [_figure(general[0]), "<h2>The thesis' tables</h2>"]
    parts += [_section(table, "scroll") for table in tables]
    parts += ["<h2>How bodies are drawn</h2>", _figure(general[1])]
    for outcome in outcomes:
        name = outcome.contestant.name
        parts += [f"<h2>{e(name)}</h2>", f"<p>{e(outcome.contestant.description)}</p>"]
        parts += [_figure(picture) for picture in own[name]]
    parts.append("</body></html>")
    return "\n".join(parts) + "\n"


def _section(table: Table, kind: str) -> str:
    note = f'<p class="faint">{html.escape(table.note)}</p>' if table.note else ""
    return f'<h3>{table.html_title}</h3><div class="{kind}">{table.html()}</div>{note}'


def _figure(picture: _Picture) -> str:
    data = base64.b64encode(picture.png).decode("ascii")
    caption = html.escape(_CAPTIONS[picture.kind])
    return (
        f'<figure><img alt="{html.escape(picture.file)}" src="data:image/png;base64,{data}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )
