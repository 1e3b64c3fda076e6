"""The covariance of a fitted body.

With the whitened residuals r and their Jacobian J at the optimum, the covariance is (J^T J / s^2 + P)^-1, where
s^2 = max(1, mean of r^2) makes a body that does not explain the data less certain, and P is the precision of a wide
prior (a factor e in size, 0.5 in shape, one size in position, one radian in angle): what the image leaves open, such as
the turn of a round body about its axis, gets the width of the prior instead of infinity.  The outline counts with the
noise or a whole pixel, whichever is more: its errors are no independent noise.

A predicted hull comes with its own error model, so its residuals r_h are not among r: J_h^T J_h / (1 + |r_h|^2 / nu) is
added to J^T J / s^2.  The farther off the hull a body is, the less the hull counts, like the weight
(nu + J) / (nu + |r_h|^2) of a t distribution with nu degrees of freedom in J directions; but the factor begins at 1,
not at 1 + J / nu, 15 here: with that, 91 instead of 97 % of the half sizes of 196 things of
benchmarks/household_things, seeds from 7000, are within two deviations, and sigma and error rank less alike.

The above describes one valley of the cost, as if the thing were a superquadric.  Other bodies that the image allows add
their second moments about the result, and so does a predicted hull that the body does not match.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from sq_perception.fitting.cost import STEP_LENGTH, Terms
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.priors import hull_cost, hull_distances
from sq_perception.fitting.rays import DEPTH, SAMPLE, WEIGHT, Rays
from sq_perception.fitting.residuals import RENDERED, evaluate
from sq_perception.geometry.kernels import kernel
from sq_perception.geometry.superquadric import Superquadric

UNTAPERED = 11
"""Entries of a step without those of the taper: what a covariance is of."""
WEAK_SHARE = 0.15
"""Standard deviation of a half size, as a share of it, above which it is called undetermined."""
_PRIOR = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
"""Standard deviations of the prior: a factor e, half of the range of an exponent, one size, a radian."""
_NEAR_AXIS = 16
"""Power of the cosine to an axis by which directions count as near to it: half at 17 degrees, as neighbours are 32
degrees apart."""


def covariance_at(state: State, rays: Rays, terms: Terms, outline: float) -> np.ndarray:
    """Covariance (11, 11) of a1 a2 a3 e1 e2 t1 t2 t3 and the rotation vector in the object frame; metres and radians.

    (13, 13), of the tapers too, where the terms let bodies taper.
    ``outline`` is the standard deviation of the outline, metres.
    """
    stride = max(1, len(rays.hits) // SAMPLE)
    terms = terms._replace(outline_stiffness=1 / outline)
    return np.asarray(_covariance(rays.hits, rays.free, stride, terms, state.parameters, state.rotation))


@kernel
def _covariance(
    hits: np.ndarray, free: np.ndarray, stride: int, terms: Terms, parameters: np.ndarray, rotation: np.ndarray
) -> np.ndarray:
    """Covariance (k, k) as by :func:`covariance_at`; each ``stride``-th ray counts for those between."""
    sums = np.zeros((STEP_LENGTH + 1, STEP_LENGTH + 1))
    of_hull = np.zeros((STEP_LENGTH + 1, STEP_LENGTH + 1))
    hits, free = hits[::stride].copy(), free[::stride].copy()
    hits[:, WEIGHT] *= stride
    free[:, WEIGHT] *= stride
    cost = evaluate(RENDERED, hits, free, terms, parameters, rotation, hits[:, DEPTH].copy(), sums)
    has_hull = terms.hull_directions.shape[0] > 0
    hull = hull_cost(terms, parameters, rotation, of_hull) if has_hull else 0.0
    variance = max(1.0, (cost - hull) / hits[:, WEIGHT].sum())
    vaguer = 1.0 + hull / terms.hull_freedom
    unknowns = UNTAPERED if terms.taper_stiffness == 0.0 else STEP_LENGTH
    prior = np.zeros(unknowns)  # that of the taper is among the terms
    prior[:UNTAPERED] = 1.0 / np.square(_PRIOR)
    prior[5:8] /= np.square((parameters[0] + parameters[1] + parameters[2]) / 3.0)
    information = np.diag(prior)
    for j in range(unknowns):
        for k in range(j + 1):
            information[j, k] += (sums[j, k] - of_hull[j, k]) / variance + of_hull[j, k] / vaguer
            information[k, j] = information[j, k]
    covariance = _inverse(information, prior[:UNTAPERED].min())
    covariance[:3] *= parameters[:3].copy().reshape(3, 1)
    covariance[:, :3] *= parameters[:3]
    covariance = 0.5 * (covariance + covariance.T)
    if has_hull:
        _add_distances(terms, parameters, rotation, covariance)
    return covariance


@kernel
def _inverse(information: np.ndarray, least: float) -> np.ndarray:
    """The inverse of an information matrix (k, k) with no eigenvalue below ``least``, the smallest of its prior.

    Where an image is some 10^8 times as precise in one direction as the prior is in another, rounding hides the small
    eigenvalues, and an inverse may have variances below 0 or far above the prior's: the eigenvalues are then held.
    """
    inverse = np.linalg.inv(information)
    variances = np.diag(inverse)
    if (variances > 0.0).all() and (variances < 2.0 / least).all():
        return inverse
    values, axes = np.linalg.eigh(information)
    return (axes / np.maximum(values, least)) @ axes.T


@kernel
def _add_distances(terms: Terms, parameters: np.ndarray, rotation: np.ndarray, covariance: np.ndarray) -> None:
    """Add the second moments of sizes and centre that a body's distance to a predicted hull adds.

    The body does not match the hull of a thing that is no superquadric, nor a wrong prediction.  Each end of an axis
    errs by the differences in the directions near to it: whether both ends do so alike or apart, neither half their
    sum, the size, nor half their difference, the centre, errs by more.
    """
    near = (terms.hull_directions @ rotation) ** _NEAR_AXIS
    off = hull_distances(terms, parameters, rotation)
    square = (off * off) @ near / near.sum(axis=0)
    for k in range(3):
        covariance[k, k] += square[k]
    covariance[5:8, 5:8] += (rotation * square) @ rotation.T


class Alternative(NamedTuple):
    """Another body that the image allows, its weight against all others, and its own covariance (11, 11) if that is
    more than the result's."""

    state: State
    weight: float
    covariance: np.ndarray | None = None


