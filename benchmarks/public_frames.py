"""Things of known size in recorded frames of public repositories.

    python benchmarks/public_frames.py FRAMES SHEET [--name public_frames]

FRAMES holds NPZ files with ``depth``, ``K`` and ``labels``; SHEET says in JSON, by the files' stems, what they show:

    {"table_0": {"repository": "owner/name", "sensor": "RealSense", "objects": [
        {"label": 1, "name": "cracker box", "kind": "box", "size": [0.06, 0.158, 0.21],
         "hull": [[x, y, z], ...], "pose": [[...], [...], [...], [0, 0, 0, 1]]}]}}

``size`` has the full edges.  ``hull`` and ``pose`` (camera from object) may be missing.  Metres.  None of it belongs to
the repository.

| figure | masks | what |
| --- | --- | --- |
| edges | given | error of the sorted full edges, mean over the three; median and mean over the things |
| within 2, beyond 3 | given | half sizes of CONVERGED bodies, by their deviations |
| IoU | given | with the hull in its pose, 0 without a body |
| far side | given | of the predicted hull: absolute error, and bias, positive where too far |
| found | its own | things with a segment of an IoU of at least 0.5, over measured pixels |
| bodies a frame | its own | all, whether they are in the sheet or not |
"""

from __future__ import annotations

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from camera_bias import far_side, with_hulls
from common import report
from common.hull_columns import Columns
from common.scene_verdict import MATCH

from sq_perception.fitting.fit import Status
from sq_perception.recordings.frame_file import RecordedFrame
from sq_perception.recordings.frame_file import read as read_frame
from sq_perception.recovery.recoverer import FrameRecovery, Recoverer


@dataclass(frozen=True)
class Answer:
    """What became of one thing, metres; NaN where the truth or a body is missing.

    ``deviations``: of the half sizes of a CONVERGED body, in reported ones.  ``overlap``: of the best own mask.
    """

    frame: str
    sensor: str
    name: str
    kind: str
    status: str
    error: float
    deviations: list[float]
    iou: float
    far: float
    overlap: float


def answers(stem: str, entry: dict[str, Any], frame: RecordedFrame, recoverer: Recoverer) -> tuple[list[Answer], int]:
    """Every thing of one frame, and the number of bodies with own masks."""
    if frame.labels is None:
        raise SystemExit(f"{stem}: expected labels, got none")
    given, hulls = with_hulls(recoverer, frame.depth, frame.camera, frame.labels)
    own = recoverer.recover(frame.depth, frame.camera)
    bodies = {one.label: one for one in given.recovered if one.status != Status.FAILED}
    found = []
    for thing in entry["objects"]:
        label, size = thing["label"], np.sort(thing["size"])
        one = bodies.get(label)
        error, deviations, iou, far = np.nan, np.empty(0), np.nan, np.nan
        if one is not None:
            order = np.argsort(one.superquadric.size)
            off = one.superquadric.size[order] - size / 2
            error = float(2 * np.abs(off).mean())
            if one.status == Status.CONVERGED:
                deviations = off / one.sigma_size[order]
        if "pose" in thing:
            hull, pose = np.array(thing["hull"]), np.array(thing["pose"])
            inverse = np.linalg.inv(pose)
            turned = np.roll(trimesh.transformations.quaternion_from_matrix(inverse), -1)
            there = None if one is None else one.superquadric.transformed(turned, inverse[:3, 3])
            iou = 0.0 if there is None else Columns.of(hull).iou(there)
            if label in hulls:
                far = far_side(hulls[label], hull @ pose[:3, :3].T + pose[:3, 3])
        status = "FAILED" if one is None else one.status.name
        overlap = _overlap(own, frame, label)
        truth = stem, entry["sensor"], thing["name"], thing["kind"]
        found.append(Answer(*truth, status, error, deviations.tolist(), iou, far, overlap))
    return found, len(own.bodies)


