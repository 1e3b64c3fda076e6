"""Half sizes that the image leaves open: weighed against what is known beyond it.

Where the image hardly determines a size, small errors of the model would decide it: it is left to the priors, and to a
prediction where there is one.  The body competes with others of which that size is like the other two, thin, or as
predicted, the seen face in place.

What the border of an image, or of its readings, cuts off is open as well.  A prism, such as a can or a carton, looks
the same however far it goes on beyond the border.  Its cost has a wall where it would be too short to reach the border,
and is flat beyond: a search ends at the foot of the wall, whose curvature tells nothing of the flat.  So where the
border cuts an object and an end of its body lies beyond, the body is also held with that end farther out and the other
one in place, the rest fitted again.  What the image allows then adds to the covariance, with the weight of the body
itself.  A predicted hull does not count in this: it is about what the image shows, and mostly ends at the border, too.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sq_perception.fitting.covariance import Alternative, undetermined
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.observation import Observation
from sq_perception.fitting.problem import (
    BASIN_RAYS,
    DOUBT,
    INDEPENDENT_RAYS,
    REFINE_STEPS,
    VOLUME_PRICE,
    Solution,
    by_cost,
)
from sq_perception.fitting.rivals import resized
from sq_perception.geometry.kernels import kernel

THIN = 0.3
"""Half size, as a share of the other two, at which one that the image leaves open is also tried."""
EXPECTATION_SIGMA = 0.25
"""Sigma of a log half size from the network's: its errors on household things, of which one in ten is far off."""
_LONGER = (1.25, 1.6)
"""Factors of the half size at hand."""
_ALLOWED = DOUBT / 2
"""Excess of a cost that is no evidence against a length: through noise its standard deviation is 7."""
_RAYS = 1000
"""Rays of the search for each longer body, which begins near its valley."""


def weighed(solution: Solution) -> Solution:
    """The solution, or a better one once open half sizes are left to the priors and the prediction."""
    problem, state, rays = solution.problem, solution.state, solution.rays
    options, pinhole = problem.options, problem.observation.camera.is_pinhole
    weak = np.flatnonzero(undetermined(solution.covariance, state.parameters[:3]))
    if len(weak) == 0 or not (pinhole or options.expected is not None):
        return solution
    if problem.independent is None and pinhole:
        rays = rays.weighing(INDEPENDENT_RAYS / rays.weight)
        problem = problem.with_terms(volume_price=VOLUME_PRICE)
    rivals, notes = [state], solution.notes
    for k in weak:
        typical = float(np.exp(np.mean(np.log(np.delete(state.parameters[:3], k)))))
        rivals += [resized(state, int(k), size) for size in (typical, THIN * typical)]
    prior = options.expected() if callable(options.expected) else options.expected
    if prior is not None:
        problem = replace(problem.with_terms(expectation_stiffness=1 / EXPECTATION_SIGMA), prior=prior)
        notes = (*notes, "half sizes weighed against a prediction")
        extents = prior.support(state.rotation.T)
        rivals += [resized(state, int(k), float(extents[k])) for k in weak]
    few = problem.draw(BASIN_RAYS, 0.2)
    few = few.weighing(rays.weight / few.weight)
    settled = by_cost(problem.settle(rival, few) for rival in rivals)
    best = problem.refined_best(settled, rays, 2 * REFINE_STEPS)
    return replace(solution, problem=problem, state=best, rays=rays, notes=notes)


def with_open_ends(solution: Solution) -> Solution:
    """The solution, with longer bodies as alternatives where the image's border hides how long it is."""
    problem, state = solution.problem, solution.state
    ends = list(_hidden_ends(problem.observation, state))
    if not ends:
        return solution
    problem = problem.without_hull()
    rays = solution.rays.every(max(1, len(solution.rays.hits) // _RAYS))
    most = problem.settle(state, rays, 0).cost + _ALLOWED
    found = []
    for axis, sign in ends:
        for factor in _LONGER:
            longer = min(factor * state.parameters[axis], problem.limits[1][axis])
            other = problem.held(_longer(state, axis, sign, longer), axis, rays)
            if other.cost < most:
                found.append(other)
        if problem.late:
            break
    others = tuple(Alternative(other, 1 / (1 + len(found))) for other in found)
    return replace(solution, alternatives=(*solution.alternatives, *others))


def _hidden_ends(observation: Observation, state: State) -> Iterator[tuple[int, float]]:
    """Axis and sign of each end of a body beyond all readings, on a side where readings end within the object.

    They end at the image's border, or at a band without readings along it: of a rectified image, of a stereo camera.
    """
    left, top, right, bottom, cut = _borders(observation.depth, observation.mask, observation.free)
    if not cut.any():
        return
    camera = observation.camera
    for axis in range(3):
        for sign in (1.0, -1.0):
            u, v = camera.project(state.parameters[5:8] + sign * state.parameters[axis] * state.rotation[:, axis])
            if not np.isfinite([u, v]).all():
                continue
            row, column = (int(np.clip(np.rint(at), 0, n - 1)) for at, n in ((v, camera.height), (u, camera.width)))
            if (cut & [u < left[row], v < top[column], u > right[row], v > bottom[column]]).any():
                yield axis, sign


@kernel
def _borders(
    depth: np.ndarray, mask: np.ndarray, free: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """First reading of each row (h,) and column (w,), the last ones, and on which of these sides (4,) the object has
    any of them.  Free pixels, indices into the image (h, w), count as readings: some are known to be empty without one.
    """
    height, width = depth.shape
    known = np.isfinite(depth)
    for pixel in free:
        known[pixel // width, pixel % width] = True
    left, right = np.full(height, width), np.full(height, -1)
    top, bottom = np.full(width, height), np.full(width, -1)
    for v in range(height):
        for u in range(width):
            if known[v, u]:
                left[v], right[v] = min(left[v], u), u
                top[u], bottom[u] = min(top[u], v), v
    cut = np.zeros(4, np.bool_)
    for v in range(height):
        if right[v] >= 0:
            cut[0] |= mask[v, left[v]]
            cut[2] |= mask[v, right[v]]
    for u in range(width):
        if bottom[u] >= 0:
            cut[1] |= mask[top[u], u]
            cut[3] |= mask[bottom[u], u]
    return left, top, right, bottom, cut


def _longer(state: State, axis: int, sign: float, size: float) -> State:
    """The body with one end farther out and the other one in place."""
    parameters = state.parameters.copy()
    parameters[5:8] += sign * (size - parameters[axis]) * state.rotation[:, axis]
    parameters[axis] = size
    return state._replace(parameters=parameters)
