"""What is known of a body beyond its image: a support plane, and how bodies mostly are; compiled.

plane       (lowest point above the plane) / sigma where negative: n.t + d - h(-R^T n), h the support function.
gap         as ``plane`` where positive, another sigma, Cauchy: bodies do not hover, unless they stand on other things.
rest        the two components of R^T n across the axis nearest to the normal, over sigma, Cauchy: bodies lie on a face.
proportion  log a_k minus the mean of the three, over sigma: what the image leaves open resembles what it shows.
expectation log a_k minus that of a predicted half size, over sigma, Cauchy: a prediction may be altogether wrong.
roundness   log(a1 / a2) and 1 - e2, over sigma, both together bivariate Cauchy: most bodies are of revolution about z,
            and those that are not are so by any amount.
hull        W (n_j.t + h(R^T n_j) - b_j): the support function in J directions against a predicted one b, whitened by
            W^T W, the inverse of its covariance (:meth:`~sq_perception.fitting.priors.HullPrior.root`).
taper       k_x and k_y over their standard deviation: most things do not taper.
volume      a linear price on log(a1 a2 a3), which prefers the smaller of two bodies that explain the image alike.

Each function returns its share of the cost and adds its derivatives to the normal equations ``sums``; the unknowns are
those of :mod:`sq_perception.fitting.residuals`, the sizes of the terms in :class:`~sq_perception.fitting.cost.Terms`.

What is known of a thing's convex hull before its pixels are looked at is its support function and its uncertainty:

    h(n) = max over the thing of n.p,     h(n_j) ~ N(b_j, S),     j = 1 .. J

n_j, b and S are in the optical frame of the camera, metres.  No thing is a superquadric: what the best one leaves over
is added to S as an independent error of each direction, ``MODEL_SHARE`` of the thing's extent.

The network predicts h ~ t_nu(b, S) with long tails (:mod:`sq_perception.learning.networks`); the fit takes S
alone, the scale of most errors.  With the tails the fit follows bodies that few directions agree with: that cost 1.3 %
of IoU on 229 things of benchmarks/household_things, seeds from 5000.  The covariance of the fitted body depends on them
(:mod:`sq_perception.fitting.quality`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sq_perception.fitting.cost import STEP_LENGTH, Terms, add_block, add_row
from sq_perception.fitting.intersection import form_of
from sq_perception.geometry.kernels import kernel, profile_sines, support_at, support_derivatives

PULL_SHARE = 0.07
"""Standard deviation, as a share of the thing's extent, of the pull on a body that misfits twice as much as the best
do.  On 408 things of benchmarks/household_things, seeds from 5000, 0.05 to 0.14 change IoU by less than 0.2 %."""
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

    def root(self, misfit: float = 1.0) -> np.ndarray:
        """W (J, J) with W^T W = (S + model error)^-1 + (misfit - 1) / pull^2 (1 - mean over the directions).

        ``misfit``, 1 or more: mean loss of the object's rays over that of what a superquadric fits.

        The most probable body is not the one nearest to the prediction.  A superquadric that fits has the thing's form,
        and S tells how probable each form is.  One that does not fit is a compromise: b is the best that is known of
        the thing's form, and the body is to be near to it in each direction, however uncertain.  Growth in all
        directions is left to S, as the outline determines a thing's size.
        """
        count = len(self.support)
        pull = (misfit - 1.0) / (PULL_SHARE * self.extent) ** 2
        precision = self._precision + pull * (np.eye(count) - 1.0 / count)
        return np.ascontiguousarray(np.linalg.cholesky(precision).T)

    @cached_property
    def _precision(self) -> np.ndarray:
        """(S + model error)^-1."""
        model = MODEL_SHARE * self.extent
        return np.linalg.inv(self.covariance + model**2 * np.eye(len(self.support)))


@kernel
def prior_cost(terms: Terms, parameters: np.ndarray, rotation: np.ndarray, sums: np.ndarray) -> float:
    """Cost of all terms together."""
    cost = 0.0
    if terms.plane_stiffness > 0.0 or terms.rest_stiffness > 0.0:
        cost += _support_cost(terms, parameters, rotation, sums)
    if terms.proportion_stiffness > 0.0:
        cost += _proportion_cost(terms, parameters, sums)
    if terms.expectation_stiffness > 0.0:
        cost += _expectation_cost(terms, parameters, sums)
    if terms.roundness_stiffness > 0.0:
        cost += _roundness_cost(terms, parameters, sums)
    if terms.hull_directions.shape[0] > 0:
        cost += hull_cost(terms, parameters, rotation, sums)
    if terms.taper_stiffness > 0.0:
        for k in range(2):
            slope = terms.taper_stiffness * terms.taper_stiffness * parameters[8 + k]
            cost += slope * parameters[8 + k]
            sums[11 + k, 11 + k] += terms.taper_stiffness * terms.taper_stiffness
            sums[STEP_LENGTH, 11 + k] += slope
    if terms.volume_price > 0.0:
        for k in range(3):
            cost += terms.volume_price * math.log(parameters[k])
            sums[STEP_LENGTH, k] += 0.5 * terms.volume_price
    return cost


@kernel
def _support_cost(terms: Terms, parameters: np.ndarray, rotation: np.ndarray, sums: np.ndarray) -> float:
    a1, a2, a3, e1, e2, k1, k2 = form_of(parameters)
    t1, t2, t3 = parameters[5], parameters[6], parameters[7]
    normal = terms.plane[:3]
    n = np.zeros(3)
    for k in range(3):
        n[k] = rotation[0, k] * normal[0] + rotation[1, k] * normal[1] + rotation[2, k] * normal[2]
    cost = 0.0
    row = np.zeros(STEP_LENGTH + 1)
    h, hx, hy, hz, h1, h2, hk1, hk2 = support_derivatives(-n[0], -n[1], -n[2], a1, a2, a3, e1, e2, k1, k2)
    lowest = normal[0] * t1 + normal[1] * t2 + normal[2] * t3 + terms.plane[3] - h
    s = terms.plane_stiffness if lowest < 0.0 else terms.gap_stiffness
    if s > 0.0:
        residual = s * lowest
        if lowest < 0.0:
            cost += residual * residual
        else:
            square = residual * residual
            cost += math.log1p(square)
            s /= math.sqrt(1.0 + square)
            residual /= math.sqrt(1.0 + square)
        row[0], row[1], row[2] = s * hx * n[0], s * hy * n[1], s * hz * n[2]
        row[3], row[4], row[11], row[12] = -s * h1, -s * h2, -s * hk1, -s * hk2
        row[5], row[6], row[7] = s * normal[0], s * normal[1], s * normal[2]
        row[8] = s * (hy * n[2] - hz * n[1])
        row[9] = s * (hz * n[0] - hx * n[2])
        row[10] = s * (hx * n[1] - hy * n[0])
        row[STEP_LENGTH] = residual
        add_row(row, sums)
    if terms.rest_stiffness > 0.0:
        s = terms.rest_stiffness
        upright = 0
        for k in range(1, 3):
            if abs(n[k]) > abs(n[upright]):
                upright = k
        square = (n[0] * n[0] + n[1] * n[1] + n[2] * n[2] - n[upright] * n[upright]) * s * s
        cost += math.log1p(square)
        scale = s / math.sqrt(1.0 + square)
        for k in range(3):
            if k == upright:
                continue
            row[:] = 0.0
            after, before = (k + 1) % 3, (k + 2) % 3
            row[8 + before] = scale * n[after]
            row[8 + after] = -scale * n[before]
            row[STEP_LENGTH] = scale * n[k]
            add_row(row, sums)
    return cost


@kernel
def hull_cost(terms: Terms, parameters: np.ndarray, rotation: np.ndarray, sums: np.ndarray) -> float:
    """Cost |W (h - b)|^2 of the hull."""
    count = terms.hull_directions.shape[0]
    rows = _hull_rows(terms, parameters, rotation)
    whitened = rows @ terms.hull_root.T
    square = 0.0
    for j in range(count):
        square += whitened[STEP_LENGTH, j] * whitened[STEP_LENGTH, j]
    add_block(whitened, count, sums)
    return square


@kernel
def hull_distances(terms: Terms, parameters: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Differences h - b (J,) of the support functions, metres."""
    return _hull_rows(terms, parameters, rotation)[STEP_LENGTH]


