"""Scenes of every kind that a segmentation meets, measured by sensors of every kind, with true masks.

| kind | what |
| --- | --- |
| table, low, steep | household things on a table, seen 20 to 70, 3 to 20, 70 to 90 degrees above it |
| flat | two to five cartons or books of 16 to 24 x 12 to 17 cm, each 13 to 35 mm thick, on a table |
| room | a table that ends, and what stands on the floor behind it |
| floor | small things on the floor of a room, beside what is larger than a thing, seen by a robot's camera |
| heap | 20 to 60 bodies of 4 to 7 cm that touch |
| near | 5 to 24 bodies of 2 to 3.5 cm that touch, 0.28 to 0.45 m before a wrist camera |
| crowd | up to twelve superquadrics that touch |
| carton, stool, shelf board, shelves, tray, bin | things in and on :mod:`sq_perception.simulation.furniture` |
| nothing | a table and the room behind it, and no thing |
| label | as table; a band across each thing, or a patch of it, has no reading, as of a dark or shiny label |

A quarter of the images is measured by a sensor of random parameters, the others by one of
:data:`sq_perception.simulation.sensor_noise.PRESETS`; the depth of a third is bent: off by up to 0.5 % of itself,
as a quadratic function of the pixel.  Scene k of a kind follows from (``SEED``, kind, k) alone.  Images are half of VGA
but for one in four, which is VGA.  Metres, optical frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.geometry.union import move
from sq_perception.imaging.camera import Camera
from sq_perception.simulation import furniture, scenes, sensor_noise, thing_views
from sq_perception.simulation.camera_stages import Stages
from sq_perception.simulation.rendering import render_things
from sq_perception.simulation.scenes import plane_depth, turn_about_up
from sq_perception.simulation.thing import NO_CAVITY
from sq_perception.simulation.thing_setting import optical_from_table
from sq_perception.simulation.things_on_table import things_on_table

SEED = 7803
_RANDOM_SENSOR, _BENT, _BEND, _FULL = 0.25, 1 / 3, 0.005, 0.25
_FOCALS = (430.0, 700.0)
"""Pixels at VGA."""
_SHARP = (0.02, 0.1)
"""Exponents of cartons and books."""
_FAR_WALL = 6.0

_Drawn = tuple[np.ndarray, np.ndarray]
"""True depth, +inf where nothing is, and labels, (height, width)."""


@dataclass(frozen=True, eq=False)
class SegmentationScene:
    """A measured image, NaN where nothing was measured, and its true masks, 0 where there is no thing."""

    kind: str
    seed: int
    sensor: str
    depth: np.ndarray
    labels: np.ndarray
    camera: Camera


def scene(kind: str, seed: int) -> SegmentationScene:
    """The scene of a kind and a seed."""
    rng = np.random.default_rng([SEED, list(KINDS).index(kind), seed])
    camera = _camera(rng)
    depth, labels = KINDS[kind](rng, camera)
    sensor = "random"
    if rng.random() < _RANDOM_SENSOR:
        seen = labels > 0 if labels.any() else np.ones(labels.shape, bool)
        measured = thing_views.measure_by_any(depth, seen, camera, Stages(), rng)
    else:
        sensor = str(rng.choice(list(sensor_noise.PRESETS)))
        measured = sensor_noise.preset(sensor).measure(depth, camera, rng)
    if rng.random() < _BENT:
        measured = measured * _bent(camera, rng)
    return SegmentationScene(kind, seed, sensor, measured.astype(np.float32), labels.astype(np.int32), camera)


def _camera(rng: np.random.Generator) -> Camera:
    scale = 1.0 if rng.random() < _FULL else 0.5
    width, height, focal = int(640 * scale), int(480 * scale), scale * rng.uniform(*_FOCALS)
    return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def _bent(camera: Camera, rng: np.random.Generator) -> np.ndarray:
    """Factors (height, width) of a depth that a calibration leaves bent."""
    v, u = np.indices((camera.height, camera.width))
    x, y = 2 * u / (camera.width - 1) - 1, 2 * v / (camera.height - 1) - 1
    form = np.tensordot(rng.normal(size=5), np.stack([x, y, x * x, x * y, y * y]), 1)
    return 1 + rng.uniform(0.2, 1) * _BEND * form / np.abs(form).max()


def _tables(low: float, high: float) -> Callable[[np.random.Generator, Camera], _Drawn]:
    def drawn(rng: np.random.Generator, camera: Camera) -> _Drawn:
        made = things_on_table(rng, camera=camera, elevation=(low, high))
        return made.depth, made.labels

    return drawn


def _labelled(rng: np.random.Generator, camera: Camera) -> _Drawn:
    depth, labels = _tables(20.0, 70.0)(rng, camera)
    for thing in range(1, int(labels.max()) + 1):
        cells = np.argwhere(labels == thing)
        if len(cells) < 20:
            continue
        centred = cells - cells.mean(axis=0)
        across, along = np.linalg.eigh(centred.T @ centred)[1].T
        way, beside = (along, across) if rng.random() < 0.7 else (across, along)
        place, extent, width = centred @ way, np.ptp(centred @ way), np.ptp(centred @ beside)
        hidden = np.abs(place - rng.uniform(-0.25, 0.25) * extent) < rng.uniform(0.05, 0.175) * extent
        if rng.random() > 0.6:
            hidden &= np.abs(centred @ beside) < rng.uniform(0.3, 0.5) * width
        depth[tuple(cells[hidden].T)] = np.inf
    return depth, labels


def _with_room(rng: np.random.Generator, camera: Camera) -> _Drawn:
    made = things_on_table(rng, camera=camera, elevation=(8.0, 50.0))
    return furniture.add_room(made, rng), made.labels


def _nothing(rng: np.random.Generator, camera: Camera) -> _Drawn:
    made = things_on_table(rng, 1, camera, (8.0, 70.0))
    depth = furniture.add_room(made, rng) if rng.random() < 0.6 else made.depth
    empty = np.minimum(plane_depth(made.plane, camera), made.wall)
    return np.where(made.labels > 0, empty, depth), np.zeros_like(made.labels)


def _in_furniture(name: str) -> Callable[[np.random.Generator, Camera], _Drawn]:
    def drawn(rng: np.random.Generator, camera: Camera) -> _Drawn:
        made = furniture.things_in_furniture(name, rng, camera)
        return made.depth, made.labels

    return drawn


def _crowd(rng: np.random.Generator, camera: Camera) -> _Drawn:
    depth, labels = scenes.draw_crowd(rng, int(rng.integers(1, scenes.MOST + 1)), camera).render()
    return np.where(np.isnan(depth), np.inf, depth), labels


def _view(rng: np.random.Generator, elevation: tuple[float, float], distance: float) -> tuple[np.ndarray, np.ndarray]:
    """Optical from the table's frame: a quaternion, and the place of the point that is looked at."""
    look = optical_from_table(rng.uniform(*np.deg2rad(elevation)), rng.normal(0, np.deg2rad(2.0)))
    return look, np.array([0.0, 0.0, distance])


