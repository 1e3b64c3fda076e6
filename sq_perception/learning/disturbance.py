"""What cameras, masks and neighbours do to a canonical view: occluders, noise, steps, holes, wrong edges.

Everything here is relative to the side of the view, so that one description serves objects of any size.  Values of a
view: z in (0, 1] where the object is seen, 0 background, HIDDEN where it may go on unseen.

    occluder    hides a share of the body, uniform up to 0.4 (see view_rendering.Occluder)
    noise       sigma log-uniform from 1/2000 to 3/100 of the side; a part of it is common to blocks of pixels,
                as where one measurement covers several pixels of the view or a matching window smooths
    steps       quantised depth, 1/400 to 1/25 of the side
    holes       up to 15 % of the object in blobs of any width: HIDDEN, as pixels without a measurement are
    edges       the mask ends up to two pixels early, or takes in a pixel of whatever lies behind
    framing     the view's middle, nearest depth and side are off by some per cent, as all of the above have it
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sq_perception.imaging.canonical_view import HIDDEN
from sq_perception.simulation.view_rendering import Occluder

_MOST_HIDDEN = 0.4
"""Largest share of a body that an occluder hides."""
_LEAST_NOISE, _MOST_NOISE = 1 / 2000, 0.03
"""Standard deviations of a depth, in sides of the view."""
_STEPS = (1 / 400, 1 / 25)
_MOST_HOLES = 0.15
_FRAMING = np.array([0.012, 0.012, 0.012, 0.02])
_SMALLEST = 1 / 255


@dataclass(frozen=True)
class Disturbance:
    """How many of the views are disturbed, and how much."""

    occluded_share: float = 0.0
    """Share of the views with an occluder."""
    noisy_share: float = 0.0
    """Share of the views with noise, steps, holes and wrong edges, each of them in some of those."""

    def occluder(self, count: int, rng: np.random.Generator) -> Occluder | None:
        """Occluders for ``count`` bodies, some of which hide nothing; None where no view is to have one."""
        if self.occluded_share == 0:
            return None
        share = np.where(rng.random(count) < self.occluded_share, rng.uniform(0, _MOST_HIDDEN, count), 0.0)
        return any_occluder(share, rng)

    def framing(self, count: int, rng: np.random.Generator) -> np.ndarray | None:
        """Errors (count, 4) of the framing, see :func:`view_rendering.render_views`; None where nothing is noisy."""
        if self.noisy_share == 0:
            return None
        return np.where(rng.random((count, 1)) < self.noisy_share, _FRAMING * rng.standard_normal((count, 4)), 0.0)

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


def _noise(views: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    count, pixels = views.shape[:2]
    sigma = _LEAST_NOISE * (_MOST_NOISE / _LEAST_NOISE) ** _one_each(count, rng)
    common = _one_each(count, rng)
    fine = rng.standard_normal(views.shape, dtype=np.float32)
    coarse = _blocks(rng.standard_normal((count, pixels, pixels), dtype=np.float32), rng)
    noise = sigma * (np.sqrt(1 - common) * fine + np.sqrt(common) * coarse)
    return np.where(views > 0, np.clip(views + noise, _SMALLEST, 1), views)


def _steps(views: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    finest, coarsest = _STEPS
    step = finest * (coarsest / finest) ** _one_each(len(views), rng)
    phase = _one_each(len(views), rng)
    stepped = np.clip((np.floor(views / step + phase) + 0.5 - phase) * step, _SMALLEST, 1)
    chosen = (views > 0) & (_one_each(len(views), rng) < 0.4)
    return np.where(chosen, stepped, views)


def _holes(views: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    share = np.where(rng.random((len(views), 1, 1)) < 0.5, rng.uniform(0, _MOST_HOLES, (len(views), 1, 1)), 0.0)
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
