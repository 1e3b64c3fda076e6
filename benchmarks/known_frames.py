"""Recorded frames of things whose true size, and pose where there is one, are known.

    python benchmarks/known_frames.py FRAMES HULLS [--bodies METHOD=FILE ...] [--name known_frames]

FRAMES holds NPZ files with ``depth``, ``K``, ``labels`` and, for each of ``ids``: ``kind``, ``dims`` (full edges,
metres, NaN unknown), ``mesh`` (name, or empty) and ``T_cam_mesh`` (4 x 4, NaN unknown); HULLS holds <mesh>.hull.ply.
None of it belongs to the repository.

| method | masks | what |
| --- | --- | --- |
| auto, given | true | `Recoverer().recover(depth, camera, labels)` |
| network, given | true | the prediction of the weights `robust`, not refined |
| auto, own | its own | the body whose mask has the largest IoU with the true one, if that is at least 0.25 |
| classic | true | Solina and Bajcsy's fit to the points |
| smallest box | true | the smallest box around the measured points |
| METHOD | true | bodies of another program, if its file has one for the frame and label |

IoU is with the convex hull of the mesh in its pose, 0 for a thing without a body; errors are those of the sorted full
edges, their mean over the three; ``2 sigma`` the share of half sizes within two reported deviations.  ``fair`` are
boxes, cans and bottles, which superquadrics can be like.  Times are of single threads.  Millimetres, milliseconds.

The FILE of another METHOD is a JSON list of objects with ``frame`` (the NPZ's stem), ``label``, ``size``, ``shape``,
``translation``, ``rotation`` (x y z w) and ``milliseconds``; what it lacks was missed.
"""

from __future__ import annotations

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from common import report
from common.hull_columns import Columns
from common.scene_verdict import smallest_box

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.camera import Camera
from sq_perception.recovery.recoverer import FrameRecovery, Recoverer, Recovery, RecoveryOptions

FAIR = ("box", "rounded_box", "cylinder", "bottle")
MATCH = 0.25
METHODS = ("auto, given", "network, given", "auto, own", "classic", "smallest box")

Others = dict[str, dict[tuple[str, int], dict[str, Any]]]
"""Bodies of other programs, by method, by frame and label."""


@dataclass(frozen=True)
class Answer:
    """What one method made of one thing; NaN where the truth, or the method's word, is missing."""

    kind: str
    method: str
    iou: float
    error: float
    covered: float
    milliseconds: float


def camera_of(frame: Any) -> Camera:
    """The pinhole camera of a frame."""
    (height, width), k = frame["depth"].shape, frame["K"]
    return Camera(width, height, k[0, 0], k[1, 1], k[0, 2], k[1, 2])


@cache
def columns(path: Path) -> Columns:
    return Columns.of(np.asarray(trimesh.load_mesh(path, process=False).vertices))


def answer(
    frame: Any, number: int, hulls: Path, method: str, body: Superquadric | None, sigma: np.ndarray, ms: float
) -> Answer:
    """One body beside the truth; ``sigma`` (3,) of its half sizes, metres."""
    dims, mesh, pose = np.sort(frame["dims"][number]), str(frame["mesh"][number]), frame["T_cam_mesh"][number]
    iou = error = covered = np.nan
    if mesh and np.isfinite(pose).all():
        iou = 0.0
        if body is not None:
            inverse = np.linalg.inv(pose)
            turned = trimesh.transformations.quaternion_from_matrix(inverse)
            there = body.transformed(np.roll(turned, -1), inverse[:3, 3])
            iou = columns(hulls / f"{mesh}.hull.ply").iou(there)
    if body is not None and np.isfinite(dims).all():
        order = np.argsort(body.size)
        error = float(np.abs(2 * body.size[order] - dims).mean())
        if np.isfinite(sigma).all():
            covered = float((np.abs(body.size[order] - dims / 2) < 2 * sigma[order]).mean())
    return Answer(str(frame["kind"][number]), method, iou, error, covered, ms)


