"""What one depth image says about one object: rays that hit it, rays that must miss it, and the depth noise.

Rows of rays are (o_x, o_y, d_x, d_y, z, 1/sigma, weight, last), see :mod:`sq_perception.fitting.residuals`.

Object rays: pixels of the mask with a depth.  Drawn systematically with weight sqrt(1 + slope^2), that is by surface
area instead of by pixel, since the steep parts of a body are the ones that fix its hidden extent.

Free rays: pixels beside the mask.  One that measured something farther says "empty up to there"; one that measured
something nearer says so up to its own depth only, which binds nothing (what lies behind an occluder is unknown); one
that measured nothing says nothing, unless a missing depth means a truly empty background (the thesis' images).

Depth noise: third differences z0 - 3 z1 + 3 z2 - z3 of neighbouring pixels have variance 20 sigma^2 and cancel slope
and curvature; their median absolute value over the mask, times 1.4826 / sqrt(20), is sigma.  Quantisation with step q
adds q^2 / 12 at least; q is the smallest depth difference that occurs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from sq_perception.fitting.residuals import RAY_COLUMNS
from sq_perception.geometry.kernels import kernel
from sq_perception.imaging.camera import Camera

_STEEPEST = 6.0
_BAND_PIXELS = 4
_BAND_SHARE = 0.03
_WIDER = 0.5
_HOLE = 5
"""Holes and notches of the mask up to this width, pixels, are closed: the outline of a convex body has none."""
_JUMP_PIXELS, _JUMP_NOISE = 10.0, 6.0
"""A depth step between neighbours above so many pixel widths, plus so many noise levels, ends a surface."""
_SMALLEST_PIECE = 0.02
_COARSE = 3
"""Far from the mask, only every third pixel in each direction becomes a free ray."""
_NOISE_SAMPLES = 2000
_MEDIAN_TO_SIGMA = 1.4826
_FREE_MARGIN = 3.0
"""Free space ends this many noise levels in front of the measured depth."""


@dataclass(frozen=True)
class Observation:
    """One object in one image, cropped to its surroundings.

    Attributes
    ----------
    object_rays : (n, 7)
        All pixels of the object; the last column is the area weight for drawing.
    free_rays : (m, 7)
        All candidates for free space; the last column likewise.
    free_pixels : int
        Number of pixels that the free rays stand for.
    noise : float
        Depth noise and model error together, metres.
    footprint : float
        Width of a pixel at the object, metres.
    depth, mask : (h, w)
        The crop, the mask with its small holes closed; ``camera`` belongs to them.
    """

    object_rays: np.ndarray
    free_rays: np.ndarray
    free_pixels: int
    noise: float
    footprint: float
    depth: np.ndarray
    mask: np.ndarray
    camera: Camera

    @cached_property
    def points(self) -> np.ndarray:
        """Measured points (n, 3) of the object in the optical frame."""
        r = self.object_rays
        return np.stack([r[:, 0] + r[:, 4] * r[:, 2], r[:, 1] + r[:, 4] * r[:, 3], r[:, 4]], axis=1)

    def coarsened(self, model_error: float) -> Observation:
        """The same observation trusted less: ``model_error`` (metres) joins the noise."""
        noise = float(np.hypot(self.noise, model_error))
        rays, free = self.object_rays.copy(), self.free_rays.copy()
        rays[:, 5] *= self.noise / noise
        free[:, 4] -= 2.0 * model_error
        return replace(self, object_rays=rays, free_rays=free, noise=noise)

    def beyond(self, band: float) -> Observation:
        """The same observation with free rays only farther than ``band`` pixels from the mask."""
        kept = self.distance_to_mask(self.free_rays) > band + 0.4
        return replace(self, free_rays=self.free_rays[kept])

    def distance_to_mask(self, rays: np.ndarray) -> np.ndarray:
        """Distance (n,) of the rays' pixels to the mask, in pixels."""
        return self._distance.ravel()[rays[:, 7].astype(int)]

    @cached_property
    def _distance(self) -> np.ndarray:
        return cv2.distanceTransform((~self.mask).view(np.uint8), cv2.DIST_L2, 3)


