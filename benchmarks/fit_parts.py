"""What each part of the surface fit is worth: the fit without it, on the same images.

    python benchmarks/fit_parts.py [--sets "household; noise 8"] [--parts "other valleys"] [--scenes 300]
                                   [--first 52000] [--bodies 200] [--update] [--name fit_parts]

| set | what |
| --- | --- |
| household | things of :mod:`household_things` from seed ``first`` on, at least half visible: true masks, plane, hull |
| household, no hull | each third of them by `fit` alone, with their plane |
| tabletop | superquadrics on a table (:mod:`frame_time`, five a scene, from number ``first`` on, D435), as household |
| lying cans | sharp cans on a table, 3 to 4 cm thick and 8 to 14 cm long, noise of 1.5 mm z^2, on the plane |
| all others | rows of :mod:`single_body`, other bodies than there; `edge lost`: eroded masks, no readings beside them |

Each image is fitted as shipped and without each part, one after the other.  IoU is with the true body, or the convex
hull of the thing; 0 where the fit failed.  ``beyond 3`` counts half sizes of converged bodies that err by more than
three reported deviations.  Differences have their standard errors, time is a ratio of processor times.  Parts that
change no body of a set are left out of its table.  Rows of parts that the fit no longer has keep the commit at which
they were measured (``--update``).
"""

from __future__ import annotations

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Literal
from unittest.mock import patch

import ablation
import frame_time
import numpy as np
import single_body
from common import report
from common.hull_columns import Columns

from sq_perception.fitting import multistart, starts, surface_fit, valleys
from sq_perception.fitting.fit import Fit, Status
from sq_perception.fitting.observation import BAND_PIXELS
from sq_perception.fitting.options import FitOptions
from sq_perception.geometry import Superquadric, metrics
from sq_perception.geometry import rotation as quaternions
from sq_perception.imaging import raycast, regions
from sq_perception.imaging.camera import Camera
from sq_perception.recovery.recoverer import Recoverer
from sq_perception.recovery.seen_object import SeenObject
from sq_perception.simulation.scenes import plane_depth

SEED = 9100
CAN_CAMERA = Camera(640, 480, 600.0, 600.0, 319.5, 239.5)


@dataclass(frozen=True, eq=False)
class Item:
    """An object to fit, and what is true of it: a body, or the corners (n, 3) of its hull."""

    kind: str
    depth: np.ndarray
    mask: np.ndarray
    camera: Camera
    options: FitOptions
    truth: Superquadric | np.ndarray
    start: Superquadric | Literal["auto"] = "auto"

    def fit(self) -> Fit:
        return surface_fit.fit(self.depth, self.mask, self.camera, start=self.start, options=self.options)

    def iou(self, body: Superquadric) -> float:
        if isinstance(self.truth, Superquadric):
            return float(np.squeeze(metrics.volume_iou(body, self.truth)))
        return self._columns.iou(body)

    @cached_property
    def _columns(self) -> Columns:
        assert isinstance(self.truth, np.ndarray)
        return Columns.of(self.truth)

    def size_errors(self, body: Superquadric) -> np.ndarray:
        """Of the body's half extents along its axes (3,), metres."""
        axes = body.rotation_matrix.T
        if isinstance(self.truth, Superquadric):
            return np.asarray(body.support(axes) + body.support(-axes) - 2 * self.truth.support(axes)) / 2
        return np.asarray(body.support(axes) + body.support(-axes) - np.ptp(self.truth @ axes.T, axis=0)) / 2


Part = Callable[[], AbstractContextManager[Any]]


def _same(solution: multistart.Solution) -> multistart.Solution:
    return solution


def _without(owner: Any, **changed: Any) -> Part:
    return partial(patch.multiple, owner, **changed)


PARTS: dict[str, Part] = {
    "other valleys": _without(valleys, explore=_same),
    "all depths of a face": _without(valleys, weigh_depths=_same),
    "open ends": _without(valleys, lengthen_open_ends=_same),
    "open sizes": _without(valleys, weigh_open_sizes=_same),
    "oval": _without(valleys, add_oval=_same),
    "straight where a taper tells little": _without(surface_fit, _straighten=_same),
    "sharper outline": _without(surface_fit, sharpen_outline=lambda problem, state, *_: (problem, state)),
    "lost edge": _without(surface_fit, drop_lost_edge=lambda problem, state: (problem, state)),
    "more rays under noise": _without(surface_fit, _MOST_FINAL_RAYS=surface_fit._FINAL_RAYS),
    "starts turned by 45 degrees": _without(starts, eighth_turns=lambda _: np.empty((0, 3, 3))),
    "a superquadric of a thing": _without(surface_fit, _is_explained=lambda *_: False, _FINE_NOISE=0.0),
    "the thing as an alternative": _without(surface_fit, _AS_A_THING=0.0),
}


