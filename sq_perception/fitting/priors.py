"""What is known of a body beyond its image: a support plane, and how bodies mostly are; compiled.

plane       how deep a body reaches below the plane, over sigma: h(-R^T n) - n.t - d, h the support function.
gap         how far it ends above the plane, over sigma, Cauchy: bodies do not hover, unless they stand on others.
rest        the two components of R^T n across the axis nearest to the normal, over sigma, Cauchy: bodies lie on a face.
proportion  log a_k minus the mean of the three, over sigma: what the image leaves open resembles what it shows.
expectation log a_k minus that of a predicted half size, over sigma, Cauchy: a prediction may be altogether wrong.
roundness   log(a1 / a2) and 1 - e2, over sigma, both together bivariate Cauchy: most bodies are of revolution about z,
            and those that are not are so by any amount.
hull        W (n_j.t + h(R^T n_j) - b_j): the support function in J directions against a predicted one b, whitened by
            W^T W, the inverse of its covariance (:attr:`~sq_perception.fitting.priors.HullPrior.root`).
taper       k_x and k_y over their standard deviation: most things do not taper.
volume      a linear price on log(a1 a2 a3), which prefers the smaller of two bodies that explain the image alike.

Derivatives are added to the normal equations ``sums``; the unknowns are those of
:mod:`sq_perception.fitting.residuals`, the sizes of the terms in :class:`~sq_perception.fitting.cost.Terms`.

What is known of a thing's convex hull before its pixels are looked at is its support function and its uncertainty:

    h(n) = max over the thing of n.p,     h(n_j) ~ N(b_j, S),     j = 1 .. J

n_j, b and S are in the optical frame of the camera, metres.  No thing is a superquadric: what the best one leaves over
is added to S as an independent error of each direction, ``MODEL_SHARE`` of the thing's extent.

The network predicts h ~ t_nu(b, S) with long tails (:mod:`sq_perception.learning.networks`); the fit takes S
alone, the scale of most errors.  With the tails the fit follows bodies that few directions agree with: that costs 1.3 %
of IoU on household things.  The covariance of the fitted body depends on them
(:mod:`sq_perception.fitting.quality`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sq_perception.fitting.cost import STEP_LENGTH, Terms, add_block
from sq_perception.fitting.intersection import form_of
from sq_perception.geometry.kernels import kernel, profile_sines, support_at

MODEL_SHARE = 0.02
"""Difference between a thing's support function and that of the nearest superquadric, as a share of the thing's extent.
Chosen on benchmarks/household_things, where 0.01 and 0.03 cost 0.2 % of IoU."""


@dataclass(frozen=True, eq=False)
class HullPrior:
    """A predicted support function.

    Attributes
    ----------
    directions : (J, 3)
        Unit vectors n_j, optical frame.
    support : (J,)
        b_j, metres from the origin of the optical frame.
    covariance : (J, J)
        S, square metres.
    extent : float
        The thing's size as far as it was seen, metres.
    freedom : float
        nu; infinite for errors of a normal distribution.
    """

    directions: np.ndarray
    support: np.ndarray
    covariance: np.ndarray
    extent: float
    freedom: float = math.inf

    @cached_property
    def root(self) -> np.ndarray:
        """W (J, J) with W^T W = (S + model error)^-1."""
        model = (MODEL_SHARE * self.extent) ** 2 * np.eye(len(self.support))
        return np.ascontiguousarray(np.linalg.cholesky(np.linalg.inv(self.covariance + model)).T)


@kernel
def prior_cost(terms: Terms, parameters: np.ndarray, rotation: np.ndarray, sums: np.ndarray) -> float:
    """Cost of all terms together."""
    rows = np.zeros((STEP_LENGTH + 1, 13))  # of all terms but the hull; residuals in the last row
    log_a1, log_a2, log_a3 = math.log(parameters[0]), math.log(parameters[1]), math.log(parameters[2])
    cost = terms.volume_price * (log_a1 + log_a2 + log_a3)
    sums[STEP_LENGTH, :3] += 0.5 * terms.volume_price
    if terms.plane_stiffness > 0.0:
        down = np.empty((1, 3))
        down[0] = -terms.plane[:3]
        rows[:, :1] = _support_rows(down, terms.plane[3:], parameters, rotation)
        is_below = rows[STEP_LENGTH, 0] > 0.0
        cost += _weigh(rows, 0, 1, terms.plane_stiffness if is_below else terms.gap_stiffness, 0.0 if is_below else 1.0)
    if terms.rest_stiffness > 0.0:
        n = terms.plane[:3] @ rotation
        upright = int(np.argmax(np.abs(n)))
        for j in range(1, 3):
            k, after, before = (upright + j) % 3, (upright + j + 1) % 3, (upright + j + 2) % 3
            rows[8 + before, j], rows[8 + after, j], rows[STEP_LENGTH, j] = n[after], -n[before], n[k]
        cost += _weigh(rows, 1, 3, terms.rest_stiffness, 1.0)
    if terms.proportion_stiffness > 0.0:
        mean = (log_a1 + log_a2 + log_a3) / 3.0
        for k in range(3):
            rows[:3, 3 + k] = -1.0 / 3.0
            rows[k, 3 + k] += 1.0
        rows[STEP_LENGTH, 3], rows[STEP_LENGTH, 4], rows[STEP_LENGTH, 5] = log_a1 - mean, log_a2 - mean, log_a3 - mean
        cost += _weigh(rows, 3, 6, terms.proportion_stiffness, 0.0)
    if terms.expectation_stiffness > 0.0:
        for k in range(3):
            rows[k, 6 + k], rows[STEP_LENGTH, 6 + k] = 1.0, math.log(parameters[k] / terms.expected[k])
            cost += _weigh(rows, 6 + k, 7 + k, terms.expectation_stiffness, 1.0)
    if terms.roundness_stiffness > 0.0:
        rows[0, 9], rows[1, 9], rows[STEP_LENGTH, 9] = 1.0, -1.0, log_a1 - log_a2
        rows[4, 10], rows[STEP_LENGTH, 10] = -1.0, 1.0 - parameters[4]
        cost += _weigh(rows, 9, 11, terms.roundness_stiffness, 3.0)
    if terms.taper_stiffness > 0.0:
        rows[11, 11], rows[12, 12], rows[STEP_LENGTH, 11:] = 1.0, 1.0, parameters[8:]
        cost += _weigh(rows, 11, 13, terms.taper_stiffness, 0.0)
    add_block(rows, rows.shape[1], sums)
    if terms.hull_directions.shape[0] > 0:
        cost += hull_cost(terms, parameters, rotation, sums)
    return cost


@kernel
def _weigh(rows: np.ndarray, begin: int, end: int, stiffness: float, tails: float) -> float:
    """The cost of the residuals of some columns, which become so stiff: their squares, or, if ``tails`` is not 0, so
    many times Cauchy's loss of them together."""
    square = 0.0
    for j in range(begin, end):
        square += (stiffness * rows[STEP_LENGTH, j]) ** 2
    scale = stiffness if tails == 0.0 else stiffness * math.sqrt(tails / (1.0 + square))
    for k in range(STEP_LENGTH + 1):
        for j in range(begin, end):
            rows[k, j] *= scale
    return square if tails == 0.0 else tails * math.log1p(square)


