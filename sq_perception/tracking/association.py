"""Which observation continues which track.

A pair passes the gate in place if the bodies overlap: with the support functions h along the line of the centres, whose
distance is D,

    D / (h_track + h_observed) < 1/2,    or < 1 while the centres agree within their covariances.

Its cost is the negative logarithm of a Student density with n degrees of freedom of the difference in n dimensions,

    cost = 2 n log(1 + d^2 / n) + log det S,

like that of a normal density close by, and moderate for bodies that moved.  The assignment of least cost is taken;
what is left alone costs as much as a pair at d = 100: a pair close by is not given up for two far apart.

What is left over may have been moved by more than its own size.  It is the same body if its sizes and exponents agree
within the distance that something can be carried in the time.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sq_perception.geometry.kernels import inline_kernel, kernel, support
from sq_perception.tracking import forms, gating, state
from sq_perception.tracking.state import CENTRE, LENGTH, SIZE_AND_SHAPE

DEEP = 0.5
"""D over both supports, 1 where bodies touch, below which they are in one place: no two things are.  Chosen."""
_ALONE = 1e4
"""d^2, with the median covariance, that costs as much as what is left alone.  Chosen: beyond any error."""


class Pairs(NamedTuple):
    """k pairs: indices of tracks and observations, and the observations in the tracks' forms."""

    track: np.ndarray
    observed: np.ndarray
    state: np.ndarray
    covariance: np.ndarray

    @classmethod
    def none(cls) -> Pairs:
        nothing = np.zeros(0, dtype=int)
        return cls(nothing, nothing, np.zeros((0, 12)), np.zeros((0, LENGTH, LENGTH)))

    def at(self, which: np.ndarray) -> Pairs:
        return Pairs(*(part[which] for part in self))

    def __add__(self, other: Pairs) -> Pairs:  # type: ignore[override]
        return Pairs(*(np.concatenate(both) for both in zip(self, other, strict=True)))


def pairs_in_place(
    track: np.ndarray, track_covariance: np.ndarray, observed: np.ndarray, covariance: np.ndarray
) -> Pairs:
    """Pairs of n tracks (n, 12) and m observations (m, 12) that overlap.

    Covariances are (n, 11, 11) and (m, 11, 11); an error that observations have beside theirs is part of the tracks'.
    """
    distance = separation(track, observed)
    between = observed[None, :, 5:8] - track[:, None, 5:8]
    centres = track_covariance[:, None, CENTRE, CENTRE] + covariance[None, :, CENTRE, CENTRE]
    agree = state.mahalanobis(centres, between) < gating.LIMITS[3]
    i, j = np.nonzero((distance < DEEP) | ((distance < 1) & agree))
    if not len(i):
        return Pairs.none()
    pairs = Pairs(i, j, *forms.nearest(track[i], track_covariance[i], observed[j], covariance[j]))
    total = track_covariance[i] + pairs.covariance
    return _assign(pairs, total, state.difference(track[i], pairs.state), np.zeros(len(i)), distance.shape)


def pairs_elsewhere(
    track: np.ndarray, track_covariance: np.ndarray, reach: np.ndarray, observed: np.ndarray, covariance: np.ndarray
) -> Pairs:
    """Pairs that agree in sizes and exponents, with centres within ``reach`` (n,) metres; the near ones first."""
    distance = np.linalg.norm(observed[None, :, 5:8] - track[:, None, 5:8], axis=-1)
    i, j = np.nonzero(distance < reach[:, None])
    if not len(i):
        return Pairs.none()
    free = forms.loosen_pose(track_covariance[i], distance[i, j])
    pairs = Pairs(i, j, *forms.nearest(track[i], free, observed[j], covariance[j]))
    total = (track_covariance[i] + pairs.covariance)[:, SIZE_AND_SHAPE, SIZE_AND_SHAPE]
    error = state.difference(track[i], pairs.state)[:, SIZE_AND_SHAPE]
    alike = state.mahalanobis(total, error) < gating.LIMITS[5]
    way = distance[i, j] / reach[i]
    return _assign(pairs.at(alike), total[alike], error[alike], way[alike], distance.shape)


