"""The tolerant course: things, which are no superquadrics, and whose unseen side the image does not show.

One maximum a posteriori fit.  The cost, minus twice the log of the posterior, is the sum of

    object  w rho(r)        what the object's pixels measured; sigma joins noise and model error in squares
    free    w rho(r)        pixels beside the object that saw farther keep the body out
    plane, rest             the body does not reach below its support, and mostly lies on a face
    hull                    |W (h - b)|^2: support function h against the predicted b; W depends on the misfit m
    volume, proportion      weak, and only where nothing is predicted

See :mod:`sq_perception.fitting.residuals`, :mod:`sq_perception.fitting.priors` and
:mod:`sq_perception.fitting.hull_prior`.  Where the model errs, neighbouring pixels err alike: the object counts as few
independent rays, however many are drawn.

Where a hull is predicted, the body is fitted to the thing's convex hull, which encloses lids below a rim, necks and
handles: points behind the surface count by Cauchy's loss, and space within the outline's convex hull may be empty.  The
object then counts as INDEPENDENT_OF_PREDICTED / m rays, m = max(1, c / EXPLAINED), c their mean loss: the variance of
the model's error is not known beforehand, and the likelihood maximised over it divides by the variance found.  The more
the body misfits, the more it is drawn to the predicted hull (:meth:`~sq_perception.fitting.hull_prior.HullPrior.root`).
That pull does not count towards the covariance, and there the rays count as fewer by m once more: larger errors extend
over larger parts, such as a neck, a spout or a dent.

Beside a predicted hull a body may taper, if the evidence is for it (docs/surface_fit.md).

1. Starts: the given bodies (the prediction), and boxes on the plane, or along the points' axes without one.
2. A few steps from each on few rays; more from the best, which determines c.
3. Convergence on all rays from the best one or two.
4. Without a prediction: a hollow or notched object is fitted once more as its convex hull; and every object also as a
   body of revolution, chosen by evidence (:mod:`sq_perception.fitting.revolution`).  Beside a predicted hull the latter
   is not tried: on benchmarks/household_things it cost tools 12 % of IoU, and gained no other kind 1 %.

Metres, radians, optical frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sq_perception.fitting import revolution, unseen
from sq_perception.fitting.fit import INLIER
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.options import TAPER
from sq_perception.fitting.problem import (
    COARSE_RAYS,
    FINAL_RAYS,
    FIRST_STEPS,
    INDEPENDENT_RAYS,
    REFINE_STEPS,
    VOLUME_PRICE,
    Problem,
    Solution,
    by_cost,
    terms_of,
)
from sq_perception.fitting.rays import SAMPLE
from sq_perception.fitting.residuals import mean_loss, surface_distance
from sq_perception.fitting.starts import on_plane, principal
from sq_perception.geometry.quantiles import deviation

INDEPENDENT_OF_PREDICTED, EXPLAINED = 100.0, 0.5
"""Most rays that an object counts as beside a predicted hull, and the mean loss up to which it does: what cartons and
cans leave.  Chosen on benchmarks/household_things: 200 rays gain on boxes what bottles lose, 50 the other way."""
_KEPT = 2
"""Starts that go on from the first few steps.  More changed nothing on benchmarks/household_things, and neither did
boxes that are deeper than what was seen."""
_INNER_CAUCHY = 1.0
"""Scale of Cauchy's loss: noise levels behind the surface beyond which a point hardly counts."""
_AS_HULL = ("like the convex hull of the object",)
SPREAD = 2.5**2
"""Factor of the covariance for things that are no superquadrics, as their residuals err alike.  Beside a predicted hull
the misfit and the distance to the hull of each thing take its place: on 600 things of benchmarks/household_things,
seeds from 3000, sigma and error then rank more alike (0.65, 0.57 with the factor), at two thirds of the sigma."""
TAPER_SIGMA = 0.3
"""Standard deviation of the prior of a taper: of household things bottles have the largest ones, up to 0.6."""
_HUBER = 1.0
"""Noise levels up to which Huber's loss is quadratic: what strays farther is another part of the thing: a neck, a
handle."""


def solve(problem: Problem, given: Sequence[State]) -> Solution:
    """The most probable body, from the given starts and boxes."""
    problem = _with_priors(problem)
    points, plane = problem.observation.points, problem.options.plane
    boxes = principal(points, deeper=False) if plane is None else on_plane(points, plane)
    starts = [*given, *boxes]
    solution = _best(problem, starts)
    if problem.hull is None:
        if not problem.late:
            solution = revolution.weighed(unseen.weighed(_hollow_as_hull(solution, starts)))
    elif _mean_loss(problem, solution.state) > _typical_of_hollow(problem):
        solution = replace(solution, notes=_AS_HULL, as_hull=True)
    return solution if problem.late else unseen.with_open_ends(solution)