@kernel
def hull_cost(terms: Terms, parameters: np.ndarray, rotation: np.ndarray, sums: np.ndarray) -> float:
    """Cost |W (h - b)|^2 of the hull."""
    rows = _support_rows(terms.hull_directions, terms.hull_support, parameters, rotation) @ terms.hull_root.T
    add_block(rows, rows.shape[1], sums)
    square = 0.0
    for residual in rows[STEP_LENGTH]:
        square += residual * residual
    return square


@kernel
def hull_distances(terms: Terms, parameters: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Differences h - b (J,) of the support functions, metres."""
    return _support_rows(terms.hull_directions, terms.hull_support, parameters, rotation)[STEP_LENGTH]


@kernel
def _support_rows(
    directions: np.ndarray, support: np.ndarray, parameters: np.ndarray, rotation: np.ndarray
) -> np.ndarray:
    """Derivatives of h, a column for each direction, and h - b in the last row: one array, for vector code."""
    count = directions.shape[0]
    rows = np.empty((STEP_LENGTH + 1, count))
    for j in range(count):
        rows[5, j], rows[6, j], rows[7, j] = directions[j]
        rows[STEP_LENGTH, j] = -support[j]
    a1, a2, a3, e1, e2, k1, k2 = form_of(parameters)
    t1, t2, t3 = parameters[5], parameters[6], parameters[7]
    m11, m12, m13 = rotation[0]
    m21, m22, m23 = rotation[1]
    m31, m32, m33 = rotation[2]
    turned = np.empty((3, count))
    for j in range(count):
        d0, d1, d2 = rows[5, j], rows[6, j], rows[7, j]
        turned[0, j] = m11 * d0 + m21 * d1 + m31 * d2
        turned[1, j] = m12 * d0 + m22 * d1 + m32 * d2
        turned[2, j] = m13 * d0 + m23 * d1 + m33 * d2
    is_tapered = k1 != 0.0 or k2 != 0.0
    sines = profile_sines(turned, form_of(parameters)) if is_tapered else np.zeros(count)
    for j in range(count):
        n0, n1, n2 = turned[0, j], turned[1, j], turned[2, j]
        h, hx, hy, hz, h1, h2, hk1, hk2 = support_at(sines[j], n0, n1, n2, a1, a2, a3, e1, e2, k1, k2)
        rows[11, j], rows[12, j] = hk1, hk2
        rows[0, j], rows[1, j], rows[2, j] = hx * n0, hy * n1, hz * n2
        rows[3, j], rows[4, j] = h1, h2
        rows[8, j], rows[9, j], rows[10, j] = hy * n2 - hz * n1, hz * n0 - hx * n2, hx * n1 - hy * n0
        rows[STEP_LENGTH, j] += rows[5, j] * t1 + rows[6, j] * t2 + rows[7, j] * t3 + h
    return rows
