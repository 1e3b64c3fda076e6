"""Household things in and on furniture: what carries them is neither a table nor one of them.

    python benchmarks/furniture.py [--scenes 40] [--first 61000] [--name furniture]

| | the plane that things stand on is | beside it |
| --- | --- | --- |
| carton | the top of a box 8 to 40 cm high | the floor |
| stool | the top of a board on four legs, 25 to 60 cm high | the floor |
| shelf board | the top of a board 2 cm thick | a wall right behind it, the floor 0.5 to 1.5 m below |
| shelves | the same | a back, two sides, a board above and one below, the floor |
| tray | the table | four walls 1.5 to 5 cm high around the things |
| bin | the table | four walls 8 to 30 cm high |

Things are those of :mod:`household_things`; scene k of a kind follows from (``SEED``, kind, k) alone, and sensors
alternate.  Figures are those of :mod:`cameras`.  No furniture is a thing: a body of it is a false one.
"""

from __future__ import annotations

if __name__ == "__main__":
    import one_thread  # noqa: F401

from collections.abc import Callable
from dataclasses import dataclass, replace

import cameras
import household_things
import numpy as np
import report
import tabletop

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast
from sq_perception.simulation.scenes import plane_depth
from sq_perception.simulation.things_on_table import TABLE_CAMERA, ThingsOnTable, things_on_table

SEED = 7802
_SHARP = 0.02
_MARGIN = (0.02, 0.12)
"""Metres of free board around all things."""
_TRIES = 20


@dataclass(frozen=True, eq=False)
class Place:
    """The smallest rectangle around all things along some direction, and a margin.

    Attributes
    ----------
    axes : (3, 3)
        Columns: along its sides, and up; in the optical frame.  The second one leads away from the camera.
    middle : (3,)
        On the plane that things stand on.
    half : (2,)
        Half its sides.
    height
        Of the highest thing.
    """

    axes: np.ndarray
    middle: np.ndarray
    half: np.ndarray
    height: float

    @classmethod
    def around(cls, truth: ThingsOnTable, rng: np.random.Generator, turn: float) -> Place:
        yaw = rng.uniform(-turn, turn)
        c, s = np.cos(yaw), np.sin(yaw)
        axes = truth.table @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
        parts = [placed.parts for placed in truth.placed]
        high = np.max([(each.translation @ axes + each.support(axes.T)).max(axis=0) for each in parts], axis=0)
        low = np.min([(each.translation @ axes - each.support(-axes.T)).min(axis=0) for each in parts], axis=0)
        low[:2] -= rng.uniform(*_MARGIN, 2)
        high[:2] += rng.uniform(*_MARGIN, 2)
        ground = -truth.plane[3]
        middle = axes @ np.array([*(low + high)[:2] / 2, ground])
        return cls(axes, middle, (high - low)[:2] / 2, float(high[2] - ground))

    def box(self, low: tuple[float, float, float], high: tuple[float, float, float]) -> Superquadric:
        """A box between two corners, which count from the middle."""
        below, above = np.array(low), np.array(high)
        centre = self.middle + self.axes @ (below + above) / 2
        return Superquadric((above - below) / 2, np.full(2, _SHARP), centre, quaternions.from_matrix(self.axes))

    def walls(self, height: float, thick: float) -> list[Superquadric]:
        x, y = self.half
        return [
            self.box((-x - thick, -y - thick, 0), (-x, y + thick, height)),
            self.box((x, -y - thick, 0), (x + thick, y + thick, height)),
            self.box((-x, -y - thick, 0), (x, -y, height)),
            self.box((-x, y, 0), (x, y + thick, height)),
        ]


Furniture = tuple[list[Superquadric], float]
"""Its parts, and how far below the things the floor is."""


def carton(place: Place, rng: np.random.Generator) -> Furniture:
    x, y, high = *place.half, rng.uniform(0.08, 0.4)
    return [place.box((-x, -y, -high), (x, y, 0))], high


def stool(place: Place, rng: np.random.Generator) -> Furniture:
    x, y, high, thick = *place.half, rng.uniform(0.25, 0.6), rng.uniform(0.02, 0.04)
    legs = [
        place.box((min(a, 0.8 * a), min(b, 0.8 * b), -high), (max(a, 0.8 * a), max(b, 0.8 * b), -thick))
        for a in (-x, x)
        for b in (-y, y)
    ]
    return [place.box((-x, -y, -thick), (x, y, 0)), *legs], high


