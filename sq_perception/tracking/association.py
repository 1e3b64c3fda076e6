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

Agreement
---------
With the error e = z - x^ and S, the sum of both covariances, an observation agrees with its track if

    e^T S^-1 e < chi2_11(0.999)

and neither its centre nor its rotation alone lies outside of chi2_3(0.999) by more than what no one would call motion.
Errors common to several views are in the estimate and in the observation and cancel in e, so that for views from one
side S is up to 2.5 times too large: a margin for fits whose errors exceed what they report.

Forms
-----
The 24 rotations T of a cube rename a body's axes: R -> R T, sizes change places, and a rotation vector w of the body's
frame becomes T^T w.  Eight of them keep z on its line and describe the same body.  The other sixteen exchange z with x
or y.  Of the principal cross sections, xy is rounded by e2, yz and zx by e1; after the exchange of z and x the section
yz has become xy, and the other two share one exponent:

    e2' = e1,    e1' = (e1 + e2) / 2,

wrong by (e1 - e2) / 2 in each of them.  A box whose exponents differ by less than the noise is fitted now with one axis
as z and now with another.  So an exchange is a candidate too where |e1 - e2| < 1/2, with the variance (e1 - e2)^2
added to both exponents: exponents of fitted boxes and ovals differ by less, those of cylinders by more.  The candidate
of greatest likelihood is taken: least d^2 + log det S.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.kernels import inline_kernel, kernel, support
from sq_perception.tracking import state
from sq_perception.tracking.state import CENTRE, HAND, LENGTH, SHAPE, SIZE, SIZE_AND_SHAPE, TURN

DEEP = 0.5  # d over both supports, 1 where bodies touch, below which they are in one place: no two things are.  Chosen.


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
    """Pairs of n tracks (n, 12) and m observations (m, 12) that overlap.  Covariances are (n, 11, 11) and (m, 11, 11);
    an error that observations have beside theirs is part of the tracks'."""
    distance = separation(track, observed)
    between = observed[None, :, 5:8] - track[:, None, 5:8]
    centres = track_covariance[:, None, CENTRE, CENTRE] + covariance[None, :, CENTRE, CENTRE]
    agree = state.mahalanobis(centres, between) < LIMITS[3]
    i, j = np.nonzero((distance < DEEP) | ((distance < 1) & agree))
    if not len(i):
        return Pairs.none()
    pairs = Pairs(i, j, *nearest_form(track[i], track_covariance[i], observed[j], covariance[j]))
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
    free = loosen_pose(track_covariance[i], distance[i, j])
    pairs = Pairs(i, j, *nearest_form(track[i], free, observed[j], covariance[j]))
    total = (track_covariance[i] + pairs.covariance)[:, SIZE_AND_SHAPE, SIZE_AND_SHAPE]
    error = state.difference(track[i], pairs.state)[:, SIZE_AND_SHAPE]
    alike = state.mahalanobis(total, error) < LIMITS[5]
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
    # d^2, with the median covariance, that costs as much as what is left alone. Chosen: beyond any error.
    table = np.full(shape, 2 * n * np.log1p(1e4 / n) + np.median(volume))
    table[pairs.track, pairs.observed] = 2 * n * np.log1p(state.mahalanobis(covariance, error) / n) + volume + extra
    chosen = cheapest(table) if len(table) <= len(table.T) else cheapest(table.T.copy()).T
    return pairs.at(chosen[pairs.track, pairs.observed])


@kernel
def cheapest(cost: np.ndarray) -> np.ndarray:
    """The pairs with the least sum of costs (n, m), n <= m, each row in one: (n, m), bool.  The Hungarian method with
    potentials and shortest paths (Kuhn 1955, Jonker and Volgenant 1987); row 0 and column 0 stand for none."""
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


LIMITS = {3: 16.266236196238125, 5: 20.515005652432876, LENGTH: 31.26413362023999}
"""chi-squared numbers of so many dimensions stay below with probability 0.999.  Chosen: one good observation in 1000 is
doubted."""


class Agreement(NamedTuple):
    """How n observations agree with their tracks, arrays (n,)."""

    agrees: np.ndarray
    fits: np.ndarray  # in sizes and exponents; agrees: as a whole
    slid: np.ndarray
    turned: np.ndarray  # the rotation is elsewhere; slid: the centre
    excess: np.ndarray  # e^T S^-1 e over its limit, at least 1


