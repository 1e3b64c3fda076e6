"""What one depth image shows of one object: pixels that hit it, pixels that must miss it, and the depth noise.

Object pixels: those of the mask with a depth.  They are drawn systematically with weight sqrt(1 + slope^2), that is by
surface area instead of by pixel, since the steep parts of a body are the ones that fix its hidden extent.

Free pixels: those beside the mask.  One that measured something farther shows that space is empty up to there; one that
measured something nearer shows so up to its own depth only, which constrains nothing (what lies behind an occluder is
unknown).

A pixel without a reading shows nothing where pixels around the object were measured at all: beside a real thing it is
the shadow of a baseline, a side seen at a grazing angle, a dark or shiny label, on the thing or beside it.  Where
nothing around the object was measured, as in an orthographic image of the thesis, or before a background out of range,
it is no pixel of the object and counts as empty, unless it lies within the convex hull of the mask.

Noise: third differences z0 - 3 z1 + 3 z2 - z3 of neighbouring pixels have variance 20 sigma^2 and cancel slope and
curvature; their median absolute value over the mask, times 1.4826 / sqrt(20), is sigma; of readings in whole steps
their root mean square.  Quantisation with step q adds q^2 / 12 at least; q is the smallest depth difference that
occurs.  The estimate holds for the object as a whole.

Both kinds of pixels become rays (:mod:`sq_perception.fitting.cost`) when a stage of the fit draws them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np

from sq_perception.fitting.cost import SAMPLE, rays_through
from sq_perception.fitting.options import ON_SUPPORT
from sq_perception.geometry.kernels import kernel
from sq_perception.geometry.quantiles import MEDIAN_TO_SIGMA
from sq_perception.imaging import depth_steps, regions
from sq_perception.imaging.camera import Camera
from sq_perception.imaging.depth_steps import coherent
from sq_perception.imaging.raycast import heights

_STEEPEST = 6.0
"""Largest slope, 80 degrees; steeper pixels count as this, as they determine little of the depth."""
BAND_PIXELS = 4
"""Least width, pixels, of the band around the mask whose every pixel counts, as that much of a mask's edge may be
missing."""
_BEHIND_SHARE = 0.02
"""Share of a mask's pixels joined to the object by way of its support alone, from which on the mask is too large: by
one pixel around an object of 150.  One in twenty right masks of benchmarks/household_things has as much, from its
sensor's edges, which changes no mean; with 0.05, clean boxes in masks one pixel too large lost 3 % IoU."""
_COARSE = 3
"""Spacing, pixels in each direction, of free pixels far from the mask."""
OUTLIER_SHARE = 0.01
"""Share of the points left out at either end of a direction: readings of something else that got into the mask."""
_FEWEST = 8
"""Fewest differences for an estimate: with fewer, one edge within the mask is the median."""


class DepthNoise(NamedTuple):
    """Standard deviation ``sigma`` of the depth noise of an object, metres.

    ``quantum`` is the step of the readings, metres, where these have little other noise: then all readings of a face
    that looks at the camera err alike, as the same number was rounded.  0 where noise mixes the steps.
    """

    sigma: float
    quantum: float = 0.0


