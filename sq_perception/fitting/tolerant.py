"""The tolerant course: for things that are no superquadrics, whose surface strays from any by a model error.

Neighbouring pixels err alike then: the object counts as few independent rays, points behind the surface weigh less
than those before it, and wide priors decide what is open.  There all starts compete, as a wrong valley is good enough
soon.  What no superquadric comes near is fitted as its convex hull, the space beside it let go.

It is entered at two places:

* :func:`solve`, where a model error is known from the start, as on a plane: ``problem.observation`` counts it in;
* :func:`take_over`, from the exact course once it is at its end: what its best body leaves becomes the model error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sq_perception.fitting import revolution, starts, unseen
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.problem import (
    ESCALATED_FINALISTS,
    INDEPENDENT_RAYS,
    VOLUME_PRICE,
    Problem,
    Solution,
    by_cost,
    coarse,
    draw,
    least,
    refine,
    select,
    terms_of,
)
from sq_perception.fitting.rays import WEIGHT
from sq_perception.fitting.residuals import surface_distance

_RAYS = 800
_LEFT_OVER_RAYS = 3000
_PROMISING = 24
"""So many of the bodies that were tried begin once more."""
_MEDIAN_TO_SIGMA = 1.4826
"""Of absolute values of a normal distribution."""
_OUTER_HUBER, _INNER_CAUCHY = 2.0, 1.0
"""Objects that are no superquadrics are hollow and notched, not hairy: a point may well lie behind the surface of the
body that encloses the object, but not in front of it.  Of an exact superquadric both are noise, and weighing those
behind less would pull the body towards the camera by half of that noise."""
_MODEL_SPREAD = 2.5**2
"""Factor of the covariance for objects that are no superquadrics, whose errors are alike: read from
benchmarks/scanned_objects."""


def solve(problem: Problem, given: Sequence[State]) -> Solution:
    """The best body from the given starts and automatic ones."""
    problem = replace(problem, independent=INDEPENDENT_RAYS)
    if problem.options.plane is not None:
        problem = problem.with_terms(huber=_OUTER_HUBER, inner_cauchy=_INNER_CAUCHY)
    tried = coarse(problem, given)
    finalists = select(problem, tried) if given else []
    if not given or not problem.late:
        found = starts.automatic(problem)
        tried += found
        finalists = select(problem, found, finalists)
    return _decide(problem, finalists, tried)


def take_over(problem: Problem, best: State, tried: Sequence[State]) -> Solution:
    """The best body where an exact one was sought in vain: ``best``, among all the bodies that were ``tried``."""
    hits = problem.observation.object_rays(_LEFT_OVER_RAYS)
    left_over = _MEDIAN_TO_SIGMA * float(np.median(surface_distance(hits, best.parameters, best.rotation)))
    observation = problem.observation.coarsened(left_over)
    terms = terms_of(observation, problem.options)._replace(
        huber=_OUTER_HUBER, inner_cauchy=_INNER_CAUCHY, volume_price=VOLUME_PRICE
    )
    problem = replace(problem, observation=observation, terms=terms, independent=INDEPENDENT_RAYS)
    found = coarse(problem, by_cost(tried)[:_PROMISING])
    finalists = select(problem, found, most=ESCALATED_FINALISTS)
    return _decide(problem, finalists, [*tried, *found])


def _decide(problem: Problem, finalists: list[State], tried: Sequence[State]) -> Solution:
    """The finalists on all rays; as the hull if none comes near."""
    as_hull = False
    if not problem.explained_by(finalists) and not problem.late:
        hull = problem.observation.of_hull()
        as_hull = len(hull.free) < len(problem.observation.free)
        if as_hull:
            problem = replace(problem, observation=hull)
            finalists = select(problem, coarse(problem, by_cost(tried)[:_PROMISING]), most=ESCALATED_FINALISTS)
    excess = max(1.0, finalists[0].cost / INDEPENDENT_RAYS)
    rays = draw(problem, problem.options.pixels or _RAYS, 0.3)
    for part in rays:
        part[:, WEIGHT] /= excess
    best = refine(problem, finalists[0], rays)
    for rival in finalists[1:]:
        if problem.late:
            break
        best = least([best, refine(problem, rival, rays)])
    notes = ("like the convex hull of the object",) if as_hull else ()
    solution = Solution(problem, best, rays, notes=notes, spread_factor=_MODEL_SPREAD, as_hull=as_hull)
    if not problem.late:
        solution = unseen.weighed(solution)
    if not problem.late and problem.observation.camera.is_pinhole:
        solution = revolution.weighed(solution)
    return solution
