"""Half sizes that the image leaves open: weighed against what is known beyond it.

Where the image hardly determines a size, small errors of the model would decide it: it is left to the priors, and to
a prediction where there is one.  The same body competes with that size like its others, thin, and as predicted, its
seen face in place.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sq_perception.fitting.covariance import undetermined
from sq_perception.fitting.problem import (
    BASIN_RAYS,
    INDEPENDENT_RAYS,
    REFINE_STEPS,
    VOLUME_PRICE,
    Solution,
    by_cost,
    draw,
    refined_best,
    settle,
)
from sq_perception.fitting.rivals import resized

THIN = 0.3
"""A size that the image leaves open is also tried this thin, as a share of the other two."""
EXPECTATION_SIGMA = 0.25
"""Of a log half size against the network's: its errors on household things, of which one in ten is far off."""


def weighed(solution: Solution) -> Solution:
    """The solution, or a better one once open half sizes are left to the priors and the prediction."""
    problem, state, rays = solution.problem, solution.state, solution.rays
    options, pinhole = problem.options, problem.observation.camera.is_pinhole
    weak = np.flatnonzero(undetermined(solution.covariance(), state.parameters[:3]))
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
    few = draw(problem, BASIN_RAYS, 0.2)
    few = few.weighing(rays.weight / few.weight)
    settled = by_cost(settle(problem, rival, few) for rival in rivals)
    best = refined_best(problem, settled, rays, 2 * REFINE_STEPS)
    return replace(solution, problem=problem, state=best, rays=rays, notes=notes)