@kernel
def _hull_rows(terms: Terms, parameters: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Derivatives of h, a column for each direction, and h - b in the last row: one array, for vector code."""
    count = terms.hull_directions.shape[0]
    rows = np.empty((STEP_LENGTH + 1, count))
    for j in range(count):
        rows[5, j], rows[6, j], rows[7, j] = terms.hull_directions[j]
        rows[STEP_LENGTH, j] = -terms.hull_support[j]
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


@kernel
def _proportion_cost(terms: Terms, parameters: np.ndarray, sums: np.ndarray) -> float:
    mean = (math.log(parameters[0]) + math.log(parameters[1]) + math.log(parameters[2])) / 3.0
    cost, square = 0.0, terms.proportion_stiffness * terms.proportion_stiffness
    for k in range(3):
        apart = math.log(parameters[k]) - mean
        cost += square * apart * apart
        sums[STEP_LENGTH, k] += square * apart
        for j in range(k + 1):
            sums[k, j] += square * ((1.0 if j == k else 0.0) - 1.0 / 3.0)
    return cost


@kernel
def _expectation_cost(terms: Terms, parameters: np.ndarray, sums: np.ndarray) -> float:
    cost, s = 0.0, terms.expectation_stiffness
    for k in range(3):
        residual = s * math.log(parameters[k] / terms.expected[k])
        above = 1.0 + residual * residual
        cost += math.log(above)
        sums[k, k] += s * s / above
        sums[STEP_LENGTH, k] += s * residual / above
    return cost


@kernel
def _roundness_cost(terms: Terms, parameters: np.ndarray, sums: np.ndarray) -> float:
    s = terms.roundness_stiffness
    oval, square = s * math.log(parameters[0] / parameters[1]), s * (1.0 - parameters[4])
    above = 1.0 + oval * oval + square * square
    slope = 3.0 * s / above
    sums[0, 0] += s * slope
    sums[1, 0] -= s * slope
    sums[1, 1] += s * slope
    sums[4, 4] += s * slope
    sums[STEP_LENGTH, 0] += slope * oval
    sums[STEP_LENGTH, 1] -= slope * oval
    sums[STEP_LENGTH, 4] -= slope * square
    return 3.0 * math.log(above)
