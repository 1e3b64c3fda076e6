"""A household object: a union of superquadrics with its resting poses, and building blocks of object families.

An object is a union of superquadrics in its own frame: metres, z up when it stands, box centre at the origin.
Its convex hull, which planners need, has the support function

    h(n) = max over the parts of  n.t + h_part(R^T n),

in closed form by :meth:`Superquadric.support`.  An open vessel also has cavities, superquadrics that are removed from
the union; the hull ignores them.

The user's own objects are meshes, to train a network on besides the simulated household.  A mesh rests on the faces of
its hull on which it is stable, as often as it would settle there (K. Goldberg et al., "Part pose statistics", 1999, as
computed by trimesh for uniform density).  Views show the mesh; the network predicts its hull, whose corners are in
:attr:`Thing.parts` as points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.geometry.union import flat_support, support_of_union
from sq_perception.simulation.rendering import Mesh

UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
ON_X = np.array([0.0, -np.sqrt(0.5), 0.0, np.sqrt(0.5)])  # the object's x axis points up: it lies on a side
ON_Y = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
"""The object's y axis, of an oval bottle the shorter one, points up."""
INVERTED = np.array([1.0, 0.0, 0.0, 0.0])

SIX_WAYS = np.concatenate([np.eye(3), -np.eye(3)])
NO_CAVITY = Superquadric.stack([])

CARTON_RESTS = (("standing", UPRIGHT, 0.45), ("flat", ON_X, 0.3), ("on its side", ON_Y, 0.25))
ROUND_RESTS = (("standing", UPRIGHT, 0.78), ("lying", ON_Y, 0.19), ("inverted", INVERTED, 0.03))
OVAL_RESTS = (("standing", UPRIGHT, 0.75), ("lying", ON_Y, 0.2), ("on its side", ON_X, 0.05))

Numbers = Sequence[float] | np.ndarray
Row = tuple[float, ...]  # a part: a1 a2 a3 e1 e2 x y z qx qy qz qw


@dataclass(frozen=True, eq=False)
class Rest:
    """A resting pose: the quaternion (4,) from the object's frame to one with z up, and its probability."""

    name: str
    turn: np.ndarray
    likely: float


