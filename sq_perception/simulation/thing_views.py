"""Canonical views of household things as cameras see them, with the support function of their hulls: training data.

Each view is what :func:`canonical_view.from_mask` makes of a small pinhole image of the thing on its table, after a
sensor measured it: what a network is trained on is made by the code that it will be used with.  The image is drawn as
follows.

    pose        standing, lying, leaning (:meth:`Thing.pose`), on the table, on top of something, or free in any pose
    camera      5 to 85 degrees above the table, most 20 to 70; a roll of some degrees; off the image's middle by up to
                27 degrees; 0.35 to 2 m away; the thing is 30 to 80 pixels wide
    around it   up to three neighbours on the table, something before it, the table's end, a wall or nothing behind it
    sensor      one of :mod:`sensor_noise` with random parameters: noise of a window, steps, the shadow of the baseline
                on either side, fattened or mixed or wandering edges, lost grazing sides; besides waves, a side that is
                lost as one eye hardly sees it, lost edges, contours, dark blobs and bands, smoothing; in half of the
                views what is missing beside the thing is filled with what is there
    mask        too small or too large by up to two pixels, with or without what measured the table
    image       a border that cuts the thing

Metres; optical frame of the camera where nothing else is said.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.geometry.support_directions import DIRECTIONS
from sq_perception.geometry.union import flat_support, moved, support_of_union
from sq_perception.imaging import canonical_view
from sq_perception.imaging.camera import Camera
from sq_perception.imaging.canonical_view import CanonicalView
from sq_perception.imaging.coherence import coherent
from sq_perception.simulation.household import KINDS, NO_CAVITY, SIX_WAYS, Thing, draw_thing
from sq_perception.simulation.mesh_rendering import render_mesh
from sq_perception.simulation.sensor_noise import Ideal, SensorNoise, Stereo, StructuredLight, TimeOfFlight
from sq_perception.simulation.thing_rendering import render_things

ON_TOP, FREE = 0.10, 0.05
"""Shares of the views in which the thing stands on something on the table, and in which there is no table."""
OWN = 0.5
"""Share of the views that show one's own things, where there are such."""
PLANE_GIVEN = 0.8
PLANE_TILT, PLANE_SHIFT = float(np.deg2rad(0.7)), 0.002
"""Standard deviations of the given plane: of its tilt in both directions, and of its distance from the thing."""

_DISTANCE = (0.35, 1.3, 2.0)
_FARTHEST = 12.0
"""Diagonals of its box, more than which no thing is away."""
_FOCALS = (425.0, 525.0, 580.0, 615.0, 700.0, 920.0)
"""Pixels: depth cameras at VGA to HD."""
_PIXELS_ACROSS = (30.0, 80.0)
_OFF_AXIS = (0.5, 0.4)
_AROUND = 0.7
"""Half of the image's side over the thing's width."""
_LEAST_SEEN = 40
_LARGEST_SUPPORT, _LEAST_WIDTH = 3.0, 0.6
_OPPOSITE = np.argmin(DIRECTIONS @ DIRECTIONS.T, axis=1)
_ATTEMPTS = 50
_ON_TABLE = 0.003
_JUMP_PIXELS, _JUMP = 10.0, 0.002


@dataclass(frozen=True, eq=False)
class ThingViews:
    """Views of n things, p x p pixels.

    Attributes
    ----------
    images : float32 (n, p, p)
        As :attr:`CanonicalView.marked`: z in (0, 1], 0 background, HIDDEN where the thing may go on unseen.
    planes : float32 (n, 4)
        The plane n.p + d = 0 of the table in the view's frame and unit, n up; zeros where none is given.
    extents : float32 (n,)
        Sides of the views, metres.
    support : float32 (n, 42)
        max n.(p - c) over the thing's hull for n of :data:`DIRECTIONS`, c = (1/2, 1/2, NEAREST), in sides of the view.
    kinds : int64 (n,)
        Index into :data:`household.KINDS`.
    """

    images: np.ndarray
    planes: np.ndarray
    extents: np.ndarray
    support: np.ndarray
    kinds: np.ndarray