# Sets


def _item(kind: str, one: SeenObject, depth: np.ndarray, camera: Camera, known: FitOptions, truth: Any) -> Item:
    """What the recovery asks the fit for, near the object alone."""
    assert one.prediction is not None
    body, (x, y, width, height) = one.prediction.body(), regions.box(one.mask)
    reach = max(width, height) + BAND_PIXELS
    top, left = max(y - reach, 0), max(x - reach, 0)
    near = slice(top, y + height + reach), slice(left, x + width + reach)
    crop = np.ascontiguousarray(depth[near])
    view = camera.cropped(left, top, crop.shape[1], crop.shape[0])
    options = replace(known, hull=one.prediction.hull(), expected=body)
    return Item(kind, crop, np.ascontiguousarray(one.mask[near]), view, options, truth, body)


def household(first: int, scenes: int) -> Iterator[Item]:
    for seen in ablation.simulated(range(first, first + scenes), Recoverer()):
        yield _item(seen.kind, seen.one, seen.depth, seen.camera, seen.known, seen.hull)


def without_hull(first: int, scenes: int) -> Iterator[Item]:
    for item in list(household(first, scenes))[::3]:
        yield replace(item, start="auto", options=replace(item.options, hull=None, expected=None))


def tabletop(first: int, scenes: int) -> Iterator[Item]:
    recoverer, camera = Recoverer(), frame_time.camera(*frame_time.IMAGES[0])
    for number in range(first, first + scenes):
        seen = frame_time.frame(5, number, camera, frame_time.SENSORS[0])
        for label, (one, known) in ablation.shown(seen.depth, camera, seen.labels, recoverer).items():
            if seen.visible[label - 1] >= 0.5:
                yield _item("superquadric", one, seen.depth, camera, known, seen.scene.bodies[label - 1])


def lying_cans(count: int) -> Iterator[Item]:
    rng = np.random.default_rng(SEED)
    for _ in range(count):
        tilt, angle = rng.uniform(0.5, 1.2), rng.uniform(0, np.pi)
        radius, length = rng.uniform(0.03, 0.04), rng.uniform(0.04, 0.07)
        up, level = -np.array([0.0, np.sin(tilt), np.cos(tilt)]), np.array([1.0, 0.0, 0.0])
        axis = np.cos(angle) * level + np.sin(angle) * np.cross(up, level)
        turn = quaternions.from_matrix(np.stack([up, np.cross(axis, up), axis], axis=1))
        can = Superquadric([radius, radius, length], [0.02, 1.0], [0.0, 0.0, rng.uniform(0.5, 0.9)], turn)
        plane = np.append(up, radius - up @ can.translation)
        rendered, _ = raycast.render(can, CAN_CAMERA)
        depth = np.minimum(rendered, plane_depth(plane, CAN_CAMERA))
        depth = depth + rng.normal(0, 0.0015, depth.shape) * np.where(np.isfinite(depth), depth, 0.0) ** 2
        yield Item("can", depth, np.isfinite(rendered), CAN_CAMERA, FitOptions(plane=plane), can)


def _edge_lost(image: single_body.Image, rng: np.random.Generator) -> single_body.Image:
    mask = single_body.eroded(image, rng).mask
    return single_body.Image(np.where(mask, image.depth, np.nan), mask, image.camera)


ROWS = {**single_body.ROWS, "edge lost 2 px": single_body.Row(single_body.cube_bodies, damage=_edge_lost)}


def single_bodies(name: str, count: int) -> Iterator[Item]:
    row = ROWS[name]
    rng = np.random.default_rng([SEED, list(ROWS).index(name)])
    for body in row.bodies(count, rng):
        image = row.image(body) if row.image else single_body.sensor(body, rng)
        image = row.damage(image, rng) if row.damage else image
        yield Item("superquadric", image.depth, image.mask, image.camera, FitOptions(pixels=row.pixels), body)


