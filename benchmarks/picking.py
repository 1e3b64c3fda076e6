"""Things taken from a table, in physics: how often a grasp holds and how much of the table is cleared.

    python benchmarks/picking.py [--scenes 20] [--kinds packed,pile] [--contestants ours,...] [--each FILE]

The protocol of VGN and GIGA: scenes of :mod:`picking_scenes`, five things each; every round one image, one recovery
with our own masks, one grasp, the most probable one, in the physics of :mod:`picking_world`; until the table is empty,
no grasp is found, or two have failed in a row.

    GSR = held / tried        DR = taken / all things

| contestant | bodies | their uncertainty |
| --- | --- | --- |
| ours | the recovery | its covariance |
| ours without sigma | the same | 10 % of the size each |
| true bodies | the superquadric nearest to the true hull, at the true place | none |
| classic | Solina and Bajcsy's fit to our masks' points | 10 % |
| box | the smallest box of our masks' points | 10 % |
| centroid | no planner: straight down on the points' middle, across their narrowest direction | |

Ours has its own masks, mended by its fits; classic, box and centroid have the segmentation's.  All but the last go
through the same planner with the same surroundings.  Intervals are Wilson's, 95 %; picks of one scene are not
independent, so that they are somewhat too narrow.  ``--each`` is a file of lines, one a scene and contestant: the same
command goes on where it was interrupted.

Published for orientation only, other things and another simulator: GIGA (HR) 87.9 / 86.0 packed, 69.8 / 51.1 pile; VGN
74.5 / 79.2, 60.7 / 44.0; GPD 35.4 / 30.7, 17.7 / 9.2 (GSR / DR).  Physics: mujoco, the extra ``picking``.
"""

from __future__ import annotations

import argparse
import os

if __name__ == "__main__":  # as a script only: a process that imports this has threads already
    for variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(variable, "1")

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import picking_scenes
import report
import trimesh
from picking_scenes import EYE, KINDS, LOOK, TABLE_CAMERA, THINGS, Scene
from picking_world import Thing, World

from sq_perception.evaluation import plots
from sq_perception.evaluation.grasp_figure import draw_grasps
from sq_perception.fitting import solina_bajcsy
from sq_perception.geometry import mesh
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.grasping.gripper import PANDA
from sq_perception.grasping.planner import Grasp, grasps
from sq_perception.grasping.surroundings import Surroundings
from sq_perception.recovery.recoverer import FrameRecovery, Recoverer

MOST_ROUNDS = 12
ASKED = {"packed": (93, 92), "pile": (80, 70)}
BINS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
_SHOWN = (150, 490), (335, 65)
"""Columns and rows of a picture."""
_FIRST_SEED = 5000
"""Chosen before the first run."""


@dataclass(frozen=True, eq=False)
class Seen:
    """One image, what was recovered from it, and the world that it is of, which only the truth looks at."""

    depth: np.ndarray
    recovery: FrameRecovery
    world: World

    def points(self, label: int) -> np.ndarray:
        """Measured points (n, 3) of one mask."""
        rows, columns = np.nonzero((self.recovery.labels == label) & np.isfinite(self.depth))
        return TABLE_CAMERA.unproject(columns, rows, self.depth[rows, columns].astype(float))

    def planned(self, bodies: list[Superquadric], covariance: np.ndarray | None = None) -> tuple[Grasp, ...]:
        around = Surroundings.of_image(self.depth, TABLE_CAMERA, self.recovery.plane)
        return grasps(Superquadric.stack(bodies), PANDA, covariance, around).grasps


def ours(seen: Seen) -> tuple[Grasp, ...]:
    found = seen.recovery.recovered
    return seen.planned([one.superquadric for one in found], np.array([one.covariance for one in found]))


def without_sigma(seen: Seen) -> tuple[Grasp, ...]:
    return seen.planned([one.superquadric for one in seen.recovery.recovered])


def true_bodies(seen: Seen) -> tuple[Grasp, ...]:
    bodies = []
    for k in seen.world.left:
        position, rotation = seen.world.pose(k)
        bodies.append(_nearest(seen.world.things[k]).transformed(rotation, position).transformed(LOOK, EYE))
    return seen.planned(bodies, np.zeros((len(bodies), 11, 11)))


@lru_cache(maxsize=64)
def _nearest(thing: Thing) -> Superquadric:
    """The superquadric nearest to a thing's hull: least squares of points all over it."""
    vertices = np.concatenate([mesh.triangles(part, 16)[0] for part in thing.parts])
    hull = trimesh.convex.convex_hull(vertices)
    points = trimesh.sample.sample_surface(hull, 1000, seed=0)[0]
    return solina_bajcsy.fit(points, escapes=3).superquadric


def classic(seen: Seen) -> tuple[Grasp, ...]:
    """The recovery was made by that method."""
    return seen.planned([one.superquadric for one in seen.recovery.recovered])


