"""How large and how sharp a fitted body may be."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

SMALLEST_SIZE = 0.02
"""Smallest size, as a share of the observed extent, when the data set the bounds: 6 mm of 30 cm."""
LARGEST_SIZE = 2.0
"""Largest size, likewise: a body may hide as much again as it shows."""
WIDEST_EXPONENT = 2.0
"""Beyond, a superquadric is not convex and its gauge no norm."""


@dataclass(frozen=True)
class Bounds:
    """Limits of a fit.

    Attributes
    ----------
    shape : (float, float)
        Range of both exponents e1 and e2, within (0, 2].
    size : (float, float) or None
        Range of all three half sizes, metres.  None takes it from the extent of the observed points.

    Raises
    ------
    ValueError
        For a range that is empty, not finite or not positive, or exponents above 2.
    """

    shape: tuple[float, float] = (0.1, 1.0)
    size: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        for name, limits in (("shape", self.shape), ("size", self.size)):
            if limits is None:
                continue
            low, high = limits
            if not (np.isfinite([low, high]).all() and 0 < low <= high):
                raise ValueError(f"bounds of {name}: expected 0 < low <= high, got {limits}")
        if self.shape[1] > WIDEST_EXPONENT:
            raise ValueError(f"bounds of shape: expected exponents up to {WIDEST_EXPONENT:g}, got {self.shape}")

    def limits(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper limit (8,) of a1 a2 a3 e1 e2 t1 t2 t3 for observed points (n, 3)."""
        low, high = points.min(axis=0), points.max(axis=0)
        extent = max(float(np.linalg.norm(high - low)), 1e-9)
        size = self.size if self.size is not None else (SMALLEST_SIZE * extent / 2, LARGEST_SIZE * extent / 2)
        reach = math.sqrt(3.0) * max(extent, size[1])  # no point of a body is farther from its centre
        (smallest, largest), (sharpest, bluntest) = size, self.shape
        lower = np.array([*[smallest] * 3, *[sharpest] * 2, *(low - reach)])
        upper = np.array([*[largest] * 3, *[bluntest] * 2, *(high + reach)])
        return lower, upper
