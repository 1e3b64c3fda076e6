"""Which observation continues which track.

A pair is possible in place if the bodies overlap: with h the support functions along the line of the centres, whose
distance is D,

    D / (h_track + h_observed) < 1/2,    or < 1 while the centres agree within their covariances.

Its cost is the negative logarithm of a Student density of the whole difference, in the observation's best form
(:mod:`sq_perception.tracking.forms`): with Mahalanobis distance d in n = 11 dimensions

    cost = (n + nu) log(1 + d^2 / nu) + log det S,

which ranks like a normal density close by and stays moderate for bodies that moved.  The assignment of least cost wins,
where what is left alone costs as much as a pair at d = 100: a pair close by is not given up for two far apart.

Two bodies cannot be in one place.  A track that overlaps an older one so deeply is its twin: most likely a piece that
a segmentation once cut off.  Of several observations in the place of a track the first is for the elder, the rest for
its twins: other pairs cost more.  Bodies of quite other sizes, such as an apple in a bowl, outweigh that.

What is left over may have been moved by more than its own size.  A body whose sizes and exponents alone agree, within
the distance that something can travel in the time, is taken for the same: these five errors are compared in the form
whose sizes fit best, whatever the rotation.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sq_perception.geometry.kernels import inline_kernel, kernel, support
from sq_perception.tracking import agreement, forms, state
from sq_perception.tracking.state import CENTRE, LENGTH, SIZE_AND_SHAPE

_DEEP = 0.5
"""D over both supports, where 1 is touching: no two things can be nearer than half of that.  Chosen."""
_FREEDOM = 5.0
"""nu of the Student density: long tails, as deviations are often too small.  Chosen."""
_ALONE = 1e4
"""d^2 of a pair, of the median of covariances, that costs as much as what is left alone: beyond any error.  Chosen."""
_TWIN = 30.0
"""What another pair than elder and first costs more: as much as d = 5.  Chosen."""


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


def in_place(
    track: np.ndarray,
    track_covariance: np.ndarray,
    observed: np.ndarray,
    covariance: np.ndarray,
) -> Pairs:
    """Pairs of n tracks (n, 12), oldest first, and m observations (m, 12), most important first, that overlap.

    Covariances are (n, 11, 11) and (m, 11, 11); what observations have in addition to theirs, such as a least error,
    is part of the tracks'.
    """
    apart = _apart(track, observed)
    between = observed[None, :, 5:8] - track[:, None, 5:8]
    centres = track_covariance[:, None, CENTRE, CENTRE] + covariance[None, :, CENTRE, CENTRE]
    agree = state.mahalanobis(centres, between) < agreement.LIMITS[3]
    deep = apart < _DEEP
    i, j = np.nonzero(deep | ((apart < 1) & agree))
    if not len(i):
        return Pairs.none()
    pairs = Pairs(i, j, *forms.nearest(track[i], track_covariance[i], observed[j], covariance[j], forms.EXCHANGE))
    total = track_covariance[i] + pairs.covariance
    error = state.difference(track[i], pairs.state)
    younger, later = np.any(twins(track), axis=1), np.greater(np.cumsum(deep, axis=1), deep)
    unlike = younger[i] != later[i, j]
    return _assigned(pairs, total, error, _TWIN * unlike, deep.shape)


def twins(states: np.ndarray) -> np.ndarray:
    """Whether state i is a twin of an older state j, bool (n, n), of states (n, 12), the oldest first."""
    return np.tril(_apart(states, states) < _DEEP, -1)


def elsewhere(
    track: np.ndarray,
    track_covariance: np.ndarray,
    reach: np.ndarray,
    observed: np.ndarray,
    covariance: np.ndarray,
) -> Pairs:
    """Pairs that agree in sizes and exponents, with centres within ``reach`` (n,) metres."""
    distance = np.linalg.norm(observed[None, :, 5:8] - track[:, None, 5:8], axis=-1)
    i, j = np.nonzero(distance < reach[:, None])
    if not len(i):
        return Pairs.none()
    free = _unplaced(track_covariance[i], distance[i, j])
    pairs = Pairs(i, j, *forms.nearest(track[i], free, observed[j], covariance[j], forms.EXCHANGE))
    total = (track_covariance[i] + pairs.covariance)[:, SIZE_AND_SHAPE, SIZE_AND_SHAPE]
    error = state.difference(track[i], pairs.state)[:, SIZE_AND_SHAPE]
    alike = state.mahalanobis(total, error) < agreement.LIMITS[5]
    way = distance[i, j] / reach[i]
    return _assigned(pairs.at(alike), total[alike], error[alike], way[alike], distance.shape)


def warm_up() -> None:
    """Compile, or load from disk, every kernel."""
    _apart(np.ones((1, 12)), np.ones((1, 12)))
    cheapest(np.ones((1, 1)))


@kernel
def _apart(some: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Distances (n, m) of the centres of states (n, 12) and (m, 12) over both supports along the way."""
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
    """The support of a state (12,) in a direction: half of what it measures along it."""
    a, b, c, w = state[8], state[9], state[10], state[11]
    # R^T n = n + 2 v x (v x n - w n) for the quaternion (v, w).
    dx, dy, dz = b * z - c * y - w * x, c * x - a * z - w * y, a * y - b * x - w * z
    return float(
        support(
            x + 2.0 * (b * dz - c * dy),
            y + 2.0 * (c * dx - a * dz),
            z + 2.0 * (a * dy - b * dx),
            state[0],
            state[1],
            state[2],
            state[3],
            state[4],
            0.0,
            0.0,
        )
    )


