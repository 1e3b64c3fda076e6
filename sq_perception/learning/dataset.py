"""Training data drawn and rendered on the fly: bodies of the thesis' protocol in their canonical views.

The protocol itself is in :mod:`sq_perception.simulation.scenes`; depth comes in 255 integer steps a unit, as in its
images.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast, unit_cube
from sq_perception.learning.choices import Framing
from sq_perception.learning.disturbance import Disturbance
from sq_perception.learning.positions import move_bodies, move_images
from sq_perception.simulation.scenes import THESIS_SIZE, thesis_bodies
from sq_perception.simulation.view_rendering import Occluder, render_views

GREY_LEVELS = 255.0
CAMERA_DISTANCE = (1.5, 12.0)
"""Nearest and farthest pinhole camera, in lengths of the body."""
_PROPORTION = 6.0
POOL = 4096
"""Views of a pool: a gigabyte of those of the thesis' size."""


@dataclass(frozen=True)
class ViewSource:
    """Which bodies are drawn, and how they are seen."""

    pixels: int = 64
    """Side of the views."""
    pinhole_share: float = 0.0
    """Share of the views that a pinhole camera sees, at 1.5 to 12 times the body's length; the others are
    orthographic, as in the thesis."""
    wide_share: float = 0.0
    """Share of the bodies with proportions up to 1 : 6, many of them boxes, cylinders or ellipsoids; the others are
    those of the thesis' protocol."""
    disturbance: Disturbance = field(default_factory=Disturbance)
    framing: Framing = "cropped"
    """Canonical views, or full: the whole cube, as in the thesis' images."""


def wide_bodies(count: int, rng: np.random.Generator) -> Superquadric:
    """Bodies (count,) with half sizes log-uniform within 1 : 6; two thirds nearly boxes, cylinders or ellipsoids."""
    bodies = thesis_bodies(count, rng)
    size = THESIS_SIZE[1] * _PROPORTION ** -rng.random((count, 3))
    edged, round_ = rng.uniform(0.1, 0.3, (count, 2)), rng.uniform(0.8, 1.0, (count, 2))
    kind = rng.integers(6, size=count)[:, None]
    cylinder = np.stack([edged[:, 0], round_[:, 1]], axis=1)
    shape = np.select([kind < 2, kind == 2, kind == 3], [edged, cylinder, round_], bodies.shape)
    return Superquadric(size, shape, bodies.translation, bodies.rotation)


def draw_views(
    count: int, rng: np.random.Generator, source: ViewSource | None = None, occluder: Occluder | None = None
) -> tuple[np.ndarray, Superquadric]:
    """Views (count, p, p) of freshly drawn bodies, and the bodies (count,) in the views' frames.

    Occluders and framing are those of the source's disturbance, or the ones given; noise, holes and edges are left to
    :meth:`Disturbance.applied`, which may change a view anew each time it is used.
    """
    source = source or ViewSource()
    pinhole_share, disturbance = source.pinhole_share, source.disturbance
    bodies = thesis_bodies(count, rng)
    if source.wide_share > 0:
        wide = wide_bodies(count, rng).to_flat()
        chosen = rng.random((count, 1)) < source.wide_share
        bodies = Superquadric.from_flat(np.where(chosen, wide, bodies.to_flat()))
    if source.framing == "full":
        return full_frames(bodies, source.pixels), bodies
    distance = None
    if pinhole_share > 0:
        length = 2 * bodies.size.max(axis=1)
        nearest, farthest = CAMERA_DISTANCE
        distance = length * nearest * (farthest / nearest) ** rng.random(count)
        distance = np.where(rng.random(count) < pinhole_share, distance, np.inf)
    occluder = occluder or disturbance.occluder(count, rng)
    miss = disturbance.framing(count, rng)
    return render_views(bodies, source.pixels, np.full(count, GREY_LEVELS), distance, occluder, miss)


def full_frames(bodies: Superquadric, pixels: int = unit_cube.THESIS_PIXELS) -> np.ndarray:
    """Render the thesis' 8 bit images of bodies (n,) of the cube frame, as a network takes them.

    Returns float32 (n, p, p), z of the surface, 0 for background.
    """
    camera = unit_cube.camera(pixels)
    grey = np.empty((len(bodies), pixels, pixels), np.uint8)
    for frame, body in zip(grey, unit_cube.optical_from_cube(bodies), strict=True):
        frame[:] = unit_cube.grey_from_depth(raycast.render(body, camera)[0], np.uint8)
    return np.where(grey > 0, (grey + np.float32(0.5)) / np.float32(GREY_LEVELS), np.float32(0))


def turn_at_random(
    images: np.ndarray, bodies: Superquadric, rng: np.random.Generator
) -> tuple[np.ndarray, Superquadric]:
    """Images (n, p, p) and their bodies (n,), each in any of the 8 positions."""
    turns, mirror = rng.integers(4, size=len(images)), rng.random(len(images)) < 0.5
    return move_images(images, turns, mirror), move_bodies(bodies, turns, mirror)


class ViewPool:
    """A pool of rendered views from which batches are drawn, each time in another of the 8 positions.

    Rendering costs as much as a training step.  Each batch renders only ``batch / reuse`` new views, which replace the
    oldest of the pool; a view is so seen about ``reuse`` times, rarely twice in the same position, and with new noise
    each time.
    """

    def __init__(
        self, rng: np.random.Generator, source: ViewSource | None = None, capacity: int = POOL, reuse: int = 4
    ) -> None:
        self._rng, self._reuse = rng, reuse
        self._source = source or ViewSource()
        images, bodies = draw_views(capacity, rng, self._source)
        self._images, self._flat, self._next = images, bodies.to_flat().copy(), 0

    def batch(self, count: int) -> tuple[np.ndarray, Superquadric]:
        """Views (count, p, p) and bodies (count,) in the views' frames."""
        fresh = max(1, count // self._reuse)
        images, bodies = draw_views(fresh, self._rng, self._source)
        slots = (self._next + np.arange(fresh)) % len(self._images)
        self._images[slots], self._flat[slots] = images, bodies.to_flat()
        self._next = int(slots[-1] + 1) % len(self._images)
        chosen = self._rng.integers(len(self._images), size=count)
        bodies = Superquadric.from_flat(self._flat[chosen])
        views, bodies = turn_at_random(self._images[chosen], bodies, self._rng)
        return self._source.disturbance.apply(views, self._rng), bodies
