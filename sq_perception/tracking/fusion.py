"""Fusing what was observed of one body, without counting the same error twice.

Equations
---------
An observation z of the state x with covariance R, seen from the direction c in the body's frame, has three errors,

    z = x + g + b_c + v,    cov g = gamma R,    cov b_c = B = rho R + F,    cov v = W = (1 - rho - gamma) R.

v is new in every frame.  b_c is common to all views from within an angle of c: it is what a still camera sees wrongly
again and again, an outline, a wrong hidden side, an object that is no superquadric, a camera that is not quite
calibrated.  F is its least size.  b_c is considered and not estimated (Schmidt 1966): along with the covariance P of
the error x^ - x of the estimate its correlation C_c = cov(x^ - x, b_c) with each view is kept, and

    S = P - C_c - C_c^T + B + W,    K = (P - C_c) S^-1,    x^ <- x^ + K (z - x^),
    P <- (I-K) P (I-K)^T + (I-K) C_c K^T + K C_c^T (I-K)^T + K (B + W) K^T,
    C_j <- (I-K) C_j + K B [j = c].

g is common to all views from anywhere, such as edges that a sensor widens or what a network takes the unseen side for,
and no number of views lessens it.  It is g = L q with L L^T = gamma R and one unknown q of unit covariance for the life
of the track.  Its effect on x^ is carried along,

    M <- (I-K) M + K L,    cov(x^ - x) = P + M M^T,

and K does not know of it: a gain that did would subtract one view from another to cancel what they are supposed to
share.

An answer that repeats an earlier one, of readings that are the same but for noise, has the same v again and shows no
more than that the body is where it was: it is not fused, K = 0.

Equal views are averaged with equal weights and P falls to B, not to zero; views from elsewhere count as new.  With rho
= gamma = 0 and F = 0 it is the Kalman filter of a constant.

A view beyond the kept number takes the place of the one used longest ago: P keeps its error, only that a later look
from there counts as new.  So does, in those numbers, a look that knows some of them far better than the view's common
error: a hand was in front, say, and is no more.  The three of the centre count as one, as their axes are the world's.

Reference: S. F. Schmidt, Application of State-Space Methods to Navigation Problems, Adv. in Control Systems 3, 1966.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.tracking import state
from sq_perception.tracking.state import CENTRE, LENGTH, TURN

VIEW_ANGLE = 0.25
"""Radians: views closer than this share their systematic error.  Chosen: outlines change little within 14 degrees."""
VIEWS = 16
"""Directions that are remembered for each body: two thirds of a circle at ``VIEW_ANGLE``.  Each costs time."""
_BETTER = 4.0
"""Ratio of variances: a look is far better that halves a deviation.  Chosen: of 224 looks at eight simulated bodies
that nothing hid, the least sure first look had 2.1 times a later one's."""


class Views(NamedTuple):
    """The directions that bodies were seen from; batch dimensions first, then one entry per kept view.

    Attributes
    ----------
    direction : (..., m, 3)
        Unit vector from the body to the camera, body frame; zero for an entry not used yet.
    bias : (..., m, 11, 11)
        B of each view.
    correlation : (..., m, 11, 11)
        C of each view.
    used : (..., m)
        Number of the observation that used it last; -1 never.
    """

    direction: np.ndarray
    bias: np.ndarray
    correlation: np.ndarray
    used: np.ndarray

    @classmethod
    def first(cls, direction: np.ndarray, bias: np.ndarray) -> Views:
        """One view, whose common error is that of the estimate."""
        directions, biases, used = np.zeros((VIEWS, 3)), np.zeros((VIEWS, LENGTH, LENGTH)), np.full(VIEWS, -1)
        directions[0], biases[0], used[0] = direction, bias, 0
        return cls(directions, biases, biases, used)

    def of(self, index: int) -> Views:
        return Views(*(part[index] for part in self))


