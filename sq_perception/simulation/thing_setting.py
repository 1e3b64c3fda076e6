"""An object before a camera, in a random pose with surroundings; metres, optical frame unless noted.

pose        standing, lying, leaning (:meth:`Thing.pose`), on the table, on top of something, or free in any pose
camera      sees the object from 20 to 70 degrees above the table, in a quarter from 65 to 90 (many robots' cameras look
            straight down), in a fifth from 3 to 25; a roll of some degrees; off the image's middle by up to 27 degrees;
            0.35 to 2 m away; the object is 15 to 80 pixels wide
around it   up to three neighbours on the table, the table's end, a wall or nothing behind it
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.geometry.union import flat_support, move
from sq_perception.imaging.camera import Camera
from sq_perception.simulation.rendering import Mesh, render_mesh, render_things
from sq_perception.simulation.thing import NO_CAVITY, SIX_WAYS, Thing


@dataclass(frozen=True, eq=False)
class Setting:
    """An object before a camera, in the optical frame."""

    parts: Superquadric
    cavities: Superquadric  # the object's own, as parts are: batches (k,) and (m,)
    others: Superquadric  # batch (j,), j >= 0: neighbours, and what it stands on
    table: np.ndarray | None  # (4,), n.p + d = 0, n up
    behind: float  # depth of the wall behind all, +inf without one
    camera: Camera
    surface: Mesh | None = None  # the object's surface, if it is seen as a mesh
    height: float = 0.0  # height above the table of the object's support, metres

    @property
    def under(self) -> np.ndarray | None:
        """The surface that the object stands on, as ``table``: that, or along it the top of something."""
        return None if self.table is None else self.table - np.array([0.0, 0.0, 0.0, self.height])

    def view_from(self, place: np.ndarray, camera: Camera) -> Setting:
        """Return the same setting for a camera at ``place`` (3,) with the same orientation."""

        def shift(bodies: Superquadric) -> Superquadric:
            return replace(bodies, translation=bodies.translation - place)

        table = None if self.table is None else self.table + np.array([0.0, 0.0, 0.0, self.table[:3] @ place])
        surface = None if self.surface is None else Mesh(self.surface.vertices - place, self.surface.faces)
        parts, cavities, others = shift(self.parts), shift(self.cavities), shift(self.others)
        return Setting(parts, cavities, others, table, self.behind - place[2], camera, surface, self.height)

    def render(self) -> tuple[np.ndarray, np.ndarray]:
        """Render depth (height, width), +inf for no surface, and the object's visible pixels."""
        if self.surface is not None:
            around = np.ones(len(self.others))
            depth, _ = render_things(self.others, around, NO_CAVITY, np.zeros(0), self.camera, self.table, self.behind)
            near = render_mesh(self.surface, self.camera)
            return np.minimum(depth, near), near < depth
        bodies = Superquadric.from_flat(np.concatenate([self.parts.to_flat(), self.others.to_flat()]))
        owner = np.arange(len(bodies)) >= len(self.parts)
        whose = np.zeros(len(self.cavities))
        depth, index = render_things(bodies, owner, self.cavities, whose, self.camera, self.table, self.behind)
        return depth, index == 0


def draw_setting(thing: Thing, rng: np.random.Generator) -> Setting:
    """Draw a random pose of the object before a random camera; see the module."""
    free = rng.random() < 0.05
    turn = quaternions.random(1, rng)[0] if free else thing.pose(rng)[1]
    parts = move(thing.parts.to_flat(), turn, np.zeros(3))
    reach = flat_support(parts, SIX_WAYS)
    others, floor = [], 0.0
    if not free:
        if rng.random() < 0.15:
            floor = -rng.uniform(0.02, 0.2)
            others.append(_stand(reach, floor, rng))
        others = _with_neighbours(others, parts, floor, rng)

    # The table's frame has its origin below the thing, at the height of its lowest point.
    lift = np.array([0.0, 0.0, reach[5]])
    look, shift, distance = _camera_pose(parts, reach, lift, rng)
    matrix = quaternions.to_matrix(look)
    parts = move(parts, look, shift + matrix @ lift)
    surface = None
    if thing.surface is not None:
        placed = thing.surface.vertices @ (matrix @ quaternions.to_matrix(turn)).T + shift + matrix @ lift
        surface = Mesh(placed, thing.surface.faces)
    cavities = thing.cavities
    if len(cavities):
        cavities = Superquadric.from_flat(
            move(cavities.to_flat(), quaternions.multiply(look, turn), shift + matrix @ lift)
        )
    table = None if free else np.append(matrix[:, 2], -(matrix[:, 2] @ shift) - floor)
    behind = distance * rng.uniform(1.3, 3.0) if rng.random() < 0.85 else np.inf
    around = move(np.array(others).reshape(-1, 12), look, shift)
    camera = _camera(parts, rng)
    thing_parts, others_around = Superquadric.from_flat(parts), Superquadric.from_flat(around)
    return Setting(thing_parts, cavities, others_around, table, behind, camera, surface, -floor)


