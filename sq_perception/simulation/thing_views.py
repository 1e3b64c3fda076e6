"""Canonical views of household objects as cameras see them, with the support function of their hulls: training data.

Each view is what :func:`canonical_view.from_mask` makes of a small pinhole image of the object on its table:

    setting     pose, camera and what is around the object: :mod:`sq_perception.simulation.thing_setting`
    before it   in some images something nearer, which comes in from one side
    sensor      of :mod:`sensor_noise` with random parameters; in some images waves, a side that is lost as one eye
                hardly sees it, lost edges, contours, dark blobs and bands, objects that are lost but for patches,
                smoothing.  In half of them what is missing beside the object is filled with what is there.  Last come
                the camera's :mod:`~sq_perception.simulation.camera_stages`
    mask        too small or too large by up to two pixels, with or without what measured the table, and what nothing
                measured; of some a part is lost
    image       a border that cuts the object

Metres; optical frame of the camera unless noted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.geometry.union import DIRECTIONS, support_of_union
from sq_perception.imaging import canonical_view
from sq_perception.imaging.camera import Camera
from sq_perception.imaging.canonical_view import CanonicalView
from sq_perception.imaging.depth_steps import coherent, shown_step
from sq_perception.simulation.camera_stages import Stages, align, decimate, decimate_camera, draw_stages, temporal
from sq_perception.simulation.household import KINDS, draw_thing
from sq_perception.simulation.sensor_noise import Ideal, SensorNoise, Stereo, StructuredLight, TimeOfFlight
from sq_perception.simulation.thing import Thing
from sq_perception.simulation.thing_setting import Setting, draw_setting

_PIXELS = 64  # side of the views: what the network of objects takes
PROCESSED = 0.5
"""Share of the views whose depth passes through random stages after the sensor; few drawn cameras have none at all."""
_LEAST_SEEN = 40


@dataclass(frozen=True, eq=False)
class ThingViews:
    """Views of n objects, p x p pixels."""

    images: np.ndarray  # float32 (n, p, p), as :attr:`CanonicalView.with_steps`: z in (0, 1] on the object
    planes: np.ndarray
    """float32 (n, 4), the plane n.p + d = 0 of the table in the view's frame and unit, n up; zeros where none is
    given."""
    extents: np.ndarray  # float32 (n,), sides of the views, metres
    support: np.ndarray
    """float32 (n, 42), max n.(p - c) over the object's hull for n of :data:`DIRECTIONS`, c = (1/2, 1/2, NEAREST), in
    sides of the view."""
    kinds: np.ndarray  # int64 (n,), index into :data:`household.KINDS`


def draw_thing_views(count: int, rng: np.random.Generator, own: Sequence[Thing] = ()) -> ThingViews:
    """Draw views of ``count`` random objects, half of them of ``own`` objects if there are any."""
    images = np.empty((count, _PIXELS, _PIXELS), dtype=np.float32)
    planes, extents = np.zeros((count, 4), np.float32), np.empty(count, np.float32)
    support, numbers = np.empty((count, len(DIRECTIONS)), np.float32), np.empty(count, dtype=np.int64)
    for k in range(count):
        thing, view, plane, reach = _draw_one(rng, own)
        images[k], planes[k], extents[k], support[k] = view.with_steps, plane, view.extent, reach
        numbers[k] = KINDS.index(thing.kind)
    return ThingViews(images, planes, extents, support, numbers)


def support_in_view(parts: Superquadric, view: CanonicalView) -> np.ndarray:
    """Return the support function (42,) of a union in the optical frame, as in :class:`ThingViews`."""
    directions = DIRECTIONS @ quaternions.to_matrix(view.rotation)
    return (support_of_union(parts, directions) - directions @ view.anchor) / view.extent


def _draw_one(rng: np.random.Generator, own: Sequence[Thing]) -> tuple[Thing, CanonicalView, np.ndarray, np.ndarray]:
    """Draw an object, its view, the plane in the view's frame and its support function."""
    attempts = 50
    for _ in range(attempts):
        thing = own[int(rng.integers(len(own)))] if len(own) and rng.random() < 0.5 else draw_thing(rng)
        setting = draw_setting(thing, rng)
        stages = draw_stages(rng) if rng.random() < PROCESSED else Stages()
        measured, seen, camera = _measure(setting, stages, rng)
        plane = None
        # Of an object on top of something the plane is that top as often as recovery finds it.  Else the object hovers
        # above its plane, and a network that often sees that expects it of objects whose lower end is hidden.
        below = setting.under if rng.random() < 2 / 3 else setting.table
        if below is not None and rng.random() < 0.8:
            plane = _disturb_plane(below, setting.parts.translation.mean(axis=0), rng)
        if np.count_nonzero(seen & np.isfinite(measured)) < _LEAST_SEEN:
            continue
        mask = _mask(measured, seen, camera, setting.table if plane is None else plane, rng)
        # Of household objects that are 50 to 90 % visible, one in five loses a tenth and more to a segmentation.
        if rng.random() < 0.08:
            mask = _cut_off(mask, rng)
        # Masks from depth end where nothing was measured, those from colour do not.
        if rng.random() >= 0.5:
            mask = mask & np.isfinite(measured)
        measured, mask, camera = _cut(measured, mask, camera, rng)
        if np.count_nonzero(mask & np.isfinite(measured)) < _LEAST_SEEN:
            continue
        view = canonical_view.from_mask(measured, mask, camera, _PIXELS, plane=plane, missing_is_hidden=True)
        reach = support_in_view(setting.parts, view)
        widths = reach + reach[np.argmin(DIRECTIONS @ DIRECTIONS.T, axis=1)]  # with the opposite directions
        if np.abs(reach).max() > 3.0 or widths.max() < 0.6:
            continue
        return thing, view, np.zeros(4) if plane is None else view.plane_to_canonical(plane), reach
    raise RuntimeError(f"no view of a thing shows {_LEAST_SEEN} pixels of it in {attempts} attempts")


