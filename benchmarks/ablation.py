"""What each source of knowledge about the unseen side is worth: the fit without it, on the same things and masks.

    python benchmarks/ablation.py [--scenes 60] [--first 5000] [--frames FRAMES --hulls HULLS] [--name ablation]

Things of household scenes (:mod:`household_things`), at least half visible, and of recorded frames where they are named
(:mod:`known_frames`); true masks.  Each is fitted once a row, with the same prediction and the same pixels:

| row | the fit |
| --- | --- |
| whole | as it is shipped |
| no predicted hull | neither the hull nor the predicted body as a start |
| no covariance | errors of neighbouring directions taken for independent |
| twice as vague, as sure | the deviations of the predicted hull times and over 2 |
| every ray counts | as 1000 independent rays instead of 100 |
| as a body | points within count in full, space within the outline's hull must be empty |
| no plane, no free space | without either |
| no plane, exactly | without one, and a superquadric that explains the image to its noise is sought first |
| missing is empty | pixels without a reading belong to no part of the body |
| hull alone | hardly any ray counts: what the network knows |
| half the error | the mean of the predicted and the true support function, with half the deviations |
| true behind | the true one in directions that point away from the camera, with a tenth of the deviations |
| true hull | the true support function in place of the predicted one, 1 % of the view exact |

IoU is with the true convex hull, 0 where no body was found.  The difference to the first row has its standard error.
"""

from __future__ import annotations

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import household_things
import numpy as np
import trimesh
from common import report
from common.hull_columns import Columns
from common.scene_verdict import FEWEST_PIXELS, HALF
from known_frames import camera_of

from sq_perception.fitting import multistart, surface_fit
from sq_perception.fitting.fit import Status
from sq_perception.fitting.observation import Observation
from sq_perception.fitting.options import FitOptions
from sq_perception.fitting.priors import HullPrior
from sq_perception.imaging.camera import Camera
from sq_perception.recovery import methods
from sq_perception.recovery.recoverer import Recoverer
from sq_perception.recovery.seen_object import SeenObject

EXACT = 0.01
"""Of a view's side: how well the true hull is taken to be known."""
BEHIND = 0.1
"""Least cosine between the line of sight and a direction that points away from the camera."""


@dataclass(frozen=True, eq=False)
class Seen:
    """One thing of one image, what the recovery knows of it before its fit, and the corners (n, 3) of its hull."""

    kind: str
    one: SeenObject
    depth: np.ndarray
    camera: Camera
    known: FitOptions
    hull: np.ndarray


def _same(hull: HullPrior, _: Seen) -> HullPrior:
    return hull


def _true(hull: HullPrior, seen: Seen) -> HullPrior:
    exact = (EXACT * hull.extent) ** 2 * np.eye(len(hull.support))
    return replace(hull, support=_support(hull, seen), covariance=exact)


def _half_true(hull: HullPrior, seen: Seen) -> HullPrior:
    return replace(hull, support=0.5 * (hull.support + _support(hull, seen)), covariance=0.25 * hull.covariance)


def _true_behind(hull: HullPrior, seen: Seen) -> HullPrior:
    middle = seen.hull.mean(axis=0)
    behind = hull.directions @ middle > BEHIND * np.linalg.norm(middle)
    surer = np.where(behind, 0.1, 1.0)
    support = np.where(behind, _support(hull, seen), hull.support)
    return replace(hull, support=support, covariance=hull.covariance * np.outer(surer, surer))


def _support(hull: HullPrior, seen: Seen) -> np.ndarray:
    return np.asarray((seen.hull @ hull.directions.T).max(axis=0))


def _rays(count: float) -> AbstractContextManager[Any]:
    return patch.object(multistart, "INDEPENDENT", count)


@dataclass(frozen=True)
class Row:
    """One way to fit: what is changed in the predicted hull, in the program, and in the options."""

    name: str
    hull: Callable[[HullPrior, Seen], HullPrior | None] = _same
    program: Callable[[], AbstractContextManager[Any]] = nullcontext
    options: dict[str, Any] = field(default_factory=dict)


ROWS = (
    Row("whole"),
    Row("no predicted hull", hull=lambda *_: None),
    Row("no covariance", hull=lambda h, _: replace(h, covariance=np.diag(np.diag(h.covariance)))),
    Row("twice as vague", hull=lambda h, _: replace(h, covariance=4 * h.covariance)),
    Row("twice as sure", hull=lambda h, _: replace(h, covariance=h.covariance / 4)),
    Row("every ray counts", program=partial(_rays, 1000.0)),
    Row("as a body", program=lambda: patch.multiple(Observation, of_hull=lambda self: self)),
    Row("no plane", options={"plane": None}),
    Row("no plane, exactly", program=lambda: patch.object(surface_fit, "fills", lambda *_: True),
        options={"plane": None}),
    Row("no free space", options={"nan_is_empty": False}),
    Row("missing is empty", options={"nan_is_empty": True}),
    Row("hull alone", program=partial(_rays, 3.0)),
    Row("half the error", hull=_half_true),
    Row("true behind", hull=_true_behind),
    Row("true hull", hull=_true),
)  # fmt: skip


