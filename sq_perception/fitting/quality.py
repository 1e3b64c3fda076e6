"""How sure a fitted body is, and how good: covariance, residual, share of inliers, status and its reason.

With the whitened residuals r and their Jacobian J at the optimum, the covariance is (J^T J / s^2 + P)^-1, where
s^2 = max(1, mean of r^2) makes a body that does not explain the data less certain, and P is the precision of a wide
prior (a factor e in size, 0.5 in shape, one size in position, one radian in angle): what the image leaves open, such as
the turn of a round body about its axis, gets the width of the prior instead of infinity.  The outline counts with the
noise or a whole pixel, whichever is more: its errors are no independent noise.

A predicted hull comes with its own error model, so its residuals r_h are not among r: J_h^T J_h / (1 + |r_h|^2 / nu) is
added to J^T J / s^2.  The farther off the hull a body is, the less the hull counts, like the weight
(nu + J) / (nu + |r_h|^2) of a t distribution with nu degrees of freedom in J directions; but the factor begins at 1,
not at 1 + J / nu, 15 here: with that, deviations are too small, and sigma and error rank less alike.

The above describes one valley of the cost, as if the thing were a superquadric.  Other bodies that the image allows add
their second moments about the result, and so does a predicted hull that the body does not match.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sq_perception.fitting.cost import SAMPLE, STEP_LENGTH, Ray, Terms
from sq_perception.fitting.fit import CUT_SHORT, FAILED_SHARE, INLIER, Fit, Status
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.observation import OUTLIER_SHARE, span
from sq_perception.fitting.priors import hull_cost, hull_distances
from sq_perception.fitting.residuals import RENDERED, evaluate
from sq_perception.fitting.starts import enclosing_box
from sq_perception.geometry.kernels import kernel
from sq_perception.geometry.quantiles import quantile
from sq_perception.geometry.superquadric import Superquadric

if TYPE_CHECKING:
    from sq_perception.fitting.multistart import Solution

UNTAPERED = 11
"""Entries of a step without those of the taper: what a covariance is of."""
WEAK_SHARE = 0.15
"""Standard deviation of a half size, as a share of it, above which it is called undetermined."""
_PRIOR = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
"""Standard deviations of the prior: a factor e, half of the range of an exponent, one size, a radian."""
_UNFINISHED = "how far it is off is not known"
_AXES = "xyz"


@kernel
def covariance_at(
    hits: np.ndarray, free: np.ndarray, terms: Terms, parameters: np.ndarray, rotation: np.ndarray
) -> np.ndarray:
    """Covariance (11, 11) of a1 a2 a3 e1 e2 t1 t2 t3 and the rotation vector in the object frame; metres and radians.

    (13, 13), of the tapers too, where the terms let bodies taper.  Of many rays some count for all.
    """
    stride = max(1, hits.shape[0] // SAMPLE)
    sums = np.zeros((STEP_LENGTH + 1, STEP_LENGTH + 1))
    of_hull = np.zeros((STEP_LENGTH + 1, STEP_LENGTH + 1))
    hits, free = hits[::stride].copy(), free[::stride].copy()
    hits[:, Ray.WEIGHT] *= stride
    free[:, Ray.WEIGHT] *= stride
    cost = evaluate(RENDERED, hits, free, terms, parameters, rotation, hits[:, Ray.DEPTH].copy(), sums)
    has_hull = terms.hull_directions.shape[0] > 0
    hull = hull_cost(terms, parameters, rotation, of_hull) if has_hull else 0.0
    variance = max(1.0, (cost - hull) / hits[:, Ray.WEIGHT].sum())
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
    values, axes = np.linalg.eigh(information)
    return (axes / np.maximum(values, least)) @ axes.T


@kernel
def _add_distances(terms: Terms, parameters: np.ndarray, rotation: np.ndarray, covariance: np.ndarray) -> None:
    """Add the second moments of sizes and centre that a body's distance to a predicted hull adds.

    The body does not match the hull of a thing that is no superquadric, nor a wrong prediction.  Each end of an axis
    errs by the differences in the directions near to it: whether both ends do so alike or apart, neither half their
    sum, the size, nor half their difference, the centre, errs by more.
    """
    near = (terms.hull_directions @ rotation) ** 16  # half at 17 degrees, as neighbours are 32 degrees apart
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


def covariance_of_form(covariance: np.ndarray, body: Superquadric, form: Superquadric) -> np.ndarray:
    """The covariance in another of the body's 8 forms: axes exchange and reverse."""
    turn = np.round(body.rotation_matrix.T @ form.rotation_matrix)
    change = np.eye(UNTAPERED)
    change[0:3, 0:3] = np.abs(turn).T
    change[8:11, 8:11] = turn.T
    return change @ covariance @ change.T