@dataclass(frozen=True, eq=False)
class Setting:
    """A thing before a camera, in the optical frame.

    Attributes
    ----------
    parts, cavities : Superquadric
        Of the thing, (k,) and (m,).
    others : Superquadric
        Batch (j,), j >= 0: neighbours, and what it stands on.
    table : (4,) or None
        n.p + d = 0, n up.
    behind : float
        Depth of the wall behind all, +inf without one.
    camera : Camera
    surface : (n, 3), (m, 3), optional
        Vertices and faces of the thing's mesh, if it is seen as one.
    """

    parts: Superquadric
    cavities: Superquadric
    others: Superquadric
    table: np.ndarray | None
    behind: float
    camera: Camera
    surface: tuple[np.ndarray, np.ndarray] | None = None

    def render(self) -> tuple[np.ndarray, np.ndarray]:
        """Depth (height, width), +inf where there is nothing, and where the thing is seen."""
        if self.surface is not None:
            around = np.ones(len(self.others))
            depth, _ = render_things(self.others, around, NO_CAVITY, np.zeros(0), self.camera, self.table, self.behind)
            near = render_mesh(*self.surface, self.camera)
            return np.minimum(depth, near), near < depth
        bodies = Superquadric.from_flat(np.concatenate([self.parts.to_flat(), self.others.to_flat()]))
        owner = np.arange(len(bodies)) >= len(self.parts)
        whose = np.zeros(len(self.cavities))
        depth, index = render_things(bodies, owner, self.cavities, whose, self.camera, self.table, self.behind)
        return depth, index == 0


def draw_thing_views(
    count: int,
    rng: np.random.Generator,
    pixels: int = 64,
    kinds: Sequence[str] | None = None,
    own: Sequence[Thing] = (),
) -> ThingViews:
    """Views of ``count`` random things, half of them one's ``own`` where there are such.

    ``kinds`` as of :func:`household.draw_thing`, for the others.
    """
    images = np.empty((count, pixels, pixels), dtype=np.float32)
    planes, extents = np.zeros((count, 4), np.float32), np.empty(count, np.float32)
    support, numbers = np.empty((count, len(DIRECTIONS)), np.float32), np.empty(count, dtype=np.int64)
    for k in range(count):
        thing, view, plane, reach = _draw_one(rng, pixels, kinds, own)
        images[k], planes[k], extents[k], support[k] = view.marked, plane, view.extent, reach
        numbers[k] = KINDS.index(thing.kind)
    return ThingViews(images, planes, extents, support, numbers)


def support_in_view(parts: Superquadric, view: CanonicalView) -> np.ndarray:
    """The support function (42,) of a union, given in the optical frame, as :class:`ThingViews` has it."""
    directions = DIRECTIONS @ quaternions.to_matrix(view.rotation)
    return (support_of_union(parts, directions) - directions @ view.anchor) / view.extent


def _draw_one(
    rng: np.random.Generator, pixels: int, kinds: Sequence[str] | None, own: Sequence[Thing]
) -> tuple[Thing, CanonicalView, np.ndarray, np.ndarray]:
    """A thing, its view, the plane in the view's frame and its support function."""
    for _ in range(_ATTEMPTS):
        thing = own[int(rng.integers(len(own)))] if len(own) and rng.random() < OWN else draw_thing(rng, kinds)
        setting = draw_setting(thing, rng)
        depth, seen = setting.render()
        depth, seen = _something_before(depth, seen, rng)
        if np.count_nonzero(seen) < _LEAST_SEEN:
            continue
        measured = _measured(depth, seen, setting.camera, rng)
        plane = None
        if setting.table is not None and rng.random() < PLANE_GIVEN:
            plane = _imprecise(setting.table, setting.parts.translation.mean(axis=0), rng)
        if np.count_nonzero(seen & np.isfinite(measured)) < _LEAST_SEEN:
            continue
        mask = _masked(measured, seen, setting.camera, setting.table if plane is None else plane, rng)
        measured, mask, camera = _cut(measured, mask, setting.camera, rng)
        if np.count_nonzero(mask & np.isfinite(measured)) < _LEAST_SEEN:
            continue
        view = canonical_view.from_mask(measured, mask, camera, pixels, plane=plane, missing_is_hidden=True)
        reach = support_in_view(setting.parts, view)
        if np.abs(reach).max() > _LARGEST_SUPPORT or (reach + reach[_OPPOSITE]).max() < _LEAST_WIDTH:
            continue
        return thing, view, np.zeros(4) if plane is None else view.plane_to_canonical(plane), reach
    raise RuntimeError(f"no view of a thing shows {_LEAST_SEEN} pixels of it in {_ATTEMPTS} attempts")