def observe(
    depth: np.ndarray,
    mask: np.ndarray,
    camera: Camera,
    noise: float | None,
    model_error: float,
    nan_is_empty: bool,
) -> Observation | None:
    """Sort the pixels of an image; None if the mask holds no depth at all.

    ``noise`` None estimates it; ``model_error`` (metres) adds to it in squares.
    """
    rows = np.flatnonzero(mask.any(axis=1))
    if rows.size == 0:
        return None
    columns = np.flatnonzero(mask[rows[0] : rows[-1] + 1].any(axis=0))
    extent = max(rows[-1] - rows[0], columns[-1] - columns[0]) + 1
    band = max(_BAND_PIXELS, int(np.ceil(_BAND_SHARE * extent)))
    margin = max(band, int(np.ceil(_WIDER * extent / 2)))
    top, left = max(int(rows[0]) - margin, 0), max(int(columns[0]) - margin, 0)
    bottom = min(int(rows[-1]) + margin + 1, camera.height)
    right = min(int(columns[-1]) + margin + 1, camera.width)
    window = (slice(top, bottom), slice(left, right))
    crop = np.ascontiguousarray(depth[window], dtype=np.float32)
    if camera.is_pinhole:
        crop = np.where(crop > 0, crop, np.float32(np.nan))
    inside = np.ascontiguousarray(mask[window], dtype=bool)
    view = camera.cropped(left, top, right - left, bottom - top)
    typical = _typical_depth(crop, inside)
    if not np.isfinite(typical):
        return None
    if noise is None:
        noise = max(_noise(crop, inside), 1e-6 * max(abs(typical), 1e-3))
    noise = float(np.hypot(noise, model_error))
    focal = np.sqrt(view.fx * view.fy)
    footprint = float(typical / focal if view.is_pinhole else 1 / focal)
    inside = _coherent(crop, inside, _JUMP_PIXELS * footprint + _JUMP_NOISE * noise)
    filled = cv2.morphologyEx(inside.view(np.uint8), cv2.MORPH_CLOSE, np.ones((_HOLE, _HOLE), np.uint8))
    claimed = cv2.bitwise_or(filled, np.ascontiguousarray(mask[window]).view(np.uint8))
    near = cv2.dilate(filled, np.ones((2 * band + 1, 2 * band + 1), np.uint8))
    margin_in_front = max(_FREE_MARGIN * noise, 2.0 * model_error)
    intrinsics = np.array([view.fx, view.fy, view.cx, view.cy])
    rays, free, free_pixels = _collect(
        crop, inside, claimed, near, intrinsics, view.is_pinhole, noise, footprint, margin_in_front, nan_is_empty
    )
    return Observation(rays, free, free_pixels, noise, footprint, crop, filled.view(bool), view)


def draw(rays: np.ndarray, count: int, offset: float = 0.5) -> np.ndarray:
    """About ``count`` of the rays, systematically by their weight; each then weighs 1."""
    total = rays[:, 6].sum()
    if len(rays) > count and total > 0:
        return _draw(rays, count, offset)
    chosen = rays.copy()
    chosen[:, 6] = 1.0
    return chosen


@kernel
def _draw(rays: np.ndarray, count: int, offset: float) -> np.ndarray:
    total = 0.0
    for i in range(rays.shape[0]):
        total += rays[i, 6]
    chosen = np.empty((count, RAY_COLUMNS))
    step = total / count
    ahead = step * offset
    passed = 0.0
    k = 0
    for i in range(rays.shape[0]):
        passed += rays[i, 6]
        if passed > ahead and k < count:
            chosen[k] = rays[i]
            chosen[k, 6] = 1.0
            k += 1
            while passed > ahead:
                ahead += step
    return chosen[:k].copy()