def undetermined(covariance: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Which half sizes (3,) the image leaves open."""
    return np.sqrt(np.diag(covariance)[:3]) > WEAK_SHARE * size


# The result


def assess(solution: Solution, began: float) -> Fit:
    """The result of a fit, with its residual, inliers, covariance and status."""
    observation, state = solution.problem.observation, solution.state
    body = state.body
    canonical = body.canonical_form()
    covariance = covariance_of_form(solution.covariance + spread(state, solution.alternatives), body, canonical)
    sigma_taper = np.sqrt(np.diag(solution.taper_covariance))
    if solution.is_unfinished:  # it holds at the lowest point of a valley, where the body is not
        covariance = np.full_like(covariance, np.nan)
    typical = quantile(np.abs(solution.distances), 0.5)
    residual, inlier_share = _within(solution.distances, INLIER * observation.sigma, INLIER * typical)
    if solution.as_hull:
        # A hollow thing lies inside its hull: only what sticks out speaks against the body, if a tenth does.
        typical = quantile(np.maximum(solution.distances, 0.0), 0.9)
    reached, message = judge(canonical, covariance, typical, observation.sigma, solution.as_hull)
    if solution.is_unfinished and reached == Status.CONVERGED:
        reached, message = Status.WEAK, _UNFINISHED
    cut = (CUT_SHORT,) if solution.problem.late else ()
    return Fit(
        superquadric=canonical,
        residual=residual,
        status=reached,
        message="; ".join([message, *solution.notes, *cut]),
        noise=observation.sigma,
        inlier_share=inlier_share,
        seen=seen_extents(canonical, observation.points),
        covariance=covariance,
        sigma_taper=sigma_taper[::-1] if body.size[0] < body.size[1] else sigma_taper,  # x and y are exchanged
        iterations=state.iterations,
        milliseconds=(time.perf_counter() - began) * 1e3,
        is_predicted=solution.problem.has_hull,
        as_hull=solution.as_hull,
    )


@kernel
def _within(distances: np.ndarray, noise: float, typical: float) -> tuple[float, float]:
    """Root mean square of the distances (n,) within either bound, and the share of those within the first one."""
    square, kept, inlying = 0.0, 0, 0
    for distance in distances:
        size = abs(distance)
        is_kept = size < max(noise, typical)
        square += size * size if is_kept else 0.0
        kept += is_kept
        inlying += size < noise
    return math.sqrt(square / max(kept, 1)), inlying / distances.shape[0]


def seen_extents(body: Superquadric, points: np.ndarray) -> np.ndarray:
    """Share (3,) of each full size of a single body that points (n, 3) span along its axis, 0 to 1."""
    axes = body.rotation_matrix.T
    low, high = (span(points, axes) - (axes @ body.translation)[:, None]).T
    half = body.size * (1 + np.append(np.abs(body.taper), 0.0))  # at the wide end
    seen = np.minimum(high, half) - np.maximum(low, -half)
    return np.clip(seen / (2 * half * (1 - 2 * OUTLIER_SHARE)), 0.0, 1.0)


def fail(points: np.ndarray, thinnest: float, noise: float, reason: str, began: float) -> Fit:
    """The result where no body can be fitted to points (n, 3): a box around them, no thinner than that."""
    body = enclosing_box(points, thinnest)
    distance = body.sampson_distance(points)
    return Fit(
        superquadric=body.canonical_form(), residual=float(np.sqrt(np.mean(distance**2))), status=Status.FAILED,
        message=reason, noise=noise, inlier_share=0.0, milliseconds=(time.perf_counter() - began) * 1e3,
    )


def judge(
    body: Superquadric, covariance: np.ndarray, typical: float, sigma: float, as_hull: bool
) -> tuple[Status, str]:
    """The status and its reason, without lengths: only the reader of the image knows their unit.

    ``typical`` is how far points typically miss the body, or stick out of one fitted as a hull, metres; ``sigma`` is
    the noise and the model error, metres, ``covariance`` (11, 11).
    """
    smallest = float(body.size.min())
    # A quarter of the thickness of a plate or a pen is less than any thing strays.
    strays = max(FAILED_SHARE * smallest, INLIER * sigma)
    # A body that encloses a thing but for a trigger, a spout or a rim is one that a planner can use with care; those
    # that left out more had an IoU below 0.45.
    bearable = max(strays, float(np.median(body.size))) if as_hull else strays
    off = f"many of the points lie {typical / smallest:.0%} of its smallest half size and more off"
    if typical > bearable:
        return Status.FAILED, f"no superquadric found: {off} the best one"
    weak = [_AXES[k] for k in np.flatnonzero(undetermined(covariance, body.size))]
    reasons = [f"half size along {' and '.join(weak)} undetermined"] if weak else []
    if typical > strays:
        reasons.append(off)
    return (Status.WEAK, "; ".join(reasons)) if reasons else (Status.CONVERGED, "converged")
