"""Rays of an object and of the free space beside it: a row each, its columns by name.

A pixel is a ray p = o + z d with o_z = 0 and d_z = 1, in the optical frame: o = 0 for a pinhole camera, d = (0, 0, 1)
for an orthographic one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

ORIGIN_X, ORIGIN_Y, DIRECTION_X, DIRECTION_Y, DEPTH, STIFFNESS, WEIGHT, LAST = range(8)
"""Columns of a ray.

DEPTH, metres: what the pixel measured; for a free ray, up to where its space is empty.  STIFFNESS, 1 / metres:
1 / sigma of the depth; 1 for a free ray, whose sigma is the outline's.  WEIGHT: as how many rays it counts.  LAST,
metres: where the ray met the body last time, which is where the next search for the intersection starts.
"""
RAY_COLUMNS = 8


class Rays(NamedTuple):
    """The rays that one stage of a fit draws."""

    hits: np.ndarray
    """(n, 8), pixels of the object."""
    free: np.ndarray
    """(m, 8), pixels beside it."""

    @property
    def weight(self) -> float:
        """Total weight of the object's rays: the cost of a body that leaves nothing but noise."""
        return float(self.hits[:, WEIGHT].sum())

    def weighing(self, factor: float) -> Rays:
        """The same rays with all weights times a factor."""
        hits, free = self.hits.copy(), self.free.copy()
        hits[:, WEIGHT] *= factor
        free[:, WEIGHT] *= factor
        return Rays(hits, free)

    def every(self, stride: int) -> Rays:
        """Each ``stride``-th ray."""
        return Rays(self.hits[::stride].copy(), self.free[::stride].copy())
