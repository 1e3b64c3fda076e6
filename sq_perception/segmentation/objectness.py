"""How surely a segment is a thing, and no bump of its support, wall or piece of furniture.

Equation
--------
    m = mean height of the segment's readings above the support
    s = standard deviation of the mean height of an area of the support as large as a quarter of the segment, or that of
        single readings where it is less
    z = m / s
    logit P(thing) = a l + b log(min(z, z_most)) + c

l is the median over the segment's pixels of the logit by which a network says that they are of one object
(:mod:`sq_perception.recovery.own_segments`).  s is measured on the support itself, by blocks of its pixels: it holds
what the sensor's noise leaves of a mean of so many correlated readings, and the waves of a bent depth, which no mean
removes.  a, b, c are those of a logistic regression (see ``_WEIGHTS``).

A fragment of a thing rises and looks like one as well; its finished body tells.  With p the probability above, u the
largest standard deviation of a half size over that half size, 1 at most, n the segment's pixels over the fewest that a
segment has, q the largest affinity to a segment with more pixels, and o the share of the body's surface within the body
of that one,

    logit P(thing | body) = a' logit p + b' log u + c' log n + d' log q + e' o + f'

Heights and deviations in metres as at one metre of depth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from sq_perception.segmentation.support_plane import LEAST_SIGMA

_WEIGHTS = (1.08, 9.8, -22.6)
"""a, b, c, a regression on segments of benchmarks/common/segmentation_scenes."""
_MOST_SURE = 8.0
"""z_most: a segment that rises more is surely no bump, and a wall rises as well."""
_UNASKED = 3.4
"""l of a segment that no network was asked about: what rises by six deviations is then a thing."""
LEAST = 0.2
"""What is less likely a thing is left out: a thing that is missed costs as much as four bodies of nothing."""
_BODY_WEIGHTS = (0.2, -0.8, 0.7, -0.5, -4.0, -2.2)
"""a' to f', a regression on bodies of benchmarks/household_things.  The score of the body, and how much hides it, are
not used: they would leave out things that are half hidden."""
LEAST_POSTERIOR = 0.25
"""What is less likely a thing is left out with its body."""
_BLOCKS = (4, 32)
"""Pixels a side of the smallest and the largest block of the support."""
_SUPPORT = 0.03
"""Up to this height, metres, a pixel of no segment tells of the support."""


@dataclass(frozen=True, eq=False)
class HeightEvidence:
    """What a frame shows of its support.

    Attributes
    ----------
    relative : float32 (height, width)
        Heights above the support as at one metre of depth, 0 where nothing was measured.
    segments : int32 (height, width)
        Those first found in it: the support is around them.
    sigma
        Standard deviation of single readings of the support.
    """

    relative: np.ndarray
    segments: np.ndarray
    sigma: float

    def rise(self, labels: np.ndarray, ids: Sequence[int]) -> np.ndarray:
        """z (n,) of the segments of a label image."""
        if not len(ids):
            return np.zeros(0)
        inside = labels > 0
        counts = np.bincount(labels[inside], minlength=max(ids) + 1)
        means = np.bincount(labels[inside], self.relative[inside], len(counts)) / np.maximum(counts, 1)
        is_support = (self.segments == 0) & (self.relative != 0) & (np.abs(self.relative) < _SUPPORT)
        deviations: dict[int, float] = {}
        z = np.zeros(len(ids))
        for k, label in enumerate(ids):
            # A power of two, so that few sizes of blocks are measured in a frame.
            side = int(np.clip(2.0 ** round(math.log2(max(0.5 * math.sqrt(counts[label]), 1))), *_BLOCKS))
            if side not in deviations:
                of_means = _deviation_of_means(self.relative, is_support, side)
                deviations[side] = max(min(of_means, self.sigma), LEAST_SIGMA)
            z[k] = means[label] / deviations[side]
        return z


def prior(rise: float, of_one_object: float | None = None) -> float:
    """The probability that a segment is a thing, of its rise z and the network's median logit l, if it was asked."""
    a, b, c = _WEIGHTS
    median = _UNASKED if of_one_object is None else of_one_object
    return float(probability(a * median + b * math.log(min(max(rise, 0.1), _MOST_SURE)) + c))


def posterior(likely: float, uncertainty: float, pixels: float, affinity: float, overlap: float) -> float:
    """The probability that a segment is a thing once its body is known, of p, u (NaN: 1), n, q and o."""
    p, u = min(likely, 0.999), min(1.0, max(uncertainty, 1e-3))  # NaN is no less than 1
    q = max(affinity, 2.5e-3)  # the least that a network says of two segments
    told = (math.log(p / (1 - p)), math.log(u), math.log(pixels), math.log(q), overlap, 1.0)
    return float(probability(sum(weight * each for weight, each in zip(_BODY_WEIGHTS, told, strict=True))))


def probability(log_odds: Any) -> Any:
    """1 / (1 + exp(-log odds)), of a number or an array."""
    return 0.5 * (1 + np.tanh(0.5 * log_odds))


def _deviation_of_means(relative: np.ndarray, is_support: np.ndarray, side: int) -> float:
    """Root mean square, about 0, of the mean heights of blocks of the support; inf where there are few."""
    rows, columns = (length // side * side for length in relative.shape)
    if not rows or not columns:
        return np.inf
    known = is_support[:rows, :columns].astype(np.float32)
    size = columns // side, rows // side
    share = cv2.resize(known, size, interpolation=cv2.INTER_AREA)
    sums = cv2.resize(known * relative[:rows, :columns], size, interpolation=cv2.INTER_AREA)
    means = sums[share > 0.7] / share[share > 0.7]
    if len(means) < 8:
        return np.inf
    return float(np.sqrt(np.mean(np.square(means))))
