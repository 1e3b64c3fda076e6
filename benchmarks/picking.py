"""Things taken from a table, in physics: how often a grasp holds and how much of the table is cleared.

    python benchmarks/picking.py [--scenes 20] [--kinds packed,pile] [--contestants ours,...] [--each FILE]
        [--contact-graspnet COMMAND]

The protocol of VGN and GIGA: scenes of :mod:`picking_scenes`, five things each; every round one image, one recovery
with our own masks, one grasp, the most probable one, in the physics of :mod:`picking_world`; until the table is empty,
no grasp is found, or two have failed in a row.

    GSR = held / tried        DR = taken / all things

| contestant | bodies | their uncertainty |
| --- | --- | --- |
| ours | the recovery | its covariance |
| ours without sigma | the same | 10 % of the size each |
| ours without the hull | the recovery with the network of bodies, as in release 0.2.0 | its covariance |
| ours at any score | the same as ours, but the grasp tried is the one whose score is nearest to a random number | |
| true bodies | the superquadric nearest to the true hull, at the true place | 2.5 mm of the size each |
| classic | Solina and Bajcsy's fit to our masks' points | 10 % |
| box | the smallest box of our masks' points | 10 % |
| centroid | no planner: straight down on the points' middle, across their narrowest direction | |
| cgn in masks | Contact-GraspNet, its most confident grasp with the contact in one of our masks | |
| cgn | the same anywhere on the table | |

Ours has its own masks, mended by its fits; classic, box and centroid have the segmentation's.  All but centroid and
cgn go through the same planner with the same surroundings.  Contact-GraspNet is a process of its own, started by the
command that ``--contact-graspnet`` gives (:mod:`contact_graspnet` says how); without it both are left out.  "At any
score" is for the calibration of scores (``--first 34000 --contestants "ours,ours at any score" --name picking_scores``:
no scene that a constant is from) and goes on whatever fails.

| failure | |
| --- | --- |
| collision | with the table or another thing on the way |
| wrong size | with the thing itself: the fingers do not pass it |
| missed | nothing between the pads once they closed |
| slipped | held, but not any more after lift and shake |
| unreachable | things for which there was no grasp when the scene ended |

Intervals are Wilson's, 95 %; picks of one scene are not independent, so that they are somewhat too narrow.  Those of
differences are from 2000 draws of scenes.  ``--each`` is a file of lines, one a scene and contestant: the same command
goes on where it was interrupted.  Who was not tried keeps the row of the results before.  Rows that are not of the
commit of the results name theirs.

Published for orientation only, other things and another simulator: GIGA (HR) 87.9 / 86.0 packed, 69.8 / 51.1 pile; VGN
74.5 / 79.2, 60.7 / 44.0; GPD 35.4 / 30.7, 17.7 / 9.2 (GSR / DR).  Physics: mujoco, the extra ``picking``.
"""

from __future__ import annotations

import shlex
import subprocess
import tempfile

if __name__ == "__main__":
    import one_thread  # noqa: F401

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import lru_cache
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import picking_scenes
import report
import trimesh
from both_fits import measured_points
from picking_scenes import EYE, GRIPPER, KINDS, LOOK, TABLE_CAMERA, THINGS, Scene
from picking_world import Pick, Thing, World
from scipy.stats import binomtest

from sq_perception.fitting import solina_bajcsy
from sq_perception.fitting.options import MODEL_ERROR_ON_PLANE
from sq_perception.geometry import mesh
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.grasping import planner
from sq_perception.grasping.plan import Grasp
from sq_perception.grasping.planner import grasps
from sq_perception.grasping.surroundings import Surroundings
from sq_perception.learning import checkpoint
from sq_perception.recovery.recoverer import FrameRecovery, Recoverer

MOST_ROUNDS = 12
BOTH = "both"
ASKED = {"packed": (93, 92), "pile": (80, 70)}
BINS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
_MANY = 60
"""Grasps of a body among which one of any score is sought."""
_DRAWS = 2000
_FIRST_SEED = 5000
"""Chosen before the first run."""


