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
from sq_perception.segmentation.extent import across

_TOP, _AS_HIGH = 0.95, 0.008
"""Share of a segment's points below its top, and metres by which tops of walls may differ: noise of a rim."""
_THICK, _NARROW, _OUTLYING = 0.03, 0.2, 0.1
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
        Points (n, 3) of each segment, evenly taken.
    plane : (4,)
        The plane that they stand on.
    """
    if len(points) < 3:
        return set()
    axes = across(plane[:3])
    tops = np.array([quantile(some @ plane[:3] + plane[3], _TOP) for some in points.values()])
    flat = np.concatenate(list(points.values())) @ axes
    owner = np.repeat(np.arange(len(points)), [len(some) for some in points.values()])
    lengths, directions = _moments(flat, owner)
    tried: list[bytes] = []
    for top in tops:
        level = np.abs(tops - top) < _AS_HIGH
        if np.count_nonzero(level) > 1 and level.tobytes() not in tried:
            tried.append(level.tobytes())
            longest = np.where(level, lengths, -np.inf).argmax()
            along = _around(level, flat, owner, directions[longest])
            if along.any():
                return set(np.array(list(points))[along].tolist())
    return set()


def _moments(points: np.ndarray, owner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The difference (m,) of the variances of m segments' points (n, 2) along their principal axes, and these axes
    (m, 2, 2), in columns, the shorter one first."""
    counts = np.bincount(owner)
    centred = points - np.stack([np.bincount(owner, column) / counts for column in points.T], axis=1)[owner]
    x, y = centred.T
    xx, xy, yy = (np.bincount(owner, product) / np.maximum(counts - 1, 1) for product in (x * x, x * y, y * y))
    variances, directions = np.linalg.eigh(np.stack([xx, xy, xy, yy], axis=1).reshape(-1, 2, 2))
    return variances[:, 1] - variances[:, 0], directions


def _around(level: np.ndarray, points: np.ndarray, owner: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Which of some equally high segments, bool (m,), are walls along the rectangle around them, as the longest lies.

    Not the smallest rectangle: two walls at a right angle have another one just as small.  ``points`` (n, 2) are those
    of all segments along the support, ``owner`` (n,) whose they are, from 0, ``directions`` (2, 2) the rectangle's.
    """
    placed = directions[0, :, None] * points[:, 0] + directions[1, :, None] * points[:, 1]  # (2, n): long rows are fast
    low, high = (end(placed[:, level[owner]], axis=1) for end in (np.min, np.max))
    half = np.maximum((high - low) / 2, 1e-9)  # of points on one line
    thick = min(_THICK, _NARROW * float(half.min()))
    placed -= (low + half)[:, None]
    inside = (half[:, None] - np.abs(placed)).min(axis=0) > thick
    along = level & (np.bincount(owner, inside) < _OUTLYING * np.bincount(owner))
    if 2 * half.min() < _SMALLEST or not along.any():
        return np.zeros_like(along)
    # Of the four sides in their order around the rectangle, the share of their cells that hold points beside them.
    of_walls = placed[:, along[owner]]
    cell = np.clip((_CELLS * (of_walls / (2 * half[:, None]) + 0.5)).astype(int), 0, _CELLS - 1)
    sides = [(sign, k) for sign in (1, -1) for k in (0, 1)]
    beside = [half[k] - sign * of_walls[k] < thick for sign, k in sides]
    covered = np.array([np.unique(cell[1 - k, at]).size for at, (_, k) in zip(beside, sides, strict=True)]) / _CELLS
    is_corner = bool((np.minimum(covered, np.roll(covered, 1)) > _LONG).any())
    if not is_corner or covered.mean() < _COVERED:
        return np.zeros_like(along)
    others = [np.median(placed[:, owner == k], axis=1) for k in np.flatnonzero(~along)]
    holds = any((half - np.abs(other)).min() > thick for other in others)
    return along if holds else np.zeros_like(along)