def warm_up() -> None:
    """Compile, or load from disk, every kernel."""
    separation(np.ones((1, 12)), np.ones((1, 12)))
    cheapest(np.ones((1, 1)))


@kernel
def separation(some: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Distances (n, m) of the centres of states (n, 12) and (m, 12) over both supports along their line."""
    found = np.empty((len(some), len(others)))
    for i in range(len(some)):
        for j in range(len(others)):
            x, y, z = others[j, 5] - some[i, 5], others[j, 6] - some[i, 6], others[j, 7] - some[i, 7]
            distance = math.sqrt(x * x + y * y + z * z)
            step = 1.0 / max(distance, 1e-12)
            extent = _extent(some[i], x * step, y * step, z * step) + _extent(others[j], x * step, y * step, z * step)
            found[i, j] = distance / max(extent, 1e-12)
    return found


@inline_kernel
def _extent(state: np.ndarray, x: float, y: float, z: float) -> float:
    """The support of a state (12,) in a unit direction."""
    a, b, c, w = state[8], state[9], state[10], state[11]
    # R^T n = n + 2 v x (v x n - w n) for the quaternion (v, w).
    dx, dy, dz = b * z - c * y - w * x, c * x - a * z - w * y, a * y - b * x - w * z
    x, y, z = x + 2.0 * (b * dz - c * dy), y + 2.0 * (c * dx - a * dz), z + 2.0 * (a * dy - b * dx)
    form = state[0], state[1], state[2], state[3], state[4], 0.0, 0.0
    return float(support(x, y, z, *form))


def _assign(
    pairs: Pairs, covariance: np.ndarray, error: np.ndarray, extra: np.ndarray, shape: tuple[int, ...]
) -> Pairs:
    """The pairs (k,) of the assignment of least cost, with errors (k, n) and what each costs beside them."""
    if not len(pairs.track):
        return pairs
    n, volume = error.shape[-1], np.linalg.slogdet(covariance)[1]
    table = np.full(shape, 2 * n * np.log1p(_ALONE / n) + np.median(volume))
    table[pairs.track, pairs.observed] = 2 * n * np.log1p(state.mahalanobis(covariance, error) / n) + volume + extra
    chosen = cheapest(table) if len(table) <= len(table.T) else cheapest(table.T.copy()).T
    return pairs.at(chosen[pairs.track, pairs.observed])


@kernel
def cheapest(cost: np.ndarray) -> np.ndarray:
    """The pairs of rows and columns with the least sum of costs (n, m), n <= m, each row in one: (n, m), bool.

    The Hungarian method with potentials: row after row takes the end of its shortest alternating path to a free column
    (Kuhn 1955, Jonker and Volgenant 1987).  Row 0 and column 0 stand for none.
    """
    rows, columns = cost.shape
    of_rows, of_columns = np.zeros(rows + 1), np.zeros(columns + 1)  # potentials
    row_of = np.zeros(columns + 1, dtype=np.int64)
    for new in range(1, rows + 1):
        length, before = np.full(columns + 1, np.inf), np.zeros(columns + 1, dtype=np.int64)
        done = np.zeros(columns + 1, dtype=np.bool_)
        row_of[0], end = new, 0
        while row_of[end] > 0:
            done[end] = True
            row, start, end, step = row_of[end], end, 0, np.inf
            for j in range(1, columns + 1):
                if not done[j]:
                    reduced = cost[row - 1, j - 1] - of_rows[row] - of_columns[j]
                    if reduced < length[j]:
                        length[j], before[j] = reduced, start
                    if length[j] < step:
                        step, end = length[j], j
            for j in range(columns + 1):
                if done[j]:
                    of_rows[row_of[j]] += step
                    of_columns[j] -= step
                else:
                    length[j] -= step
        while end > 0:
            row_of[end], end = row_of[before[end]], before[end]
    pairs = np.zeros((rows, columns), dtype=np.bool_)
    for j in range(1, columns + 1):
        if row_of[j] > 0:
            pairs[row_of[j] - 1, j - 1] = True
    return pairs
