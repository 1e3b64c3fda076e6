"""What each numeric constant of fitting, segmentation and tracking decides: varied by 30 % to either side, by itself.

    python benchmarks/constants.py [--only fitting.starts tracking ...] [--kernels] [--name constants]

Constants are the numbers that modules of these rooms name in capitals, and the defaults of their options.  Every one is
multiplied by 0.7 and by 1.3 (whole numbers change at least by one, of numbers just below 1 what is missing to 1), and
its room's fixed set is done again:

    fitting       16 single bodies of the thesis (clean, noise 2, outliers, 30 % hidden; masks given), and 3 tables of
                  household things through a simulated sensor, masks given
    segmentation  the same tables, own masks; and the segments of 24 frames, before a network looks at them: household
                  things on tables, and in and on furniture
    tracking      20 recovered frames of a camera about a table, shown three times, 5.5 and 28 s apart; one body is
                  pushed, one slides, one is missed and one has no covariance; only tracking is done again

Printed are, for each of both sides, how many results are other ones to the bit, and the difference of the mean IoU
with the truth, per cent (of masks for segments; tracking: of the mean error of the half sizes).  What changes nothing
is used by no image of so small a set, or by none at all.

A constant that compiled code reads is frozen in it.  With ``--kernels`` everything that reads it is compiled again, in
this process alone; without it these are passed over, as are names that are no quantities (columns, enumerations), and
numbers that are read when a module is loaded.  Results are written as they come; a run that was stopped goes on.
"""

from __future__ import annotations

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

import importlib
import pkgutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import furniture
import household_things
import numpy as np
import segmentation
import single_body
import tracking
from common import report, scene_verdict
from common.package_constants import Constant, constants, forget, frozen_in, reason_to_pass, varied
from common.tabletop import Tabletop

import sq_perception
from sq_perception.fitting import surface_fit
from sq_perception.fitting.fit import Status
from sq_perception.geometry import Superquadric, metrics
from sq_perception.segmentation import segments
from sq_perception.tracking.session import TrackingSession

FACTORS = (0.7, 1.3)
SCENES = (2, 5, 7)
"""Seeds: few things each, both sensors."""
DAMAGES = (None, single_body.noise(2), single_body.outliers, single_body.occluded)
BODIES = 4
SEGMENTED = 12
"""Frames of tables, and as many of furniture."""
FRAMES = 20
PASSES = (0.0, 5.5, 28.0)
"""Seconds between the end of a pass over the frames and the next one."""
PUSHED = np.array([0.04, 0.0, 0.0])
SLIDING = np.array([0.0, 0.0, 0.4])
"""Metres a second."""


class Measured(NamedTuple):
    """The results of a fixed set: numbers that are compared to the bit, and one for how good they are."""

    results: list[bytes]
    quality: float


# Fixed sets


@cache
def tables() -> tuple[Tabletop, ...]:
    return tuple(household_things.scene(seed, None) for seed in SCENES)


@cache
def single_images() -> list[tuple[Superquadric, single_body.Image]]:
    made = []
    for k, damage in enumerate(DAMAGES):
        rng = np.random.default_rng([41, k])
        for body in single_body.cube_bodies(BODIES, rng):
            image = single_body.orthographic(body)
            made.append((body, damage(image, rng) if damage else image))
    return made


def of_tables(own: bool) -> Measured:
    """Every thing of the tables; one that is missed or failed has an IoU of 0."""
    results, ious = [], []
    for scene in tables():
        frame = scene_verdict.recoverer().recover(scene.depth, scene.camera, None if own else scene.labels)
        matches = scene_verdict.matches(frame.labels, scene.labels, scene.depth) if own else {}
        for placed in scene.placed:
            label = matches.get(placed.label, 0) if own else placed.label
            answer = scene_verdict.of_frame(frame, label, placed, scene)
            ious.append(answer.iou)
            results.append(answer.body.tobytes() + answer.status.encode() + answer.message.encode())
        if own:
            results.append(frame.labels.tobytes())
    return Measured(results, 100 * float(np.mean(ious)))


