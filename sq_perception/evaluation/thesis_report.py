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
from sq_perception.evaluation.thesis_tables import Entry, Table

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


def write(
    folder: Path, outcomes: Sequence[Outcome], images: ThesisImages, facts: dict[str, Any], failures: Sequence[str] = ()
) -> Path:
    """Write report.md, results.json and the PNGs into an existing folder; returns report.md.

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
    for outcome in outcomes:
        plots.save(pictures.distributions(outcome), folder / _file(outcome, "distributions"))
        plots.save(pictures.examples(outcome, images), folder / _file(outcome, "examples"))
    entries = [_entry(outcome) for outcome in outcomes]
    document = {
        "format": FORMAT,
        "version": VERSION,
        "facts": facts,
        "failures": list(failures),
        "contestants": entries,
    }
    text = json.dumps(_finite(document), indent=1, allow_nan=False, ensure_ascii=False)
    (folder / "results.json").write_text(text + "\n", encoding="utf-8")
    path = folder / "report.md"
    path.write_text(_markdown(outcomes, entries, facts, failures), encoding="utf-8")
    return path


def overview(outcomes: Sequence[Outcome]) -> list[Table]:
    """All contestants, in everything that is one number."""
    return thesis_tables.overview([_entry(outcome) for outcome in outcomes])


def _file(outcome: Outcome, kind: str) -> str:
    return f"{outcome.contestant.name}_{kind}.png"


def _entry(outcome: Outcome) -> dict[str, Any]:
    contestant = outcome.contestant
    return {
        "name": contestant.name,
        "description": contestant.description,
        "loss": contestant.loss or None,
        "summary": outcome.figures.summary(),
        "examples": pictures.ranked(outcome),
        "pictures": [_file(outcome, kind) for kind in _CAPTIONS],
        **contestant.notes,
    }


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
    outcomes: Sequence[Outcome], entries: Sequence[Entry], facts: dict[str, Any], failures: Sequence[str]
) -> str:
    lines = ["# Evaluation", "", f"`{facts.get('command')}`", "", _facts_line(facts), "", _protocol(outcomes), ""]
    lines += [f"Left out: {failure}\n" for failure in failures]
    lines += [f"- {outcome.contestant.name}: {outcome.contestant.description}" for outcome in outcomes]
    for table in (*thesis_tables.overview(entries), *thesis_tables.thesis_tables(entries)):
        lines += ["", f"## {table.title}", "", table.markdown()]
        if table.note:
            lines += ["", table.note]
    for kind, caption in _CAPTIONS.items():
        lines += ["", f"## {kind.capitalize()}", "", caption]
        for outcome in outcomes:
            lines += ["", f"{outcome.contestant.name}:", "", f"![{kind}](<{_file(outcome, kind)}>)"]
    return "\n".join(lines) + "\n"
