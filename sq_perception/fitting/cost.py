"""What the cost of every fit is made of: its rays, terms, losses, and the normal equations J^T J and J^T r; compiled.

A pixel is a ray p = o + z d with o_z = 0 and d_z = 1, in the optical frame: o = 0 for a pinhole camera, d = (0, 0, 1)
for an orthographic one.  Rays of an object and of the free space beside it are rows, their columns by name.

The normal equations are summed over blocks of residuals.  A block is an array (14, LANES): rows 0 to 12 hold the
derivatives of each residual by the 13 entries of a step (see :mod:`sq_perception.fitting.residuals`), row 13 the
residuals themselves, all times the square root of their weight.  Its outer product, lower triangle, adds to ``sums``
(14, 14): J^T J in rows 0 to 12, J^T r in row 13.  Summing over a block at a time keeps the inner loop long and free of
branches, which is what vectorises.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from sq_perception.geometry.elementary import log2
from sq_perception.geometry.kernels import inline_kernel, kernel
from sq_perception.imaging.camera import Lens

Ray = IntEnum("Ray", "ORIGIN_X ORIGIN_Y DIRECTION_X DIRECTION_Y DEPTH STIFFNESS WEIGHT OFFSET SIDE", start=0)
"""Columns of a ray.

DEPTH, metres: what the pixel measured; for a free ray, up to where its space is empty.  STIFFNESS, 1 / metres:
1 / sigma of the depth; 1 for a free ray, whose sigma is the outline's.  WEIGHT: as how many rays it counts.

Of points without a camera, which lie at (ORIGIN_X, ORIGIN_Y, DEPTH): OFFSET, metres: the distance to expect.  SIDE: 0
for a point of the surface; 1 or -1 for one outside or inside, wherever that is.
"""
RAY_COLUMNS = len(Ray)
SAMPLE = 800
"""Object rays that determine a mean, a share or a median to 1 to 3 %, and take a tenth of a fit's time."""
STEP_LENGTH, PARAMETERS = 13, 10
LANES = 64
"""Residuals of a block: eight of the longest vectors, with all rows in the nearest cache (6 of its 32 KiB or more)."""


class Rays(NamedTuple):
    """The rays that one stage of a fit draws."""

    hits: np.ndarray
    """Rays (n, 9) of the object's pixels."""
    free: np.ndarray
    """Rays (m, 9) of pixels beside the object."""

    @property
    def weight(self) -> float:
        """Total weight of the object's rays: the cost of a body that leaves nothing but noise."""
        return float(self.hits[:, Ray.WEIGHT].sum())

    def scale(self, factor: float) -> Rays:
        """The same rays with all weights times a factor."""
        hits, free = self.hits.copy(), self.free.copy()
        hits[:, Ray.WEIGHT] *= factor
        free[:, Ray.WEIGHT] *= factor
        return Rays(hits, free)

    def every(self, stride: int) -> Rays:
        """Each ``stride``-th ray."""
        return Rays(self.hits[::stride].copy(), self.free[::stride].copy())


class Terms(NamedTuple):
    """Constants of the residuals; see :mod:`sq_perception.fitting.residuals` and :mod:`sq_perception.fitting.priors`.

    Points that lie inside the body, behind its surface, count by Cauchy's loss of scale ``inner_cauchy`` if that is
    not 0, all others by Huber's.  A rendered depth is found by Newton's method until |g - 1| < ``hit_tolerance``,
    then in first order. Rendered residuals up to ``dead_zone`` noise levels count as 0: what rounding may do.
    ``outline_stiffness`` is 1/sigma_o; ``plane`` is n and d of n.x + d = height, ``expected`` three half sizes; a
    stiffness or price of 0 switches its term off.  The rows of ``hull_directions`` are n_j, of ``hull_root`` those of
    W, ``hull_freedom`` is nu of its errors; no rows switch that term off.
    """

    huber: float = 3.0
    inner_cauchy: float = 0.0
    outline_huber: float = 3.0
    grazing: float = 0.01
    hit_tolerance: float = 1e-4
    dead_zone: float = 0.0
    outline_stiffness: float = 1.0
    pinhole: float = 0.0
    plane: np.ndarray = np.zeros(4)
    plane_stiffness: float = 0.0
    gap_stiffness: float = 0.0
    rest_stiffness: float = 0.0
    proportion_stiffness: float = 0.0
    roundness_stiffness: float = 0.0
    expected: np.ndarray = np.ones(3)
    expectation_stiffness: float = 0.0
    volume_price: float = 0.0
    taper_stiffness: float = 0.0
    hull_directions: np.ndarray = np.empty((0, 3))
    hull_support: np.ndarray = np.empty(0)
    hull_root: np.ndarray = np.empty((0, 0))
    hull_freedom: float = math.inf


