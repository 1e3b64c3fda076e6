"""Quantiles of few numbers, without what ``np.quantile`` spends on axes, weights and methods."""

from __future__ import annotations

import numpy as np


def quantile(numbers: np.ndarray, share: float) -> float:
    """The value below which a share (0 to 1) of some numbers (n >= 1,) lies, between two of them linearly."""
    place = share * (len(numbers) - 1)
    before = int(place)
    after = min(before + 1, len(numbers) - 1)
    ordered = np.partition(numbers, (before, after))
    lower, upper = float(ordered[before]), float(ordered[after])
    return lower + (upper - lower) * (place - before)
