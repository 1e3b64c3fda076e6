"""Who picks in benchmarks/picking.py: each takes an image and what was recovered from it, and gives grasps, best first.

| contestant | bodies | their uncertainty |
| --- | --- | --- |
| ours | the recovery | its covariance |
| ours with parts | the parts of things that have some | their covariance |
| ours without sigma | the recovery | 10 % of the size each |
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
command that ``--contact-graspnet`` gives (:mod:`contact_graspnet` says how); without it both are left out.
"""

from __future__ import annotations

import json
import shlex
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import trimesh

from common.picking_scenes import EYE, GRIPPER, LOOK, TABLE_CAMERA
from common.picking_world import Thing, World
from sq_perception.fitting import solina_bajcsy
from sq_perception.fitting.options import MODEL_ERROR
from sq_perception.geometry import mesh
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.grasping import planner
from sq_perception.grasping.plan import Grasp, GraspPlan
from sq_perception.grasping.planner import grasps
from sq_perception.grasping.surroundings import Surroundings
from sq_perception.learning import checkpoint
from sq_perception.recovery.recoverer import FrameRecovery, Recoverer

_MANY = 60
"""Grasps of a body among which one of any score is sought."""


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
        return TABLE_CAMERA.points(self.depth)[(self.recovery.labels == label) & np.isfinite(self.depth)]

    def plan(self, bodies: list[Superquadric], covariance: np.ndarray | None = None) -> GraspPlan:
        around = Surroundings.of_image(self.depth, TABLE_CAMERA, self.recovery.plane)
        return grasps(Superquadric.stack(bodies), GRIPPER, covariance, around)

    def planned(self, bodies: list[Superquadric], covariance: np.ndarray | None = None) -> tuple[Grasp, ...]:
        return self.plan(bodies, covariance).grasps


def ours(seen: Seen) -> tuple[Grasp, ...]:
    around = Surroundings.of_image(seen.depth, TABLE_CAMERA, seen.recovery.plane)
    return planner.grasps_of(seen.recovery.recovered, GRIPPER, around).grasps


def without_sigma(seen: Seen) -> tuple[Grasp, ...]:
    return seen.planned([one.superquadric for one in seen.recovery.recovered])


def true_bodies(seen: Seen) -> tuple[Grasp, ...]:
    bodies = []
    for k in seen.world.left:
        position, rotation = seen.world.pose(k)
        bodies.append(_nearest(seen.world.things[k]).transformed(rotation, position).transformed(LOOK, EYE))
    covariance = np.diag([MODEL_ERROR**2] * 3 + [0.0] * 8)
    return seen.planned(bodies, np.repeat(covariance[None], len(bodies), axis=0))


@lru_cache(maxsize=64)
def _nearest(thing: Thing) -> Superquadric:
    """The superquadric nearest to a thing's hull: least squares of points all over it."""
    vertices = np.concatenate([mesh.triangles(part, 16)[0] for part in thing.parts])
    hull = trimesh.convex.convex_hull(vertices)
    points = trimesh.sample.sample_surface(hull, 1000, seed=0)[0]
    return solina_bajcsy.fit(points, escapes=3).superquadric


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


# What "ours with parts", "ours without the hull" and "classic" have of their own is their recovery: recoverer_of.
CONTESTANTS: dict[str, Callable[[Seen], tuple[Grasp, ...]]] = {
    "ours": ours,
    "ours without sigma": without_sigma,
    "ours with parts": ours,
    "ours without the hull": ours,
    "ours at any score": at_any_score,
    "true bodies": true_bodies,
    "classic": without_sigma,
    "box": box,
    "centroid": centroid,
    "cgn in masks": cgn_in_masks,
    "cgn": cgn,
}
WITH_PARTS = "ours with parts"
ON_RECOVERED = ("ours", WITH_PARTS, "ours without sigma", "ours without the hull", "ours at any score", "classic")
PEERS = ("cgn in masks", "cgn")


def recoverer_of(contestant: str) -> Recoverer:
    """The recovery that a contestant gets."""
    if contestant == "ours without the hull":
        return Recoverer(model=checkpoint.DEFAULT)
    return Recoverer(method="auto" if contestant.startswith("ours") or contestant == "cgn in masks" else "classic")
