"""How good a fit is: residual, share of inliers, covariance, status and its reason."""

from __future__ import annotations

import math
import time

import numpy as np

from sq_perception.fitting.covariance import carried_over, spread, undetermined
from sq_perception.fitting.fit import CUT_SHORT, FAILED_SHARE, INLIER, Fit, Status
from sq_perception.fitting.multistart import Solution
from sq_perception.fitting.observation import OUTLIER_SHARE, Observation, span
from sq_perception.geometry.kernels import kernel
from sq_perception.geometry.quantiles import quantile
from sq_perception.geometry.superquadric import Superquadric

_REACHED = 0.9
"""Share of the points of a thing fitted as a hull: how far the rest sticks out decides whether it is enclosed."""
_ENCLOSED_SHARE = 1.0
"""Share of the middle half size by which points may stick out of a hull: a body that encloses a thing but for a
trigger, a spout or a rim is one that a planner can use with care.  Of 3582 things of benchmarks/household_things ten
well measured ones left more than the smallest half size of their hull: seven less than this, of IoU 0.33 to 0.80, and
three more, of 0.24 to 0.43."""
_UNFINISHED = "how far it is off is not known"
_AXES = "xyz"


def assessed(solution: Solution, began: float) -> Fit:
    """The result of a fit, with its residual, inliers, covariance and status."""
    observation, state = solution.problem.observation, solution.state
    body = state.body
    covariance = solution.covariance + spread(state, solution.alternatives)
    canonical = body.canonical_form()
    is_exchanged = abs(body.rotation_matrix[:, 0] @ canonical.rotation_matrix[:, 0]) < 0.5
    sigma_taper = np.sqrt(np.diag(solution.taper_covariance))
    covariance = carried_over(covariance, body, canonical)
    if solution.is_unfinished:  # it holds at the lowest point of a valley, where the body is not
        covariance = np.full_like(covariance, np.nan)
    typical = quantile(np.abs(solution.distances), 0.5)
    residual, inlier_share = _within(solution.distances, INLIER * observation.sigma, INLIER * typical)
    if solution.as_hull:
        # A hollow thing lies inside its hull: only what sticks out speaks against the body.
        typical = quantile(np.maximum(solution.distances, 0.0), _REACHED)
    reached, message = status(canonical, covariance, typical, observation.sigma, solution.as_hull)
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
        sigma_taper=sigma_taper[::-1] if is_exchanged else sigma_taper,
        iterations=state.iterations,
        milliseconds=(time.perf_counter() - began) * 1e3,
        is_predicted=solution.problem.hull is not None,
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
    low, high = span(points - body.translation, body.rotation_matrix.T).T
    half = body.untapered().size
    low, high = np.maximum(low, -half), np.minimum(high, half)
    return np.clip((high - low) / (2 * half * (1 - 2 * OUTLIER_SHARE)), 0.0, 1.0)


def failed(body: Superquadric, observation: Observation, reason: str, began: float) -> Fit:
    """The result where no body can be fitted: a box around what was seen."""
    points = observation.points
    distance = np.abs(body.sampson_distance(points))
    return Fit(
        superquadric=body.canonical_form(),
        residual=float(np.sqrt(np.mean(distance**2))),
        status=Status.FAILED,
        message=reason,
        noise=observation.sigma,
        inlier_share=0.0,
        milliseconds=(time.perf_counter() - began) * 1e3,
    )


def status(
    body: Superquadric, covariance: np.ndarray, typical: float, sigma: float, as_hull: bool
) -> tuple[Status, str]:
    """The status and its reason, without lengths: only the reader of the image knows their unit.

    ``typical`` is how far points typically miss the body, or stick out of one fitted as a hull, metres; ``sigma`` is
    the noise and the model error, metres, ``covariance`` (11, 11).
    """
    smallest = float(body.size.min())
    # A quarter of the thickness of a plate or a pen is less than any thing strays.
    strays = max(FAILED_SHARE * smallest, INLIER * sigma)
    bearable = max(strays, _ENCLOSED_SHARE * float(np.median(body.size))) if as_hull else strays
    off = f"many of the points lie {typical / smallest:.0%} of its smallest half size and more off"
    if typical > bearable:
        return Status.FAILED, f"no superquadric found: {off} the best one"
    weak = [_AXES[k] for k in np.flatnonzero(undetermined(covariance, body.size))]
    reasons = [f"half size along {' and '.join(weak)} undetermined"] if weak else []
    if typical > strays:
        reasons.append(off)
    return (Status.WEAK, "; ".join(reasons)) if reasons else (Status.CONVERGED, "converged")
