"""Order statistics of one array: quantiles, a robust standard deviation, and where numbers are densest.

:func:`quantile` and :func:`select` give what ``np.quantile`` does.  NumPy spends most of its time on options where
there are few numbers, and on moving them where there are many.
"""

from __future__ import annotations

import numpy as np

from sq_perception.geometry.kernels import kernel

MEDIAN_TO_SIGMA = 1.4826  # standard deviation of normal numbers over the median of their absolute values


def quantile(numbers: np.ndarray, share: float) -> float:
    """Return the value below which a share (0 to 1) of some numbers (n >= 1,) lies, linearly interpolated."""
    place = share * (len(numbers) - 1)
    before = int(place)
    after = min(before + 1, len(numbers) - 1)
    ordered = np.partition(numbers, (before, after))
    lower, upper = float(ordered[before]), float(ordered[after])
    return lower + (upper - lower) * (place - before)


def deviation(sizes: np.ndarray) -> float:
    """Estimate the standard deviation of zero-mean normal numbers from absolute values (n >= 1,), robustly."""
    return MEDIAN_TO_SIGMA * quantile(sizes, 0.5)


def densest(ordered: np.ndarray, width: float) -> slice:
    """Return the slice of sorted numbers (n,) with most of them within ``width`` of its first; the first such."""
    if not len(ordered):
        return slice(0)
    counts = np.searchsorted(ordered, ordered + width, side="right") - np.arange(len(ordered))
    first = int(counts.argmax())
    return slice(first, first + int(counts[first]))


@kernel
def select(numbers: np.ndarray, rank: int) -> float:
    """Return the float32 of (n,) >= 0 with ``rank`` others before it in ascending order.  Their bits, read as whole
    numbers, have the same order: counts of the upper halves find that of the wanted one, then the lower half."""
    bits = numbers.view(np.uint32)
    left, high = rank, np.uint32(0)
    counts = np.zeros(1 << 16, np.int32)
    for number in bits:
        counts[number >> 16] += 1
    while left >= counts[high]:
        left -= counts[high]
        high += 1
    counts[:] = 0
    for number in bits:
        if number >> 16 == high:
            counts[number & 0xFFFF] += 1
    low = np.uint32(0)
    while left >= counts[low]:
        left -= counts[low]
        low += 1
    return float(np.array([high << 16 | low], np.uint32).view(np.float32)[0])