def draw_setting(thing: Thing, rng: np.random.Generator) -> Setting:
    """The thing in a random pose before a random camera; see the module."""
    free = rng.random() < FREE
    turn = quaternions.random(1, rng)[0] if free else thing.pose(rng)[1]
    parts = moved(thing.parts.to_flat(), turn, np.zeros(3))
    reach = flat_support(parts, SIX_WAYS)
    others, floor = [], 0.0
    if not free:
        if rng.random() < ON_TOP:
            floor = -rng.uniform(0.02, 0.2)
            others.append(_stand(reach, floor, rng))
        others += _neighbours(parts, floor, rng)

    elevation = np.deg2rad(rng.uniform(20, 70) if rng.random() < 0.75 else rng.uniform(5, 85))
    roll = rng.normal(0, np.deg2rad(4.0)) if rng.random() < 0.93 else rng.uniform(-np.pi, np.pi)
    aside, below = rng.uniform(-1, 1, 2) * _OFF_AXIS
    look = looking_down(elevation - np.arctan(below), roll)
    matrix = quaternions.to_matrix(look)
    near, usual, far = _DISTANCE
    distance = np.exp(rng.uniform(np.log(near), np.log(usual if rng.random() < 0.85 else far)))
    distance = min(distance, _FARTHEST * float(np.linalg.norm(reach[:3] + reach[3:])))
    ray = np.array([aside, below, 1.0])
    # The table's frame has its origin below the thing, at the height of its lowest point.
    lift = np.array([0.0, 0.0, reach[5]])
    shift = distance * ray / np.linalg.norm(ray) - matrix @ (lift + 0.5 * (reach[:3] - reach[3:]))
    parts = moved(parts, look, shift + matrix @ lift)
    surface = None
    if thing.surface is not None:
        vertices, faces = thing.surface
        surface = vertices @ (matrix @ quaternions.to_matrix(turn)).T + shift + matrix @ lift, faces
    cavities = thing.cavities
    if len(cavities):
        cavities = Superquadric.from_flat(
            moved(cavities.to_flat(), quaternions.multiply(look, turn), shift + matrix @ lift)
        )
    table = None if free else np.append(matrix[:, 2], -(matrix[:, 2] @ shift) - floor)
    behind = distance * rng.uniform(1.3, 3.0) if rng.random() < 0.85 else np.inf
    around = moved(np.array(others).reshape(-1, 12), look, shift)
    camera = _camera(parts, rng)
    thing_parts, others_around = Superquadric.from_flat(parts), Superquadric.from_flat(around)
    return Setting(thing_parts, cavities, others_around, table, behind, camera, surface)


def looking_down(pitch: float, roll: float) -> np.ndarray:
    """Optical from table frame, a quaternion: the axis ``pitch`` radians below the horizon, towards the table's y."""
    half, other = 0.5 * (np.pi / 2 + pitch), 0.5 * roll
    c, s = np.cos(half), np.sin(half)
    return np.array([s * np.cos(other), s * np.sin(other), c * np.sin(other), c * np.cos(other)])


def _camera(parts: np.ndarray, rng: np.random.Generator) -> Camera:
    """A camera whose image is the thing and what is around it."""
    right, down, _, left, up, _ = flat_support(parts, SIX_WAYS)
    z = float(parts[:, 7].mean())
    width = max(right + left, down + up)
    focal = rng.choice(_FOCALS) * rng.uniform(0.9, 1.1)
    across = min(max(focal * width / z, _PIXELS_ACROSS[0]), rng.uniform(*_PIXELS_ACROSS))
    focal = across * z / width
    half = int(np.ceil(_AROUND * across)) + 4
    u, v = focal * 0.5 * (right - left) / z, focal * 0.5 * (down - up) / z
    return Camera(2 * half, 2 * half, focal, focal, half - u, half - v)


def _stand(reach: np.ndarray, floor: float, rng: np.random.Generator) -> np.ndarray:
    """A flat part (12,) under the thing, from the table up to height 0."""
    half = np.array([0.5 * (reach[0] + reach[3]), 0.5 * (reach[1] + reach[4])]) * rng.uniform(0.6, 1.8, 2)
    middle = 0.5 * (reach[:2] - reach[3:5])
    e2 = 1.0 if rng.random() < 0.2 else 0.08
    return np.array([*half, -floor / 2, 0.05, e2, *middle, floor / 2, 0.0, 0.0, 0.0, 1.0])


def _neighbours(parts: np.ndarray, floor: float, rng: np.random.Generator) -> list[np.ndarray]:
    """Up to three parts (12,) beside the thing, as seen from above; many between it and the camera, many touch it."""
    rows = []
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
        rows.append(row)
    return rows