def _unplaced(covariance: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Covariances (k, 11, 11) that know sizes and exponents only."""
    free = covariance.copy()
    free[:, range(5, 8), range(5, 8)] += 1 + distance[:, None] ** 2
    free[:, range(8, 11), range(8, 11)] += 10.0
    return free


def _assigned(
    pairs: Pairs, covariance: np.ndarray, error: np.ndarray, more: np.ndarray, shape: tuple[int, ...]
) -> Pairs:
    """The pairs (k,) of the assignment that costs least, with errors (k, n) and what each costs more."""
    if not len(pairs.track):
        return pairs
    dimensions, volume = error.shape[-1] + _FREEDOM, np.linalg.slogdet(covariance)[1]
    cost = dimensions * np.log1p(state.mahalanobis(covariance, error) / _FREEDOM) + volume
    table = np.full(shape, dimensions * np.log1p(_ALONE / _FREEDOM) + np.median(volume))
    table[pairs.track, pairs.observed] = cost + more
    kept = cheapest(table) if len(table) <= len(table.T) else cheapest(table.T.copy()).T
    return pairs.at(kept[pairs.track, pairs.observed])


@kernel
def cheapest(cost: np.ndarray) -> np.ndarray:
    """The pairs of rows and columns with the least sum of costs (n, m), n <= m, each row in one: (n, m), bool.

    Rows are added one by one, each by the shortest path that changes earlier pairs, in costs less the prices of rows
    and columns (Crouse, On implementing 2D rectangular assignment algorithms, 2016).
    """
    rows, columns = cost.shape
    of_row, of_column = np.full(rows, -1), np.full(columns, -1)
    of_rows, of_columns = np.zeros(rows), np.zeros(columns)  # prices
    for new in range(rows):
        length, before = np.full(columns, np.inf), np.full(columns, -1)
        done = np.zeros(columns, dtype=np.bool_)
        row, end, so_far = new, -1, 0.0
        while row >= 0:
            end = -1
            for j in range(columns):
                if not done[j]:
                    through = so_far + cost[row, j] - of_rows[row] - of_columns[j]
                    if through < length[j]:
                        length[j], before[j] = through, row
                    if end < 0 or length[j] < length[end]:
                        end = j
            done[end] = True
            row, so_far = of_column[end], length[end]
        of_rows[new] += so_far
        for j in range(columns):
            if done[j]:
                of_columns[j] -= so_far - length[j]
                if j != end:
                    of_rows[of_column[j]] += so_far - length[j]
        while end >= 0:  # the row before takes the end, and its own column is the next end; the new one had none
            row = before[end]
            of_column[end] = row
            of_row[row], end = end, of_row[row]
    pairs = np.zeros((rows, columns), dtype=np.bool_)
    for i in range(rows):
        pairs[i, of_row[i]] = True
    return pairs