def _best(problem: Problem, starts: Sequence[State]) -> Solution:
    few = problem.draw(COARSE_RAYS, 0.7)
    straight = problem.within(taper=0.0)
    begun = by_cost(problem.in_time(starts, lambda start: straight.settle(start, few, FIRST_STEPS)))
    settled = by_cost(problem.in_time(begun[:_KEPT], lambda state: straight.settle(state, few)))
    if problem.hull is None:
        return _refined(problem, settled)
    misfit = max(1.0, _mean_loss(problem, settled[0]) / EXPLAINED)
    terms = problem.terms
    if misfit > 1.0:
        terms = terms._replace(hull_root=problem.hull.root(misfit))
    drawn = replace(problem, independent=INDEPENDENT_OF_PREDICTED / misfit, terms=terms)
    if not problem.late:
        few = drawn.draw(COARSE_RAYS, 0.7)
        settled = by_cost(drawn.in_time(settled, lambda state: drawn.settle(state, few)))
    solution = _straight_unless_known(_refined(drawn, settled))
    problem = replace(problem, limits=solution.problem.limits)
    problem = problem.with_terms(taper_stiffness=solution.problem.terms.taper_stiffness)
    return replace(solution, problem=problem, rays=solution.rays.weighing(1 / misfit))


def _straight_unless_known(solution: Solution) -> Solution:
    """The solution, its body fitted once more without a taper where the evidence is not for one.

    The ratio of the evidence for k = 0 to that for any k is that of the densities of the posterior and the prior there
    (J. M. Dickey, The weighted likelihood ratio, Annals of Mathematical Statistics 42(1), 1971): no price of parameters
    is to be chosen.
    """
    problem, taper, covariance = solution.problem, solution.state.parameters[8:], solution.taper_covariance
    known = taper @ np.linalg.solve(covariance, taper) + np.linalg.slogdet(covariance)[1]
    if known > 4 * math.log(TAPER_SIGMA) or problem.late:
        return solution
    straight = problem.with_terms(taper_stiffness=0.0).within(taper=0.0)
    return replace(solution, problem=straight, state=straight.refine(solution.state, solution.rays))


def _refined(problem: Problem, settled: Sequence[State]) -> Solution:
    rays = problem.draw(problem.options.pixels or SAMPLE, 0.3)
    spread = SPREAD if problem.hull is None else 1.0
    return Solution(problem, problem.refined_best(settled, rays, 2 * REFINE_STEPS), rays, spread_factor=spread)


def _mean_loss(problem: Problem, body: State) -> float:
    """Mean loss of the object's rays: c of the module."""
    rays = problem.observation.object_rays(SAMPLE, 0.1)
    return mean_loss(rays, problem.terms.huber, body.parameters, body.rotation)


def _typical_of_hollow(problem: Problem) -> float:
    """Huber's loss of a point as far off as noise reaches at most: a bowl's or a pair of pliers' typically have it."""
    return problem.terms.huber * (2 * INLIER - problem.terms.huber)


def _hollow_as_hull(solution: Solution, starts: Sequence[State]) -> Solution:
    """The solution, or the body of the thing's hull if it leaves too much for a solid thing."""
    problem = solution.problem
    if solution.state.cost <= _typical_of_hollow(problem) * INDEPENDENT_RAYS:
        return solution
    as_hull = replace(problem, observation=problem.observation.of_hull())
    return replace(_best(as_hull, [solution.state, *starts]), notes=_AS_HULL, as_hull=True)


def take_over(problem: Problem, best: State, given: Sequence[State]) -> Solution:
    """The most probable body where an exact one was sought in vain: what ``best`` leaves becomes the model error."""
    hits = problem.observation.object_rays(FINAL_RAYS)
    left_over = deviation(np.abs(surface_distance(hits, best.parameters, best.rotation)))
    observation = problem.observation
    observation = replace(observation, model_error=float(np.hypot(observation.model_error, left_over)))
    return solve(replace(problem, observation=observation, terms=terms_of(observation, problem.options)), given)


def _with_priors(problem: Problem) -> Problem:
    hull = problem.options.predicted_hull()
    if hull is None:
        terms = problem.terms._replace(huber=_HUBER, inner_cauchy=_INNER_CAUCHY, volume_price=VOLUME_PRICE)
        return replace(problem, terms=terms, independent=INDEPENDENT_RAYS)
    terms = problem.terms._replace(
        huber=_HUBER,
        inner_cauchy=_INNER_CAUCHY,
        proportion_stiffness=0.0,
        volume_price=0.0,
        # Writable and of double precision: kernels would be compiled again for other arrays.
        hull_directions=np.array(hull.directions, float, order="C"),
        hull_support=np.array(hull.support, float, order="C"),
        hull_root=hull.root(),
        taper_stiffness=1 / TAPER_SIGMA,
    )
    observation = problem.observation.of_hull()
    known = replace(problem, terms=terms, observation=observation, independent=INDEPENDENT_OF_PREDICTED, hull=hull)
    return known.within(taper=TAPER)
