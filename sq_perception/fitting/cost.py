"""What the cost of every fit is made of: its terms, its losses, and the normal equations J^T J and J^T r; compiled.

The normal equations are summed over blocks of residuals.  A block is an array (14, LANES): rows 0 to 12 hold the
derivatives of each residual by the 13 entries of a step (see :mod:`sq_perception.fitting.residuals`), row 13 the
residuals themselves, all times the square root of their weight.  Its outer product, lower triangle, adds to ``sums``
(14, 14): J^T J in rows 0 to 12, J^T r in row 13.  Summing over a block at a time keeps the inner loop long and free of
branches, which is what vectorises.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sq_perception.geometry.elementary import log2
from sq_perception.geometry.kernels import inline_kernel, kernel

STEP_LENGTH, PARAMETERS = 13, 10
LANES = 64
"""Residuals of a block: eight of the longest vectors, with all rows in the nearest cache (6 of its 32 KiB or more)."""
_SMALL = 1e-300
_LN_2 = math.log(2.0)


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
    return loss, math.sqrt(weight * min(1.0, huber / max(size, _SMALL)))


@inline_kernel
def cauchy_loss(residual: float, scale: float, weight: float) -> tuple[float, float]:
    """Cauchy's loss, which almost stops growing beyond ``scale``, and the square root of its weight; no branch."""
    above = 1.0 + residual * residual / (scale * scale)
    return _LN_2 * weight * scale * scale * log2(above), math.sqrt(weight / above)


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
def add_row(row: np.ndarray, sums: np.ndarray) -> None:
    """Add the outer product of a single residual's row (14,)."""
    for k in range(STEP_LENGTH + 1):
        for j in range(k + 1):
            sums[k, j] += row[k] * row[j]