def spread(state: State, alternatives: Iterable[Alternative]) -> np.ndarray:
    """Second moments (11, 11) of the alternatives about a body: what several valleys of the cost add to its covariance.

    Sizes are compared along the axes of the body, exponents between bodies with the same z axis.  What an alternative
    is unsure of itself joins for sizes and places.
    """
    moments = np.zeros((UNTAPERED, UNTAPERED))
    for other, weight, own in alternatives:
        partner = np.abs(state.rotation.T @ other.rotation).argmax(axis=1)
        difference = np.zeros(UNTAPERED)
        difference[0:3] = other.parameters[partner] - state.parameters[0:3]
        if partner[2] == 2:
            difference[3:5] = other.parameters[3:5] - state.parameters[3:5]
        difference[5:8] = other.parameters[5:8] - state.parameters[5:8]
        moments += weight * np.outer(difference, difference)
        if own is not None:
            moments[0:3, 0:3] += weight * np.diag(np.diag(own)[partner])
            moments[5:8, 5:8] += weight * own[5:8, 5:8]
    return moments


def carried_over(covariance: np.ndarray, body: Superquadric, form: Superquadric) -> np.ndarray:
    """The covariance in another of the body's 8 forms: axes exchange and reverse."""
    turn = np.round(body.rotation_matrix.T @ form.rotation_matrix)
    change = np.eye(UNTAPERED)
    change[0:3, 0:3] = np.abs(turn).T
    change[8:11, 8:11] = turn.T
    return change @ covariance @ change.T


def undetermined(covariance: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Which half sizes (3,) the image leaves open."""
    return np.sqrt(np.diag(covariance)[:3]) > WEAK_SHARE * size