@dataclass(frozen=True)
class Crop:
    """An object and its surroundings in an image, as far as they do not depend on how far the object strays.

    ``depth`` (h, w) is NaN where nothing was measured; ``mask`` is the caller's, ``camera`` belongs to both.  Every
    pixel counts in a ``band`` of so many pixels around the mask.  ``distance`` is the mean depth of the object,
    ``footprint`` the width of a pixel there, metres.
    """

    depth: np.ndarray
    mask: np.ndarray
    camera: Camera
    band: int
    noise: DepthNoise
    distance: float
    footprint: float

    @classmethod
    def around(cls, depth: np.ndarray, mask: np.ndarray, camera: Camera, noise: float | None) -> Crop | None:
        """The crop around a mask of an image; None if it holds no depth at all.  ``noise`` None estimates it."""
        x, y, width, height = regions.box(np.ascontiguousarray(mask))
        extent = max(width, height)
        band = max(BAND_PIXELS, math.ceil(0.03 * extent))
        margin = max(band, math.ceil(extent / 4))
        top, left = max(y - margin, 0), max(x - margin, 0)
        bottom, right = min(y + height + margin, camera.height), min(x + width + margin, camera.width)
        crop = np.ascontiguousarray(depth[top:bottom, left:right], dtype=np.float32)
        measured = np.isfinite(crop) & (crop > 0) if camera.is_pinhole else np.isfinite(crop)
        crop = np.where(measured, crop, np.float32(np.nan))
        inside = np.ascontiguousarray(mask[top:bottom, left:right])
        seen = (inside & measured).view(np.uint8)
        if not seen.any():
            return None
        distance = float(cv2.mean(crop, seen)[0])
        least = 1e-6 * max(abs(distance), 1e-3)  # what single precision resolves
        known = estimate_noise(crop, inside, least) if noise is None else DepthNoise(noise)
        footprint = (distance if camera.is_pinhole else 1.0) / math.sqrt(camera.fx * camera.fy)
        view = camera.cropped(left, top, right - left, bottom - top)
        return cls(crop, inside, view, band, known, distance, footprint)

    def observe(self, model_error: float, nan_is_empty: bool | None, plane: np.ndarray | None = None) -> Observation:
        """The crop, its pixels sorted; ``model_error`` in metres, ``nan_is_empty`` and ``plane`` as in the options."""
        sigma = math.hypot(self.noise.sigma, model_error)
        inside = self._coherent(10 * self.footprint + 6 * sigma, plane)
        # Holes and notches of five pixels are closed: the outline of a convex body has none.
        filled = cv2.morphologyEx(inside.view(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
        claimed = cv2.bitwise_or(filled, self.mask.view(np.uint8))
        near = cv2.dilate(filled, np.ones((2 * self.band + 1, 2 * self.band + 1), np.uint8))
        if nan_is_empty is None:
            beside = cv2.subtract(near, claimed)
            measured = cv2.bitwise_and(beside, np.isfinite(self.depth).view(np.uint8))
            # Where fewer than a tenth of the pixels next to the object were measured, no background is in range.
            nan_is_empty = cv2.countNonZero(measured) / max(cv2.countNonZero(beside), 1) < 0.1
        lost = regions.convex_hull(claimed) if nan_is_empty else np.ones_like(claimed)
        pixels, areas, free, free_pixels = _sort(self.depth, inside, claimed, near, lost, self.footprint)
        reach = np.cumsum(areas, dtype=float)
        shown = draw(pixels, reach, 2000, 0.5)
        v, u = np.divmod(shown, self.camera.width)
        return Observation(
            **{**vars(self), "mask": filled.view(bool)}, pixels=pixels, reach=reach, free=free, free_pixels=free_pixels,
            model_error=model_error, points=np.asfortranarray(self.camera.unproject(u, v, self.depth.ravel()[shown])),
        )

    def _coherent(self, jump: float, plane: np.ndarray | None) -> np.ndarray:
        """The mask (h, w) without what a depth step of more than ``jump`` metres separates from the object.

        A mask that is too large shows the support all around the object, which joins all that is behind to the object's
        foot without a step: then only what is above the support counts.
        """
        inside = coherent(self.depth, self.mask, jump)
        if plane is None:
            return inside
        low = heights(self.depth, self.mask, self.camera.lens, plane) <= ON_SUPPORT
        # A thin thing on its support is as low all over.
        if not low.any() or 2 * np.count_nonzero(low) > np.count_nonzero(self.mask):
            return inside
        above = coherent(self.depth, self.mask & ~low, jump)
        # Three pixels of an object's foot are no higher than its support.
        with_foot = depth_steps.grow(above.astype(np.int32), low, self.depth, 3, depth_steps.STEP) > 0
        is_too_large = np.count_nonzero(with_foot) < (1 - _BEHIND_SHARE) * np.count_nonzero(inside)
        return above if is_too_large else inside


@dataclass(frozen=True)
class Observation(Crop):
    """A crop whose pixels are sorted; the mask is that of the object, with its small holes closed.

    ``pixels`` (n,) are those of the object, as indices into the crop in row-major order, ``reach`` (n,) their areas
    summed up to each; ``free`` (m,) those beside it that may constrain it and stand for ``free_pixels``.  The object
    may stray from a superquadric by ``model_error``, which joins the noise in squares.  ``points`` (k, 3): some 2000
    measured ones, evenly over the surface; each coordinate a contiguous column, which is reduced several times as fast.
    """

    pixels: np.ndarray
    reach: np.ndarray
    free: np.ndarray
    free_pixels: int
    model_error: float
    points: np.ndarray

    @cached_property
    def sigma(self) -> float:
        """Noise and model error at the object's distance joined in squares, metres."""
        return float(np.hypot(self.noise.sigma, self.model_error))

    @property
    def outline(self) -> float:
        """Standard deviation of an outline whose misfit was not measured yet, metres: the noise, or a whole pixel."""
        return max(self.sigma, self.footprint)

    @cached_property
    def sample(self) -> np.ndarray:
        """Rays of the object that determine a mean, a share or a median to 1 to 3 %."""
        return self.object_rays(SAMPLE)

    def object_rays(self, count: int, offset: float = 0.5) -> np.ndarray:
        """About ``count`` rays (k, 9) of the object, systematically by area; each weighs 1.

        Draws with other offsets (0 to 1) take other pixels.
        """
        return self._through(draw(self.pixels, self.reach, count, offset), 0.0)

    def free_rays(self, count: int, offset: float = 0.5) -> np.ndarray:
        """At most ``count`` rays (k, 9) of free pixels, drawn evenly; z is where free space ends."""
        pixels = self.free
        if len(pixels) > count:
            pixels = pixels[((np.arange(count) + offset) * (len(pixels) / count)).astype(np.int64)]
        return self.free_rays_of(pixels)

    def free_rays_of(self, pixels: np.ndarray) -> np.ndarray:
        """The rays through some of the free pixels; their space ends three standard deviations before the reading."""
        return self._through(pixels, 3.0)

    def ring(self, radius: float) -> np.ndarray:
        """The free pixels at distance ``radius`` from the mask, to half a pixel: at 1, those that touch it."""
        return self.free[np.abs(self._distance_to_mask - radius) < 0.5]

    def beyond(self, band: float) -> Observation:
        """The same observation with free pixels only farther than ``band`` pixels from the mask."""
        return replace(self, free=self.free[self._distance_to_mask > band + 0.4])

    def of_hull(self) -> Observation:
        """The same observation of the object's convex hull: free pixels within the hull of the mask are left out."""
        hull = regions.convex_hull(np.ascontiguousarray(self.mask).view(np.uint8))
        kept = self.free[hull.ravel()[self.free] == 0]
        count = round(self.free_pixels * len(kept) / max(len(self.free), 1))
        return replace(self, free=kept, free_pixels=count)

    @cached_property
    def _distance_to_mask(self) -> np.ndarray:
        distance = cv2.distanceTransform((~self.mask).view(np.uint8), cv2.DIST_L2, 3)
        return distance.ravel()[self.free]

    def _through(self, pixels: np.ndarray, margin: float) -> np.ndarray:
        return rays_through(pixels, self.depth, self.camera.lens, self.noise.sigma, self.model_error, margin)


def span(points: np.ndarray, directions: np.ndarray, outliers: float = OUTLIER_SHARE) -> np.ndarray:
    """Least and largest coordinates (k, 2) of points (n, 3) along directions (k, 3), but for outliers at either end."""
    place = (len(points) - 1) * np.array([outliers, 1 - outliers])
    before = place.astype(int)
    after = np.minimum(before + 1, len(points) - 1)
    along = np.partition(directions @ points.T, (*before, *after), axis=1)
    lower, upper = along[:, before], along[:, after]
    return np.asarray(lower + (upper - lower) * (place - before))


@kernel
def draw(pixels: np.ndarray, reach: np.ndarray, count: int, offset: float) -> np.ndarray:
    """All of the pixels (n,), or about ``count``, systematically by their areas, summed up to each in ``reach``."""
    if pixels.shape[0] <= count:
        return pixels
    chosen, k = np.empty(count, pixels.dtype), 0
    step = reach[-1] / count
    ahead = step * offset
    for i in range(pixels.shape[0]):
        if reach[i] > ahead and k < count:
            chosen[k] = pixels[i]
            k += 1
            while reach[i] > ahead:
                ahead += step
    return chosen[:k]


@kernel
def _sort(
    depth: np.ndarray, inside: np.ndarray, claimed: np.ndarray, near: np.ndarray, lost: np.ndarray, footprint: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Object pixels, their areas, free pixels, and how many pixels the free ones stand for.

    A missing depth is unknown where ``lost`` is set, and elsewhere empty.
    """
    height, width = depth.shape
    pixels, free = np.empty(height * width, np.int32), np.empty(height * width, np.int32)
    areas, row = np.empty(height * width, np.float32), np.empty(width)
    count, free_count, free_pixels = 0, 0, 0
    for v in range(height):
        _write_areas(depth, inside, v, footprint, row)
        for u in range(width):
            if inside[v, u]:
                if np.isfinite(depth[v, u]):
                    pixels[count] = v * width + u
                    areas[count] = row[u]
                    count += 1
                continue
            chosen = near[v, u] or (u % _COARSE == 0 and v % _COARSE == 0)
            if chosen and not claimed[v, u] and (np.isfinite(depth[v, u]) or not lost[v, u]):
                free[free_count] = v * width + u
                free_count += 1
                free_pixels += 1 if near[v, u] else _COARSE * _COARSE
    return pixels[:count].copy(), areas[:count].copy(), free[:free_count].copy(), free_pixels


@kernel
def _write_areas(depth: np.ndarray, inside: np.ndarray, v: int, footprint: float, areas: np.ndarray) -> None:
    """Write sqrt(1 + slope^2) of a row: central differences, slopes capped; 1 at the mask's edge.  Vector code."""
    height, width = depth.shape
    areas[:] = 1.0
    if not 0 < v < height - 1:
        return
    above, here, below = depth[v - 1], depth[v], depth[v + 1]
    inside_above, inside_here, inside_below = inside[v - 1], inside[v], inside[v + 1]
    for u in range(1, width - 1):
        across = (here[u + 1] - here[u - 1]) / (2.0 * footprint)
        down = (below[u] - above[u]) / (2.0 * footprint)
        square = across * across + down * down
        known = inside_above[u] & inside_below[u] & inside_here[u - 1] & inside_here[u + 1] & (square >= 0.0)
        areas[u] = np.sqrt(1.0 + min(square, _STEEPEST * _STEEPEST)) if known else 1.0


# The depth noise


def estimate_noise(depth: np.ndarray, inside: np.ndarray, least: float) -> DepthNoise:
    """The noise of the depth image within a mask (h, w); ``least`` metres if it is smaller or cannot be estimated."""
    step = max(1, int(np.count_nonzero(inside)) // 2500)  # the median of 5000 third differences is known to 1.5 %
    third, first = np.hstack([_differences(depth, inside, step), _differences(depth.T, inside.T, step)])
    if third.size < _FEWEST:
        return DepthNoise(least)
    median = np.partition(third, third.size // 2)[third.size // 2]
    moved = first[first > 0]
    if moved.size >= _FEWEST:
        rank = moved.size // 50
        quantum = float(np.partition(moved, rank)[rank])
        steps = moved / quantum
        if np.mean(np.abs(steps - np.rint(steps)) < 0.02) > 0.8:
            # The median of whole steps is a whole step; beyond six of either is an edge.
            near = third[third < 6.0 * max(median, quantum)]
            spread = math.sqrt(np.mean(near * near) / 20.0)
            is_rounded = spread < 0.5 * quantum
            return DepthNoise(max(spread, quantum / math.sqrt(12.0), least), quantum if is_rounded else 0.0)
    return DepthNoise(max(MEDIAN_TO_SIGMA * float(median) / math.sqrt(20.0), least))


def _differences(depth: np.ndarray, inside: np.ndarray, step: int) -> np.ndarray:
    """Absolute third and first differences (2, n) along every ``step``-th row."""
    rows, within = depth[::step].astype(float), inside[::step]
    third, first = np.abs(np.diff(rows, 3)), np.abs(np.diff(rows))[:, : max(rows.shape[1] - 3, 0)]
    known = within[:, :-3] & within[:, 1:-2] & within[:, 2:-1] & within[:, 3:] & (third >= 0)
    return np.stack([third[known], first[known]])