def iou(seen: Seen, columns: Columns, row: Row) -> float:
    """Of one thing fitted one way."""
    assert seen.one.prediction is not None
    hull = seen.one.prediction.hull()
    assert hull is not None
    changed = row.hull(hull, seen)
    body = None if changed is None else seen.one.prediction.body
    options = replace(seen.known, **row.options, hull=changed, expected=body)
    depth = seen.depth if row.name != "no free space" else np.where(seen.one.mask, seen.depth, np.float32(np.nan))
    with row.program():
        fit = surface_fit.fit(
            depth, seen.one.mask, seen.camera, start="auto" if body is None else body, options=options
        )
    return 0.0 if fit.status == Status.FAILED else columns.iou(fit.superquadric)


def shown(
    depth: np.ndarray, camera: Camera, labels: np.ndarray, recoverer: Recoverer
) -> dict[int, tuple[SeenObject, FitOptions]]:
    """What the recovery knows of each labelled thing when it begins to fit."""
    found = {}
    fitted = methods._surface_fit

    def kept(one: SeenObject, depth: np.ndarray, camera: Camera, known: FitOptions) -> Any:
        found[one.label] = one, known
        return fitted(one, depth, camera, known)

    with patch.object(methods, "_surface_fit", kept):
        recoverer.recover(depth, camera, labels)
    return found


def simulated(seeds: range, recoverer: Recoverer) -> Iterator[Seen]:
    for seed in seeds:
        scene = household_things.scene(seed, None)
        found = shown(scene.depth, scene.camera, scene.labels, recoverer)
        for placed in scene.placed:
            if placed.pixels >= FEWEST_PIXELS and placed.visible_share >= HALF and placed.label in found:
                yield Seen(
                    placed.thing.kind,
                    found[placed.label][0],
                    scene.depth,
                    scene.camera,
                    found[placed.label][1],
                    placed.hull,
                )


def recorded(frames: Path, hulls: Path, recoverer: Recoverer) -> Iterator[Seen]:
    for path in sorted(frames.glob("*.npz")):
        frame = np.load(path)
        depth, camera = frame["depth"], camera_of(frame)
        found = shown(depth, camera, frame["labels"].astype(np.int32), recoverer)
        for number, label in enumerate(frame["ids"]):
            pose, name = frame["T_cam_mesh"][number], str(frame["mesh"][number])
            if not name or not np.isfinite(pose).all() or int(label) not in found:
                continue
            corners = np.asarray(trimesh.load_mesh(hulls / f"{name}.hull.ply", process=False).vertices)
            hull = corners @ pose[:3, :3].T + pose[:3, 3]
            yield Seen(str(frame["kind"][number]), found[int(label)][0], depth, camera, found[int(label)][1], hull)


def compared(things: list[Seen]) -> dict[str, Any]:
    """IoU of every row, by kind, and its difference to the first row, percent."""
    columns = [Columns.of(seen.hull) for seen in things]
    kinds = np.array([seen.kind for seen in things])
    result: dict[str, Any] = {}
    first = None
    for row in ROWS:
        ious = 100 * np.array([iou(seen, each, row) for seen, each in zip(things, columns, strict=True)])
        first = ious if first is None else first
        difference = ious - first
        result[row.name] = {
            "iou": float(ious.mean()),
            "difference": float(difference.mean()),
            "error": float(difference.std() / np.sqrt(len(ious))),
            "count": len(ious),
            **{str(kind): float(ious[kinds == kind].mean()) for kind in np.unique(kinds)},
        }
        print(row.name, f"{ious.mean():.1f}", flush=True)
    return result


def table(result: dict[str, Any]) -> str:
    kinds = [name for name in result["whole"] if name not in ("iou", "difference", "error", "count")]
    lines = [
        [
            name,
            f"{one['iou']:.1f}",
            f"{one['difference']:+.1f} +- {one['error']:.1f}",
            *(f"{one[k]:.1f}" for k in kinds),
        ]
        for name, one in result.items()
    ]
    return report.table(["fit", "IoU %", "difference", *kinds], lines)


def main() -> None:
    parser = report.parser(__doc__, "ablation")
    parser.add_argument("--scenes", type=int, default=60, help="number of household scenes")
    parser.add_argument("--first", type=int, default=5000, help="seed of the first one")
    parser.add_argument("--frames", type=Path, help="recorded frames, as of known_frames")
    parser.add_argument("--hulls", type=Path, help="their true hulls")
    options = parser.parse_args()
    recoverer = Recoverer()
    sets = {"household": list(simulated(range(options.first, options.first + options.scenes), recoverer))}
    if options.frames is not None and options.hulls is not None:
        sets["recorded"] = list(recorded(options.frames, options.hulls, recoverer))
    result = {name: compared(things) for name, things in sets.items()}
    text = "\n\n".join(f"{name}, {one['whole']['count']} things\n\n{table(one)}" for name, one in result.items())
    report.write(options.name, {"scenes": options.scenes, "first": options.first, **result}, text)


if __name__ == "__main__":
    main()
