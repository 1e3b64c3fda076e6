"""An estimate of the standard deviation of a depth image's noise.

Third differences z0 - 3 z1 + 3 z2 - z3 of neighbouring pixels have variance 20 sigma^2 and cancel slope and curvature;
their median absolute value over the mask, times 1.4826 / sqrt(20), is sigma; of readings in whole steps their root mean
square.  Quantisation with step q adds q^2 / 12 at least; q is the smallest depth difference that occurs.  The estimate
holds for the object as a whole.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sq_perception.geometry.kernels import kernel
from sq_perception.geometry.quantiles import MEDIAN_TO_SIGMA

_SAMPLES = 5000
"""Third differences that are taken, about: their median is then known to 1.5 %."""
_EDGE = 6.0
"""Third differences of whole steps beyond so many medians, and steps, show an edge."""
_FEWEST = 8
"""Fewest differences for an estimate: with fewer, one edge within the mask is the median."""


class DepthNoise(NamedTuple):
    """Standard deviation ``sigma`` of the depth noise of an object, metres.

    ``quantum`` is the step of the readings, metres, where these have little other noise: then all readings of a face
    that looks at the camera err alike, as the same number was rounded.  0 where noise mixes the steps.
    """

    sigma: float
    quantum: float = 0.0


def estimate(depth: np.ndarray, inside: np.ndarray, least: float) -> DepthNoise:
    """The noise of the depth image within a mask (h, w); ``least`` metres if it is smaller or cannot be estimated."""
    spread, quantum = _spread(depth, inside)
    is_rounded = spread < 0.5 * quantum
    return DepthNoise(max(spread, quantum / math.sqrt(12.0), least), quantum if is_rounded else 0.0)


@kernel
def _spread(depth: np.ndarray, inside: np.ndarray) -> tuple[float, float]:
    """The standard deviation by third differences, and the quantum of the first ones; 0 for what is not known."""
    third, first = _differences(depth, inside, max(1, int(2 * np.count_nonzero(inside) / _SAMPLES)))
    if third.size < _FEWEST:
        return 0.0, 0.0
    median = np.partition(third, third.size // 2)[third.size // 2]
    moved = first[first > 0]
    if moved.size >= _FEWEST:
        rank = moved.size // 50
        quantum = np.partition(moved, rank)[rank]
        steps = moved / quantum
        if np.count_nonzero(np.abs(steps - np.rint(steps)) < 0.02) > 0.8 * moved.size:
            # The median of whole steps is a whole step.
            near = third[third < _EDGE * max(median, quantum)]
            return math.sqrt(np.mean(near * near) / 20.0), quantum
    return MEDIAN_TO_SIGMA * median / math.sqrt(20.0), 0.0


@kernel
def _differences(depth: np.ndarray, inside: np.ndarray, step: int) -> tuple[np.ndarray, np.ndarray]:
    """Absolute third and first differences along rows and columns, every ``step``-th line."""
    height, width = depth.shape
    most = ((height - 1) // step + 1) * width + ((width - 1) // step + 1) * height
    third, first = np.empty(most), np.empty(most)
    count = 0
    for down, right in ((0, 1), (1, 0)):
        for v in range(0, height - 3 * down, 1 if down else step):
            for u in range(0, width - 3 * right, 1 if right else step):
                line = True
                for k in range(4):
                    line = line and inside[v + k * down, u + k * right]
                if not line:
                    continue
                a, b = depth[v, u], depth[v + down, u + right]
                c, d = depth[v + 2 * down, u + 2 * right], depth[v + 3 * down, u + 3 * right]
                value = abs(a - 3.0 * b + 3.0 * c - d)
                if value >= 0.0:
                    third[count] = value
                    first[count] = abs(np.float64(a) - np.float64(b))
                    count += 1
    return third[:count], first[:count]
