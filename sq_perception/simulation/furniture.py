"""Household objects in and on furniture, instead of on a plain table; and the room behind a table.

| | the plane that objects stand on is | beside it |
| --- | --- | --- |
| carton | the top of a box 8 to 40 cm high | the floor |
| stool | the top of a board on four legs, 25 to 60 cm high | the floor |
| shelf board | the top of a board 2 cm thick | a wall right behind it, the floor 0.5 to 1.5 m below |
| shelves | the same | a back, two sides, a board above and one below, the floor |
| tray | the table | four walls 1.5 to 5 cm high around the objects |
| bin | the table | four walls 8 to 30 cm high |

A carton counts as an object too, where its label is visible, though it was not placed; other furniture does not.

Cameras also see what is beyond a table, which is no object on it.  The table of a room ends along a line behind the
objects, across a direction a that leads away from the camera, turned by up to 70 degrees.  Behind it is a floor, or a
lower table, 5 to 90 cm below; on its visible part stand up to ten superquadrics, sharp or rounded, with edges of 4 cm
to 1 m, that may reach above the table: boxes, bins, chairs and shelves.

Metres, optical frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera
from sq_perception.simulation.scenes import plane_depth, turn_about_up
from sq_perception.simulation.things_on_table import TABLE_CAMERA, ThingsOnTable, things_on_table


@dataclass(frozen=True, eq=False)
class _Place:
    """The smallest rectangle around all objects along some direction, and a margin."""

    axes: np.ndarray  # (3, 3), columns: along its sides, and up. The second one leads away from the camera
    middle: np.ndarray  # (3,), on the plane that objects stand on
    half: np.ndarray  # (2,), half its sides
    height: float  # height of the highest object, metres

    @classmethod
    def around(cls, scene: ThingsOnTable, rng: np.random.Generator, turn: float) -> _Place:
        axes = scene.table @ turn_about_up(rng.uniform(-turn, turn))
        parts = [placed.parts for placed in scene.placed]
        high = np.max([(each.translation @ axes + each.support(axes.T)).max(axis=0) for each in parts], axis=0)
        low = np.min([(each.translation @ axes - each.support(-axes.T)).min(axis=0) for each in parts], axis=0)
        low[:2] -= rng.uniform(0.02, 0.12, 2)  # free board around all objects
        high[:2] += rng.uniform(0.02, 0.12, 2)
        ground = -scene.plane[3]
        middle = axes @ np.array([*(low + high)[:2] / 2, ground])
        return cls(axes, middle, (high - low)[:2] / 2, float(high[2] - ground))

    def box(self, low: tuple[float, float, float], high: tuple[float, float, float]) -> Superquadric:
        """Return a box between two corners, relative to the middle."""
        below, above = np.array(low), np.array(high)
        centre = self.middle + self.axes @ (below + above) / 2
        return Superquadric((above - below) / 2, np.full(2, 0.02), centre, quaternions.from_matrix(self.axes))

    def walls(self, height: float, thick: float) -> list[Superquadric]:
        x, y = self.half
        return [
            self.box((-x - thick, -y - thick, 0), (-x, y + thick, height)),
            self.box((x, -y - thick, 0), (x + thick, y + thick, height)),
            self.box((-x, -y - thick, 0), (x, -y, height)),
            self.box((-x, y, 0), (x, y + thick, height)),
        ]


_Parts = tuple[list[Superquadric], float]  # parts of a piece of furniture, and how far below the objects the floor is


def _carton(place: _Place, rng: np.random.Generator) -> _Parts:
    x, y, high = *place.half, rng.uniform(0.08, 0.4)
    return [place.box((-x, -y, -high), (x, y, 0))], high


def _stool(place: _Place, rng: np.random.Generator) -> _Parts:
    x, y, high, thick = *place.half, rng.uniform(0.25, 0.6), rng.uniform(0.02, 0.04)
    legs = [
        place.box((min(a, 0.8 * a), min(b, 0.8 * b), -high), (max(a, 0.8 * a), max(b, 0.8 * b), -thick))
        for a in (-x, x)
        for b in (-y, y)
    ]
    return [place.box((-x, -y, -thick), (x, y, 0)), *legs], high


def _shelf_board(place: _Place, rng: np.random.Generator) -> _Parts:
    (x, y), down = place.half, rng.uniform(0.5, 1.5)
    wall = place.box((-3.0, y, -down), (3.0, y + 0.05, 2.0))
    return [place.box((-x, -y, -0.02), (x, y, 0)), wall], down


def _shelves(place: _Place, rng: np.random.Generator) -> _Parts:
    (x, y), thick, down = place.half, 0.02, rng.uniform(0.5, 1.5)
    above, below = place.height + rng.uniform(0.05, 0.2), rng.uniform(0.25, 0.4)
    boards = [place.box((-x, -y, z - thick), (x, y, z)) for z in (0.0, above + thick, -below)]
    sides = [place.box((min(a, a + t), -y, -down), (max(a, a + t), y, 1.0)) for a, t in ((-x, -thick), (x, thick))]
    return [*boards, *sides, place.box((-x, y, -down), (x, y + thick, 1.0))], down


def _tray(place: _Place, rng: np.random.Generator) -> _Parts:
    return place.walls(rng.uniform(0.015, 0.05), rng.uniform(0.004, 0.01)), 0.0


def _bin(place: _Place, rng: np.random.Generator) -> _Parts:
    return place.walls(rng.uniform(0.08, 0.3), rng.uniform(0.003, 0.02)), 0.0


@dataclass(frozen=True)
class _Kind:
    """A kind of furniture: its parts, the most objects on it, the camera's elevation in degrees, its largest turn in
    radians, and whether it is an object itself."""

    parts: Callable[[_Place, np.random.Generator], _Parts]
    most: int
    elevation: tuple[float, float]
    turn: float
    is_thing: bool = False


_KINDS = {
    "carton": _Kind(_carton, 3, (20.0, 70.0), np.pi, is_thing=True),
    "stool": _Kind(_stool, 3, (20.0, 70.0), np.pi),
    "shelf board": _Kind(_shelf_board, 4, (10.0, 50.0), 0.6),
    "shelves": _Kind(_shelves, 4, (3.0, 30.0), 0.6),
    "tray": _Kind(_tray, 6, (25.0, 80.0), np.pi),
    "bin": _Kind(_bin, 8, (45.0, 90.0), np.pi),
}
KINDS = tuple(_KINDS)


def things_in_furniture(name: str, rng: np.random.Generator, camera: Camera = TABLE_CAMERA) -> ThingsOnTable:
    """Draw objects in or on a piece of furniture, one of ``KINDS``, without hidden ones; they stand on ``plane``.
    Raises ValueError if they do not fit into the image, or the furniture always hides all of them."""
    kind = _KINDS[name]
    for _ in range(20):
        scene = things_on_table(rng, int(rng.integers(1, kind.most + 1)), camera, kind.elevation)
        seen = _furnish(scene, *kind.parts(_Place.around(scene, rng, kind.turn), rng), kind.is_thing)
        if seen.placed:
            return seen
    raise ValueError(f"things in {name}: none is in sight")


def _furnish(scene: ThingsOnTable, parts: list[Superquadric], down: float, is_thing: bool) -> ThingsOnTable:
    furniture, _ = raycast.render(Superquadric.stack(parts), scene.camera)
    beyond = np.minimum(plane_depth(scene.plane + np.array([0, 0, 0, down]), scene.camera), scene.wall)
    behind = np.minimum(furniture, beyond)
    most = max(placed.label for placed in scene.placed)
    in_sight = (scene.labels > 0) & (scene.depth < behind)
    around = np.where(is_thing & (furniture < beyond), np.int32(most + 1), np.int32(0))
    labels, depth = np.where(in_sight, scene.labels, around), np.where(in_sight, scene.depth, behind)
    counts = np.bincount(labels.ravel(), minlength=most + 1)
    placed = tuple(replace(one, pixels=int(counts[one.label])) for one in scene.placed if counts[one.label])
    return replace(scene, depth=depth, labels=labels, placed=placed)


_TURN = float(np.deg2rad(70.0))


def add_room(scene: ThingsOnTable, rng: np.random.Generator) -> np.ndarray:
    """Return the depth (height, width) of a scene with a room behind its table; its objects and occluders stay."""
    camera, normal = scene.camera, scene.plane[:3]
    angle = rng.uniform(-_TURN, _TURN)
    away = scene.table @ np.array([np.sin(angle), np.cos(angle), 0.0])
    rows, columns = np.nonzero(scene.labels)
    if not rows.size:
        return scene.depth
    farthest = (camera.unproject(columns, rows, scene.depth[rows, columns]) @ away).max()
    edge = farthest + rng.uniform(0.03, 0.4)
    table = plane_depth(scene.plane, camera)
    v, u = np.nonzero(np.isfinite(table))
    on_table = np.zeros(table.shape, bool)
    on_table[v, u] = camera.unproject(u, v, table[v, u]) @ away < edge
    floor = np.append(normal, scene.plane[3] + rng.uniform(0.05, 0.9))
    ground = plane_depth(floor, camera)
    free = np.nonzero((scene.labels == 0) & ~on_table & np.isfinite(ground))
    if not free[0].size:
        return scene.depth
    chosen = rng.integers(free[0].size, size=int(rng.integers(1, 11)))
    feet = camera.unproject(free[1][chosen], free[0][chosen], ground[free][chosen])
    standing = Superquadric.stack([_stand_behind_table(foot, edge, away, scene.table, rng) for foot in feet])
    seen = np.minimum(np.minimum(ground, raycast.render(standing, camera)[0]), scene.wall)
    return np.where((scene.labels > 0) | on_table, scene.depth, seen)


def _stand_behind_table(
    foot: np.ndarray, edge: float, away: np.ndarray, table: np.ndarray, rng: np.random.Generator
) -> Superquadric:
    """Return a body on the floor below a point, moved from the table if it would reach under its top."""
    least, most = np.log((0.02, 0.5))
    size, turn = np.exp(rng.uniform(least, most, 3)), turn_about_up(rng.uniform(0, np.pi))
    clear = foot @ away - edge - np.hypot(*size[:2])
    centre = foot - min(clear, 0.0) * away + size[2] * table[:, 2]
    return Superquadric(size, rng.uniform(0.1, 1.0, 2), centre, quaternions.from_matrix(table @ turn))
