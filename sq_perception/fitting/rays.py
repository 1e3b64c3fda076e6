"""Rays of an object and of the free space beside it: a row each, its columns by name.

A pixel is a ray p = o + z d with o_z = 0 and d_z = 1, in the optical frame: o = 0 for a pinhole camera, d = (0, 0, 1)
for an orthographic one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sq_perception.geometry.kernels import kernel
from sq_perception.imaging.camera import Lens

ORIGIN_X, ORIGIN_Y, DIRECTION_X, DIRECTION_Y, DEPTH, STIFFNESS, WEIGHT = range(7)
"""Columns of a ray.

DEPTH, metres: what the pixel measured; for a free ray, up to where its space is empty.  STIFFNESS, 1 / metres:
1 / sigma of the depth; 1 for a free ray, whose sigma is the outline's.  WEIGHT: as how many rays it counts.
"""
RAY_COLUMNS = 7
SAMPLE = 800
"""Object rays that determine a mean, a share or a median to 1 to 3 %, and take a tenth of a fit's time."""


class Rays(NamedTuple):
    """The rays that one stage of a fit draws."""

    hits: np.ndarray
    """Rays (n, 7) of the object's pixels."""
    free: np.ndarray
    """Rays (m, 7) of pixels beside the object."""

    @property
    def weight(self) -> float:
        """Total weight of the object's rays: the cost of a body that leaves nothing but noise."""
        return float(self.hits[:, WEIGHT].sum())

    def weighing(self, factor: float) -> Rays:
        """The same rays with all weights times a factor."""
        hits, free = self.hits.copy(), self.free.copy()
        hits[:, WEIGHT] *= factor
        free[:, WEIGHT] *= factor
        return Rays(hits, free)

    def every(self, stride: int) -> Rays:
        """Each ``stride``-th ray."""
        return Rays(self.hits[::stride].copy(), self.free[::stride].copy())


@kernel
def drawn(pixels: np.ndarray, areas: np.ndarray, count: int, offset: float) -> np.ndarray:
    """All of the pixels (n,), or about ``count`` of them, systematically by their areas.

    Other offsets (0 to 1) take other pixels.
    """
    if pixels.shape[0] <= count:
        return pixels
    total = 0.0
    for i in range(areas.shape[0]):
        total += areas[i]
    chosen = np.empty(count, np.int32)
    step = total / count
    ahead = step * offset
    passed = 0.0
    k = 0
    for i in range(pixels.shape[0]):
        passed += areas[i]
        if passed > ahead and k < count:
            chosen[k] = pixels[i]
            k += 1
            while passed > ahead:
                ahead += step
    return chosen[:k]


@kernel
def through(
    pixels: np.ndarray, depth: np.ndarray, lens: Lens, noise: float, model_error: float, margin: float
) -> np.ndarray:
    """Rays (n, 7) through pixels, indices into the depth image; free ones end a margin before the reading.

    Noise and model error join in squares; ``margin``: in such standard deviations, 0 for rays of the object.
    """
    fx, fy, cx, cy, pinhole = lens
    width = depth.shape[1]
    sigma = np.sqrt(noise * noise + model_error * model_error)
    rays = np.zeros((pixels.shape[0], RAY_COLUMNS))
    for i in range(pixels.shape[0]):
        v, u = pixels[i] // width, pixels[i] % width
        x, y = (u - cx) / fx, (v - cy) / fy
        if pinhole:
            rays[i, DIRECTION_X], rays[i, DIRECTION_Y] = x, y
        else:
            rays[i, ORIGIN_X], rays[i, ORIGIN_Y] = x, y
        z = np.float64(depth[v, u])
        rays[i, STIFFNESS] = rays[i, WEIGHT] = 1.0
        if not np.isfinite(z):
            rays[i, DEPTH] = 1e300
            continue
        rays[i, DEPTH] = z - margin * sigma
        if margin == 0.0:
            rays[i, STIFFNESS] = 1.0 / sigma
    return rays
