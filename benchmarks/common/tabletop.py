"""Seeded scenes of household things on a table, as a depth sensor sees them.

A pinhole camera of 640 x 480 pixels, 60 degrees wide, looks down on the table at 25 to 65 degrees from 0.5 to 1.2 m.
The table is a rectangle; beside it one sees the floor, 0.75 m lower.  1 to 8 things (:mod:`mesh_things`) lie on it in
stable poses, wholly inside the image, farther than the sensor's shortest distance, their outlines on the table at least
``GAP`` apart: no two penetrate, but many stand close by each other or before each other.

The table's frame has x to the right, y away from the camera, z up; its origin is the point looked at.

Masks are the true pixels: what the sensor makes of edges is not in them.  A thing's visible share is the number of its
pixels over those that it would have alone.

Metres; optical frame; heights above the table = n.p + d.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull

from common import mesh_things
from common.mesh_things import MeshThing
from sq_perception.imaging.camera import Camera
from sq_perception.simulation import sensor_noise
from sq_perception.simulation.rendering import Mesh, render_mesh
from sq_perception.simulation.scenes import plane_depth

SENSORS = {"stereo": "realsense_d435", "structured light": "kinect_v1"}
"""Scenes of even seeds are seen by the first, those of odd seeds by the second."""
CAMERA = Camera(640, 480, 320 / np.tan(np.deg2rad(30)), 320 / np.tan(np.deg2rad(30)), 319.5, 239.5)
MOST = 8
DISTANCE = (0.5, 1.2)
ELEVATION = (25.0, 65.0)
ROLL = 5.0
GAP = 0.003
NEAREST = 0.35
TABLE_SIDES = ((1.0, 1.6), (0.65, 0.9))
FLOOR = 0.75
_STREAM = 7701
_TRIES = 40
_SPREADS = 12
_MARGIN = 1.0


@dataclass(frozen=True, eq=False)
class Placed:
    """One thing of a scene.

    Attributes
    ----------
    rest
        How it lies.
    rotation, translation : (3, 3), (3,)
        Camera from thing.
    label
        Its value in the label image.
    pixels, alone
        How many pixels show it, and would if it were alone.
    """

    thing: MeshThing
    rest: str
    rotation: np.ndarray
    translation: np.ndarray
    label: int
    pixels: int
    alone: int

    @property
    def visible_share(self) -> float:
        return self.pixels / self.alone

    @property
    def hull(self) -> np.ndarray:
        """Corners (n, 3) of its convex hull in the optical frame."""
        return self.thing.hull @ self.rotation.T + self.translation


@dataclass(frozen=True, eq=False)
class Tabletop:
    """A scene, its image and its truth.

    Attributes
    ----------
    depth, true_depth : float32, float64 (height, width)
        As measured, NaN where nothing was; as it is, +inf where nothing is.
    labels : int32 (height, width)
        True masks, 0 for what is no thing.
    plane : (4,)
        Of the table.
    table : (3, 3)
        Columns: to the right along the table, away from the camera along it, up; in the optical frame.
    """

    seed: int
    sensor: str
    camera: Camera
    depth: np.ndarray
    true_depth: np.ndarray
    labels: np.ndarray
    plane: np.ndarray
    table: np.ndarray
    placed: tuple[Placed, ...]


@dataclass(frozen=True, eq=False)
class _Stand:
    """Where the camera and the table are."""

    table: np.ndarray
    origin: np.ndarray
    yaw: float
    sides: np.ndarray
    nearest: float

    @property
    def plane(self) -> np.ndarray:
        return np.append(self.table[:, 2], -self.table[:, 2] @ self.origin)

    def holds(self, outline: np.ndarray) -> bool:
        """Whether points (n, 2) of the table's frame lie on the table."""
        along = outline @ about_z(self.yaw)[:2, :2]
        return bool((np.abs(along) < self.sides / 2).all())


def scene(seed: int, scans: Path | None = None, sensor: str | None = None) -> Tabletop:
    """The scene of a seed.

    Parameters
    ----------
    seed
        The same one, with the same other arguments, gives the same scene and the same noise.
    scans
        The folder of scanned objects; without it there are none of them.
    sensor
        One of ``SENSORS``; by default the seed decides.
    """
    sensor = sensor or list(SENSORS)[seed % len(SENSORS)]
    rng = np.random.default_rng([_STREAM, seed])
    model = sensor_noise.preset(SENSORS[sensor])
    nearest = max(NEAREST, getattr(model, "near", 0.0) + 0.01)
    scanned = mesh_things.scans(scans)
    count = int(rng.integers(1, MOST + 1))
    while True:
        things = [mesh_things.draw(rng, scanned) for _ in range(count)]
        for _ in range(_TRIES):
            stand = _stand(rng, nearest)
            poses = _arranged(things, stand, rng)
            if poses is not None:
                return _seen(seed, sensor, model, stand, things, poses, rng)


def outline(points: np.ndarray) -> np.ndarray:
    """Corners (n, 2), counterclockwise, of the convex outline of points (m, 2 or more)."""
    flat = points[:, :2]
    return flat[ConvexHull(flat).vertices]


def gap(first: np.ndarray, second: np.ndarray) -> float:
    """The widest strip between two convex outlines, at most their distance; negative where they overlap."""
    widest = -np.inf
    for one, other in ((first, second), (second, first)):
        along = np.roll(one, -1, axis=0) - one
        normal = np.stack([along[:, 1], -along[:, 0]], 1) / np.linalg.norm(along, axis=1, keepdims=True)
        reach = np.einsum("ij,ij->i", normal, one)
        widest = max(widest, float(((normal @ other.T).min(axis=1) - reach).max()))
    return widest