def items(name: str, first: int, scenes: int, bodies: int) -> Iterator[Item]:
    """The objects of a set."""
    of_scenes = {"household": household, "household, no hull": without_hull, "tabletop": tabletop}
    if name in of_scenes:
        return of_scenes[name](first, scenes // 5 if name == "tabletop" else scenes)
    return lying_cans(bodies // 2) if name == "lying cans" else single_bodies(name, bodies)


SETS = ("household", "household, no hull", "tabletop", "lying cans", *ROWS)


# Figures


def measured(objects: Iterator[Item], parts: dict[str, Part]) -> dict[str, Any]:
    """Figures (n, 7) of each object by part: IoU, errors over deviations, converged, time, error of length along z."""
    figures: dict[str, list[list[float]]] = {"whole": [], **{name: [] for name in parts}}
    kinds = []
    for item in objects:
        kinds.append(item.kind)
        known: dict[bytes, float] = {}  # IoU of bodies seen before: most parts change few
        for name in figures:
            with parts.get(name, nullcontext)():
                began = time.process_time()
                fit = item.fit()
                spent = time.process_time() - began
            body, errors = fit.superquadric, item.size_errors(fit.superquadric)
            number = np.array(body.to_numbers()).tobytes()
            known[number] = known[number] if number in known else item.iou(body)
            over = np.abs(errors) / fit.sigma_size
            row = [known[number] * (fit.status != Status.FAILED), *over, fit.status == Status.CONVERGED, spent]
            figures[name].append([float(number) for number in (*row, 2 * errors[2])])
    return {"kinds": kinds, **figures}


def summary(name: str, figures: dict[str, Any]) -> dict[str, Any]:
    """A part's line of a set."""
    whole, part = (np.array(figures[each]) for each in ("whole", name))
    difference, kinds = 100 * (part[:, 0] - whole[:, 0]), np.array(figures["kinds"])

    def gained(chosen: np.ndarray) -> list[float]:
        return [float(chosen.mean()), float(chosen.std() / np.sqrt(len(chosen)))]

    beyond, before = ((each[:, 1:4] > 3).mean(axis=1) * each[:, 4] for each in (part, whole))
    return {
        "count": len(part),
        "changed": float((part[:, :5] != whole[:, :5]).any(axis=1).mean()),
        "iou": 100 * float(part[:, 0].mean()),
        "iou_difference": gained(difference),
        "worst": 100 * float(part[:, 0].min()),
        "beyond_3": 100 * float(beyond.sum() / max(part[:, 4].sum(), 1)),
        "beyond_3_difference": gained(100 * (beyond - before)),
        "converged": 100 * float(part[:, 4].mean()),
        "time": float(part[:, 5].sum() / whole[:, 5].sum()),
        "along_z_mm": gained(1e3 * part[:, 6]),
        "by_kind": {str(kind): gained(difference[kinds == kind]) for kind in np.unique(kinds)},
    }


def line(name: str, row: dict[str, Any]) -> dict[str, str]:
    """A row of the table."""
    (gain, error), (wider, spread) = row["iou_difference"], row["beyond_3_difference"]
    return {
        "without": name,
        "changed %": f"{100 * row['changed']:.0f}",
        "IoU %": f"{row['iou']:.2f}",
        "difference": f"{gain:+.2f} +- {error:.2f}",
        "worst": f"{row['worst']:.0f}",
        "beyond 3 %": f"{row['beyond_3']:.1f}",
        "difference of these": f"{wider:+.2f} +- {spread:.2f}",
        "converged %": f"{row['converged']:.0f}",
        "time": f"{row['time']:.2f}",
        "commit": row["commit"],
    }


def text(result: dict[str, Any]) -> str:
    tables = []
    for name, rows in result.items():
        lines = [line(part, row) for part, row in rows.items() if part == "whole" or row["changed"] > 0]
        tables.append(f"{name}, {rows['whole']['count']} objects\n\n{report.table_of(lines)}")
    return "\n\n".join(tables)


def main() -> None:
    parser = report.parser(__doc__, "fit_parts")
    parser.add_argument("--sets", default="; ".join(SETS), help="separated by semicolons; all by default")
    parser.add_argument("--parts", default="; ".join(PARTS), help="likewise")
    parser.add_argument("--scenes", type=int, default=300)
    parser.add_argument("--first", type=int, default=52000, help="seed of the first household scene")
    parser.add_argument("--bodies", type=int, default=200, help="single bodies of a row; half as many cans")
    parser.add_argument("--update", action="store_true", help="keep what else the files have, with its commits")
    options = parser.parse_args()
    surface_fit.warm_up()
    parts = {name.strip(): PARTS[name.strip()] for name in options.parts.split(";") if name.strip()}
    result: dict[str, Any] = report.previous(options.name, "sets") if options.update else {}
    for name in (each.strip() for each in options.sets.split(";")):
        figures = measured(items(name, options.first, options.scenes, options.bodies), parts)
        rows = result.setdefault(name, {})
        for part in ("whole", *parts):
            rows[part] = {**summary(part, figures), "commit": report.commit()}
            print(name, "|", " | ".join(line(part, rows[part]).values()), flush=True)
        result = {each: result[each] for each in SETS if each in result}
        report.write(options.name, {"options": vars(options), "sets": result}, text(result), shown=False)


if __name__ == "__main__":
    main()