@cache
def segmented_frames() -> list[Tabletop]:
    kinds = furniture.KINDS
    in_furniture = [furniture.scene(kinds[k % len(kinds)], k) for k in range(SEGMENTED)]
    return [household_things.scene(seed, None) for seed in range(SEGMENTED)] + in_furniture


def of_segments() -> Measured:
    """Every thing of some frames: the IoU of its readings with those of its segment."""
    results, ious = [], []
    for scene in segmented_frames():
        found = segments.segment(scene.depth, scene.camera).labels
        ious += segmentation.score(np.where(np.isfinite(scene.depth), scene.labels, 0), found).ious
        results.append(found.tobytes())
    return Measured(results, 100 * float(np.mean(ious)))


def of_single_images() -> Measured:
    fits = [surface_fit.fit(image.depth, image.mask, image.camera) for _, image in single_images()]
    bodies = Superquadric.stack([fit.superquadric for fit in fits])
    iou = metrics.volume_iou(bodies, Superquadric.stack([body for body, _ in single_images()]))
    iou *= np.array([fit.status != Status.FAILED for fit in fits])
    found = [fit.superquadric.to_numbers() for fit in fits]
    results = [
        body.tobytes() + fit.covariance.tobytes() + fit.message.encode() for body, fit in zip(found, fits, strict=True)
    ]
    return Measured(results, 100 * float(iou.mean()))


class Seen(NamedTuple):
    """What a tracker is given."""

    superquadric: Superquadric
    covariance: np.ndarray
    is_predicted: bool
    seen: np.ndarray
    repeats: int = 0


@cache
def tracked_frames() -> list[tuple[tracking.View, list[Seen], list[Superquadric]]]:
    """Frames with their observations and the true body of each."""
    (shown,) = tracking.scenes(1, 1)
    recoverer, made = scene_verdict.recoverer(), []
    for k, view in enumerate(tracking.views(shown, tracking.ROWS["moving"], FRAMES, np.random.default_rng(3))):
        frame = recoverer.recover(view.depth, view.scene.camera, view.labels)
        seen, truths = [], []
        for one in frame.recovered:
            body, truth, covariance = one.superquadric, view.scene.bodies[one.label - 1], one.covariance
            if one.label == 1 and k >= 8:  # pushed
                body, truth = (each.transformed(np.array([0.0, 0, 0, 1]), PUSHED) for each in (body, truth))
            if one.label == 4 and k >= 5:
                by = SLIDING * (min(k, 15) - 5) / tracking.RATE
                body, truth = (each.transformed(np.array([0.0, 0, 0, 1]), by) for each in (body, truth))
            if one.label == 2 and 10 <= k < 17:  # not recovered, and in the last of these frames not there
                continue
            if one.label == 3 and k % 2:
                covariance = np.full_like(covariance, np.nan)
            seen.append(Seen(body, covariance, one.is_predicted, one.seen))
            truths.append(truth)
        depth = np.where((view.labels == 2) & (12 <= k < 17), view.depth + 1.0, view.depth)
        made.append((replace(view, depth=depth), seen, truths))
    return made


def of_tracked_frames() -> Measured:
    """Quality is the mean error of half sizes, per cent."""
    session, results, errors, stamp = TrackingSession(), [], [], 0.0
    for number, gap in enumerate(PASSES):
        stamp += gap
        for view, seen, truths in tracked_frames():
            stamp += 1 / tracking.RATE
            shown = seen[number:]  # in later passes some are missed for good
            followed = session.follow(shown, stamp, view.pose, camera=view.scene.camera, depth=view.depth)
            for one, truth in zip(followed, truths[number:], strict=True):
                numbers = one.superquadric.to_numbers()
                results.append(numbers.tobytes() + one.covariance.tobytes() + str(one.id).encode())
                errors.append(np.abs(tracking.size_errors(one.superquadric, truth)[0]).mean())
            results.append(str(session.hidden).encode())
    return Measured(results, 100 * float(np.mean(errors)))