def _camera_pose(
    parts: np.ndarray, reach: np.ndarray, lift: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, float]:
    """Draw the optical from table pose, quaternion (4,) and translation (3,), and the distance of parts (k, 12) with
    the support ``reach`` (6,) in SIX_WAYS; ``lift`` (3,) leads to the table's frame."""
    # Of a network that saw 0.5 % from above 80 degrees the hulls there erred half as much again as those at 20 to 70.
    elevations = (20.0, 70.0), (65.0, 90.0), (3.0, 25.0)
    elevation = np.deg2rad(rng.uniform(*rng.choice(elevations, p=(0.55, 0.25, 0.2))))
    roll = rng.normal(0, np.deg2rad(4.0)) if rng.random() < 0.93 else rng.uniform(-np.pi, np.pi)
    aside, below = rng.uniform(-1, 1, 2) * (0.5, 0.4)
    ray = np.array([aside, below, 1.0])
    look = optical_from_table(_pitch(ray, elevation, roll), roll)
    matrix = quaternions.to_matrix(look)
    near, usual, far = 0.35, 1.3, 2.0
    distance = np.exp(rng.uniform(np.log(near), np.log(usual if rng.random() < 0.85 else far)))
    distance = min(distance, 12.0 * float(np.linalg.norm(reach[:3] + reach[3:])))
    middle = 0.5 * (reach[:3] - reach[3:])
    towards = -matrix[2]
    before = float(flat_support(parts, towards[None])[0] - towards @ middle)
    # Long objects are farther away: none comes nearer than 5 cm to the camera.
    distance = max(distance, (before + 0.05) * float(np.linalg.norm(ray)))
    return look, distance * ray / np.linalg.norm(ray) - matrix @ (lift + middle), distance


def level_directions(count: int) -> np.ndarray:
    """Return unit vectors (count, 3) all around, at right angles to z."""
    bearings = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return np.stack([np.cos(bearings), np.sin(bearings), 0 * bearings], axis=1)


def optical_from_table(pitch: float, roll: float) -> np.ndarray:
    """Return the optical from table quaternion: the axis ``pitch`` below the horizon, towards the table's y."""
    half, other = 0.5 * (np.pi / 2 + pitch), 0.5 * roll
    c, s = np.cos(half), np.sin(half)
    return np.array([s * np.cos(other), s * np.sin(other), c * np.sin(other), c * np.cos(other)])


def _pitch(ray: np.ndarray, elevation: float, roll: float) -> float:
    """Return the pitch, radians, of a camera whose ray meets the table at ``elevation``, or as steeply as it can.  With
    r the ray, its length one, turned back by the roll, r_y cos p + r_z sin p = sin(elevation)."""
    x, y, z = ray / np.linalg.norm(ray)
    y = np.cos(roll) * y - np.sin(roll) * x
    return float(np.arcsin(min(np.sin(elevation) / np.hypot(y, z), 1.0)) - np.arctan2(y, z))


def _camera(parts: np.ndarray, rng: np.random.Generator) -> Camera:
    """Draw a camera whose image shows the object and its surroundings."""
    right, down, _, left, up, _ = flat_support(parts, SIX_WAYS)
    z = float(parts[:, 7].mean())
    width = max(right + left, down + up)
    # Depth cameras at VGA to HD.
    focal = rng.choice((425.0, 525.0, 580.0, 615.0, 700.0, 920.0)) * rng.uniform(0.9, 1.1)
    least, most = 15.0, 80.0
    across = min(max(focal * width / z, least), rng.uniform(least, most))
    focal = across * z / width
    half = int(np.ceil(0.7 * across)) + 4
    u, v = focal * 0.5 * (right - left) / z, focal * 0.5 * (down - up) / z
    return Camera(2 * half, 2 * half, focal, focal, half - u, half - v)


def _stand(reach: np.ndarray, floor: float, rng: np.random.Generator) -> np.ndarray:
    """Return a flat part (12,) under the object, from the table up to height 0."""
    half = np.array([0.5 * (reach[0] + reach[3]), 0.5 * (reach[1] + reach[4])]) * rng.uniform(0.6, 1.8, 2)
    middle = 0.5 * (reach[:2] - reach[3:5])
    e2 = 1.0 if rng.random() < 0.2 else 0.08
    return np.array([*half, -floor / 2, 0.05, e2, *middle, floor / 2, 0.0, 0.0, 0.0, 1.0])


def _with_neighbours(
    others: list[np.ndarray], parts: np.ndarray, floor: float, rng: np.random.Generator
) -> list[np.ndarray]:
    """Add up to three parts (12,) beside the object, many before it, many touching it, without penetration."""
    rows, level = list(others), level_directions(32)
    for _ in range(rng.choice((0, 0, 0, 0, 1, 1, 1, 2, 2, 3))):
        size = np.exp(rng.uniform(np.log(0.02), np.log(0.1), 3))
        shape = rng.uniform(0.1, 1.0, 2) ** [1.0, 0.7]
        turn = rng.uniform(0, np.pi)
        bearing = rng.uniform(-np.pi, np.pi) if rng.random() < 0.6 else rng.normal(-np.pi / 2, 0.7)
        way = np.array([np.cos(bearing), np.sin(bearing), 0.0])
        rotation = np.array([0.0, 0.0, np.sin(turn / 2), np.cos(turn / 2)])
        row = np.array([*size, *shape, 0.0, 0.0, floor + size[2], *rotation])
        gap = 0.0 if rng.random() < 0.3 else rng.uniform(0, 0.08)
        far = flat_support(parts, way[None])[0] + flat_support(row[None], -way[None])[0] + gap
        row[5:7] = far * way[:2] + rng.normal(0, 0.02) * np.array([-way[1], way[0]])
        # One of some vertical planes parts it from each of the others.
        reach = flat_support(row[None], level)
        if all((reach + flat_support(other[None], -level) <= 0).any() for other in rows):
            rows.append(row)
    return rows