def compare(size: np.ndarray, total: np.ndarray, error: np.ndarray) -> Agreement:
    """The agreement of errors (n, 11) with covariances S (n, 11, 11), of bodies with half sizes (n, 3)."""
    # No motion: displacements below this share of the mean half size, and rotations below so many radians. Chosen: one
    # or two millimetres of a household thing, 3 degrees.
    still = 0.05

    def is_outside(part: slice) -> np.ndarray:
        return state.mahalanobis(total[:, part, part], error[:, part]) > LIMITS[part.stop - part.start]

    slid = is_outside(CENTRE) & (np.linalg.norm(error[:, CENTRE], axis=-1) > still * size.mean(axis=-1))
    turned = is_outside(TURN) & (np.linalg.norm(error[:, TURN], axis=-1) > still)
    excess = state.mahalanobis(total, error) / LIMITS[LENGTH]
    return Agreement((excess <= 1) & ~slid & ~turned, ~is_outside(SIZE_AND_SHAPE), slid, turned, np.maximum(excess, 1))


def is_same_side(before: np.ndarray, now: np.ndarray) -> bool:
    """Whether two vectors are less than 60 degrees apart; False for zero."""
    return bool(before @ now > 0.5 * np.linalg.norm(before) * np.linalg.norm(now))


def _rotations() -> np.ndarray:
    """The 24 rotation matrices with entries 0 and +-1, the 8 that leave z on its line first."""
    found = []
    for order in ((0, 1, 2), (1, 0, 2), (0, 2, 1), (2, 1, 0), (1, 2, 0), (2, 0, 1)):
        for signs in np.ndindex(2, 2, 2):
            turn = np.eye(3)[:, list(order)] * (1 - 2 * np.array(signs))
            if np.linalg.det(turn) > 0:
                found.append(turn)
    return np.array(found)


TURNS = _rotations()
EXACT = 8  # the number of rotations that describe the same body
_QUATERNIONS = quaternions.from_matrix(TURNS)
_CHANGES = np.zeros((len(TURNS), LENGTH, LENGTH))  # what the renaming of axes makes of an error
_CHANGES[:, range(3, 8), range(3, 8)] = 1
_CHANGES[:, SIZE, SIZE] = np.abs(TURNS).transpose(0, 2, 1)
_CHANGES[:, TURN, TURN] = TURNS.transpose(0, 2, 1)
_CHANGES[EXACT:, SHAPE, SHAPE] = [[0.5, 0.5], [1.0, 0.0]]


def candidates(observed: np.ndarray) -> np.ndarray:
    """All 24 forms (..., 24, 12) of states (..., 12)."""
    changed = np.einsum("kij,...j->...ki", _CHANGES[:, :8, :8], observed[..., :8])
    return np.concatenate([changed, quaternions.multiply(observed[..., None, 8:12], _QUATERNIONS)], axis=-1)


def nearest_form(
    track: np.ndarray, track_covariance: np.ndarray, observed: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The form of each of n observations (n, 12) that continues its track (n, 12), and its covariance (n, 11, 11)."""
    each = np.arange(len(track))
    unlike = np.abs(observed[:, 3] - observed[:, 4])
    is_box = unlike < 0.5
    count = len(TURNS) if is_box.any() else EXACT
    forms = candidates(observed)[:, :count]
    changed = _CHANGES[:count] @ covariance[:, None] @ _CHANGES[:count].swapaxes(-1, -2)
    changed[:, EXACT:, range(3, 5), range(3, 5)] += unlike[:, None, None] ** 2
    total = changed + track_covariance[:, None]
    cost = state.mahalanobis(total, state.difference(track[:, None], forms)) + np.linalg.slogdet(total)[1]
    cost[:, EXACT:][~is_box] = np.inf
    best = np.argmin(cost, axis=1)
    return forms[each, best], changed[each, best]


def loosen_pose(covariance: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Covariances (n, 11, 11) of bodies that were carried by ``distance`` (n,) metres and may have been rotated."""
    deviation = np.zeros((len(covariance), LENGTH))
    deviation[:, CENTRE], deviation[:, TURN] = distance[:, None], HAND
    return covariance + deviation[:, :, None] ** 2 * np.eye(LENGTH)


def rename_axes(
    track: np.ndarray, track_covariance: np.ndarray, observed: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """An observation (12,) that its track does not follow, and its covariance, with the axes named as the track's.  The
    rotation about an axis that the observation leaves open, as of something round, is the track's."""
    distance = np.linalg.norm(observed[None, 5:8] - track[5:8], axis=-1)
    free = loosen_pose(track_covariance[None], distance)
    (form,), (changed,) = nearest_form(track[None], free, observed[None], covariance[None])
    is_open = np.diag(changed)[TURN] > state.DETERMINED**2
    turn = np.where(is_open, state.difference(form, track)[TURN], 0)
    return np.append(form[:8], quaternions.multiply(form[8:], quaternions.from_rotation_vector(turn))), changed