@inline_kernel
def huber_loss(residual: float, huber: float, weight: float) -> tuple[float, float]:
    """Huber's loss of a residual, quadratic up to ``huber``, and the square root of its weight; no branch.

    P. J. Huber, Robust estimation of a location parameter, Annals of Mathematical Statistics 35(1), 1964.
    """
    size = abs(residual)
    inner = min(size, huber)
    loss = weight * inner * (2.0 * size - inner)
    return loss, math.sqrt(weight * min(1.0, huber / max(size, 1e-300)))


@inline_kernel
def cauchy_loss(residual: float, scale: float, weight: float) -> tuple[float, float]:
    """Cauchy's loss, which almost stops growing beyond ``scale``, and the square root of its weight; no branch."""
    above = 1.0 + residual * residual / (scale * scale)
    return math.log(2.0) * weight * scale * scale * log2(above), math.sqrt(weight / above)


@kernel
def add_block(block: np.ndarray, filled: int, sums: np.ndarray) -> None:
    """Add the outer products of the first ``filled`` columns of the block, two by two rows at a time."""
    for k in range(0, STEP_LENGTH + 1, 2):
        for j in range(0, k + 2, 2):
            total, right, below, across = 0.0, 0.0, 0.0, 0.0
            for i in range(filled):
                total += block[k, i] * block[j, i]
                right += block[k, i] * block[j + 1, i]
                below += block[k + 1, i] * block[j, i]
                across += block[k + 1, i] * block[j + 1, i]
            sums[k, j] += total
            sums[k, j + 1] += right
            sums[k + 1, j] += below
            sums[k + 1, j + 1] += across


@kernel
def rays_of(points: np.ndarray) -> np.ndarray:
    """Rays (n, 9) of points (n, 3) without a camera, each of weight 1."""
    rays = np.zeros((points.shape[0], RAY_COLUMNS))
    rays[:, Ray.ORIGIN_X], rays[:, Ray.ORIGIN_Y], rays[:, Ray.DEPTH] = points[:, 0], points[:, 1], points[:, 2]
    rays[:, Ray.STIFFNESS] = 1.0
    rays[:, Ray.WEIGHT] = 1.0
    return rays


@kernel
def rays_through(
    pixels: np.ndarray, depth: np.ndarray, lens: Lens, noise: float, model_error: float, margin: float
) -> np.ndarray:
    """Rays (n, 9) through pixels, indices into the depth image; free ones end a margin before the reading.

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
            rays[i, Ray.DIRECTION_X], rays[i, Ray.DIRECTION_Y] = x, y
        else:
            rays[i, Ray.ORIGIN_X], rays[i, Ray.ORIGIN_Y] = x, y
        z = np.float64(depth[v, u])
        rays[i, Ray.STIFFNESS] = rays[i, Ray.WEIGHT] = 1.0
        if not np.isfinite(z):
            rays[i, Ray.DEPTH] = 1e300
            continue
        rays[i, Ray.DEPTH] = z - margin * sigma
        if margin == 0.0:
            rays[i, Ray.STIFFNESS] = 1.0 / sigma
    return rays
