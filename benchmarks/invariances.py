"""What must not matter: the camera's roll, masks of some pixels more or less, gaps in the image, the size of the world.

    python benchmarks/invariances.py [--scenes 70] [--first 30000] [--name invariances]

Scenes of :mod:`household_things`, as they are and with one thing changed:

    roll    the camera is turned by 90, 180 and 270 degrees about its optical axis
    masks   the given ones are 1 to 3 pixels smaller, or larger where there is no other thing
    gaps    every second line is missing, every second pixel of each line in turn, or all but every third pixel of every
            third line, as in depth that was registered to more pixels
    size    all lengths are multiplied, before another sensor, whose noise is that of the distance: blocks of some
            centimetres at 0.3 m, crates at 3 m; ``max_size`` grows with them

Counted are things at least half visible, with 200 pixels and half of them measured.  IoU is with the convex hull, 0
where there is no body or a failed one, and by its own segments where masks are ``own``, matched as in
:mod:`scene_verdict`; ``difference`` is to the scenes as they are, thing by thing, with its standard error; ``2 sigma``
the share of half sizes within two reported deviations.
"""

from __future__ import annotations

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import cv2
import household_things
import numpy as np
from common import report, scene_verdict
from common.mesh_things import MeshThing
from common.tabletop import Tabletop

import sq_perception as sq
from sq_perception.imaging.camera import Camera
from sq_perception.simulation import sensor_noise

AS_IT_IS = "as it is"
SIZES = {"realsense_d435": (0.4, 0.7, 1.0, 2.0, 3.0), "azure_kinect": (1.0, 2.0, 3.0)}
GAPS: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "every second line": lambda row, column: row % 2 == 1,
    "a chess board": lambda row, column: (row + column) % 2 == 1,
    "all but 1 in 9": lambda row, column: (row % 3 > 0) | (column % 3 > 0),
}
_MAX_SIZE = sq.RecoveryOptions().max_size


@dataclass(frozen=True)
class Row:
    """What is changed in a scene, and whose masks are taken."""

    name: str
    masks: str
    change: Callable[[Tabletop], Tabletop]
    times: float = 1.0


def rolled(scene: Tabletop, quarters: int) -> Tabletop:
    """What a camera sees that is turned clockwise by so many quarters about its optical axis."""
    camera, matrix = scene.camera, np.eye(3)
    for _ in range(quarters):
        camera = Camera(camera.height, camera.width, camera.fy, camera.fx, camera.cy, camera.width - 1 - camera.cx)
        matrix = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]) @ matrix
    depth, true_depth, labels = (
        np.ascontiguousarray(np.rot90(image, quarters)) for image in (scene.depth, scene.true_depth, scene.labels)
    )
    placed = [
        replace(one, rotation=matrix @ one.rotation, translation=matrix @ one.translation) for one in scene.placed
    ]
    return replace(
        scene,
        camera=camera,
        depth=depth,
        true_depth=true_depth,
        labels=labels,
        plane=np.append(matrix @ scene.plane[:3], scene.plane[3]),
        table=matrix @ scene.table,
        placed=tuple(placed),
    )


def misfit(scene: Tabletop, pixels: int) -> Tabletop:
    """With masks so many pixels larger, or smaller if negative."""
    brush, labels = np.ones((2 * abs(pixels) + 1,) * 2, np.uint8), np.zeros_like(scene.labels)
    for label in np.unique(scene.labels[scene.labels > 0]).tolist():
        mask = (scene.labels == label).view(np.uint8)
        other = cv2.dilate(mask, brush) if pixels > 0 else cv2.erode(mask, brush, borderValue=1)
        labels[(other > 0) & np.isin(scene.labels, (0, label))] = label
    return replace(scene, labels=labels)