def _rendered(
    rows: list[np.ndarray], look: np.ndarray, eye: np.ndarray, camera: Camera, furniture_from: int, wall: float
) -> _Drawn:
    """Boxes in the table's frame; those from ``furniture_from`` on are no things."""
    table = quaternions.to_matrix(look)
    plane = np.append(table[:, 2], -table[:, 2] @ eye)
    parts = Superquadric.from_flat(move(np.array(rows), look, eye))
    owner = np.arange(len(rows))
    depth, index = render_things(parts, owner, NO_CAVITY, owner[:0], camera, plane, wall)
    return depth, np.where(index < furniture_from, index + 1, 0)


def _upright(half: np.ndarray, shape: np.ndarray, at: np.ndarray, yaw: float) -> np.ndarray:
    """A body on the table."""
    turn = quaternions.from_matrix(turn_about_up(yaw))
    return np.concatenate([half, shape, [at[0], at[1], half[2]], turn])


def _apart(circles: list[tuple[np.ndarray, float]], at: np.ndarray, radius: float) -> bool:
    return all(np.hypot(*(at - other)) > radius + its for other, its in circles)


def _flat(rng: np.random.Generator, camera: Camera) -> _Drawn:
    look, eye = _view(rng, (30.0, 75.0), rng.uniform(0.65, 1.3))
    wanted, rows, circles = int(rng.integers(2, 6)), [], []
    for _ in range(200):
        half = np.array([rng.uniform(0.08, 0.12), rng.uniform(0.06, 0.085), rng.uniform(0.0065, 0.0175)])
        at, radius = rng.normal(0, 0.2, 2), float(np.hypot(*half[:2]))
        body = _upright(half, np.full(2, rng.uniform(*_SHARP)), at, rng.uniform(0, np.pi))
        corners = camera.project(quaternions.to_matrix(look) @ np.append(at, 0) + eye)
        margin = 0.5 * radius * camera.fx / eye[2]
        inside = (corners > margin).all() and (corners < np.array([camera.width, camera.height]) - margin).all()
        if inside and _apart(circles, at, 0.9 * radius):
            rows.append(body)
            circles.append((at, 0.9 * radius))
        if len(rows) == wanted:
            break
    return _rendered(rows, look, eye, camera, len(rows), rng.uniform(1.8, 3.5))


