"""Household things seen by two cameras 60 degrees apart, against one.

    python benchmarks/two_cameras.py [--scenes 40] [--first 0] [--sensor stereo] [--name two_cameras]

Scenes of :mod:`household_things`.  The second camera is the first one after a turn about the table's normal through the
point that the first looks at; poses are exact.  Both are fused by :func:`sq_perception.tracking.views.fuse_views`.
Counted are the things that both cameras show at least half, with own masks those that the first one finds:

    one       the first camera
    again     the first camera, with a second frame of it: what another frame alone brings
    two       both cameras

    weak %    bodies with a half size whose standard deviation is above 15 % of it
    edge mm   error of full edges, both lists ascending, mean over the three
    2 sigma % half sizes within two reported deviations of half the hull's extent along the same axis
    IoU %     of volumes with the true hull
    split     things of which the second frame made a second body
"""

from __future__ import annotations

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

from dataclasses import replace
from typing import Any

import household_things
import numpy as np
from common import report, scene_verdict, tabletop

from sq_perception.fitting.quality import undetermined
from sq_perception.geometry import Superquadric
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.union import move
from sq_perception.recovery.recoverer import FrameRecovery
from sq_perception.simulation.rendering import render_things
from sq_perception.simulation.things_on_table import ThingsOnTable, things_on_table
from sq_perception.tracking.views import View, fuse_views

APART = 60.0
HERE = (np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3))
MASKS = ("given", "own")


def from_aside(truth: ThingsOnTable, degrees: float) -> tuple[ThingsOnTable, tuple[np.ndarray, np.ndarray]]:
    """The scene from a camera that went about the table, and that camera's pose in the first one's frame."""
    normal, offset = truth.plane[:3], truth.plane[3]
    middle = np.array([0, 0, -offset / normal[2]])
    turn = quaternions.from_rotation_vector(np.deg2rad(degrees) * normal)
    position = middle - quaternions.to_matrix(turn) @ middle
    back = quaternions.conjugate(turn)
    matrix = quaternions.to_matrix(back)
    placed = [
        replace(
            one, rotation=quaternions.multiply(back, one.rotation), translation=matrix @ (one.translation - position)
        )
        for one in truth.placed
    ]
    plane = np.append(matrix @ normal, offset + normal @ position)
    owner = np.repeat(range(len(placed)), [len(one.thing.parts) for one in placed])
    whose = np.repeat(range(len(placed)), [len(one.thing.cavities) for one in placed])
    parts = np.vstack([one.parts.to_flat() for one in placed])
    holes = np.vstack([move(one.thing.cavities.to_flat(), one.rotation, one.translation) for one in placed])
    bodies, cavities = Superquadric.from_flat(parts), Superquadric.from_flat(holes)
    depth, index = render_things(bodies, owner, cavities, whose, truth.camera, plane, truth.wall)
    shown = tuple(replace(one, pixels=int((index == k).sum())) for k, one in enumerate(placed))
    labels = (index + 1).astype(np.int32)
    there = replace(truth, depth=depth, labels=labels, plane=plane, table=matrix @ truth.table, placed=shown)
    return there, (turn, position)


def recover(scene: tabletop.Tabletop, masks: str) -> FrameRecovery:
    return scene_verdict.recoverer().recover(scene.depth, scene.camera, scene.labels if masks == "given" else None)


def verdicts(seed: int, sensor: str | None, masks: str) -> list[dict[str, dict[str, Any]]]:
    """What is known of each counted thing, by row of the table."""
    sensor = sensor or list(tabletop.SENSORS)[seed % len(tabletop.SENSORS)]
    rng = np.random.default_rng([household_things.SEED, seed])
    truth = things_on_table(rng)
    aside, pose = from_aside(truth, APART)
    scenes = [household_things.sensed(each, seed, sensor, rng) for each in (truth, truth, aside)]
    frames = [recover(scene, masks) for scene in scenes]
    views = [
        View(frame.recovered, where, scene.camera, scene.depth)
        for frame, where, scene in zip(frames, (HERE, HERE, pose), scenes, strict=True)
    ]
    first, beside = scenes[0], scenes[2]
    own = {placed.label: placed.label for placed in first.placed}
    if masks == "own":
        own = scene_verdict.matches(frames[0].labels, first.labels, first.depth)
    number = {body.label: k for k, body in enumerate(frames[0].recovered)}
    fused = {name: fuse_views(some) for name, some in (("one", views[:1]), ("again", views[:2]), ("two", views[::2]))}
    found = []
    for placed, other in zip(first.placed, beside.placed, strict=True):
        counted = household_things.is_counted(placed, first) and household_things.is_counted(other, beside)
        if not counted or own.get(placed.label) not in number:
            continue
        track_id = number[own[placed.label]] + 1  # tracks are born in the order of the first frame's bodies
        rows = {}
        for name, tracks in fused.items():
            track = next((each for each in tracks if each.id == track_id), None)
            if track is None:
                continue
            body, sigma = track.superquadric, track.sigma_size
            answer = scene_verdict.answer(body, placed, first, sigma)
            inside = [
                each for each in tracks if np.linalg.norm(each.superquadric.translation - body.translation) < 0.03
            ]
            rows[name] = {
                "weak": bool(undetermined(track.covariance, body.size).any()),
                "edge": answer.size_error,
                "covered": float(answer.covered.mean()),
                "iou": answer.iou,
                "split": len(inside) > 1,
            }
        if len(rows) == len(fused):
            found.append(rows)
    return found


def figures(things: list[dict[str, Any]]) -> dict[str, float]:
    """Means over the things of a row; of edges also the median, and the number of split things."""
    found = {key: float(np.mean([one[key] for one in things])) for key in ("weak", "edge", "covered", "iou")}
    median, split = np.median([one["edge"] for one in things]), sum(one["split"] for one in things)
    return {"things": len(things), **found, "median_edge": float(median), "split": split}


def line(name: str, row: dict[str, float]) -> dict[str, str]:
    """A row of the table."""
    return {
        "masks, cameras": name,
        "things": f"{row['things']}",
        "weak %": f"{100 * row['weak']:.0f}",
        "edge mm, mean / median": f"{1e3 * row['edge']:.1f} / {1e3 * row['median_edge']:.1f}",
        "2 sigma %": f"{100 * row['covered']:.0f}",
        "IoU %": f"{100 * row['iou']:.1f}",
        "split": f"{row['split']}",
    }


def main() -> None:
    parser = report.parser(__doc__, "two_cameras")
    parser.add_argument("--scenes", type=int, default=40)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--sensor", choices=list(tabletop.SENSORS), help="of all scenes; by default they alternate")
    options = parser.parse_args()
    rows = {}
    for masks in MASKS:
        seeds = range(options.first, options.first + options.scenes)
        things = [one for seed in seeds for one in verdicts(seed, options.sensor, masks)]
        for name in ("one", "again", "two"):
            rows[f"{masks}, {name}"] = figures([one[name] for one in things])
            print(" | ".join(line(f"{masks}, {name}", rows[f"{masks}, {name}"]).values()), flush=True)
    table = report.table_of([line(*row) for row in rows.items()])
    report.write(options.name, {"options": vars(options), "rows": rows}, table)


if __name__ == "__main__":
    main()