class ContactGraspNet:
    """The process of :mod:`contact_graspnet`, started by a command."""

    def __init__(self, command: str) -> None:
        self._process = subprocess.Popen(
            shlex.split(command), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        self._folder = tempfile.TemporaryDirectory()
        self._frame = Path(self._folder.name) / "frame.npz"
        self._optical_from_world = np.eye(4)
        self._optical_from_world[:3, :3], self._optical_from_world[:3, 3] = quaternions.to_matrix(LOOK), EYE

    def found(self, depth: np.ndarray) -> list[tuple[Grasp, int, int]]:
        """Grasps, the most confident first, and row and column of the contact of each."""
        world_from_optical = np.linalg.inv(self._optical_from_world)
        np.savez(self._frame, depth=depth, K=TABLE_CAMERA.matrix, world_from_optical=world_from_optical)
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"{self._frame}\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        if not answer:
            raise RuntimeError("the command of --contact-graspnet ended: run it by itself to see why")
        return [
            (Grasp(-1, np.array(place), np.array(turn), opening, np.nan, score, ""), row, column)
            for place, turn, opening, score, row, column in json.loads(answer)
        ]


@dataclass(frozen=True, eq=False)
class Seen:
    """One image, what was recovered from it, and the world that it is of, which only the truth looks at."""

    depth: np.ndarray
    recovery: FrameRecovery
    world: World
    peer: ContactGraspNet | None = None
    chance: float = 0.0

    def points(self, label: int) -> np.ndarray:
        """Measured points (n, 3) of one mask."""
        return measured_points(self.depth.astype(float), self.recovery.labels == label, TABLE_CAMERA)

    def planned(self, bodies: list[Superquadric], covariance: np.ndarray | None = None) -> tuple[Grasp, ...]:
        around = Surroundings.of_image(self.depth, TABLE_CAMERA, self.recovery.plane)
        return grasps(Superquadric.stack(bodies), GRIPPER, covariance, around).grasps


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
    covariance = np.diag([MODEL_ERROR_ON_PLANE**2] * 3 + [0.0] * 8)
    return seen.planned(bodies, np.repeat(covariance[None], len(bodies), axis=0))


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
        height = max(top - 0.03, GRIPPER.tip + 0.005)
        position = middle + (height - float(np.median(heights))) * plane[:3]
        frame = np.stack([np.cross(y, down), y, down], axis=1)
        found.append(Grasp(k, position, quaternions.from_matrix(frame), GRIPPER.opening, np.nan, top, ""))
    return tuple(sorted(found, key=lambda grasp: -grasp.score))


def at_any_score(seen: Seen) -> tuple[Grasp, ...]:
    """The one whose score is nearest to a random number first."""
    usual, planner.PER_BODY = planner.PER_BODY, _MANY
    try:
        found = ours(seen)
    finally:
        planner.PER_BODY = usual
    return tuple(sorted(found, key=lambda grasp: abs(grasp.score - seen.chance)))


def cgn(seen: Seen) -> tuple[Grasp, ...]:
    assert seen.peer
    return tuple(grasp for grasp, _, _ in seen.peer.found(seen.depth))


def cgn_in_masks(seen: Seen) -> tuple[Grasp, ...]:
    assert seen.peer
    labels = seen.recovery.labels
    return tuple(grasp for grasp, row, column in seen.peer.found(seen.depth) if labels[row, column] > 0)


CONTESTANTS: dict[str, Callable[[Seen], tuple[Grasp, ...]]] = {
    "ours": ours,
    "ours without sigma": without_sigma,
    "ours without the hull": ours,
    "ours at any score": at_any_score,
    "true bodies": true_bodies,
    "classic": classic,
    "box": box,
    "centroid": centroid,
    "cgn in masks": cgn_in_masks,
    "cgn": cgn,
}
ON_RECOVERED = ("ours", "ours without sigma", "ours without the hull", "ours at any score", "classic")
PEERS = ("cgn in masks", "cgn")


def recoverer_of(contestant: str) -> Recoverer:
    """The recovery that a contestant gets."""
    if contestant == "ours without the hull":
        return Recoverer(model=checkpoint.DEFAULT)
    return Recoverer(method="auto" if contestant.startswith("ours") or contestant == "cgn in masks" else "classic")


@dataclass(frozen=True, eq=False)
class Round:
    """What was seen, which grasp was tried at which thing, and what came of it."""

    seen: Seen
    grasp: Grasp
    aim: int
    milliseconds: float
    pick: Pick


def rounds(
    scene: Scene, contestant: str, recoverer: Recoverer, peer: ContactGraspNet | None = None, world: World | None = None
) -> Iterator[Round]:
    """Image, grasp, pick, until the table is empty or no grasp is found."""
    world = world or scene.world()
    rng, chance = np.random.default_rng([scene.seed, 1]), np.random.default_rng([scene.seed, 3])
    for _ in range(MOST_ROUNDS):
        if not world.left:
            return
        depth = picking_scenes.observed(world, scene.sensor, rng)
        seen = Seen(depth, recoverer.recover(depth, TABLE_CAMERA), world, peer, chance.uniform())
        started = time.process_time()
        found = CONTESTANTS[contestant](seen)
        milliseconds = 1e3 * (time.process_time() - started)
        if not found:
            return
        position, rotation = scene.carried_out(found[0].position, found[0].rotation)
        aim = _aimed_at(world, position)
        yield Round(seen, found[0], aim, milliseconds, world.pick(position, rotation, found[0].opening))


def cleared(scene: Scene, contestant: str, recoverer: Recoverer, peer: ContactGraspNet | None) -> dict[str, Any]:
    """One scene by one contestant, round by round."""
    world = scene.world()
    picks: list[dict[str, Any]] = []
    failed, end = 0, ""
    for one in rounds(scene, contestant, recoverer, peer, world):
        picks.append(
            {
                **asdict(one.pick),
                "score": one.grasp.score,
                "weakest": one.grasp.weakest,
                "aim": one.aim,
                "ms": round(one.milliseconds, 1),
            }
        )
        failed = 0 if one.pick.held >= 0 else failed + 1
        if failed == 2 and contestant != "ours at any score":
            end = "two failures"
            break
    if not end:
        end = "empty" if not world.left else "no grasp" if len(picks) < MOST_ROUNDS else "rounds"
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


FAILURES = ("collision", "wrong size", "missed", "slipped")


def failure(pick: dict[str, Any]) -> str:
    """Why a pick failed, empty if it did not; see the module."""
    if pick["held"] >= 0:
        return ""
    return "wrong size" if pick["how"] == "collision" and pick["touched"] == str(pick["aim"]) else str(pick["how"])


def wilson(good: int, count: int) -> tuple[float, float, float]:
    """Share and its 95 % interval, percent."""
    if not count:
        return float("nan"), float("nan"), float("nan")
    interval = binomtest(good, count).proportion_ci(method="wilson")
    return 100 * good / count, 100 * interval.low, 100 * interval.high


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
            failed = [failure(pick) for pick in picks]
            causes = {cause: failed.count(cause) for cause in FAILURES}
            causes["unreachable"] = sum(len(run["left"]) for run in runs if run["end"] == "no grasp")
            causes["two failures"] = sum(run["end"] == "two failures" for run in runs)
            found[f"{kind}: {name}"] = {
                "scenes": len(runs),
                "tried": len(picks),
                "gsr": wilson(sum(held), len(picks)),
                "dr": wilson(sum(run["taken"] for run in runs), THINGS * len(runs)),
                "causes": causes,
                "bins": bins,
                "planning_ms": float(np.median([pick["ms"] for pick in picks])) if picks else None,
            }
            commits = {run["commit"] for run in runs if run.get("commit")}
            if commits - {report.commit()}:
                found[f"{kind}: {name}"]["commit"] = ", ".join(sorted(commits))
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
                _named(name, one),
                str(one["scenes"]),
                str(one["tried"]),
                rate(one["gsr"]),
                str(asked[0]),
                rate(one["dr"]),
                str(asked[1]),
                *(str(count) for count in causes.values()),
            ]
        )
    heads = ["scenes: contestant", "scenes", "tried", "GSR %", "asked", "DR %", "asked"]
    heads += [*FAILURES, "unreachable", "ended by two failures"]
    return report.table(heads, rows)