def shelf_board(place: Place, rng: np.random.Generator) -> Furniture:
    (x, y), down = place.half, rng.uniform(0.5, 1.5)
    wall = place.box((-3.0, y, -down), (3.0, y + 0.05, 2.0))
    return [place.box((-x, -y, -0.02), (x, y, 0)), wall], down


def shelves(place: Place, rng: np.random.Generator) -> Furniture:
    (x, y), thick, down = place.half, 0.02, rng.uniform(0.5, 1.5)
    above, below = place.height + rng.uniform(0.05, 0.2), rng.uniform(0.25, 0.4)
    boards = [place.box((-x, -y, z - thick), (x, y, z)) for z in (0.0, above + thick, -below)]
    sides = [place.box((min(a, a + t), -y, -down), (max(a, a + t), y, 1.0)) for a, t in ((-x, -thick), (x, thick))]
    return [*boards, *sides, place.box((-x, y, -down), (x, y + thick, 1.0))], down


def tray(place: Place, rng: np.random.Generator) -> Furniture:
    return place.walls(rng.uniform(0.015, 0.05), rng.uniform(0.004, 0.01)), 0.0


def bin_(place: Place, rng: np.random.Generator) -> Furniture:
    return place.walls(rng.uniform(0.08, 0.3), rng.uniform(0.003, 0.02)), 0.0


@dataclass(frozen=True)
class Kind:
    """Of furniture: its parts, most things, degrees above it of the camera, radians by which it is turned at most."""

    parts: Callable[[Place, np.random.Generator], Furniture]
    most: int
    elevation: tuple[float, float]
    turn: float


KINDS = {
    "carton": Kind(carton, 3, (20.0, 70.0), np.pi),
    "stool": Kind(stool, 3, (20.0, 70.0), np.pi),
    "shelf board": Kind(shelf_board, 4, (10.0, 50.0), 0.6),
    "shelves": Kind(shelves, 4, (3.0, 30.0), 0.6),
    "tray": Kind(tray, 6, (25.0, 80.0), np.pi),
    "bin": Kind(bin_, 8, (45.0, 90.0), np.pi),
}


def scene(name: str, seed: int) -> tabletop.Tabletop:
    """The scene of a seed; things that the furniture hides altogether are left out."""
    kind = KINDS[name]
    rng = np.random.default_rng([SEED, list(KINDS).index(name), seed])
    for _ in range(_TRIES):
        truth = things_on_table(rng, int(rng.integers(1, kind.most + 1)), TABLE_CAMERA, kind.elevation)
        seen = _furnished(truth, *kind.parts(place := Place.around(truth, rng, kind.turn), rng), place)
        if seen.labels.any():
            break
    return household_things.sensed(seen, seed, list(tabletop.SENSORS)[seed % len(tabletop.SENSORS)], rng)


def _furnished(truth: ThingsOnTable, parts: list[Superquadric], down: float, place: Place) -> ThingsOnTable:
    behind, _ = raycast.render(Superquadric.stack(parts), truth.camera)
    floor = plane_depth(truth.plane + np.array([0, 0, 0, down]), truth.camera)
    behind = np.minimum(np.minimum(behind, floor), truth.wall)
    labels = np.where(truth.depth < behind, truth.labels, 0)
    depth = np.where(labels > 0, truth.depth, behind)
    counts = np.bincount(labels.ravel(), minlength=1 + max(placed.label for placed in truth.placed))
    placed = tuple(replace(one, pixels=int(counts[one.label])) for one in truth.placed if counts[one.label])
    return replace(truth, depth=depth, labels=labels, placed=placed)


def main() -> None:
    parser = report.parser(__doc__, "furniture")
    parser.add_argument("--scenes", type=int, default=40, help="number of scenes of each kind")
    parser.add_argument("--first", type=int, default=61000, help="seed of the first scene")
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.scenes)
    rows = {name: cameras.row([cameras.looked_at(scene(name, seed)) for seed in seeds]) for name in KINDS}
    facts = {"scenes": options.scenes, "first": options.first}
    report.write(options.name, {**facts, "rows": rows}, cameras.table("furniture", rows))


if __name__ == "__main__":
    main()