SETS: dict[str, dict[str, Callable[[], Measured]]] = {
    "fitting": {"single bodies": of_single_images, "things": partial(of_tables, False)},
    "segmentation": {"segments": of_segments, "things": partial(of_tables, True)},
    "tracking": {"tracked": of_tracked_frames},
}


def compared(now: Measured, usual: Measured) -> dict[str, float]:
    """The share of results that are other ones, and how much better they are."""
    same = sum(one == other for one, other in zip(now.results, usual.results, strict=False))
    return {"changed": 1 - same / len(usual.results), "difference": now.quality - usual.quality}


# The run


def row(constant: Constant, usual: dict[str, Measured]) -> dict[str, Any]:
    """What both sides of a constant change, by part of the fixed set."""
    value, frozen = constant.value, frozen_in(constant) if not constant.field else set()
    found: dict[str, Any] = {"value": np.asarray(value).tolist(), "sides": {}}
    for factor in FACTORS:
        other = varied(value, factor)
        forget(frozen)
        constant.set(other)
        try:
            sides = {part: compared(run(), usual[part]) for part, run in SETS[constant.room].items()}
        except Exception as error:  # what a value makes impossible is reported, and the next one's turn comes
            sides = {"error": f"{type(error).__name__}: {error}".splitlines()[0]}
        finally:
            constant.set(value)
        found["sides"][str(factor)] = sides
    forget(frozen)
    return found


def line(key: str, found: dict[str, Any]) -> list[str]:
    """A row of the table."""
    if "passed" in found:
        return [key, found["shown"], found["passed"], ""]
    cells = []
    for sides in found["sides"].values():
        if "error" in sides:
            cells.append(sides["error"])
            continue
        cells.append(
            "; ".join(f"{part}: {100 * one['changed']:.0f} %, {one['difference']:+.2f}" for part, one in sides.items())
        )
    return [key, found["shown"], *cells]


def text(result: dict[str, Any]) -> str:
    """The table, and what changed nothing."""
    header = ["constant", "value", *(f"x {factor}: results changed, quality" for factor in FACTORS)]
    rows = [line(key, found) for key, found in sorted(result.items())]
    idle = [key for key, found in sorted(result.items()) if "sides" in found and _is_idle(found)]
    return report.table(header, rows) + f"\n\nChanged nothing: {', '.join(idle) or 'none'}"


def _is_idle(found: dict[str, Any]) -> bool:
    sides = [one for each in found["sides"].values() for one in each.values()]
    return all(isinstance(one, dict) and one["changed"] == 0 for one in sides)


def main() -> None:
    parser = report.parser(__doc__, "constants")
    parser.add_argument("--only", nargs="+", default=list(SETS), help="rooms, or modules as room.module")
    parser.add_argument("--kernels", action="store_true", help="those too that compiled code has frozen in (hours)")
    options = parser.parse_args()
    scene_verdict.recoverer().warm_up(tables()[0].camera)
    for module in pkgutil.walk_packages(sq_perception.__path__, "sq_perception."):
        if module.name.split(".")[1] in SETS:
            importlib.import_module(module.name)
    result: dict[str, Any] = report.previous(options.name, "constants")
    usual: dict[str, dict[str, Measured]] = {}
    for room in SETS:
        for constant in constants(room):
            wanted = any(f"{constant.key}.".startswith(f"{each}.") for each in options.only)
            if not wanted or "sides" in result.get(constant.key, {}):
                continue
            values = np.asarray(constant.value).ravel()
            values = np.unique(values) if values.size > 4 else values
            shown = " ".join(f"{x:.4g}" for x in values)
            passed = reason_to_pass(constant, options.kernels)
            if passed:
                found: dict[str, Any] = {"shown": shown, "passed": passed}
            else:
                if room not in usual:
                    usual[room] = {part: run() for part, run in SETS[room].items()}
                found = {"shown": shown, **row(constant, usual[room])}
            result[constant.key] = found
            print(" | ".join(line(constant.key, found)), flush=True)
            facts = {"options": vars(options), "factors": FACTORS}
            report.write(options.name, {**facts, "constants": result}, text(result), shown=False)


if __name__ == "__main__":
    main()