def _overlap(own: FrameRecovery, frame: RecordedFrame, label: int) -> float:
    """The largest IoU of an own mask with a true one, over measured pixels."""
    measured = np.isfinite(frame.depth)
    true = (frame.labels == label) & measured
    labels = np.unique(own.labels[true])
    masks = [(own.labels == each) & measured for each in labels[labels > 0]]
    return float(max((np.count_nonzero(mask & true) / np.count_nonzero(mask | true) for mask in masks), default=0.0))


def summary(group: list[Answer]) -> dict[str, Any]:
    """The figures of some things; None where nothing is known."""

    def figure(values: list[float], function: Callable[[np.ndarray], Any], factor: float) -> float | None:
        known = np.array(values)[np.isfinite(values)]
        return factor * float(function(known)) if len(known) else None

    errors, far = [one.error for one in group], [one.far for one in group]
    deviations = np.abs([each for one in group for each in one.deviations])
    return {
        "things": len(group),
        "bodies": int(np.isfinite(errors).sum()),
        "edges median": figure(errors, np.median, 1e3),
        "edges mean": figure(errors, np.mean, 1e3),
        "converged": sum(one.status == "CONVERGED" for one in group),
        "within 2": figure(list(deviations < 2), np.mean, 100),
        "beyond 3": figure(list(deviations > 3), np.mean, 100),
        "posed": int(np.isfinite([one.iou for one in group]).sum()),
        "iou": figure([one.iou for one in group], np.mean, 100),
        "far side": figure(far, lambda known: np.abs(known).mean(), 1e3),
        "bias": figure(far, np.mean, 1e3),
        "found": sum(one.overlap >= MATCH for one in group),
    }


def cells(title: str, one: dict[str, Any]) -> dict[str, str]:
    """One row of the table."""

    def cell(name: str, form: str) -> str:
        return "-" if one[name] is None else format(one[name], form)

    return {
        "things": title,
        "number": cell("things", "d"),
        "edges mm, median / mean": f"{cell('edges median', '.1f')} / {cell('edges mean', '.1f')}",
        "CONVERGED": cell("converged", "d"),
        "half sizes within 2 / beyond 3 deviations %": f"{cell('within 2', '.0f')} / {cell('beyond 3', '.0f')}",
        "IoU % (posed)": f"{cell('iou', '.1f')} ({one['posed']})",
        "far side of the hull mm: error; bias": f"{cell('far side', '.1f')}; {cell('bias', '+.1f')}",
        "found with own masks": cell("found", "d"),
    }


def main() -> None:
    parser = report.parser(__doc__, "public_frames")
    parser.add_argument("frames", type=Path, help="folder of NPZ files")
    parser.add_argument("sheet", type=Path, help="JSON of what they show")
    options = parser.parse_args()
    sheet = json.loads(options.sheet.read_text(encoding="utf-8"))
    recoverer = Recoverer(threads=1)
    everything: list[Answer] = []
    bodies = 0
    for stem, entry in sheet.items():
        found, count = answers(stem, entry, read_frame(options.frames / f"{stem}.npz"), recoverer)
        everything += found
        bodies += count
    groups = {"all": everything}
    for attribute in ("sensor", "kind"):
        for value in sorted({getattr(one, attribute) for one in everything}):
            groups[f"{attribute}: {value}"] = [one for one in everything if getattr(one, attribute) == value]
    figures = {title: summary(group) for title, group in groups.items()}
    repositories = sorted({entry["repository"] for entry in sheet.values()})
    head = f"{len(sheet)} frames of {', '.join(repositories)}; {bodies / len(sheet):.1f} bodies a frame with own masks"
    text = f"{head}\n\n{report.table_of([cells(title, one) for title, one in figures.items()])}"
    each = [{name: None if value != value else value for name, value in asdict(one).items()} for one in everything]
    result = {"repositories": repositories, "frames": len(sheet), "bodies": bodies, "groups": figures, "things": each}
    report.write(options.name, result, text)


if __name__ == "__main__":
    main()
