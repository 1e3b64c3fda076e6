"""The report of an evaluation: tables and pictures as Markdown, every figure as JSON, the pictures as PNG."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sq_perception.evaluation import evaluation_pictures as pictures
from sq_perception.evaluation import plots, thesis_tables
from sq_perception.evaluation.contest import Outcome
from sq_perception.evaluation.thesis_images import ThesisImages
from sq_perception.evaluation.thesis_tables import Entry

FORMAT, VERSION = "sq_perception.evaluation", 1
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


def document(outcomes: Sequence[Outcome], facts: dict[str, Any], failures: Sequence[str] = ()) -> dict[str, Any]:
    """Everything that was found, as results.json has it but for numbers that JSON does not know.

    Parameters
    ----------
    outcomes
        At least one.
    facts
        JSON values about the run, as :func:`provenance.facts` gives them.
    failures
        Why some contestants are missing; shown at the top.
    """
    entries = [
        {
            "name": outcome.contestant.name,
            "description": outcome.contestant.description,
            "loss": outcome.contestant.loss or None,
            "summary": outcome.figures.summary(),
            "examples": pictures.ranked(outcome),
            "pictures": [_file(outcome.contestant.name, kind) for kind in _CAPTIONS],
            **outcome.contestant.notes,
        }
        for outcome in outcomes
    ]
    return {"format": FORMAT, "version": VERSION, "facts": facts, "failures": list(failures), "contestants": entries}


def write(folder: Path, found: dict[str, Any], outcomes: Sequence[Outcome], images: ThesisImages) -> Path:
    """Write report.md, results.json and the PNGs of a :func:`document` into an existing folder; returns report.md."""
    for outcome in outcomes:
        plots.save(pictures.distributions(outcome), folder / _file(outcome.contestant.name, "distributions"))
        plots.save(pictures.examples(outcome, images), folder / _file(outcome.contestant.name, "examples"))
    text = json.dumps(_finite(found), indent=1, allow_nan=False, ensure_ascii=False)
    (folder / "results.json").write_text(text + "\n", encoding="utf-8")
    path = folder / "report.md"
    path.write_text(_markdown(found), encoding="utf-8")
    return path


def _file(name: str, kind: str) -> str:
    return f"{name}_{kind}.png"


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


def _protocol(entries: Sequence[Entry]) -> str:
    bodies = " and ".join(str(count) for count in sorted({entry["summary"]["bodies"] for entry in entries}))
    return (
        f"Bodies of the thesis' protocol that no training has seen, clean 8 bit images of 256 x 256 pixels, {bodies} "
        "of them (the table says who had how many, always the first ones). ΔT is in per cent of the cube's side."
    )


def _markdown(found: dict[str, Any]) -> str:
    entries, facts = found["contestants"], found["facts"]
    lines = ["# Evaluation", "", f"`{facts.get('command')}`", "", _facts_line(facts), "", _protocol(entries), ""]
    lines += [f"Left out: {failure}\n" for failure in found["failures"]]
    lines += [f"- {entry['name']}: {entry['description']}" for entry in entries]
    for table in (*thesis_tables.overview(entries), *thesis_tables.thesis_tables(entries)):
        lines += ["", f"## {table.title}", "", table.markdown()]
        if table.note:
            lines += ["", table.note]
    for kind, caption in _CAPTIONS.items():
        lines += ["", f"## {kind.capitalize()}", "", caption]
        for entry in entries:
            lines += ["", f"{entry['name']}:", "", f"![{kind}](<{_file(entry['name'], kind)}>)"]
    return "\n".join(lines) + "\n"
