"""How sure a fit is: residual, inliers, covariance, and a verdict in words.

With the whitened residuals r and their Jacobian J at the optimum, the covariance is (J^T J / s^2 + P)^-1, where
s^2 = max(1, sum r^2 / (n - 11)) lets a body that does not explain the data be less sure of itself, and P is the
precision of a wide prior (a factor e in size, 0.5 in shape, one size in position, one radian in angle): what the image
leaves open, such as the turn of a round body about its axis, gets the width of the prior instead of infinity.  The
outline counts with a whole pixel: its errors are no independent noise.
"""

from __future__ import annotations

import time

import numpy as np

from sq_perception.fitting.fit import Fit, Status
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.observation import Observation, draw
from sq_perception.fitting.residuals import RENDERED, STEP_LENGTH, evaluate, surface_distance
from sq_perception.fitting.search import Search
from sq_perception.geometry.superquadric import Superquadric

_PRIOR_LOG_SIZE = 1.0
_PRIOR_SHAPE = 0.5
_PRIOR_ANGLE = 1.0
_INLIER = 3.0
_JUDGED_RAYS = 800
_WEAK_SHARE = 0.15
"""A half size whose standard deviation exceeds this share of it is called undetermined."""
_FAILED_SHARE = 0.25
_AXES = "xyz"


def judged(state: State, search: Search, began: float) -> Fit:
    """The result of a search, with everything that can be said about its quality."""
    observation = search.observation
    stride = max(1, len(search.rays) // _JUDGED_RAYS)
    rays, free = (np.ascontiguousarray(kind[::stride]) for kind in (search.rays, search.free))
    sums = np.zeros((STEP_LENGTH + 1, STEP_LENGTH + 1))
    outline = max(observation.noise, observation.footprint)
    scene = search.scene._replace(outline_stiffness=1 / outline)
    cost = evaluate(RENDERED, rays, free, scene, state.parameters, state.rotation, sums)
    freedom = max(rays[:, 6].sum() - STEP_LENGTH, 1.0)
    variance = max(1.0, cost / freedom)
    body = state.body
    covariance = _covariance(stride * sums[:STEP_LENGTH, :STEP_LENGTH], state.parameters, variance)
    canonical = body.canonical_form()
    covariance = _carried_over(covariance, body, canonical)
    everything = draw(observation.object_rays, _JUDGED_RAYS)
    distance = surface_distance(everything, state.parameters, state.rotation)
    inlying = distance < _INLIER * observation.noise
    typical = float(np.median(distance))
    kept = distance < max(_INLIER * observation.noise, _INLIER * typical)
    residual = float(np.sqrt(np.mean(distance[kept] ** 2))) if kept.any() else typical
    status, message = _verdict(canonical, covariance, typical)
    return Fit(
        superquadric=canonical,
        residual=residual,
        noise=observation.noise,
        inlier_share=float(inlying.mean()),
        covariance=covariance,
        status=status,
        message=message,
        iterations=state.iterations,
        milliseconds=(time.perf_counter() - began) * 1e3,
    )


def failed(body: Superquadric, observation: Observation, reason: str, began: float) -> Fit:
    """No fit, but a box around what was seen."""
    points = observation.points
    distance = np.abs(body.sampson_distance(points))
    return Fit(
        superquadric=body.canonical_form(),
        residual=float(np.sqrt(np.mean(distance**2))),
        noise=observation.noise,
        inlier_share=0.0,
        covariance=np.full((STEP_LENGTH, STEP_LENGTH), np.nan),
        status=Status.FAILED,
        message=reason,
        iterations=0,
        milliseconds=(time.perf_counter() - began) * 1e3,
    )


def _covariance(normal_matrix: np.ndarray, parameters: np.ndarray, variance: float) -> np.ndarray:
    """(11, 11) of a1 a2 a3 e1 e2 t1 t2 t3 and the rotation vector, from the lower triangle of J^T J."""
    lower = np.tril(normal_matrix)
    full = lower + np.tril(normal_matrix, -1).T
    length = float(np.mean(parameters[:3]))
    prior = np.array([1 / _PRIOR_LOG_SIZE] * 3 + [1 / _PRIOR_SHAPE] * 2 + [1 / length] * 3 + [1 / _PRIOR_ANGLE] * 3)
    covariance = np.linalg.inv(full / variance + np.diag(prior**2))
    units = np.concatenate([parameters[:3], np.ones(STEP_LENGTH - 3)])
    covariance = units[:, None] * covariance * units
    return (covariance + covariance.T) / 2


def _carried_over(covariance: np.ndarray, body: Superquadric, form: Superquadric) -> np.ndarray:
    """The covariance in another of the 8 forms: axes exchange and reverse."""
    turn = np.round(body.rotation_matrix.T @ form.rotation_matrix)
    change = np.eye(STEP_LENGTH)
    change[0:3, 0:3] = np.abs(turn).T
    change[8:11, 8:11] = turn.T
    return change @ covariance @ change.T


def _verdict(body: Superquadric, covariance: np.ndarray, typical: float) -> tuple[Status, str]:
    if typical > _FAILED_SHARE * float(body.size.min()):
        return Status.FAILED, (
            f"no superquadric found: half of the points lie more than {1e3 * typical:.1f} mm off the best one"
        )
    sigma = np.sqrt(np.diag(covariance))
    weak = [
        f"half size along {_AXES[k]} undetermined: {1e3 * body.size[k]:.0f} +- {1e3 * sigma[k]:.0f} mm"
        for k in range(3)
        if sigma[k] > _WEAK_SHARE * body.size[k]
    ]
    if weak:
        return Status.WEAK, "; ".join(weak)
    return Status.CONVERGED, "converged"