def _named(name: str, row: dict[str, Any]) -> str:
    return f"{name} (commit {row['commit']})" if "commit" in row else name


def gains_table(gains: dict[str, Any]) -> str:
    """Of pairs of contestants that tried the same scenes."""
    rows = [
        [
            _named(name, one),
            f"{one['scenes'][0]:.0f}",
            *("{:+.0f} ({:+.0f} to {:+.0f})".format(*one[rate]) for rate in ("gsr", "dr")),
        ]
        for name, one in gains.items()
        if one
    ]
    return report.table(["difference on the same scenes", "scenes", "GSR %", "DR %"], rows)


def gain(lines: list[dict[str, Any]], kind: str, name: str, other: str) -> dict[str, list[float]]:
    """By how many percent GSR and DR of one contestant are above another's on the same scenes, and 95 % intervals.

    ``kind`` is one, or "both", of which nothing is said where scenes of one were not tried.
    """
    asked = [run for run in lines if kind in (run["kind"], BOTH)]
    runs = {
        who: {(run["kind"], run["seed"]): run for run in asked if run["contestant"] == who} for who in (name, other)
    }
    seeds = sorted(set(runs[name]) & set(runs[other]))
    if {seed[0] for seed in seeds} != (set(KINDS) if kind == BOTH else {kind}):
        return {}
    counts = np.array(
        [[(runs[who][seed]["taken"], len(runs[who][seed]["picks"])) for seed in seeds] for who in (name, other)]
    )
    draws = np.random.default_rng(0).integers(len(seeds), size=(_DRAWS, len(seeds)))
    found = {}
    for rate in ("gsr", "dr"):
        values = []
        for chosen in (np.arange(len(seeds))[None], draws):
            taken, tried = counts[:, chosen].sum(axis=2).transpose(2, 0, 1)
            share = taken / np.maximum(tried, 1) if rate == "gsr" else taken / (THINGS * len(seeds))
            values.append(100 * (share[0] - share[1]))
        found[rate] = [float(values[0][0]), *np.percentile(values[1], [2.5, 97.5]).tolist()]
    return {"scenes": [len(seeds)], **found}