def box(seen: Seen) -> tuple[Grasp, ...]:
    bodies = []
    for one in seen.recovery.bodies:
        box_from_points, edges = trimesh.bounds.oriented_bounds(seen.points(one.label))
        turn = box_from_points[:3, :3].T
        half = np.maximum(edges / 2, 1e-3)
        bodies.append(
            Superquadric(half, np.full(2, 0.1), -turn @ box_from_points[:3, 3], quaternions.from_matrix(turn))
        )
    return seen.planned(bodies)


def centroid(seen: Seen) -> tuple[Grasp, ...]:
    """The thing that is nearest to the gripper first."""
    plane = seen.recovery.plane
    if plane is None:
        return ()
    found = []
    for k, one in enumerate(seen.recovery.bodies):
        points = seen.points(one.label)
        heights = points @ plane[:3] + plane[3]
        middle = np.median(points, axis=0)
        flat = points - middle - (heights - np.median(heights))[:, None] * plane[:3]
        y = np.linalg.eigh(flat.T @ flat)[1][:, 1]  # the third direction is the plane's normal
        down = -plane[:3]
        y = np.cross(down, np.cross(y, down))
        y /= np.linalg.norm(y)
        top = float(np.quantile(heights, 0.98))
        height = max(top - 0.03, PANDA.tip + 0.005)
        position = middle + (height - float(np.median(heights))) * plane[:3]
        frame = np.stack([np.cross(y, down), y, down], axis=1)
        found.append(Grasp(k, position, quaternions.from_matrix(frame), PANDA.opening, np.nan, top, ""))
    return tuple(sorted(found, key=lambda grasp: -grasp.score))


CONTESTANTS: dict[str, Callable[[Seen], tuple[Grasp, ...]]] = {
    "ours": ours,
    "ours without sigma": without_sigma,
    "true bodies": true_bodies,
    "classic": classic,
    "box": box,
    "centroid": centroid,
}


_OURS = ("ours", "ours without sigma")


def cleared(scene: Scene, contestant: str, recoverer: Recoverer) -> dict[str, Any]:
    """One scene by one contestant, round by round."""
    world = scene.world()
    rng = np.random.default_rng([scene.seed, 1])
    picks: list[dict[str, Any]] = []
    failed, end = 0, "rounds"
    for _ in range(MOST_ROUNDS):
        if not world.left:
            end = "empty"
            break
        depth = picking_scenes.observed(world, scene.sensor, rng)
        seen = Seen(depth, recoverer.recover(depth, TABLE_CAMERA), world)
        started = time.process_time()
        found = CONTESTANTS[contestant](seen)
        milliseconds = 1e3 * (time.process_time() - started)
        if not found:
            end = "no grasp"
            break
        best = found[0]
        position, rotation = picking_scenes.to_world(best.position, best.rotation)
        aim = _aimed_at(world, position)
        pick = world.pick(position, rotation, best.opening)
        picks.append(
            {
                **asdict(pick),
                "score": best.score,
                "weakest": best.weakest,
                "aim": aim,
                "position": np.round(position, 4).tolist(),
                "rotation": np.round(rotation, 4).tolist(),
                "opening": round(best.opening, 4),
                "ms": round(milliseconds, 1),
            }
        )
        failed = 0 if pick.held >= 0 else failed + 1
        if failed == 2:
            end = "two failures"
            break
    return {
        "kind": scene.kind,
        "seed": scene.seed,
        "contestant": contestant,
        "picks": picks,
        "taken": sum(pick["held"] >= 0 for pick in picks),
        "end": end,
        "left": [scene.things[k].name for k in world.left],
    }


def _aimed_at(world: World, position: np.ndarray) -> int:
    """The thing whose parts the TCP is deepest in or nearest to."""
    gauge = {}
    for k in world.left:
        at, turn = world.pose(k)
        gauge[k] = float(world.things[k].parts.transformed(turn, at).gauge(position[None])[:, 0].min())
    return min(gauge, key=gauge.__getitem__)


