"""The size of what points show, as a ruler measures it: edges of the box around them."""

from __future__ import annotations

import math

import numpy as np

LARGEST_THING = 0.6
"""Metres: the largest edge of a thing, unless it is said otherwise."""
_SAMPLES = 400
"""Pixels of a segment, evenly taken: the 1 % that may stick out are a few still."""
_OUTLIERS = 0.01
"""Share of the points at either end that do not count for the extent: sensors smear edges."""
TURNS = np.stack([np.cos(np.deg2rad(np.arange(0, 180, 10))), np.sin(np.deg2rad(np.arange(0, 180, 10)))], axis=1)
"""Directions (18, 2) in which edges are measured."""


def across(normal: np.ndarray) -> np.ndarray:
    """Two axes (3, 2) at right angles to a normal."""
    x, y, z = normal.tolist()
    a, b, c = (z, 0.0, -x) if abs(z) > 0.5 else (-y, x, 0.0)
    axes = np.array([[a, y * c - z * b], [b, z * a - x * c], [c, x * b - y * a]])
    return axes / math.sqrt(a * a + b * b + c * c)


def largest_edge(points: np.ndarray, up: np.ndarray | None = None) -> float:
    """Largest edge of the box around points (n, 3) whose largest edge is least, metres: upright, or of principal axes.

    A hundredth of the points at either end may stick out.
    """
    points = points[:: 1 + len(points) // _SAMPLES]
    if up is None:
        axes = np.linalg.eigh(np.cov(points.T))[1] if len(points) > 3 else np.eye(3)
        return float(_extents(axes.T @ points.T).max())
    edges = _extents(np.concatenate([TURNS @ across(up).T, up[None]]) @ points.T)
    # A quarter turn apart, the two edges of one rectangle.
    half = len(TURNS) // 2
    return float(max(np.maximum(edges[:half], edges[half:-1]).min(), edges[-1]))


def _extents(values: np.ndarray) -> np.ndarray:
    """The extent of the values of each row, without what sticks out."""
    ordered = np.sort(values, axis=1)
    out = int(_OUTLIERS * values.shape[1])
    return np.asarray(ordered[:, -1 - out] - ordered[:, out])