def _measure(setting: Setting, stages: Stages, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, Camera]:
    """Draw the image of a camera with these stages, the object's visible pixels, and the camera."""
    camera = setting.camera
    depth, seen = setting.render()
    if stages.beside:
        # The sensor is beside the camera that the image is aligned to, and sees the thing at the same place.
        place = np.array([stages.beside, 0.0, 0.0])
        size = round(camera.width * stages.focal), round(camera.height * stages.focal)
        middle = setting.parts.translation[:, 2].mean()
        cx = stages.focal * (camera.cx + camera.fx * stages.beside / middle)
        sensor = Camera(*size, stages.focal * camera.fx, stages.focal * camera.fy, cx, stages.focal * camera.cy)
        near, whose = setting.view_from(place, sensor).render()
        measured = measure_by_any(near, whose, sensor, stages, rng) if whose.any() else near
        return align(measured, sensor, place, camera, stages.whole), seen, camera
    depth, seen = _add_occluder(depth, seen, rng)
    if stages.decimation > 1:
        half = slice(stages.decimation // 2, None, stages.decimation)
        kept = decimate_camera(camera, stages.decimation)
        shown = np.s_[: kept.height, : kept.width]
        measured = measure_by_any(depth, seen, camera, stages, rng) if seen.any() else depth
        return decimate(measured, stages.decimation), seen[half, half][shown], kept
    return measure_by_any(depth, seen, camera, stages, rng) if seen.any() else depth, seen, camera


def _add_occluder(depth: np.ndarray, seen: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return image and mask, some with an occluder from one side: a straight edge, a corner or a round object."""
    if rng.random() > 0.25 or not seen.any():
        return depth, seen
    v, u = np.nonzero(seen)
    side = max(np.ptp(u), np.ptp(v)) + 1
    across, down = np.meshgrid(np.arange(depth.shape[1]) - u.mean(), np.arange(depth.shape[0]) - v.mean())
    way = rng.uniform(-np.pi, np.pi)
    c, s = np.cos(way), np.sin(way)
    bow = 0.0 if rng.random() < 0.5 else rng.uniform(-1.0, 4.0)
    other = np.abs((c * down - s * across) / side - rng.uniform(-0.2, 0.2)) ** rng.integers(1, 3)
    reach = (c * across + s * down) / side - bow * other
    front = np.quantile(reach[seen], 1 - rng.uniform(0, 0.6))
    thick = rng.uniform(0.1, 0.4) if rng.random() < 0.2 else np.inf
    before = (reach > front) & (reach < front + thick)
    near = depth[seen].min() * rng.uniform(0.6, 0.97)
    return np.where(before, np.minimum(near, depth), depth), seen & ~before


def _disturb_plane(plane: np.ndarray, at: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the plane as it would be found: tilted about the point below ``at`` and shifted."""
    normal = plane[:3] + np.deg2rad(0.7) * rng.standard_normal(3)
    normal /= np.linalg.norm(normal)
    foot = at - (plane[:3] @ at + plane[3]) * plane[:3]
    return np.append(normal, -(normal @ foot) + rng.normal(0, 0.002))


def _mask(
    measured: np.ndarray, seen: np.ndarray, camera: Camera, table: np.ndarray | None, rng: np.random.Generator
) -> np.ndarray:
    """Draw a mask as from a segmentation or a person, without readings of the table, as in views of images."""
    # Few masks are too small, as those that are all around are completed before a view is made
    # (recovery.seen_object.complete), and what a stereo camera widens an edge by looks like them.
    error = int(rng.choice((-2, -1, 0, 0, 0, 0, 0, 1, 1, 2)))
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
        above[rows, columns] = ~(points @ table[:3] + table[3] <= 0.003)
        inner = above if 2 * np.count_nonzero(above) > rows.size else inner
    footprint = float(np.median(measured[seen][np.isfinite(measured[seen])], axis=0)) / camera.fx
    return coherent(measured, inner, shown_step(footprint))


def _cut_off(mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Remove from the mask what lies beyond a straight line."""
    v, u = np.nonzero(mask)
    if not v.size:
        return mask
    way, rest = rng.uniform(-np.pi, np.pi), mask.copy()
    reach = np.cos(way) * u + np.sin(way) * v
    lost = reach > np.quantile(reach, 1 - rng.uniform(0, 0.3))
    rest[v[lost], u[lost]] = False
    return rest


def _cut(
    measured: np.ndarray, mask: np.ndarray, camera: Camera, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, Camera]:
    """Return image, mask and camera, in some cases cropped within or near the object."""
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


def draw_sensor(camera: Camera, rng: np.random.Generator) -> SensorNoise:
    """Draw a depth sensor with random parameters around those of :data:`sensor_noise.PRESETS`."""
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
    return Stereo(**shared, subpixel=rng.uniform(0.02, 0.15), fattening=int(rng.integers(0, 4)))


def measure_by_any(
    depth: np.ndarray, seen: np.ndarray, camera: Camera, stages: Stages, rng: np.random.Generator
) -> np.ndarray:
    """Measure a true depth image with a random sensor and these camera stages."""
    sensor = draw_sensor(camera, rng)
    frames = [sensor.measure(depth, camera, rng) for _ in range(stages.frames)]
    measured = temporal(frames, stages.factor, stages.threshold) if len(frames) > 1 else frames[0]
    if rng.random() < 0.4:
        measured += _waves(measured.shape, rng) * np.square(measured)
    if rng.random() < 0.35:
        measured[seen & _turn_aside(depth, camera, rng)] = np.nan
    if rng.random() < 0.25:
        measured[_edges(depth, rng)] = np.nan
    if rng.random() < 0.1:
        measured[seen & _contours(depth, seen, rng)] = np.nan
    if rng.random() < 0.15:
        measured[seen & _blob(seen, rng)] = np.nan
    # Of household objects that are half visible, 4 % are measured at less than half of their pixels.
    if rng.random() < 0.08:
        measured[seen & _all_but_patches(seen, rng)] = np.nan
    if rng.random() < 0.3:
        measured = _smooth(measured, int(rng.choice((3, 5))), seen if rng.random() < 0.5 else None)
    if rng.random() < 0.5:
        filled = ~seen & np.isnan(measured) & np.isfinite(depth)
        measured[filled] = depth[filled]
    return stages.process(measured, seen, camera)


def _waves(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Draw smooth errors, metres at 1 m, as calibration and disparity interpolation leave them."""
    coarse = rng.standard_normal((int(rng.integers(4, 14)), int(rng.integers(4, 14))), dtype=np.float32)
    sigma = np.float32(0.0005 * 8.0 ** rng.random())
    return sigma * cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)


def _edges(depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Select most pixels within one to three pixels of a depth step."""
    inverse = (1 / depth).astype(np.float32)
    brush = np.ones((3, 3), np.uint8)
    highest = cv2.dilate(inverse, brush)
    step: np.ndarray = (highest - cv2.erode(inverse, brush) > 0.06 * highest).astype(np.uint8)
    wider = int(rng.integers(0, 3))
    if wider:
        step = cv2.dilate(step, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * wider + 1, 2 * wider + 1)))
    return (step > 0) & (rng.random(depth.shape, dtype=np.float32) < rng.uniform(0.4, 1.0))


def _contours(depth: np.ndarray, seen: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Select thin lines of equal disparity, where some sensors that measure in steps find no match."""
    inverse = 1 / depth
    near, far = inverse[seen].max(), inverse[seen].min()
    lines = rng.uniform(1.5, 6.0) / max(near - far, 1e-6)
    return (inverse * lines + rng.random()) % 1.0 < rng.uniform(0.03, 0.12)


def _turn_aside(depth: np.ndarray, camera: Camera, rng: np.random.Generator) -> np.ndarray:
    """Select surfaces that turn away to one side of the image by more than a random angle."""
    with np.errstate(invalid="ignore"):
        slope = cv2.Sobel(depth, cv2.CV_64F, 1, 0, ksize=1) * (0.5 * camera.fx) / depth
        return rng.choice([-1.0, 1.0]) * slope > np.tan(np.deg2rad(rng.uniform(45, 82)))


def _blob(seen: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Select a dark label: an ellipse or a band somewhere on the object."""
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


def _all_but_patches(seen: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Select most of an object that is shiny, dark or translucent."""
    coarse = rng.standard_normal((int(rng.integers(3, 12)), int(rng.integers(3, 12))), dtype=np.float32)
    field = cv2.resize(coarse, (seen.shape[1], seen.shape[0]), interpolation=cv2.INTER_CUBIC)
    return field > np.quantile(field[seen], 1 - rng.uniform(0.3, 0.95))


def _smooth(measured: np.ndarray, width: int, within: np.ndarray | None) -> np.ndarray:
    """Average the readings of a window, all of them or only those within a mask."""
    known = np.isfinite(measured)
    inner = known if within is None else known & within
    weight = cv2.blur(inner.astype(np.float32), (width, width))
    mean = cv2.blur(np.where(inner, measured, np.float32(0)), (width, width)) / np.maximum(weight, np.float32(1e-6))
    return np.where(inner, mean, measured)