def answers(name: str, frame: Any, hulls: Path, recoverer: Recoverer, others: Others) -> list[Answer]:
    """Every method on every labelled thing of one frame."""
    depth, camera = frame["depth"], camera_of(frame)
    labels = frame["labels"].astype(np.int32)
    unknown = np.full(3, np.nan)
    found: list[Answer] = []
    for title in METHODS[:4]:
        method, _, masks = title.partition(", ")
        given = None if masks == "own" else labels
        result = recoverer.recover(depth, camera, given, RecoveryOptions(method=method))  # type: ignore[arg-type]
        share = result.milliseconds["total"] / max(len(result.bodies), 1)
        for number, label in enumerate(frame["ids"]):
            if given is None:
                one = _agreeing(result, labels == label)
            else:
                one = next((each for each in result.recovered if each.label == label), None)
            body, sigma = (None, unknown) if one is None else (one.superquadric, one.sigma_size)
            found.append(answer(frame, number, hulls, title, body, sigma, share))
    for number, label in enumerate(frame["ids"]):
        points = camera.points(depth)[(labels == label) & (depth > 0) & np.isfinite(depth)]
        found.append(answer(frame, number, hulls, METHODS[4], smallest_box(points), unknown, np.nan))
        for title, bodies in others.items():
            row = bodies.get((name, int(label)))
            body, milliseconds = (None, np.nan) if row is None else (_body(row), row["milliseconds"])
            found.append(answer(frame, number, hulls, title, body, unknown, milliseconds))
    return found


def _agreeing(result: FrameRecovery, true: np.ndarray) -> Recovery | None:
    """The body whose own mask has the largest IoU with a true one, if that is large enough."""
    best, overlap = None, MATCH
    for one in result.recovered:
        mine = result.labels == one.label
        iou = np.count_nonzero(mine & true) / max(np.count_nonzero(mine | true), 1)
        if iou >= overlap:
            best, overlap = one, iou
    return best


def _body(given: dict[str, Any]) -> Superquadric:
    return Superquadric(*(np.array(given[name]) for name in ("size", "shape", "translation", "rotation")))


def _bodies_of(argument: str) -> tuple[str, dict[tuple[str, int], dict[str, Any]]]:
    """METHOD=FILE, read."""
    method, _, path = argument.partition("=")
    rows = json.loads(Path(path).read_text(encoding="utf-8"))
    return method, {(row["frame"], int(row["label"])): row for row in rows}


def summary(group: list[Answer]) -> dict[str, Any]:
    """Means and medians; None where nothing is known."""

    def figure(values: list[float], function: Any) -> float | None:
        known = np.array(values)[np.isfinite(values)]
        return float(function(known)) if len(known) else None

    return {
        "things": len(group),
        "iou": figure([one.iou for one in group], np.mean),
        "error_median": figure([one.error for one in group], np.median),
        "error_mean": figure([one.error for one in group], np.mean),
        "two_sigma": figure([one.covered for one in group], np.mean),
        "milliseconds": figure([one.milliseconds for one in group], np.median),
    }


def main() -> None:
    parser = report.parser(__doc__, "known_frames")
    parser.add_argument("frames", type=Path, help="folder of NPZ files")
    parser.add_argument("hulls", type=Path, help="folder of <mesh>.hull.ply")
    parser.add_argument("--bodies", type=_bodies_of, action="append", default=[], help="METHOD=FILE of another program")
    options = parser.parse_args()
    paths = sorted(options.frames.glob("*.npz"))
    if not paths:
        parser.error(f"{options.frames}: no NPZ files")
    recoverer, others = Recoverer(threads=1), dict(options.bodies)
    everything: list[Answer] = []
    for path in paths:
        with np.load(path) as file:
            frame = {name: file[name] for name in file.files}
        everything += answers(path.stem, frame, options.hulls, recoverer, others)
    kinds = sorted({one.kind for one in everything})
    groups = {"fair": FAIR, **{kind: (kind,) for kind in kinds}}
    result: dict[str, Any] = {}
    rows = []
    for title, members in groups.items():
        for method in (*METHODS, *others):
            one = result.setdefault(title, {})[method] = summary(
                [a for a in everything if a.method == method and a.kind in members]
            )
            rows.append([title, method, str(one["things"]), *_cells(one)])
    header = ["things", "method", "number", "IoU %", "edge error mm, median / mean", "2 sigma %", "ms a body"]
    report.write(options.name, {"frames": len(paths), "groups": result}, report.table(header, rows))


def _cells(one: dict[str, Any]) -> list[str]:
    def cell(value: float | None, factor: float, digits: int) -> str:
        return "-" if value is None else f"{factor * value:.{digits}f}"

    return [
        cell(one["iou"], 100, 1),
        f"{cell(one['error_median'], 1e3, 1)} / {cell(one['error_mean'], 1e3, 1)}",
        cell(one["two_sigma"], 100, 0),
        cell(one["milliseconds"], 1, 0),
    ]


if __name__ == "__main__":
    main()