def fused(
    track: np.ndarray,
    covariance: np.ndarray,
    lasting: np.ndarray,
    views: Sequence[Views],
    observed: np.ndarray,
    white: np.ndarray,
    common: np.ndarray,
    shared: np.ndarray,
    direction: np.ndarray,
    turning: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Views]:
    """n tracks after one observation each.

    Parameters
    ----------
    track, observed : (n, 12)
        States in the world frame, in the same form.
    covariance : (n, 11, 11)
        P.
    lasting : (n, 11, 11)
        M.
    views
        Of each track; those after the observation are returned as a batch (n,).
    white, common : (n, 11, 11)
        W, and B for a view from a new direction.
    shared : (n, 11, 11)
        L.
    direction : (n, 3)
        Unit vector from the body to the camera, world frame.
    turning : (n,) bool
        Bodies that have turned themselves.  What rotates a resting body's estimate is a correction, and what it was
        seen from stays where it is in the world; a turned body shows another side.
    """
    count = len(track)
    error = state.difference(track, observed)
    has_turned = turning[:, None] & (np.einsum("nii->ni", white + common)[:, TURN] < state.DETERMINED**2)
    turn = quaternions.from_rotation_vector(np.where(has_turned, error[:, TURN], 0.0))
    seen_as = quaternions.multiply(track[:, 8:12], turn)
    local = np.einsum("nji,nj->ni", quaternions.to_matrix(seen_as), direction)

    row = np.arange(count)
    directions, biases, correlations, used = (np.stack(parts) for parts in zip(*views, strict=True))
    likeness = np.einsum("nmi,ni->nm", directions, local)
    place = np.argmax(likeness, axis=1)
    fresh = likeness[row, place] < np.cos(VIEW_ANGLE)
    place = np.where(fresh, np.argmin(used, axis=1), place)
    directions[row[fresh], place[fresh]] = local[fresh]
    used[row, place] = used.max(axis=1) + 1

    bias, correlation = biases[row, place], correlations[row, place]
    better = fresh[:, None] | (_variances(bias) > _BETTER * _variances(common))
    same = ~better[:, :, None] & ~better[:, None, :]
    bias = np.where(same, bias, np.where(better[:, :, None] & better[:, None, :], common, 0.0))
    correlation = np.where(better[:, None, :], 0.0, correlation)
    biases[row, place], correlations[row, place] = bias, correlation
    noise = bias + white
    total = covariance - correlation - correlation.swapaxes(1, 2) + noise
    gain = np.linalg.solve(total, (covariance - correlation).swapaxes(1, 2)).swapaxes(1, 2)
    step = np.einsum("nij,nj->ni", gain, error)

    kept = np.eye(LENGTH) - gain
    cross = kept @ correlation @ gain.swapaxes(1, 2)
    after = kept @ covariance @ kept.swapaxes(1, 2) + cross + cross.swapaxes(1, 2) + gain @ noise @ gain.swapaxes(1, 2)
    correlations = kept[:, None] @ correlations
    correlations[row, place] += gain @ bias

    back = quaternions.to_matrix(quaternions.from_rotation_vector(np.where(has_turned, 0.0, step[:, TURN])))
    after = 0.5 * (after + after.swapaxes(1, 2))
    seen = Views(directions @ back, biases, correlations, used)
    return state.moved(track, step), after, kept @ lasting + gain @ shared, seen


def _variances(covariance: np.ndarray) -> np.ndarray:
    """The variances (n, 11) of covariances (n, 11, 11), for the centre their mean, which is the same in any world."""
    variances = np.einsum("nii->ni", covariance).copy()
    variances[:, CENTRE] = variances[:, CENTRE].mean(axis=1, keepdims=True)
    return variances


def root(covariance: np.ndarray) -> np.ndarray:
    """The symmetric roots of covariances (..., 11, 11): they turn with the world, which Cholesky's do not."""
    values, vectors = np.linalg.eigh(covariance)
    return (vectors * np.sqrt(np.maximum(values, 0))[..., None, :]) @ vectors.swapaxes(-1, -2)