def _stand(rng: np.random.Generator, nearest: float) -> _Stand:
    down, roll = np.deg2rad([rng.uniform(*ELEVATION), rng.uniform(-ROLL, ROLL)])
    origin = np.array([0.0, 0.0, rng.uniform(*DISTANCE)])
    sides = np.array([rng.uniform(*side) for side in TABLE_SIDES])
    return _Stand(about_z(roll) @ looked_down_on(down), origin, rng.uniform(-0.5, 0.5), sides, nearest)


def _arranged(things: list[MeshThing], stand: _Stand, rng: np.random.Generator) -> list[tuple[str, np.ndarray]] | None:
    """A rest and a pose (4, 4) on the table for each thing; None where they find no room."""
    poses: list[tuple[str, np.ndarray]] = []
    outlines: list[np.ndarray] = []
    spread = 0.05 + rng.uniform(0.2, 0.9) * np.sqrt(sum(np.prod(thing.edges[1:]) for thing in things))
    for thing in things:
        for k in range(_TRIES * _SPREADS):
            wider = 1.15 ** (k // _TRIES)
            rest, pose = _lying(thing, spread * wider, rng)
            corners = thing.hull @ pose[:3, :3].T + pose[:3, 3]
            flat = outline(corners)
            apart = all(gap(flat, other) >= GAP for other in outlines)
            if apart and stand.holds(flat) and _in_view(corners @ stand.table.T + stand.origin, stand.nearest):
                poses.append((rest, pose))
                outlines.append(flat)
                break
        else:
            return None
    return poses


def _lying(thing: MeshThing, spread: float, rng: np.random.Generator) -> tuple[str, np.ndarray]:
    """One of the rests of a thing, turned about the vertical, its middle at most ``spread`` from the origin."""
    rest = thing.rests[rng.choice(len(thing.rests), p=[each.likely for each in thing.rests])]
    yaw, bearing, radius = rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi), spread * np.sqrt(rng.random())
    turn = about_z(yaw) @ rest.turn
    corners = thing.hull @ turn.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    pose = np.eye(4)
    pose[:3, :3] = turn
    pose[:3, 3] = [radius * np.cos(bearing), radius * np.sin(bearing), 0] - np.append((low + high)[:2] / 2, low[2])
    return rest.name, pose


def _in_view(corners: np.ndarray, nearest: float) -> bool:
    if corners[:, 2].min() < nearest:
        return False
    pixels = CAMERA.project(corners)
    limit = np.array([CAMERA.width, CAMERA.height]) - 1 - _MARGIN
    return bool((pixels > _MARGIN).all() and (pixels < limit).all())


def rendered(
    things: Sequence[tuple[MeshThing, str, np.ndarray, np.ndarray]], behind: np.ndarray
) -> tuple[np.ndarray, np.ndarray, tuple[Placed, ...]]:
    """Depth and labels (height, width) of things before a background, and these as they are placed.

    Each comes with its rest, rotation (3, 3) and translation (3,), camera from thing.
    """
    depth, labels, alone = behind, np.zeros(behind.shape, np.int32), []
    for k, (thing, _, turn, place) in enumerate(things):
        own = render_mesh(Mesh(thing.mesh.vertices @ turn.T + place, np.asarray(thing.mesh.faces)), CAMERA)
        nearer = own < depth
        depth, labels = np.where(nearer, own, depth), np.where(nearer, np.int32(k + 1), labels)
        alone.append(int(np.count_nonzero(np.isfinite(own))))
    pixels = np.bincount(labels.ravel(), minlength=len(things) + 1)[1:]
    placed = [Placed(*each, k + 1, int(pixels[k]), alone[k]) for k, each in enumerate(things)]
    return depth, labels, tuple(placed)


def _seen(
    seed: int,
    sensor: str,
    model: sensor_noise.SensorNoise,
    stand: _Stand,
    things: list[MeshThing],
    poses: list[tuple[str, np.ndarray]],
    rng: np.random.Generator,
) -> Tabletop:
    lying = [
        (thing, rest, stand.table @ pose[:3, :3], stand.table @ pose[:3, 3] + stand.origin)
        for thing, (rest, pose) in zip(things, poses, strict=True)
    ]
    depth, labels, placed = rendered(lying, _background(stand))
    measured = model.measure(depth, CAMERA, rng)
    return Tabletop(seed, sensor, CAMERA, measured, depth, labels, stand.plane, stand.table, placed)


def _background(stand: _Stand) -> np.ndarray:
    """The table, and the floor beside it; +inf beyond."""
    plane = stand.plane
    table = plane_depth(plane, CAMERA)
    points = CAMERA.points(np.where(np.isfinite(table), table, 1e3)) - stand.origin
    along = (points @ stand.table[:, :2]) @ about_z(stand.yaw)[:2, :2]
    on_table = np.isfinite(table) & (np.abs(along) < stand.sides / 2).all(axis=-1)
    return np.where(on_table, table, plane_depth(plane + [0, 0, 0, FLOOR], CAMERA))


def looked_down_on(down: float) -> np.ndarray:
    """Columns: right, away and up on a table, in the optical frame of a camera that looks down by so many radians."""
    return np.array([[1.0, 0, 0], [0, -np.sin(down), -np.cos(down)], [0, np.cos(down), -np.sin(down)]])


def about_z(angle: float) -> np.ndarray:
    """The rotation (3, 3) about z by so many radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