def _with_earlier(results: str, part: str, found: dict[str, Any]) -> dict[str, Any]:
    """What was found, and what of earlier results was not tried this time, with the commit that it was tried at."""
    made = report.previous(results, "environment").get("commit")
    earlier = {name: {"commit": made, **row} for name, row in report.previous(results, part).items() if row}
    mixed = earlier | {name: row for name, row in found.items() if row}
    places = {f"{kind}: {name}": k for k, (kind, name) in enumerate(product(KINDS, CONTESTANTS))}
    return dict(sorted(mixed.items(), key=lambda item: places.get(item[0], len(places))))


def main() -> None:
    parser = report.parser(__doc__)
    parser.add_argument("--scenes", type=int, default=20, help="of each kind")
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--contestants", default=",".join(CONTESTANTS))
    parser.add_argument("--first", type=int, default=_FIRST_SEED)
    parser.add_argument("--each", type=Path, help="result lines; those that are there are not computed again")
    parser.add_argument("--contact-graspnet", metavar="COMMAND", help="that starts contact_graspnet.py")
    parser.add_argument("--name", default="picking", help="of the results; empty: none are written")
    arguments = parser.parse_args()
    contestants = arguments.contestants.split(",")
    peer = None
    if arguments.contact_graspnet:
        peer = ContactGraspNet(arguments.contact_graspnet)
    elif set(contestants) & set(PEERS):
        contestants = [name for name in contestants if name not in PEERS]
        print("no --contact-graspnet: cgn is left out")
    lines: list[dict[str, Any]] = []
    if arguments.each and arguments.each.exists():
        lines = [json.loads(line) for line in arguments.each.read_text().splitlines()]
    have = {(line["kind"], line["seed"], line["contestant"]) for line in lines}
    recoverers = {name: recoverer_of(name) for name in contestants}
    for seed in range(arguments.first, arguments.first + arguments.scenes):
        for kind in arguments.kinds.split(","):
            missing = [name for name in contestants if (kind, seed, name) not in have]
            if not missing:
                continue
            scene = picking_scenes.scene(kind, seed)
            for name in missing:
                line = {"commit": report.commit(), **cleared(scene, name, recoverers[name], peer)}
                lines.append(line)
                if arguments.each:
                    with arguments.each.open("a") as file:
                        file.write(json.dumps(line) + "\n")
                print(kind, seed, name, line["taken"], [pick["how"] for pick in line["picks"]], line["end"], flush=True)
    found = summary(lines)
    gains = {
        f"{kind}: ours over {other}": gain(lines, kind, "ours", other)
        for kind in (*KINDS, BOTH)
        for other in ("ours without sigma", "ours without the hull", "true bodies", "classic", "cgn in masks", "cgn")
    }
    if arguments.name:
        found, gains = _with_earlier(arguments.name, "rows", found), _with_earlier(arguments.name, "gains", gains)
    text = table(found) + (f"\n\n{gains_table(gains)}" if any(gains.values()) else "")
    if arguments.name:
        report.write(arguments.name, {"rows": found, "gains": gains}, text)
    else:
        print(text)


if __name__ == "__main__":
    main()
