"""The classic method of Solina and Bajcsy: least squares on the inside-outside function of a point cloud.

Objective (thesis, chapter 7.3)

    minimise over the 11 parameters    sum_i [ sqrt(a1 a2 a3) (F(p_i)^e1 - 1) ]^2

where the factor sqrt(a1 a2 a3) prefers the smaller of two bodies that pass through the points, and the power e1 evens
out the differences between shapes.  With the gauge g, F^e1 = g^2.  Minimised by Levenberg-Marquardt with analytic
derivatives (:mod:`sq_perception.fitting.residuals`, stage ``classic``).

Start: an ellipsoid (e1 = e2 = 1) at the centroid of the points, along their principal axes, with the extents of the
points as its sizes.  The z axis is the principal axis whose moment differs most from the other two: the long axis of a
long object, the short one of a flat object, and for both the axis of rotational symmetry.

The method is the baseline of every comparison and deliberately uses nothing else: no free space, no outline, no noise.
Seen from one side, the points fix the visible half only: the centroid lies too near, and hidden extents are a guess.

Reference: F. Solina, R. Bajcsy, Recovery of parametric models from range images: the case for superquadrics with global
deformations, IEEE PAMI 12(2), 1990; A. Jaklic, A. Leonardis, F. Solina, Segmentation and Recovery of Superquadrics,
Kluwer 2000, chapter 4.
"""

from __future__ import annotations

import math
import time

import numpy as np

from sq_perception.fitting.cost import Ray, Terms, rays_of
from sq_perception.fitting.fit import FAILED_SHARE, INLIER, Fit, Status
from sq_perception.fitting.levenberg_marquardt import State, minimize
from sq_perception.fitting.options import finite_points, limits
from sq_perception.fitting.residuals import CLASSIC
from sq_perception.fitting.starts import principal_axes, reason_to_fail, three_orders
from sq_perception.geometry import rotation as quaternions

_ESCAPE = 0.3
"""Standard deviation of a disturbance: of log sizes, exponents, angles, and of the centre in mean half sizes."""


def fit(points: np.ndarray, *, escapes: int = 0) -> Fit:
    """Fit one superquadric to points (n, 3) of its visible surface.

    Parameters
    ----------
    points : (n, 3)
        Metres, in any frame; the body comes back in the same.  Rows that are not finite are ignored, and more than
        1000 points are thinned evenly in their given order.
    escapes
        How often to disturb the result at random and to start again from there; the best of all results counts.  The
        original adds noise to the cost for the same end: to leave shallow minima.

    Returns
    -------
    Fit
        Its covariance is NaN: the residual is no distance.  FAILED, with an ellipsoid about the points, for fewer than
        12 points or points on a line, and where the result misses the points.

    Raises
    ------
    ValueError
        If the array is not (n, 3) or holds no finite point.
    """
    began = time.perf_counter()
    points, _ = finite_points(points)
    if len(points) > 1000:  # the cost of the method grows with their number, its result hardly changes
        points = points[np.linspace(0, len(points) - 1, 1000).astype(int)]
    reason = reason_to_fail(points, len(points), "points")
    state = moment_start(points)
    if not reason:
        extent = float(np.linalg.norm(np.ptp(points, axis=0)))
        rays, bounds = rays_of(points), limits(points)
        rays[:, Ray.STIFFNESS] = 1 / (0.01 * extent**1.5)  # makes the damping independent of units

        def minimum(start: State) -> State:
            return minimize(CLASSIC, rays, rays[:0], Terms(huber=math.inf), start, bounds, 100, 1e-6)  # beyond need

        state, rng = minimum(state), np.random.default_rng(0)
        for _ in range(escapes):
            state = min(state, minimum(_disturb(state, rng)), key=lambda each: each.cost)
    body = state.body.canonical_form()
    distance = np.abs(body.sampson_distance(points))
    residual = float(np.sqrt(np.mean(distance**2)))
    if not reason and float(np.median(distance)) > FAILED_SHARE * float(body.size.min()):
        off = float(np.median(distance) / body.size.min())
        reason = f"no superquadric found: half of the points lie more than {off:.0%} of its smallest half size off"
    return Fit(
        superquadric=body, residual=residual, status=Status.FAILED if reason else Status.CONVERGED,
        message=reason or "converged", noise=residual, inlier_share=float(np.mean(distance <= INLIER * residual)),
        iterations=state.iterations, milliseconds=(time.perf_counter() - began) * 1e3,
    )


def _disturb(state: State, rng: np.random.Generator) -> State:
    """The body with its size, shape, centre and rotation disturbed at random."""
    parameters = state.parameters.copy()
    parameters[0:3] *= np.exp(_ESCAPE * rng.standard_normal(3))
    parameters[3:5] += _ESCAPE * rng.standard_normal(2)
    parameters[5:8] += _ESCAPE * float(parameters[0:3].mean()) * rng.standard_normal(3)
    turn = quaternions.to_matrix(quaternions.from_rotation_vector(_ESCAPE * rng.standard_normal(3)))
    return State(parameters, np.ascontiguousarray(state.rotation @ turn), math.inf, state.iterations)


def moment_start(points: np.ndarray) -> State:
    """The ellipsoid along the principal axes of the points (n >= 1, 3)."""
    centroid = points.mean(axis=0)
    centred = points - centroid
    scatter = centred.T @ centred
    moments = np.linalg.eigvalsh(scatter)
    axes = three_orders(principal_axes(scatter))[2 if moments[2] - moments[1] > moments[1] - moments[0] else 0]
    half = np.ptp(centred @ axes, axis=0) / 2
    half = np.maximum(half, max(1e-3 * float(half.max()), 1e-6))
    return State(np.concatenate([half, [1.0, 1.0], centroid, [0.0, 0.0]]), axes, math.inf, 0)
