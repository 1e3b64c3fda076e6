"""The tolerant course: things, which are no superquadrics, and whose unseen side the image does not show.

One maximum a posteriori fit.  The cost, minus twice the log of the posterior, is the sum of

    object  w rho(r)        what the object's pixels measured; sigma is the noise and the model error in squares
    free    w rho(r)        pixels beside it that saw farther: the body keeps out; times FREE beside a hull
    plane, rest             it does not reach below its support, and mostly lies on a face
    hull                    (nu + J) log(1 + |W (h - b)|^2 / nu): its support function beside the predicted one
    volume, proportion      weak, and only where nothing is predicted (:mod:`sq_perception.fitting.unseen` then too)

(:mod:`sq_perception.fitting.residuals`, :mod:`sq_perception.fitting.priors`, :mod:`sq_perception.fitting.hull_prior`).
Errors of neighbouring pixels are alike where the model errs: the object counts as INDEPENDENT_RAYS rays, however many
are drawn.  Free rays weigh less still beside a predicted hull, as an outline errs as a whole.

1. Starts: the given bodies (the prediction), and boxes on the plane, or along the points' axes without one.
2. A few steps from each on few rays; more from the best; to the end, on all rays, from the best one or two.
3. What is hollow or notched, once more as its convex hull.
4. The same as a body of revolution, chosen by evidence (:mod:`sq_perception.fitting.revolution`).

Metres, radians, optical frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sq_perception.fitting import box_start, revolution, unseen
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.problem import (
    INDEPENDENT_RAYS,
    VOLUME_PRICE,
    Problem,
    Solution,
    by_cost,
    draw,
    refined_best,
    settle,
    terms_of,
)
from sq_perception.fitting.rays import WEIGHT, Rays
from sq_perception.fitting.residuals import surface_distance

FREE = 0.3
"""Of the weight that free rays have by their number.  This and the constants below were chosen on recorded frames
(benchmarks/known_frames), whose figures they therefore flatter."""
_FEW, _RAYS = 150, 800
_KEPT = 4
_FIRST_STEPS, _MORE_STEPS, _LAST_STEPS = 5, 12, 40
_LEFT_OVER_RAYS = 3000
_MEDIAN_TO_SIGMA = 1.4826
"""Of absolute values of a normal distribution."""
_HOLLOW = 3.0
"""Noise levels that the points of a solid thing typically stray at the most.  A thing that is hollow or notched, such
as a bowl or a pair of pliers, is fitted as its hull instead: points may lie behind the surface of the body that
encloses it, and the space within its outline's hull may be empty."""
_INNER_CAUCHY = 1.0
"""Noise levels behind the surface of a hull, beyond which a point hardly counts."""
_SPREAD = 2.5**2
"""Factor of the covariance for things that are no superquadrics, whose errors are alike."""
_HUBER, _HUBER_OF_PREDICTED = 2.0, 1.0
"""Noise levels; what strays farther from a superquadric is another part of the thing: a neck, a handle.  Where a
prediction tells how far the hull reaches, such parts need not."""


def solve(problem: Problem, given: Sequence[State]) -> Solution:
    """The most probable body, from the given starts and boxes."""
    problem = _with_priors(problem)
    observation, plane = problem.observation, problem.options.plane
    boxes = box_start.principal(observation.points) if plane is None else box_start.on_plane(observation.points, plane)
    starts = [*given, *boxes]
    solution = _best(problem, starts)
    huber = problem.terms.huber
    typical_of_hollow = huber * (2 * _HOLLOW - huber) * INDEPENDENT_RAYS
    if solution.state.cost > typical_of_hollow and not problem.late:
        as_hull = replace(problem.with_terms(inner_cauchy=_INNER_CAUCHY), observation=observation.of_hull())
        notes = ("like the convex hull of the object",)
        solution = replace(_best(as_hull, [solution.state, *starts]), notes=notes, as_hull=True)
    if len(problem.terms.hull_directions) == 0 and not problem.late:
        solution = unseen.weighed(solution)
    return solution if problem.late else revolution.weighed(solution)


def _best(problem: Problem, starts: Sequence[State]) -> Solution:
    few = _drawn(problem, _FEW, 0.7)
    begun = _tried(problem, starts, few, _FIRST_STEPS)
    settled = _tried(problem, begun[:_KEPT], few, _MORE_STEPS)
    rays = _drawn(problem, problem.options.pixels or _RAYS, 0.3)
    return Solution(problem, refined_best(problem, settled, rays, _LAST_STEPS), rays, spread_factor=_SPREAD)


def take_over(problem: Problem, best: State, given: Sequence[State]) -> Solution:
    """The same where an exact body was sought in vain: what ``best`` leaves becomes the model error."""
    hits = problem.observation.object_rays(_LEFT_OVER_RAYS)
    left_over = _MEDIAN_TO_SIGMA * float(np.median(surface_distance(hits, best.parameters, best.rotation)))
    observation = problem.observation.coarsened(left_over)
    return solve(replace(problem, observation=observation, terms=terms_of(observation, problem.options)), given)


def _with_priors(problem: Problem) -> Problem:
    hull = problem.options.hull() if callable(problem.options.hull) else problem.options.hull
    terms = problem.terms._replace(huber=_HUBER, inner_cauchy=_INNER_CAUCHY, volume_price=VOLUME_PRICE)
    if hull is not None:
        terms = terms._replace(
            huber=_HUBER_OF_PREDICTED,
            inner_cauchy=0.0,
            proportion_stiffness=0.0,
            volume_price=0.0,
            hull_directions=np.ascontiguousarray(hull.directions),
            hull_support=np.ascontiguousarray(hull.support),
            hull_root=hull.root(),
            hull_freedom=hull.freedom,
        )
    return replace(problem, terms=terms, independent=INDEPENDENT_RAYS)


def _drawn(problem: Problem, count: int, offset: float) -> Rays:
    rays = draw(problem, count, offset)
    if len(problem.terms.hull_directions) > 0:
        rays.free[:, WEIGHT] *= FREE
    return rays


def _tried(problem: Problem, starts: Sequence[State], rays: Rays, steps: int) -> list[State]:
    """Where some steps lead from each start, the best first; from the first one at least."""
    found: list[State] = []
    for start in starts:
        found.append(settle(problem, start, rays, steps))
        if problem.late:
            break
    return by_cost(found)
