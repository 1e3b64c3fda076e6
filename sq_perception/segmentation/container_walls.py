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
from sq_perception.segmentation.support_plane import TOLERANCE

_TOP = 0.95
"""Share of a segment's points below its top."""
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
    if len(points) < 3:
        return set()
    axes = across(plane[:3])
    tops = {label: quantile(some @ plane[:3] + plane[3], _TOP) for label, some in points.items()}
    flat = {label: axes.T @ some.T for label, some in points.items()}
    axis = {label: _axis(some) for label, some in flat.items()}
    tried: list[list[int]] = []
    for top in tops.values():
        level = [label for label, other in tops.items() if abs(other - top) < TOLERANCE]
        if len(level) > 1 and level not in tried:
            tried.append(level)
            longest = max(level, key=lambda label: float(np.hypot(*axis[label])))
            if along := _around(level, flat, axis[longest]):
                return along
    return set()


def _axis(points: np.ndarray) -> np.ndarray:
    """Twice the angle of the principal axis of points (2, n), as a vector as long as their variances differ."""
    x, y = points - points.sum(axis=1, keepdims=True) / points.shape[1]
    return np.array([x @ x - y @ y, 2 * (x @ y)]) / len(x)


def _around(level: list[int], points: Mapping[int, np.ndarray], axis: np.ndarray) -> set[int]:
    """Which of some equally high segments are walls along the rectangle around them that lies along an axis.

    Not the smallest rectangle: two walls at a right angle have another one just as small.  ``points`` (2, n) are those
    of all segments along the support.
    """
    angle = 0.5 * np.arctan2(axis[1], axis[0])
    directions = np.array([[-np.sin(angle), np.cos(angle)], [np.cos(angle), np.sin(angle)]])
    placed = {label: directions @ some for label, some in points.items()}
    around = np.concatenate([placed[label] for label in level], axis=1)
    low, high = around.min(axis=1), around.max(axis=1)
    half = np.maximum((high - low) / 2, 1e-9)  # of points on one line
    thick = min(_THICK, 0.2 * float(half.min()))
    middle, reach = ((low + high) / 2)[:, None], (half - thick)[:, None]
    within = {label: float((np.abs(some - middle) < reach).all(axis=0).mean()) for label, some in placed.items()}
    along = {label for label in level if within[label] < _OUTLYING}
    if not along or all(within[label] < 0.5 for label in points.keys() - along):
        return set()
    of_walls = (np.concatenate([placed[label] for label in along], axis=1) - middle) / half[:, None]
    cell = np.clip((_CELLS * (of_walls / 2 + 0.5)).astype(int), 0, _CELLS - 1)
    # Of the four sides in their order around the rectangle, the share of their cells that hold points beside them.
    beside = [(1 - sign * of_walls[k]) * half[k] < thick for sign in (1, -1) for k in (0, 1)]
    covered = np.array([np.unique(cell[1 - k % 2, beside[k]]).size for k in range(4)]) / _CELLS
    return along if (np.minimum(covered, np.roll(covered, 1)) > _LONG).any() else set()