@kernel
def _typical_depth(depth: np.ndarray, inside: np.ndarray) -> float:
    total, count = 0.0, 0
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            if inside[v, u] and np.isfinite(depth[v, u]):
                total += depth[v, u]
                count += 1
    if count == 0:
        return np.nan
    return total / count


@kernel
def _coherent(depth: np.ndarray, inside: np.ndarray, jump: float) -> np.ndarray:
    """The mask without what is not the object: pieces that a depth step separates from the largest piece.

    A convex body has no step in its visible surface.  Pixels without depth belong to no piece and stay.  A piece that
    touches the largest one across a step, or is tiny, goes; one beyond a gap (a bar in front of the body) stays.
    """
    height, width = depth.shape
    label = np.zeros((height, width), np.int32)
    stack = np.empty(height * width, np.int32)
    largest, largest_size, pieces = 0, 0, 0
    sizes = np.zeros(height * width // 2 + 2, np.int32)
    for start in range(height * width):
        v, u = start // width, start % width
        if label[v, u] > 0 or not inside[v, u] or not np.isfinite(depth[v, u]) or pieces + 1 >= sizes.shape[0]:
            continue
        pieces += 1
        label[v, u] = pieces
        stack[0] = start
        top = 1
        size = 0
        while top > 0:
            top -= 1
            v, u = stack[top] // width, stack[top] % width
            size += 1
            for side in range(4):
                v2, u2 = v + (side == 0) - (side == 1), u + (side == 2) - (side == 3)
                if v2 < 0 or u2 < 0 or v2 >= height or u2 >= width or label[v2, u2] > 0 or not inside[v2, u2]:
                    continue
                if abs(depth[v2, u2] - depth[v, u]) <= jump:
                    label[v2, u2] = pieces
                    stack[top] = v2 * width + u2
                    top += 1
        sizes[pieces] = size
        if size > largest_size:
            largest, largest_size = pieces, size
    if pieces <= 1:
        return inside
    kept = np.ones(pieces + 1, np.bool_)
    for k in range(1, pieces + 1):
        kept[k] = sizes[k] >= _SMALLEST_PIECE * largest_size
    for v in range(height):
        for u in range(width):
            if label[v, u] != largest:
                continue
            for side in range(4):
                v2, u2 = v + (side == 0) - (side == 1), u + (side == 2) - (side == 3)
                if 0 <= v2 < height and 0 <= u2 < width and label[v2, u2] > 0:
                    kept[label[v2, u2]] = False
    kept[0] = kept[largest] = True
    coherent = inside.copy()
    for v in range(height):
        for u in range(width):
            coherent[v, u] = inside[v, u] and kept[label[v, u]]
    return coherent


@kernel
def _collect(
    depth: np.ndarray,
    inside: np.ndarray,
    claimed: np.ndarray,
    near: np.ndarray,
    intrinsics: np.ndarray,
    pinhole: bool,
    noise: float,
    footprint: float,
    margin_in_front: float,
    nan_is_empty: bool,
) -> tuple[np.ndarray, np.ndarray, int]:
    fx, fy, cx, cy = intrinsics
    height, width = depth.shape
    count, free_count = 0, 0
    for v in range(height):
        for u in range(width):
            if inside[v, u]:
                count += np.isfinite(depth[v, u])
            elif not claimed[v, u] and (near[v, u] or (u % _COARSE == 0 and v % _COARSE == 0)):
                free_count += nan_is_empty or np.isfinite(depth[v, u])
    rays = np.empty((count, RAY_COLUMNS))
    free = np.empty((free_count, RAY_COLUMNS))
    count, free_count, free_pixels = 0, 0, 0
    for v in range(height):
        for u in range(width):
            z = depth[v, u]
            known = np.isfinite(z)
            if inside[v, u]:
                if not known:
                    continue
                row = rays[count]
                count += 1
                row[4] = z
                row[5] = 1.0 / noise
                row[7] = z
                row[6] = _area_weight(depth, inside, v, u, footprint)
            elif not claimed[v, u] and (near[v, u] or (u % _COARSE == 0 and v % _COARSE == 0)):
                if not known and not nan_is_empty:
                    continue
                row = free[free_count]
                free_count += 1
                row[4] = z - margin_in_front if known else 1e300
                free_pixels += 1 if near[v, u] else _COARSE * _COARSE
                row[5] = 1.0
                row[6] = 1.0
                row[7] = v * width + u
            else:
                continue
            x, y = (u - cx) / fx, (v - cy) / fy
            if pinhole:
                row[0], row[1], row[2], row[3] = 0.0, 0.0, x, y
            else:
                row[0], row[1], row[2], row[3] = x, y, 0.0, 0.0
    return rays, free, free_pixels


@kernel
def _area_weight(depth: np.ndarray, inside: np.ndarray, v: int, u: int, footprint: float) -> float:
    """sqrt(1 + slope^2) by central differences, with the slope capped; 1 at the mask's edge."""
    height, width = depth.shape
    if not (0 < v < height - 1 and 0 < u < width - 1):
        return 1.0
    if not (inside[v - 1, u] and inside[v + 1, u] and inside[v, u - 1] and inside[v, u + 1]):
        return 1.0
    across = (depth[v, u + 1] - depth[v, u - 1]) / (2.0 * footprint)
    down = (depth[v + 1, u] - depth[v - 1, u]) / (2.0 * footprint)
    square = across * across + down * down
    if not square >= 0.0:
        return 1.0
    return np.sqrt(1.0 + min(square, _STEEPEST * _STEEPEST))


def _noise(depth: np.ndarray, inside: np.ndarray) -> float:
    """Standard deviation of the depth noise within the mask, metres; 0 if it cannot be told."""
    step = max(1, int(np.sqrt(inside.size / _NOISE_SAMPLES / 8)))
    third, first = _differences(depth, inside, step)
    if third.size < 8:
        return 0.0
    spread = float(np.median(third)) * _MEDIAN_TO_SIGMA / np.sqrt(20.0)
    moved = first[first > 0]
    quantum = 0.0
    if moved.size >= 8:
        smallest = float(np.quantile(moved, 0.02))
        if np.mean(np.abs(moved / smallest - np.round(moved / smallest)) < 0.02) > 0.8:
            quantum = smallest
    if spread < 0.5 * quantum:
        return quantum / float(np.sqrt(12.0))
    return spread


@kernel
def _differences(depth: np.ndarray, inside: np.ndarray, step: int) -> tuple[np.ndarray, np.ndarray]:
    """Absolute third and first differences along rows and columns, every ``step``-th line."""
    height, width = depth.shape
    third = np.empty(2 * height * width // step + 4)
    first = np.empty(2 * height * width // step + 4)
    count, moved = 0, 0
    for v in range(0, height, step):
        for u in range(width - 3):
            if inside[v, u] and inside[v, u + 1] and inside[v, u + 2] and inside[v, u + 3]:
                a, b, c, d = depth[v, u], depth[v, u + 1], depth[v, u + 2], depth[v, u + 3]
                value = abs(a - 3.0 * b + 3.0 * c - d)
                if value >= 0.0:
                    third[count] = value
                    count += 1
                    first[moved] = abs(np.float64(a) - np.float64(b))
                    moved += 1
    for u in range(0, width, step):
        for v in range(height - 3):
            if inside[v, u] and inside[v + 1, u] and inside[v + 2, u] and inside[v + 3, u]:
                a, b, c, d = depth[v, u], depth[v + 1, u], depth[v + 2, u], depth[v + 3, u]
                value = abs(a - 3.0 * b + 3.0 * c - d)
                if value >= 0.0:
                    third[count] = value
                    count += 1
                    first[moved] = abs(np.float64(a) - np.float64(b))
                    moved += 1
    return third[:count], first[:moved]
