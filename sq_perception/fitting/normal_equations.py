"""The normal equations J^T J and J^T r, summed over blocks of residuals, compiled.

A block is an array (12, LANES): rows 0 to 10 hold the derivatives of each residual by the 11 entries of a step
(see :mod:`sq_perception.fitting.residuals`), row 11 the residuals themselves, all times the square root of their
weight.  Its outer product, lower triangle, adds to ``sums`` (12, 12): J^T J in rows 0 to 10, J^T r in row 11.
Summing over a block at a time keeps the inner loop long and free of branches, which is what vectorises.
"""

from __future__ import annotations

import math

import numpy as np

from sq_perception.geometry.elementary import log2
from sq_perception.geometry.kernels import inline_kernel, kernel

STEP_LENGTH = 11
LANES = 64
_SMALL = 1e-300
_LN_2 = math.log(2.0)


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
    """Add the outer product of a single residual's row (12,)."""
    for k in range(STEP_LENGTH + 1):
        for j in range(k + 1):
            sums[k, j] += row[k] * row[j]
