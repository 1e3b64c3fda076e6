"""Canonical views of household objects as cameras see them, with the support function of their hulls: training data.

Each view is what :func:`canonical_view.from_mask` makes of a small pinhole image of the object on its table, after a
sensor measured it: what a network is trained on is made by the code that it will be used with.  The image is drawn as
follows.

    setting     pose, camera and what is around the object: :mod:`sq_perception.simulation.thing_setting`
    before it   in some images something nearer, which comes in from one side
    sensor      with what it loses: :mod:`sq_perception.simulation.thing_sensing`
    mask        too small or too large by up to two pixels, with or without what measured the table, and what nothing
                measured; of some a part is lost
    image       a border that cuts the object

Metres; optical frame of the camera unless noted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.geometry.support_directions import DIRECTIONS
from sq_perception.geometry.union import support_of_union
from sq_perception.imaging import canonical_view
from sq_perception.imaging.camera import Camera
from sq_perception.imaging.canonical_view import CanonicalView
from sq_perception.imaging.coherence import coherent, shown_step
from sq_perception.simulation.camera_stages import Stages, aligned, decimated, decimated_camera, draw_stages
from sq_perception.simulation.household import KINDS, draw_thing
from sq_perception.simulation.thing import Thing
from sq_perception.simulation.thing_sensing import measure_by_any
from sq_perception.simulation.thing_setting import Setting, draw_setting

PLANE_GIVEN, TOP_GIVEN = 0.8, 2 / 3
"""Shares of the views with a plane, and of those of an object on top of something in which it is that top, as often as
:mod:`sq_perception.recovery.supports` finds it.  Else the object hovers above its plane, and a network that often sees
that expects it of objects whose lower end is hidden."""
BEFORE, MOST_BEFORE = 0.25, 0.6
"""Share of the views with something nearer before the object, and the most of the object that it hides.  Chosen: of the
objects of household scenes a quarter are hidden by a tenth and more."""
LOST, MOST_LOST = 0.08, 0.3
"""Share of the views whose mask has lost what lies beyond a straight line, and the most of the object that it loses.
Of objects of household scenes that are 50 to 90 % visible, one in five loses a tenth and more to a segmentation."""

_MASK_ERRORS = (-2, -1, 0, 0, 0, 0, 0, 1, 1, 2)
"""Pixels by which masks are too large, each as often.  Few are too small, as those that are all around are completed
before a view is made (:func:`sq_perception.recovery.seen_object.completed`), and what a stereo camera widens an edge by
looks like them."""
_PIXELS = 64
"""Side of the views: what the network of objects takes."""
_LEAST_SEEN = 40
_OPPOSITE = np.argmin(DIRECTIONS @ DIRECTIONS.T, axis=1)
_ATTEMPTS = 50


@dataclass(frozen=True, eq=False)
class ThingViews:
    """Views of n objects, p x p pixels.

    Attributes
    ----------
    images : float32 (n, p, p)
        As :attr:`CanonicalView.with_steps`: z in (0, 1] on the object.
    planes : float32 (n, 4)
        The plane n.p + d = 0 of the table in the view's frame and unit, n up; zeros where none is given.
    extents : float32 (n,)
        Sides of the views, metres.
    support : float32 (n, 42)
        max n.(p - c) over the object's hull for n of :data:`DIRECTIONS`, c = (1/2, 1/2, NEAREST), in sides of the view.
    kinds : int64 (n,)
        Index into :data:`household.KINDS`.
    """

    images: np.ndarray
    planes: np.ndarray
    extents: np.ndarray
    support: np.ndarray
    kinds: np.ndarray


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
    for _ in range(_ATTEMPTS):
        thing = own[int(rng.integers(len(own)))] if len(own) and rng.random() < 0.5 else draw_thing(rng)
        setting = draw_setting(thing, rng)
        stages = draw_stages(rng)
        measured, seen, camera = _measure(setting, stages, rng)
        plane = None
        below = setting.under if rng.random() < TOP_GIVEN else setting.table
        if below is not None and rng.random() < PLANE_GIVEN:
            plane = _imprecise(below, setting.parts.translation.mean(axis=0), rng)
        if np.count_nonzero(seen & np.isfinite(measured)) < _LEAST_SEEN:
            continue
        mask = _mask(measured, seen, camera, setting.table if plane is None else plane, rng)
        if rng.random() < LOST:
            mask = _partly(mask, rng)
        # Masks from depth end where nothing was measured, those from colour do not.
        if rng.random() >= 0.5:
            mask = mask & np.isfinite(measured)
        measured, mask, camera = _cut(measured, mask, camera, rng)
        if np.count_nonzero(mask & np.isfinite(measured)) < _LEAST_SEEN:
            continue
        view = canonical_view.from_mask(measured, mask, camera, _PIXELS, plane=plane, missing_is_hidden=True)
        reach = support_in_view(setting.parts, view)
        if np.abs(reach).max() > 3.0 or (reach + reach[_OPPOSITE]).max() < 0.6:
            continue
        return thing, view, np.zeros(4) if plane is None else view.plane_to_canonical(plane), reach
    raise RuntimeError(f"no view of a thing shows {_LEAST_SEEN} pixels of it in {_ATTEMPTS} attempts")


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
        return aligned(measured, sensor, place, camera, stages.whole), seen, camera
    depth, seen = _something_before(depth, seen, rng)
    if stages.decimation > 1:
        half = slice(stages.decimation // 2, None, stages.decimation)
        kept = decimated_camera(camera, stages.decimation)
        shown = np.s_[: kept.height, : kept.width]
        measured = measure_by_any(depth, seen, camera, stages, rng) if seen.any() else depth
        return decimated(measured, stages.decimation), seen[half, half][shown], kept
    return measure_by_any(depth, seen, camera, stages, rng) if seen.any() else depth, seen, camera


def _something_before(depth: np.ndarray, seen: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return image and mask, some with an occluder from one side: a straight edge, a corner or a round object."""
    if rng.random() > BEFORE or not seen.any():
        return depth, seen
    v, u = np.nonzero(seen)
    side = max(np.ptp(u), np.ptp(v)) + 1
    across, down = np.meshgrid(np.arange(depth.shape[1]) - u.mean(), np.arange(depth.shape[0]) - v.mean())
    way = rng.uniform(-np.pi, np.pi)
    c, s = np.cos(way), np.sin(way)
    bow = 0.0 if rng.random() < 0.5 else rng.uniform(-1.0, 4.0)
    other = np.abs((c * down - s * across) / side - rng.uniform(-0.2, 0.2)) ** rng.integers(1, 3)
    reach = (c * across + s * down) / side - bow * other
    front = np.quantile(reach[seen], 1 - rng.uniform(0, MOST_BEFORE))
    thick = rng.uniform(0.1, 0.4) if rng.random() < 0.2 else np.inf
    before = (reach > front) & (reach < front + thick)
    near = depth[seen].min() * rng.uniform(0.6, 0.97)
    return np.where(before, np.minimum(near, depth), depth), seen & ~before


def _imprecise(plane: np.ndarray, at: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the plane as it would be found: tilted about the point below ``at`` and shifted."""
    normal = plane[:3] + np.deg2rad(0.7) * rng.standard_normal(3)
    normal /= np.linalg.norm(normal)
    foot = at - (plane[:3] @ at + plane[3]) * plane[:3]
    return np.append(normal, -(normal @ foot) + rng.normal(0, 0.002))


def _mask(
    measured: np.ndarray, seen: np.ndarray, camera: Camera, table: np.ndarray | None, rng: np.random.Generator
) -> np.ndarray:
    """Draw a mask as from a segmentation or a person, without readings of the table, as in views of images."""
    error = int(rng.choice(_MASK_ERRORS))
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


def _partly(mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Remove from the mask what lies beyond a straight line."""
    v, u = np.nonzero(mask)
    if not v.size:
        return mask
    way, rest = rng.uniform(-np.pi, np.pi), mask.copy()
    reach = np.cos(way) * u + np.sin(way) * v
    lost = reach > np.quantile(reach, 1 - rng.uniform(0, MOST_LOST))
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
