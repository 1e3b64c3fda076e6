"""The report of an evaluation: tables and pictures as Markdown, every figure as JSON, the pictures as PNG."""

from __future__ import annotations

import json
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


def write(
    folder: Path, outcomes: Sequence[Outcome], images: ThesisImages, facts: dict[str, Any], failures: Sequence[str] = ()
) -> tuple[Path, list[Entry]]:
    """Write report.md, results.json and the PNGs into an existing folder; returns report.md, and the contestants.

    Parameters
    ----------
    outcomes
        At least one.
    facts
        JSON values about the run: those of :func:`provenance.facts`, the threads and the seed.
    failures
        Why some contestants are missing; shown at the top.
    """
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
    for table in (*thesis_tables.overview(entries), *thesis_tables.thesis_tables(entries)):
        lines += ["", f"## {table.title}", "", table.markdown()]
        if table.note:
            lines += ["", table.note]
    for kind, caption in _CAPTIONS.items():
        lines += ["", f"## {kind.capitalize()}", "", caption]
        for entry in entries:
            lines += ["", f"{entry['name']}:", "", f"![{kind}](<{_file(entry['name'], kind)}>)"]
    return "\n".join(lines) + "\n"
