"""The verdict on a fit: residual, inliers, covariance, and words."""

from __future__ import annotations

import time

import numpy as np

from sq_perception.fitting.covariance import carried_over, covariance_at, spread, undetermined
from sq_perception.fitting.fit import Fit, Status
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.normal_equations import STEP_LENGTH
from sq_perception.fitting.observation import Observation
from sq_perception.fitting.residuals import surface_distance
from sq_perception.fitting.search import Search
from sq_perception.fitting.visibility import seen_extents, visible_share
from sq_perception.geometry.superquadric import Superquadric

_INLIER = 3.0
_JUDGED_RAYS = 800
_FAILED_SHARE = 0.25
_REACHED = 0.9
"""Of the points of a thing that was fitted as a hull: what the rest sticks out tells whether the body encloses it."""
_AXES = "xyz"


def judged(state: State, search: Search, began: float) -> Fit:
    """The result of a search, with everything that can be said about its quality."""
    observation = search.observation
    body = state.body
    covariance = covariance_at(state, search.rays, search.free, search.scene, search.outline)
    covariance = covariance * search.spread_factor + spread(state, search.alternatives)
    canonical = body.canonical_form()
    covariance = carried_over(covariance, body, canonical)
    everything = observation.object_rays(_JUDGED_RAYS)
    distance = surface_distance(everything, state.parameters, state.rotation)
    inlying = distance < _INLIER * observation.sigma
    typical = float(np.median(distance))
    kept = distance < max(_INLIER * observation.sigma, _INLIER * typical)
    residual = float(np.sqrt(np.mean(distance[kept] ** 2))) if kept.any() else typical
    if search.as_hull:
        # A hollow thing lies inside its hull: only what sticks out speaks against the body.
        outside = body.gauge(observation.points) > 1
        sticking_out = np.where(outside, np.abs(body.sampson_distance(observation.points)), 0.0)
        typical = float(np.quantile(sticking_out, _REACHED))
    status, message = _verdict(canonical, covariance, typical)
    return Fit(
        superquadric=canonical,
        residual=residual,
        noise=observation.sigma,
        inlier_share=float(inlying.mean()),
        visible_share=visible_share(state, observation),
        seen=seen_extents(canonical, observation.points),
        covariance=covariance,
        status=status,
        message="; ".join([message, *search.notes]),
        iterations=state.iterations,
        milliseconds=(time.perf_counter() - began) * 1e3,
        as_hull=search.as_hull,
    )


def failed(body: Superquadric, observation: Observation, reason: str, began: float) -> Fit:
    """No fit, but a box around what was seen."""
    points = observation.points
    distance = np.abs(body.sampson_distance(points))
    return Fit(
        superquadric=body.canonical_form(),
        residual=float(np.sqrt(np.mean(distance**2))),
        noise=observation.sigma,
        inlier_share=0.0,
        visible_share=float("nan"),
        seen=np.full(3, np.nan),
        covariance=np.full((STEP_LENGTH, STEP_LENGTH), np.nan),
        status=Status.FAILED,
        message=reason,
        iterations=0,
        milliseconds=(time.perf_counter() - began) * 1e3,
    )


def _verdict(body: Superquadric, covariance: np.ndarray, typical: float) -> tuple[Status, str]:
    if typical > _FAILED_SHARE * float(body.size.min()):
        return Status.FAILED, (
            f"no superquadric found: {1e3 * typical:.1f} mm and more between many of the points and the best one"
        )
    sigma, weak_axes = np.sqrt(np.diag(covariance)), undetermined(covariance, body.size)
    weak = [
        f"half size along {_AXES[k]} undetermined: {1e3 * body.size[k]:.0f} +- {1e3 * sigma[k]:.0f} mm"
        for k in range(3)
        if weak_axes[k]
    ]
    if weak:
        return Status.WEAK, "; ".join(weak)
    return Status.CONVERGED, "converged"