def _heap(
    halves: tuple[float, float], number: tuple[int, int], distances: tuple[float, float], elevation: float
) -> Callable[[np.random.Generator, Camera], _Drawn]:
    """Bodies that touch: their half sizes, how many, at what distances, seen from so many degrees and more."""

    def drawn(rng: np.random.Generator, camera: Camera) -> _Drawn:
        look, eye = _view(rng, (elevation, 80.0), rng.uniform(*distances))
        wanted, rows, circles = int(rng.integers(*number)), [], []
        spread = 1.25 * halves[0] * np.sqrt(wanted)
        for _ in range(4000):
            half = rng.uniform(*halves, 3)
            at, radius = rng.uniform(-spread, spread, 2), float(half[:2].min()) * rng.uniform(1.0, 1.2)
            if _apart(circles, at, radius):
                rows.append(_upright(half, rng.uniform(0.1, 1.0, 2), at, rng.uniform(0, np.pi)))
                circles.append((at, radius))
            if len(rows) == wanted:
                break
        return _rendered(rows, look, eye, camera, len(rows), rng.uniform(1.8, 3.5))

    return drawn


def _floor(rng: np.random.Generator, camera: Camera) -> _Drawn:
    look, eye = _view(rng, (20.0, 50.0), rng.uniform(1.4, 2.5))
    rows, circles = [], []

    def place(half: np.ndarray, shape: np.ndarray, spread: float, ahead: float) -> None:
        for _ in range(50):
            at, radius = np.array([0.0, ahead]) + rng.normal(0, spread, 2), float(np.hypot(*half[:2]))
            if _apart(circles, at, radius):
                rows.append(_upright(half, shape, at, rng.uniform(0, np.pi)))
                circles.append((at, radius))
                return

    for _ in range(int(rng.integers(1, 6))):
        place(rng.uniform(0.04, 0.15, 3), rng.uniform(0.05, 1.0, 2), 0.4, 0.0)
    things = len(rows)
    for _ in range(int(rng.integers(1, 4))):
        high = rng.uniform(0.35, 0.9)
        place(np.array([*rng.uniform(0.15, 0.5, 2), high]), np.full(2, 0.05), 0.8, 0.9)
    return _rendered(rows, look, eye, camera, things, _FAR_WALL)


KINDS: dict[str, Callable[[np.random.Generator, Camera], _Drawn]] = {
    "table": _tables(20.0, 70.0),
    "low": _tables(3.0, 20.0),
    "steep": _tables(70.0, 90.0),
    "flat": _flat,
    "room": _with_room,
    "floor": _floor,
    "heap": _heap((0.02, 0.035), (20, 61), (0.7, 1.0), 45.0),
    "crowd": _crowd,
    **{name: _in_furniture(name) for name in furniture.KINDS},
    "nothing": _nothing,
    "near": _heap((0.01, 0.0175), (5, 25), (0.28, 0.45), 35.0),
    "label": _labelled,
}