def wilson(good: int, count: int) -> tuple[float, float, float]:
    """Share and its 95 % interval, percent."""
    if not count:
        return float("nan"), float("nan"), float("nan")
    z, p = 1.96, good / count
    middle = (p + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * np.sqrt(p * (1 - p) / count + z * z / (4 * count * count))
    return 100 * p, 100 * (middle - half), 100 * (middle + half)


def summary(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """Rates, causes and calibration by kind and contestant."""
    found: dict[str, Any] = {}
    for kind in KINDS:
        for name in CONTESTANTS:
            runs = [line for line in lines if line["kind"] == kind and line["contestant"] == name]
            if not runs:
                continue
            picks = [pick for run in runs for pick in run["picks"]]
            held = [pick["held"] >= 0 for pick in picks]
            scores = np.array([pick["score"] for pick in picks])
            bins = []
            for low, high in pairwise(BINS):
                inside = (scores > low) & (scores <= high)
                count = int(inside.sum())
                bins.append(
                    [count, float(scores[inside].mean()), float(np.mean(np.array(held)[inside]))] if count else [0]
                )
            causes = {how: sum(pick["how"] == how for pick in picks) for how in ("collision", "missed", "slipped")}
            causes |= {end: sum(run["end"] == end for run in runs) for end in ("no grasp", "two failures", "rounds")}
            found[f"{kind}: {name}"] = {
                "scenes": len(runs),
                "tried": len(picks),
                "gsr": wilson(sum(held), len(picks)),
                "dr": wilson(sum(run["taken"] for run in runs), THINGS * len(runs)),
                "causes": causes,
                "bins": bins,
                "planning_ms": float(np.median([pick["ms"] for pick in picks])) if picks else None,
            }
    return found


def table(found: dict[str, Any]) -> str:
    def rate(one: tuple[float, float, float]) -> str:
        return f"{one[0]:.0f} ({one[1]:.0f} to {one[2]:.0f})"

    rows = []
    for name, one in found.items():
        asked = ASKED[name.partition(":")[0]] if name.endswith(": ours") else ("", "")
        causes = one["causes"]
        rows.append(
            [
                name,
                str(one["scenes"]),
                str(one["tried"]),
                rate(one["gsr"]),
                str(asked[0]),
                rate(one["dr"]),
                str(asked[1]),
                *(str(causes[cause]) for cause in ("collision", "missed", "slipped", "no grasp", "two failures")),
            ]
        )
    heads = ["scenes: contestant", "scenes", "tried", "GSR %", "asked", "DR %", "asked"]
    heads += ["collision", "missed", "slipped", "ended without a grasp", "ended by two failures"]
    return report.table(heads, rows)


def picture(path: Path, seed: int, recoverer: Recoverer) -> None:
    """A scene of each kind before the first pick, with the best grasp of each body."""
    figure = plots.new_figure(13.0, 5.1)
    for column, kind in enumerate(KINDS):
        scene = picking_scenes.scene(kind, seed)
        world = scene.world()
        depth = picking_scenes.observed(world, scene.sensor, np.random.default_rng([seed, 1]))
        found = recoverer.recover(depth, TABLE_CAMERA)
        bodies = [one.superquadric for one in found.recovered]
        covariance = np.array([one.covariance for one in found.recovered])
        around = Surroundings.of_image(depth, TABLE_CAMERA, found.plane)
        plan = grasps(Superquadric.stack(bodies), PANDA, covariance, around)
        ax = figure.add_axes((0.5 * column + 0.003, 0.0, 0.494, 1.0))
        draw_grasps(ax, depth, TABLE_CAMERA, bodies, plan, PANDA)
        ax.set_xlim(*_SHOWN[0])
        ax.set_ylim(*_SHOWN[1])
        ax.text(0.02, 0.04, f"{kind}, {scene.sensor}", transform=ax.transAxes, color=plots.INK, weight="bold")
    plots.save(figure, path, dots_per_inch=90)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=20, help="of each kind")
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--contestants", default=",".join(CONTESTANTS))
    parser.add_argument("--first", type=int, default=_FIRST_SEED)
    parser.add_argument("--each", type=Path, help="result lines; those that are there are not computed again")
    parser.add_argument("--picture", type=Path, help="draw the first scene of each kind there, and do no more")
    parser.add_argument("--name", default="picking", help="of the results; empty: none are written")
    arguments = parser.parse_args()
    if arguments.picture:
        picture(arguments.picture, arguments.first, Recoverer())
        return
    lines: list[dict[str, Any]] = []
    if arguments.each and arguments.each.exists():
        lines = [json.loads(line) for line in arguments.each.read_text().splitlines()]
    have = {(line["kind"], line["seed"], line["contestant"]) for line in lines}
    recoverers = {name: Recoverer(method="auto" if name in _OURS else "classic") for name in CONTESTANTS}
    for seed in range(arguments.first, arguments.first + arguments.scenes):
        for kind in arguments.kinds.split(","):
            missing = [name for name in arguments.contestants.split(",") if (kind, seed, name) not in have]
            if not missing:
                continue
            scene = picking_scenes.scene(kind, seed)
            for name in missing:
                line = cleared(scene, name, recoverers[name])
                lines.append(line)
                if arguments.each:
                    with arguments.each.open("a") as file:
                        file.write(json.dumps(line) + "\n")
                print(kind, seed, name, line["taken"], [pick["how"] for pick in line["picks"]], line["end"], flush=True)
    found = summary(lines)
    if arguments.name:
        report.write(arguments.name, {"rows": found}, table(found))
    else:
        print(table(found))


if __name__ == "__main__":
    main()