def sparse(scene: Tabletop, missing: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Tabletop:
    """Without the readings of the rows and columns for which this holds."""
    return replace(scene, depth=np.where(missing(*np.indices(scene.depth.shape)), np.float32(np.nan), scene.depth))


def resized(scene: Tabletop, times: float, sensor: str) -> Tabletop:
    """With all lengths multiplied, as a sensor sees it."""
    rng, true_depth = np.random.default_rng([scene.seed]), times * scene.true_depth
    depth = sensor_noise.preset(sensor).measure(true_depth, scene.camera, rng)
    plane = scene.plane * np.array([1.0, 1.0, 1.0, times])
    placed = tuple(
        replace(one, thing=resized_thing(one.thing, times), translation=times * one.translation) for one in scene.placed
    )
    return replace(scene, sensor=sensor, depth=depth, true_depth=true_depth, plane=plane, placed=placed)


def resized_thing(thing: MeshThing, times: float) -> MeshThing:
    mesh = thing.mesh.copy().apply_scale(times)
    return MeshThing(thing.kind, thing.name, mesh, times * thing.hull, times * thing.edges, ())


def rows() -> list[Row]:
    found = [Row(AS_IT_IS, masks, lambda scene: scene) for masks in ("given", "own")]
    for masks in ("given", "own"):
        found += [Row(f"roll {90 * k}", masks, partial(rolled, quarters=k)) for k in (1, 2, 3)]
    found += [Row(f"masks {k:+d} pixels", "given", partial(misfit, pixels=k)) for k in (-3, -2, -1, 1, 2, 3)]
    for masks in ("given", "own"):
        found += [Row(f"missing {name}", masks, partial(sparse, missing=gaps)) for name, gaps in GAPS.items()]
    for masks in ("given", "own"):
        for sensor, sizes in SIZES.items():
            changes = {k: partial(resized, times=k, sensor=sensor) for k in sizes}
            found += [Row(f"size x {k:g}, {sensor}", masks, change, k) for k, change in changes.items()]
    return found


def answers(scene: Tabletop, counted: list[int], row: Row) -> list[scene_verdict.Answer]:
    """Of the counted things of a scene, changed as a row says."""
    changed = row.change(scene)
    given = changed.labels if row.masks == "given" else None
    limits = sq.RecoveryOptions(max_size=_MAX_SIZE * max(1.0, row.times))
    frame = scene_verdict.recoverer().recover(changed.depth, changed.camera, given, limits)
    known = {label: label for label in counted}
    if given is None:
        known = scene_verdict.matches(frame.labels, changed.labels, changed.depth)
    things = {one.label: one for one in changed.placed}
    return [scene_verdict.of_frame(frame, known.get(label, 0), things[label], changed) for label in counted]


def main() -> None:
    parser = report.parser(__doc__, "invariances")
    parser.add_argument("--scenes", type=int, default=70, help="number of scenes")
    parser.add_argument("--first", type=int, default=30000, help="seed of the first scene")
    options = parser.parse_args()
    every: dict[tuple[str, str], list[scene_verdict.Answer]] = {(row.name, row.masks): [] for row in rows()}
    for seed in range(options.first, options.first + options.scenes):
        scene = household_things.scene(seed, None)
        counted = [one.label for one in scene.placed if household_things.is_counted(one, scene)]
        for row in rows():
            every[row.name, row.masks] += answers(scene, counted, row)
        print(f"scene {seed}", flush=True)
    result, lines = [], []
    for (name, masks), found in every.items():
        iou = np.array([answer.iou for answer in found])
        difference = iou - [answer.iou for answer in every[AS_IT_IS, masks]]
        covered = float(np.nanmean([answer.covered for answer in found]))
        mean, doubt = difference.mean(), difference.std() / np.sqrt(len(iou))
        result.append(
            {"row": name, "masks": masks, "things": len(iou), "iou": iou.mean(), "difference": mean, "error": doubt}
            | {"two_sigma": covered}
        )
        shown = f"{100 * mean:+.1f} +- {100 * doubt:.1f}"
        lines.append([name, masks, str(len(iou)), f"{100 * iou.mean():.1f}", shown, f"{100 * covered:.0f}"])
    header = ["scenes", "masks", "things", "IoU %", "difference", "2 sigma %"]
    facts = {"scenes": options.scenes, "first": options.first}
    report.write(options.name, {**facts, "rows": result}, report.table(header, lines))


if __name__ == "__main__":
    main()