@dataclass(frozen=True, eq=False)
class Thing:
    """A household object."""

    kind: str  # one of :data:`household.KINDS <sq_perception.simulation.household.KINDS>`
    name: str  # the family within the kind
    parts: Superquadric  # batch (k,) in the object's own frame, metres
    rests: tuple[Rest, ...]  # how it may lie; their probabilities add up to 1
    cavities: Superquadric  # batch (m,), m >= 0: cavities, removed from the union
    surface: Mesh | None = None  # what is seen in place of the union, where the parts only have its hull

    def support(self, directions: np.ndarray) -> np.ndarray:
        """Return max n.p over the convex hull, in the object's frame, for unit directions (J, 3), shape (J,)."""
        return support_of_union(self.parts, directions)

    @cached_property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner (3,) of the box around the object in its own frame."""
        reach = self.support(SIX_WAYS)
        return -reach[3:], reach[:3]

    def pose(self, rng: np.random.Generator, leaning: float = 0.06) -> tuple[str, np.ndarray]:
        """Draw a resting pose, turned about the vertical: its name and the quaternion (4,) to a frame with z up.
        ``leaning`` is the share of objects that are tilted by 4 to 35 degrees, as by something under or beside them."""
        rest = self.rests[draw_index([rest.likely for rest in self.rests], rng)]
        name, turn = rest.name, rest.turn
        if rng.random() < leaning:
            tilt, way = rng.uniform(*np.deg2rad((4.0, 35.0))), rng.uniform(0, 2 * np.pi)
            name, turn = "leaning", quaternions.multiply(_turn(np.cos(way), np.sin(way), 0.0, tilt), turn)
        return name, quaternions.multiply(_turn(0.0, 0.0, 1.0, rng.uniform(0, 2 * np.pi)), turn)


def _turn(x: float, y: float, z: float, angle: float) -> np.ndarray:
    """Return the quaternion of a turn about a unit axis by an angle in radians."""
    s = np.sin(angle / 2)
    return np.array([x * s, y * s, z * s, np.cos(angle / 2)])


def draw_index(weights: Sequence[float], rng: np.random.Generator) -> int:
    """Draw a random index with these weights."""
    return min(int(np.searchsorted(np.cumsum(weights), rng.random() * sum(weights), side="right")), len(weights) - 1)


def part(size: Numbers, shape: Numbers, at: Numbers = (0.0, 0.0, 0.0), turn: Numbers = (0.0, 0.0, 0.0, 1.0)) -> Row:
    """Return a superquadric of half sizes, exponents, centre, quaternion."""
    return (*size, *shape, *at, *turn)


def about(axis: int, degrees: float) -> Row:
    """Return the quaternion of a turn about a coordinate axis."""
    half = np.deg2rad(degrees) / 2
    turn = [0.0, 0.0, 0.0, float(np.cos(half))]
    turn[axis] = float(np.sin(half))
    return tuple(turn)


def assemble(
    kind: str, name: str, rows: list[Row], rests: Sequence[tuple[str, np.ndarray, float]], cut: Sequence[Row] = ()
) -> Thing:
    """Make an object of parts and cavities, moved to the middle of its box; rests by name, turn, weight."""
    flat = np.array(rows)
    reach = flat_support(flat, SIX_WAYS)
    middle = 0.5 * (reach[:3] - reach[3:])
    flat[:, 5:8] -= middle
    cavities = NO_CAVITY
    if cut:
        cavities = Superquadric.from_flat(np.array(cut) - [*[0.0] * 5, *middle, *[0.0] * 4])
    total = sum(likely for _, _, likely in rests)
    ways = tuple(Rest(name, turn, likely / total) for name, turn, likely in rests)
    return Thing(kind, name, Superquadric.from_flat(flat), ways, cavities)


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number whose logarithm is uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


SUFFIXES = (".ply", ".obj", ".stl", ".glb", ".off")


def read_things(folder: Path) -> tuple[Thing, ...]:
    """Read all meshes of a folder, by name.  Raises ValueError if there are none, one cannot be read or has no faces,
    or its size is none that one takes in a hand."""
    paths = sorted(path for path in folder.glob("[!.]*") if path.suffix.lower() in SUFFIXES)
    if not paths:
        raise ValueError(f"{folder}: expected meshes ({' '.join(SUFFIXES)}), found none")
    return tuple(_read(path) for path in paths)


def _read(path: Path) -> Thing:
    largest, smallest = 1.0, 0.005  # longest edge of the box around an object, metres: others are taken for other units
    import trimesh

    try:
        mesh = trimesh.load_mesh(path, process=False)
        mesh.remove_unreferenced_vertices()  # nobody sees them
        hull = mesh.convex_hull
        if not hull.volume > 0:
            raise ValueError("it is flat")  # and trimesh would look for its poses for ever
        turns, likely = hull.compute_stable_poses()
    except Exception as error:  # whatever a reader of one of many formats raises
        raise ValueError(f"{path}: no mesh with a volume: {error}") from error
    longest = float(np.ptp(hull.vertices, axis=0).max())
    if not smallest <= longest <= largest:
        raise ValueError(
            f"{path}: expected metres, a thing of {smallest} to {largest}; its longest edge is {longest:.4g}"
        )
    middle = hull.bounds.mean(axis=0)
    corners = hull.vertices - middle
    points = np.zeros((len(corners), 12))
    points[:, :3], points[:, 3:5], points[:, 5:8], points[:, 11] = 1e-5, 1.0, corners, 1.0
    order = np.argsort(-likely, kind="stable")
    # The likeliest are kept: each pose of a finely divided round side is unlikely.
    kept = order[: np.searchsorted(np.cumsum(likely[order]), 0.99 * likely.sum()) + 1]
    turns, likely = turns[kept], likely[kept]
    rests = tuple(
        Rest(f"face {k}", quaternions.from_matrix(turn[:3, :3]), float(share))
        for k, (turn, share) in enumerate(zip(turns, likely / likely.sum(), strict=True))
    )
    surface = Mesh(np.asarray(mesh.vertices, dtype=float) - middle, np.asarray(mesh.faces))
    return Thing("union", path.stem, Superquadric.from_flat(points), rests, NO_CAVITY, surface)