def _something_before(depth: np.ndarray, seen: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """In some images something nearer that comes in from one side: a straight edge, a corner or a round thing."""
    if rng.random() > 0.15 or not seen.any():
        return depth, seen
    v, u = np.nonzero(seen)
    side = max(np.ptp(u), np.ptp(v)) + 1
    across, down = np.meshgrid(np.arange(depth.shape[1]) - u.mean(), np.arange(depth.shape[0]) - v.mean())
    way = rng.uniform(-np.pi, np.pi)
    c, s = np.cos(way), np.sin(way)
    bow = 0.0 if rng.random() < 0.5 else rng.uniform(-1.0, 4.0)
    other = np.abs((c * down - s * across) / side - rng.uniform(-0.2, 0.2)) ** rng.integers(1, 3)
    reach = (c * across + s * down) / side - bow * other
    front = np.quantile(reach[seen], 1 - rng.uniform(0, 0.5))
    thick = rng.uniform(0.1, 0.4) if rng.random() < 0.2 else np.inf
    before = (reach > front) & (reach < front + thick)
    near = depth[seen].min() * rng.uniform(0.6, 0.97)
    return np.where(before, np.minimum(near, depth), depth), seen & ~before


def draw_sensor(camera: Camera, rng: np.random.Generator) -> SensorNoise:
    """A depth sensor with random parameters around those of :data:`sensor_noise.PRESETS`."""
    choice = rng.random()
    if choice < 0.1:
        return Ideal(rng.uniform(0, 0.001))
    if choice < 0.35:
        near = rng.uniform(0.1, 0.3)
        return TimeOfFlight(near, rng.uniform(3.0, 5.0), rng.uniform(0.0, 2.0), rng.uniform(0.0, 1.0))
    grazing = rng.uniform(55, 80)
    shared: dict[str, Any] = {
        "focal": camera.fx,
        "baseline": rng.choice([-1.0, 1.0]) * rng.uniform(0.02, 0.12),
        "step": rng.choice([0.0, 1 / 32, 1 / 8]),
        "window": (int(rng.choice([1, 3, 5, 7])), int(rng.choice([1, 3, 5]))),
        "near": 0.1,
        "far": 10.0,
        "edge_wander": rng.uniform(0.0, 1.2),
        "grazing": grazing,
        "blind": rng.uniform(grazing, 89),
    }
    if choice < 0.65:
        return StructuredLight(**shared)
    return Stereo(**shared, subpixel=rng.uniform(0.02, 0.15), fattening=int(rng.integers(0, 3)))


def _measured(depth: np.ndarray, seen: np.ndarray, camera: Camera, rng: np.random.Generator) -> np.ndarray:
    """What a random sensor reports of a true depth image."""
    sensor = draw_sensor(camera, rng)
    measured = sensor.measured(depth, camera, rng)
    if rng.random() < 0.4:
        measured += _waves(measured.shape, rng) * np.square(measured)
    if rng.random() < 0.35:
        measured[seen & _turned_aside(depth, camera, rng)] = np.nan
    if rng.random() < 0.35:
        measured[_edges(depth, rng)] = np.nan
    if rng.random() < 0.1:
        measured[seen & _contours(depth, seen, rng)] = np.nan
    if rng.random() < 0.15:
        measured[seen & _blob(seen, rng)] = np.nan
    if rng.random() < 0.3:
        measured = _smoothed(measured, int(rng.choice((3, 5))), seen if rng.random() < 0.5 else None)
    if rng.random() < 0.5:
        filled = ~seen & np.isnan(measured) & np.isfinite(depth)
        measured[filled] = depth[filled]
    return measured


def _waves(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Smooth errors, metres at 1 m: what calibration and the interpolation of disparities leave."""
    coarse = rng.standard_normal((int(rng.integers(4, 14)), int(rng.integers(4, 14))), dtype=np.float32)
    sigma = np.float32(0.0005 * 8.0 ** rng.random())
    return sigma * cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)


def _edges(depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Most pixels within one to three pixels of a step in depth."""
    inverse = (1 / depth).astype(np.float32)
    brush = np.ones((3, 3), np.uint8)
    highest = cv2.dilate(inverse, brush)
    step: np.ndarray = (highest - cv2.erode(inverse, brush) > 0.06 * highest).astype(np.uint8)
    wider = int(rng.integers(0, 3))
    if wider:
        step = cv2.dilate(step, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * wider + 1, 2 * wider + 1)))
    return (step > 0) & (rng.random(depth.shape, dtype=np.float32) < rng.uniform(0.4, 1.0))


