"""Training data drawn and rendered on the fly: bodies of the thesis' protocol in their canonical views, some disturbed.

The protocol itself is in :mod:`sq_perception.simulation.scenes`; depth comes in 255 integer steps a unit, as in its
images.

Disturbances are what cameras, masks and neighbours do to a view.  They are relative to its side, so that one
description serves objects of any size:

    occluder    hides a share of the body, uniform up to 0.4 (see rendering.Occluder)
    noise       sigma log-uniform from 1/2000 to 3/100 of the side; a part of it is common to blocks of pixels,
                as where one measurement covers several pixels of the view or a matching window smooths
    steps       quantised depth, 1/400 to 1/25 of the side
    holes       up to 15 % of the object in blobs of any width: HIDDEN, as pixels without a measurement are
    edges       the mask ends up to two pixels early, or takes in a pixel of whatever lies behind
    framing     the view's middle, nearest depth and side are off by some per cent, as all of the above have it
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast, unit_cube
from sq_perception.imaging.canonical_view import HIDDEN
from sq_perception.learning.choices import Framing
from sq_perception.learning.inference import move_bodies, move_images
from sq_perception.simulation.rendering import Occluder, render_views
from sq_perception.simulation.scenes import THESIS_SIZE, thesis_bodies

GREY_LEVELS = 255.0
_SMALLEST = 1 / GREY_LEVELS  # least depth of a view that is not background
POOL = 4096  # views of a pool: a gigabyte of those of the thesis' size


@dataclass(frozen=True)
class Disturbance:
    """How many of the views are disturbed, and how much."""

    occluded_share: float = 0.0  # share of the views with an occluder
    noisy_share: float = 0.0
    """Share of the views with noise, steps, holes and wrong edges, each of them in some of those."""

    def occluder(self, count: int, rng: np.random.Generator) -> Occluder | None:
        """Occluders for ``count`` bodies, some of which hide nothing; None where no view is to have one."""
        if self.occluded_share == 0:
            return None
        share = np.where(rng.random(count) < self.occluded_share, rng.uniform(0, 0.4, count), 0.0)
        return any_occluder(share, rng)

    def framing(self, count: int, rng: np.random.Generator) -> np.ndarray | None:
        """Errors (count, 4) of the framing, see :func:`rendering.render_views`; None where nothing is noisy."""
        if self.noisy_share == 0:
            return None
        deviations = np.array([0.012, 0.012, 0.012, 0.02])
        return np.where(rng.random((count, 1)) < self.noisy_share, deviations * rng.standard_normal((count, 4)), 0.0)

    def apply(self, views: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Views (n, p, p), some of them with noise, steps, holes and wrong edges; the argument is left as it is."""
        if self.noisy_share == 0:
            return views
        disturbed = views.copy()
        chosen = np.flatnonzero(rng.random(len(views)) < self.noisy_share)
        disturbed[chosen] = _holes(_steps(_noise(_edges(views[chosen], rng), rng), rng), rng)
        return disturbed


def any_occluder(share: np.ndarray, rng: np.random.Generator) -> Occluder:
    """Occluders from random directions, straight, cornered or round, that hide ``share`` (n,) of the bodies."""
    count = len(share)
    bow = np.where(rng.random(count) < 0.5, 0.0, rng.uniform(-1.0, 4.0, count))
    thickness = np.where(rng.random(count) < 0.2, rng.uniform(0.1, 0.4, count), np.inf)
    power = rng.integers(1, 3, count).astype(float)
    return Occluder(rng.uniform(-np.pi, np.pi, count), bow, rng.uniform(-0.2, 0.2, count), power, thickness, share)


@dataclass(frozen=True)
class ViewSource:
    """Which bodies are drawn, and how they are seen."""

    pixels: int = 64  # side of the views
    pinhole_share: float = 0.0
    """Share of the views that a pinhole camera sees, at 1.5 to 12 times the body's length; the others are
    orthographic, as in the thesis."""
    wide_share: float = 0.0
    """Share of the bodies with proportions up to 1 : 6, many of them boxes, cylinders or ellipsoids; the others are
    those of the thesis' protocol."""
    disturbance: Disturbance = field(default_factory=Disturbance)
    framing: Framing = "cropped"  # canonical views, or full: the whole cube, as in the thesis' images


def wide_bodies(count: int, rng: np.random.Generator) -> Superquadric:
    """Bodies (count,) with half sizes log-uniform within 1 : 6; two thirds nearly boxes, cylinders or ellipsoids."""
    bodies = thesis_bodies(count, rng)
    size = THESIS_SIZE[1] * 6.0 ** -rng.random((count, 3))
    edged, round_ = rng.uniform(0.1, 0.3, (count, 2)), rng.uniform(0.8, 1.0, (count, 2))
    kind = rng.integers(6, size=count)[:, None]
    cylinder = np.stack([edged[:, 0], round_[:, 1]], axis=1)
    shape = np.select([kind < 2, kind == 2, kind == 3], [edged, cylinder, round_], bodies.shape)
    return Superquadric(size, shape, bodies.translation, bodies.rotation)


