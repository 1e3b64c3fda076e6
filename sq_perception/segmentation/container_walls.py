"""Walls of bins, boxes and trays: what stands around things, and is none of them.

Seen from above a bin shows its inner sides and its rim, cut into several segments by corners and by what lies before
them.  With each segment's points along the support, and its top, the height above the support that few exceed,

    walls end at one height, lie along the sides of the rectangle around them, cover two adjacent ones and much of all,
    and have something else within.

A box, or a row of cans, reaches farther in from the rectangle's sides than a wall is thick; books stand in rectangles
around other things seldom.  A bin without anything in it is a thing.

Metres, optical frame.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sq_perception.geometry.quantiles import quantile
from sq_perception.segmentation.options import across

_TOP, _AS_HIGH = 0.95, 0.008
"""Share of a segment's points below its top, and metres by which tops of walls may differ: noise of a rim."""
_THICK, _OUTLYING = 0.03, 0.1
"""Metres from a side of the rectangle to the inside of a wall, with its slant and noise, or a tenth of the shorter side
where that is less; and the share of a segment's points that may lie farther in."""
_CELLS, _LONG = 20, 0.6
"""Into so many cells each side is divided; share of those of each of two adjacent sides that hold points of walls."""


def walls(points: Mapping[int, np.ndarray], plane: np.ndarray) -> set[int]:
    """Which of some segments, by their labels, are walls around others of them.

    Parameters
    ----------
    points
        Points (n, 3) of each segment, evenly taken.
    plane : (4,)
        The plane that they stand on.
    """
    axes = across(plane[:3])
    tops = {label: quantile(some @ plane[:3] + plane[3], _TOP) for label, some in points.items()}
    flat = {label: (some @ axes).T for label, some in points.items()}
    tried: list[list[int]] = []
    for top in tops.values():
        level = [label for label, other in tops.items() if abs(other - top) < _AS_HIGH]
        if len(level) > 1 and len(points) > 2 and level not in tried:
            tried.append(level)
            if along := _around(level, flat):
                return along
    return set()


def _around(level: list[int], points: Mapping[int, np.ndarray]) -> set[int]:
    """Which of some equally high segments are walls along the rectangle around them, as the longest of them lies.

    Not the smallest rectangle: two walls at a right angle have another one just as small.  ``points`` (2, n) are those
    of all segments along the support.
    """
    moments = [np.linalg.eigh(np.cov(points[label])) for label in level]
    directions = max(moments, key=lambda each: float(np.ptp(each[0])))[1].T
    ends = np.concatenate([directions @ points[label] for label in level], axis=1)
    low, high = ends.min(axis=1), ends.max(axis=1)
    half = np.maximum((high - low) / 2, 1e-9)  # of points on one line
    thick = min(_THICK, 0.2 * float(half.min()))
    placed = {label: directions @ some - (low + half)[:, None] for label, some in points.items()}
    within = {label: (half[:, None] - np.abs(some)).min(axis=0) > thick for label, some in placed.items()}
    along = {label for label in level if within[label].mean() < _OUTLYING}
    if not any(np.median(within[label]) > 0 for label in points.keys() - along) or not along:
        return set()
    of_walls = np.concatenate([placed[label] for label in along], axis=1) / half[:, None]
    cell = np.clip((_CELLS * (of_walls / 2 + 0.5)).astype(int), 0, _CELLS - 1)
    # Of the four sides in their order around the rectangle, the share of their cells that hold points beside them.
    beside = [(1 - sign * of_walls[k]) * half[k] < thick for sign in (1, -1) for k in (0, 1)]
    covered = np.array([np.unique(cell[1 - k % 2, beside[k]]).size for k in range(4)]) / _CELLS
    return along if (np.minimum(covered, np.roll(covered, 1)) > _LONG).any() else set()
