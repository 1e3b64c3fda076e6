"""Things that stand on kitchen tables, as meshes of household sizes whose convex hulls and boxes are known.

| kind | what | full edges |
| --- | --- | --- |
| box | cartons, edges rounded by 0.5 to 4 mm | 6 to 30 cm, 45 to 100 and 15 to 70 % of that, at least 2 cm |
| can | cylinders, rims rounded by 1 to 3 mm | diameter 5 to 11 cm, height 4 to 20 cm |
| bottle | body of 50 to 68 % of the height, shoulder, neck of 2.2 to 4 cm | diameter 6 to 9 cm, height 15 to 28 cm |
| scan | YCB objects (../shared/data/ycb_meshes) | as they are |

A thing's own frame has its base, or its middle, anywhere; z is the axis of revolution.  Its true edges are those of the
box that a ruler would measure: for a scan the smallest box around its hull.

Metres.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import product
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import ConvexHull

from common.hull_columns import Columns

KINDS = {"box": 0.35, "can": 0.25, "bottle": 0.2, "scan": 0.2}
"""How often each comes."""
SECTIONS = 96
ROUNDING_STEPS = 5


@dataclass(frozen=True, eq=False)
class MeshRest:
    """A way to lie on a table: the rotation (3, 3) from the thing's frame to one with z up, and its probability."""

    name: str
    turn: np.ndarray
    likely: float


@dataclass(frozen=True, eq=False)
class MeshThing:
    """One household object.

    Attributes
    ----------
    mesh
        Its surface.
    hull : (n, 3)
        Corners of its convex hull.
    edges : (3,)
        Full edges of its box, ascending.
    rests
        How it may lie on a table.
    """

    kind: str
    name: str
    mesh: trimesh.Trimesh
    hull: np.ndarray
    edges: np.ndarray
    rests: tuple[MeshRest, ...]

    @cached_property
    def columns(self) -> Columns:
        return Columns.of(self.hull)


UPRIGHT = np.eye(3)
ON_X = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
"""z of the thing along x of the table: lying."""
ON_Y = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def box(rng: np.random.Generator) -> MeshThing:
    """A carton."""
    longest = np.exp(rng.uniform(np.log(0.06), np.log(0.30)))
    middle = longest * rng.uniform(0.45, 1.0)
    shortest = np.clip(longest * rng.uniform(0.15, 0.7), 0.02, middle)
    edges = np.sort([shortest, max(middle, 0.02), longest])
    return rounded_box(edges, rng.uniform(0.0005, 0.004))


def rounded_box(edges: np.ndarray, radius: float) -> MeshThing:
    """The carton with these full edges (3,), ascending, along x, y and z, whose edges are rounded."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=radius).vertices
    corners = np.array(list(product((-0.5, 0.5), repeat=3))) * (np.asarray(edges) - 2 * radius)
    surface = trimesh.convex.convex_hull((corners[:, None] + ball).reshape(-1, 3))
    rests = MeshRest("standing", UPRIGHT, 0.3), MeshRest("flat", ON_X, 0.4), MeshRest("on its side", ON_Y, 0.3)
    return MeshThing("box", "box", surface, surface.vertices, np.sort(edges), rests)


def can(rng: np.random.Generator) -> MeshThing:
    """A cylinder."""
    return cylinder(rng.uniform(0.05, 0.11), rng.uniform(0.04, 0.20), rng.uniform(0.001, 0.003))


def cylinder(diameter: float, height: float, rim: float) -> MeshThing:
    """The cylinder with rounded rims that stands on the origin."""
    angle = np.linspace(0, np.pi / 2, ROUNDING_STEPS)
    r = diameter / 2 - rim + rim * np.sin(angle)
    z = rim - rim * np.cos(angle)
    profile = np.concatenate([[[0, 0]], np.stack([r, z], 1), np.stack([r, height - z], 1)[::-1], [[0, height]]])
    return _revolved("can", "can", profile, lying=0.25)


def bottle(rng: np.random.Generator) -> MeshThing:
    """Body, a smooth shoulder, neck."""
    radius, height, neck = rng.uniform(0.06, 0.09) / 2, rng.uniform(0.15, 0.28), rng.uniform(0.011, 0.02)
    low = height * rng.uniform(0.5, 0.68)
    high = low + height * rng.uniform(0.1, 0.24)
    base = 0.003
    share = np.linspace(0, 1, 16)
    shoulder = neck + (radius - neck) * (1 + np.cos(np.pi * share)) / 2
    profile = [[0, 0], [radius - base, 0], [radius, base]]
    profile += np.stack([shoulder, low + (high - low) * share], 1).tolist()
    profile += [[neck, height], [0, height]]
    return _revolved("bottle", "bottle", np.array(profile), lying=0.2)


@cache
def scans(folder: Path | None) -> tuple[MeshThing, ...]:
    """The YCB objects of a folder as things, in the order of the files; none without one."""
    paths = [] if folder is None else sorted(path for path in folder.glob("*.ply") if ".hull" not in path.name)
    found = []
    for path in paths:
        mesh = trimesh.load_mesh(path, process=False)
        hull = trimesh.load_mesh(path.with_suffix(".hull.ply"), process=False)
        poses, likely = hull.compute_stable_poses()
        rests = tuple(
            MeshRest(f"rest {k}", pose[:3, :3], share)
            for k, (pose, share) in enumerate(zip(poses, likely / likely.sum(), strict=True))
        )
        name = path.stem.split("_", 1)[-1].replace("_", " ")
        edges = np.sort(trimesh.bounds.oriented_bounds(hull)[1])
        found.append(MeshThing("scan", name, mesh, np.asarray(hull.vertices), edges, rests))
    return tuple(found)


MAKERS: dict[str, Callable[[np.random.Generator], MeshThing]] = {"box": box, "can": can, "bottle": bottle}


def draw(rng: np.random.Generator, scanned: tuple[MeshThing, ...]) -> MeshThing:
    """A random thing of one of the kinds, by their weights."""
    names = [name for name in KINDS if name != "scan" or scanned]
    weights = np.array([KINDS[name] for name in names])
    kind = names[rng.choice(len(names), p=weights / weights.sum())]
    return scanned[rng.integers(len(scanned))] if kind == "scan" else MAKERS[kind](rng)


def _revolved(kind: str, name: str, profile: np.ndarray, lying: float) -> MeshThing:
    """A body of revolution with the profile (n, 2) = (radius, height) from the base along its outside."""
    surface = trimesh.creation.revolve(profile, sections=SECTIONS)
    hull = np.asarray(surface.vertices)[ConvexHull(surface.vertices).vertices]
    rests = (MeshRest("upright", UPRIGHT, 1 - lying), MeshRest("lying", ON_X, lying))
    diameter, height = 2 * profile[:, 0].max(), np.ptp(profile[:, 1])
    return MeshThing(kind, name, surface, hull, np.sort([diameter, diameter, height]), rests)
