"""Quantiles without what ``np.quantile`` spends, for few numbers on axes and methods, for many on moving them.

And where numbers are densest.
"""

from __future__ import annotations

import numpy as np

from sq_perception.geometry.kernels import kernel


def quantile(numbers: np.ndarray, share: float) -> float:
    """The value below which a share (0 to 1) of some numbers (n >= 1,) lies, between two of them linearly."""
    place = share * (len(numbers) - 1)
    before = int(place)
    after = min(before + 1, len(numbers) - 1)
    ordered = np.partition(numbers, (before, after))
    lower, upper = float(ordered[before]), float(ordered[after])
    return lower + (upper - lower) * (place - before)


def densest(ordered: np.ndarray, width: float) -> slice:
    """Where most of some ordered numbers (n,) lie within a width of the first one there; the first of such places."""
    if not len(ordered):
        return slice(0)
    counts = np.searchsorted(ordered, ordered + width, side="right") - np.arange(len(ordered))
    first = int(counts.argmax())
    return slice(first, first + int(counts[first]))


@kernel
def ranked(numbers: np.ndarray, rank: int) -> float:
    """The number that ``rank`` of float32 (n,) >= 0 come before: their bits order alike, and are counted by halves."""
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