def _contours(depth: np.ndarray, seen: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Thin lines of equal disparity, at which some sensors that measure in steps find no match."""
    inverse = 1 / depth
    near, far = inverse[seen].max(), inverse[seen].min()
    lines = rng.uniform(1.5, 6.0) / max(near - far, 1e-6)
    return (inverse * lines + rng.random()) % 1.0 < rng.uniform(0.03, 0.12)


def _turned_aside(depth: np.ndarray, camera: Camera, rng: np.random.Generator) -> np.ndarray:
    """Surfaces that turn away to one side of the image by more than a random angle."""
    with np.errstate(invalid="ignore"):
        slope = cv2.Sobel(depth, cv2.CV_64F, 1, 0, ksize=1) * (0.5 * camera.fx) / depth
        return rng.choice([-1.0, 1.0]) * slope > np.tan(np.deg2rad(rng.uniform(45, 82)))


def _blob(seen: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A dark label: an ellipse or a band somewhere on the thing."""
    v, u = np.nonzero(seen)
    at = rng.integers(v.size)
    side = max(np.ptp(u), np.ptp(v)) + 1
    down, across = np.indices(seen.shape, dtype=float)
    way = rng.uniform(0, np.pi)
    c, s = np.cos(way), np.sin(way)
    x, y = c * (across - u[at]) + s * (down - v[at]), c * (down - v[at]) - s * (across - u[at])
    wide = side * rng.uniform(0.03, 0.2)
    long = np.inf if rng.random() < 0.3 else side * rng.uniform(0.05, 0.3)
    return np.square(x / long) + np.square(y / wide) < 1


def _smoothed(measured: np.ndarray, width: int, within: np.ndarray | None) -> np.ndarray:
    """The mean of the readings of a window, of all of them or of those within a mask alone."""
    known = np.isfinite(measured)
    inner = known if within is None else known & within
    weight = cv2.blur(inner.astype(np.float32), (width, width))
    mean = cv2.blur(np.where(inner, measured, np.float32(0)), (width, width)) / np.maximum(weight, np.float32(1e-6))
    return np.where(inner, mean, measured)


def _imprecise(plane: np.ndarray, at: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The plane as it is found: tilted about the point below ``at`` and shifted."""
    normal = plane[:3] + PLANE_TILT * rng.standard_normal(3)
    normal /= np.linalg.norm(normal)
    foot = at - (plane[:3] @ at + plane[3]) * plane[:3]
    return np.append(normal, -(normal @ foot) + rng.normal(0, PLANE_SHIFT))


def _masked(
    measured: np.ndarray, seen: np.ndarray, camera: Camera, table: np.ndarray | None, rng: np.random.Generator
) -> np.ndarray:
    """The mask that a segmentation or a person draws, less what measured the table, as the views of images have it."""
    error = rng.choice((-2, -1, -1, -1, 0, 0, 0, 1, 1, 2))
    mask: np.ndarray = seen.astype(np.uint8)
    if error:
        brush = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(error) + 1, 2 * abs(error) + 1))
        mask = cv2.dilate(mask, brush) if error > 0 else cv2.erode(mask, brush)
    if mask.sum() < _LEAST_SEEN:
        mask = seen.astype(np.uint8)
    inner = mask > 0
    if table is not None and rng.random() < 0.9:
        rows, columns = np.nonzero(inner)
        points = camera.unproject(columns, rows, measured[rows, columns])
        above = inner.copy()
        # A pixel without a reading stays: its comparison is False.
        above[rows, columns] = ~(points @ table[:3] + table[3] <= _ON_TABLE)
        inner = above if 2 * np.count_nonzero(above) > rows.size else inner
    footprint = float(np.median(measured[seen][np.isfinite(measured[seen])], axis=0)) / camera.fx
    return coherent(measured, inner, _JUMP_PIXELS * footprint + _JUMP)


def _cut(
    measured: np.ndarray, mask: np.ndarray, camera: Camera, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, Camera]:
    """Some images end within the thing or near to it."""
    if rng.random() > 0.1:
        return measured, mask, camera
    v, u = np.nonzero(mask)
    if not v.size:
        return measured, mask, camera
    left, top, right, bottom = 0, 0, camera.width, camera.height
    share, side = rng.uniform(-0.1, 0.4), rng.integers(4)
    if side == 0:
        left = int(np.clip(u.min() + share * np.ptp(u), 0, right - 2))
    elif side == 1:
        right = int(np.clip(u.max() + 1 - share * np.ptp(u), 2, right))
    elif side == 2:
        top = int(np.clip(v.min() + share * np.ptp(v), 0, bottom - 2))
    else:
        bottom = int(np.clip(v.max() + 1 - share * np.ptp(v), 2, bottom))
    window = np.s_[top:bottom, left:right]
    return measured[window], mask[window], camera.cropped(left, top, right - left, bottom - top)
