"""Compact pieces of a set of cells, of about one size.

The first centre is the cell that is farthest from a given place, each further one the cell farthest from those before.
Every cell belongs to the nearest centre, and the centres move to the means of their cells, some times (Lloyd 1982).
"""

from __future__ import annotations

import numpy as np

from sq_perception.geometry.kernels import kernel

_STEPS = 2
"""Steps of the centres; then no piece is a sliver at an end."""


def compact(cells: np.ndarray, count: int, place: tuple[float, float]) -> np.ndarray:
    """The piece, from 0, of each of some cells, bool (rows, columns); int32 (rows, columns), -1 elsewhere.

    There are at most ``count`` of them.  ``place`` is the row and column that the first centre is far from.
    """
    return _compact(np.ascontiguousarray(cells), count, float(place[0]), float(place[1]))


def warm_up() -> None:
    """Compile, or load from disk, the kernel."""
    compact(np.ones((2, 2), bool), 2, (0.0, 0.0))


@kernel
def _compact(cells: np.ndarray, count: int, row: float, column: float) -> np.ndarray:
    at = np.argwhere(cells).astype(np.float64)
    count = min(count, len(at))
    centres, of = np.empty((count, 2)), np.zeros(len(at), np.int32)
    square = (at[:, 0] - row) ** 2 + (at[:, 1] - column) ** 2
    for k in range(count):
        centres[k] = at[square.argmax()]
        from_it = (at[:, 0] - centres[k, 0]) ** 2 + (at[:, 1] - centres[k, 1]) ** 2
        square = from_it if k == 0 else np.minimum(square, from_it)
    for step in range(_STEPS + 1):
        for i in range(len(at)):
            least = np.inf
            for k in range(count):
                from_it_to = (at[i, 0] - centres[k, 0]) ** 2 + (at[i, 1] - centres[k, 1]) ** 2
                if from_it_to < least:
                    least, of[i] = from_it_to, k
        if step < _STEPS:
            sums, sizes = np.zeros((count, 2)), np.zeros(count)
            for i in range(len(at)):
                sums[of[i]] += at[i]
                sizes[of[i]] += 1
            for k in range(count):
                if sizes[k] > 0:
                    centres[k] = sums[k] / sizes[k]
    is_used = np.zeros(count, np.int32)
    is_used[of] = 1
    number = np.cumsum(is_used) - 1
    pieces = np.full(cells.shape, -1, np.int32)
    for i in range(len(at)):
        pieces[int(at[i, 0]), int(at[i, 1])] = number[of[i]]
    return pieces
