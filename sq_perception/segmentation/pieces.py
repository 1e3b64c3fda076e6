"""Compact pieces of a set of cells, of about one size.

The first centre is the cell that is farthest from a given place, each further one the cell farthest from those before.
Every cell belongs to the nearest centre, and the centres move to the means of their cells, some times (Lloyd 1982).
"""

from __future__ import annotations

import numpy as np

_STEPS = 2
"""Of the centres; then no piece is a sliver at an end."""


def compact(cells: np.ndarray, count: int, place: np.ndarray) -> list[np.ndarray]:
    """Pieces, at most ``count``, each bool (rows, columns), of cells, bool (rows, columns), of which there are some.

    ``place`` is the row and column that the first centre is far from.
    """
    at = np.argwhere(cells).astype(float)
    centres = at[[_squares(at, np.asarray(place, float)[None]).argmax()]]
    while len(centres) < min(count, len(at)):
        centres = np.concatenate([centres, at[[_squares(at, centres).min(axis=1).argmax()]]])
    for _ in range(_STEPS):
        nearest = _squares(at, centres).argmin(axis=1)
        centres = np.stack([at[nearest == k].mean(axis=0) for k in np.unique(nearest)])
    of = np.full(cells.shape, -1)
    of[cells] = _squares(at, centres).argmin(axis=1)
    return [of == k for k in np.unique(of[cells])]


def _squares(at: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Squared distances (n, k)."""
    return np.asarray(np.square(at[:, None] - centres).sum(axis=-1))
