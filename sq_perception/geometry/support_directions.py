"""Directions in which a support function is sampled: h(n) = max over a body of n.p, for n on the unit sphere.

The 42 vertices of an icosahedron whose 20 faces were divided once.  They are the same set after a reflection of any one
coordinate, so that the mirrored image of a thing has the mirrored support function: its values change places.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

_GOLDEN = (1 + np.sqrt(5)) / 2


def _icosphere() -> np.ndarray:
    """Return the corners (12, 3) of a regular icosahedron, then the middles (30, 3) of its edges, of length 1."""
    corners = np.array([[0, a, b * _GOLDEN] for a in (1, -1) for b in (1, -1)])
    corners = np.concatenate([np.roll(corners, k, axis=1) for k in range(3)])
    edge = 2.0
    pairs = [(i, j) for i, j in combinations(range(12), 2) if np.linalg.norm(corners[i] - corners[j]) < 1.1 * edge]
    middles = np.array([corners[i] + corners[j] for i, j in pairs])
    points = np.concatenate([corners, middles])
    points = points / np.linalg.norm(points, axis=1, keepdims=True)
    points.flags.writeable = False
    return points


DIRECTIONS = _icosphere()
"""(42, 3) unit vectors, read only."""


def mirrored(axis: int) -> np.ndarray:
    """Return indices (42,) of the directions after coordinate ``axis`` changes its sign; its own inverse."""
    image = DIRECTIONS * np.where(np.arange(3) == axis, -1, 1)
    return np.asarray(np.argmax(image @ DIRECTIONS.T, axis=1))
