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
from sq_perception.segmentation import support_plane

_TOP, _AS_HIGH = 0.95, 0.008
"""Share of a segment's points below its top, and metres by which tops of walls may differ: noise of a rim."""
_THICK, _NARROW, _STRAY = 0.03, 0.2, 0.1
"""Metres from a side of the rectangle to the inside of a wall at the most, with a bin's slant and noise; the
same as a share of half the shorter side; and the share of a segment's points that may lie farther in: a can's or a
carton's are a third at the least, and a round vessel's 18 %."""
_SMALLEST = 0.15
"""Metres, of the shorter side: what is smaller holds no things."""
_CELLS, _COVERED, _LONG = 20, 0.45, 0.6
"""Into so many cells each side is divided; shares of the whole outline, and of each of two adjacent sides, of them that
hold points of walls: those of a bin cut by the image, or half hidden, are less than all."""


def walls(points: Mapping[int, np.ndarray], plane: np.ndarray) -> set[int]:
    """Which of some segments, by their labels, are walls around others of them.

    Parameters
    ----------
    points
        Of each segment (n, 3), evenly taken.
    plane : (4,)
        What they stand on.
    """
    if len(points) < 3:
        return set()
    tops = {label: quantile(some @ plane[:3] + plane[3], _TOP) for label, some in points.items()}
    tried = []
    for top in tops.values():
        level = [label for label in tops if abs(tops[label] - top) < _AS_HIGH]
        if len(level) > 1 and level not in tried:
            tried.append(level)
            if found := _around(level, points, support_plane.across(plane[:3])):
                return found
    return set()


def _around(level: list[int], points: Mapping[int, np.ndarray], axes: np.ndarray) -> set[int]:
    """Those of some equally high segments that are walls along the rectangle around them, as the longest lies."""
    flat = {label: points[label] @ axes for label in level}
    # Not the smallest rectangle: two walls at a right angle have another one just as small.
    moments = [np.linalg.eigh(np.cov(some.T)) for some in flat.values()]
    _, directions = max(moments, key=lambda each: each[0][1] - each[0][0])
    turned = {label: some @ directions for label, some in flat.items()}
    everything = np.concatenate(list(turned.values()))
    low, high = everything.min(axis=0), everything.max(axis=0)
    middle, half = (low + high) / 2, (high - low) / 2
    if 2 * half.min() < _SMALLEST:
        return set()
    thick = min(_THICK, _NARROW * half.min())
    along = [label for label in level if np.mean(_inwards(turned[label] - middle, half) > thick) < _STRAY]
    if not along:
        return set()
    cells = np.zeros((4, _CELLS), bool)
    for label in along:
        _cover(cells, turned[label] - middle, half, thick)
    covered = cells.mean(axis=1)
    is_corner = bool((np.minimum(covered, np.roll(covered, 1)) > _LONG).any())
    if not is_corner or cells.mean() < _COVERED:
        return set()
    others = [np.median(some @ axes @ directions, axis=0) for label, some in points.items() if label not in along]
    holds = bool(others) and bool((_inwards(np.array(others) - middle, half) > thick).any())
    return set(along) if holds else set()


def _inwards(points: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Distances (n,) of points (n, 2) from the nearest side of a rectangle, positive inside."""
    return np.asarray((half - np.abs(points)).min(axis=1))


def _cover(cells: np.ndarray, points: np.ndarray, half: np.ndarray, thick: float) -> None:
    """Mark the cells of the sides, in their order around the rectangle, that points (n, 2) lie along."""
    at = np.clip((_CELLS * (points / (2 * half) + 0.5)).astype(int), 0, _CELLS - 1)
    for side, (across, sign) in enumerate(((0, 1), (1, 1), (0, -1), (1, -1))):
        near = half[across] - sign * points[:, across] < thick
        cells[side, at[near, 1 - across]] = True
