"""Quantiles of few numbers, without what ``np.quantile`` spends on axes, weights and methods."""

from __future__ import annotations

import numpy as np


def quantile(ordered: np.ndarray, share: float) -> float:
    """The value below which a share (0 to 1) of sorted numbers (n >= 1,) lies, between two of them linearly."""
    place = share * (len(ordered) - 1)
    before = int(place)
    lower, upper = float(ordered[before]), float(ordered[min(before + 1, len(ordered) - 1)])
    return lower + (upper - lower) * (place - before)