def draw_views(
    count: int, rng: np.random.Generator, source: ViewSource | None = None, occluder: Occluder | None = None
) -> tuple[np.ndarray, Superquadric]:
    """Views (count, p, p) of freshly drawn bodies, and the bodies (count,) in the views' frames.  Noise, holes and
    edges are left to :meth:`Disturbance.apply`, which changes a view anew each time it is used."""
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
        nearest, farthest = 1.5, 12.0  # in lengths of the body
        distance = length * nearest * (farthest / nearest) ** rng.random(count)
        distance = np.where(rng.random(count) < pinhole_share, distance, np.inf)
    occluder = occluder or disturbance.occluder(count, rng)
    miss = disturbance.framing(count, rng)
    return render_views(bodies, source.pixels, np.full(count, GREY_LEVELS), distance, occluder, miss)


def full_frames(bodies: Superquadric, pixels: int = unit_cube.THESIS_PIXELS) -> np.ndarray:
    """The thesis' 8 bit images of bodies (n,) of the cube frame: float32 (n, p, p), z, and 0 for background."""
    camera = unit_cube.camera(pixels)
    grey = np.empty((len(bodies), pixels, pixels), np.uint8)
    for frame, body in zip(grey, unit_cube.optical_from_cube(bodies), strict=True):
        frame[:] = unit_cube.grey_from_depth(raycast.render(body, camera)[0], np.uint8)
    return np.where(grey > 0, (grey + np.float32(0.5)) / np.float32(GREY_LEVELS), np.float32(0))


class ViewPool:
    """A pool of rendered views from which batches are drawn, each time in another of the 8 positions and noise.  Each
    batch renders only ``batch / reuse`` new ones, in place of the oldest: that costs as much as a training step."""

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
        turns, mirror = self._rng.integers(4, size=count), self._rng.random(count) < 0.5
        views = move_images(self._images[chosen], turns, mirror)
        bodies = move_bodies(Superquadric.from_flat(self._flat[chosen]), turns, mirror)
        return self._source.disturbance.apply(views, self._rng), bodies


def _noise(views: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    count, pixels = views.shape[:2]
    least, most = 1 / 2000, 0.03
    sigma = least * (most / least) ** _one_each(count, rng)
    common = _one_each(count, rng)
    fine = rng.standard_normal(views.shape, dtype=np.float32)
    coarse = _blocks(rng.standard_normal((count, pixels, pixels), dtype=np.float32), rng)
    noise = sigma * (np.sqrt(1 - common) * fine + np.sqrt(common) * coarse)
    return np.where(views > 0, np.clip(views + noise, _SMALLEST, 1), views)


def _steps(views: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    finest, coarsest = 1 / 400, 1 / 25
    step = finest * (coarsest / finest) ** _one_each(len(views), rng)
    phase = _one_each(len(views), rng)
    stepped = np.clip((np.floor(views / step + phase) + 0.5 - phase) * step, _SMALLEST, 1)
    chosen = (views > 0) & (_one_each(len(views), rng) < 0.4)
    return np.where(chosen, stepped, views)


def _holes(views: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    share = np.where(rng.random((len(views), 1, 1)) < 0.5, rng.uniform(0, 0.15, (len(views), 1, 1)), 0.0)
    hole = _blocks(rng.random(views.shape, dtype=np.float32), rng) < share
    return np.where(hole & (views > 0), np.float32(HIDDEN), views)


def _blocks(values: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Values (n, p, p) with all pixels of a block alike; blocks are 1 to 8 pixels wide, one width a view."""
    pixels = values.shape[-1]
    width = rng.choice([1, 2, 3, 5, 8], size=len(values))
    index = np.arange(pixels)[None] // width[:, None] * width[:, None]
    return values[np.arange(len(values))[:, None, None], index[:, :, None], index[:, None, :]]


def _edges(views: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Each mask too small by 0, 1 or 2 pixels, or too large by one that lies anywhere behind."""
    error = rng.choice([-1, 0, 0, 1, 2], size=len(views))[:, None, None]
    seen = views > 0
    smaller = seen & _all_neighbours(seen)
    smallest = smaller & _all_neighbours(smaller)
    kept = np.where(error < 1, seen, np.where(error == 1, smaller, smallest))
    kept |= seen & ~smallest.any(axis=(1, 2), keepdims=True)
    out = np.where(seen & ~kept, np.float32(0), views)
    border = (error == -1) & (views == 0) & ~_all_neighbours(~seen)
    taken = np.nonzero(border)
    farthest = rng.random(len(views), dtype=np.float32)[taken[0]]
    behind = np.clip(rng.random(len(farthest), dtype=np.float32) * farthest, _SMALLEST, 1)
    out[taken] = np.where(rng.random(len(farthest)) < 0.5, behind, 0)
    return out


def _one_each(count: int, rng: np.random.Generator) -> np.ndarray:
    """Uniform numbers (count, 1, 1), one a view; in half the bits all that follows takes half the time."""
    return rng.random((count, 1, 1), dtype=np.float32)


def _all_neighbours(mask: np.ndarray) -> np.ndarray:
    """Whether all four neighbours of each pixel are in the mask (n, p, p); beyond the image everything is."""
    padded = np.pad(mask, ((0, 0), (1, 1), (1, 1)), constant_values=True)
    return padded[:, :-2, 1:-1] & padded[:, 2:, 1:-1] & padded[:, 1:-1, :-2] & padded[:, 1:-1, 2:]
