"""The course of a fit: the two models of an object, and the body of each.

exact   The object is a superquadric: m = 0, every ray counts as one.
thing   It strays from one by m, a part of it alike: it counts as few independent rays, and those that a neck or a
        handle leaves far off hardly count.  Beside a predicted hull its prior is that; else what is known of bodies.

Both are one cost with other terms (docs/surface_fit.md), and one search with other stages.  How much a thing misfits is
estimated with its body: with c the mean loss of its rays it counts as INDEPENDENT / max(1, c / EXPLAINED) of them,
since the likelihood maximised over an unknown variance divides by the variance found.  For the covariance they count
as fewer by the same factor once more: larger errors extend over larger parts, such as a neck, a spout or a dent.

Free rays beside the mask show where the body ends.  If the mask lost its edge (sensors lose what they see at grazing
angles), the body covers pixels that were taken for free all around it: those are left out.  What the body then still
covers tells the outline's standard deviation.

A thing is fitted as its convex hull, which encloses lids below a rim, necks and handles: points behind the surface
count by Cauchy's loss, and space within the outline's convex hull may be empty.

Metres, radians, optical frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from sq_perception.fitting.cost import SAMPLE, Rays, Terms
from sq_perception.fitting.fit import INLIER
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.multistart import (
    BASIN,
    COARSE,
    FINAL_TOLERANCE,
    SLACK,
    THING,
    Problem,
    Solution,
    by_cost,
    within_doubt,
)
from sq_perception.fitting.observation import BAND_PIXELS, Observation
from sq_perception.fitting.options import MODEL_ERROR, TAPER, FitOptions, limits
from sq_perception.fitting.priors import HullPrior
from sq_perception.fitting.residuals import mean_loss, penetration
from sq_perception.geometry.quantiles import quantile

INDEPENDENT, EXPLAINED = 100.0, 0.5
"""Most rays that a thing counts as, and the mean loss up to which it does: what cartons and cans leave.  Chosen on
benchmarks/household_things: 200 rays gain on boxes what bottles lose, 50 the other way."""
EXPLAINS = 1.4
"""Mean squared residual up to which a body explains an image: 1, but for a sample of few rays and a search that is
not finished.  Chosen on benchmarks/single_body."""
FINAL_RAYS, _MOST_FINAL_RAYS = 3000, 6000
"""Object rays of the last stage, and most of them under much noise: a depth error of a third of a pixel's width
averages out to a two hundredth.  Chosen on benchmarks/single_body."""
_FINE_NOISE = 0.3
"""Noise, in pixel widths, that the fewest rays of the last stage average out; their number grows with its square."""
_SHARP = 0.3
"""Standard deviation of a perfect outline, in pixels: the body covers exactly the centres of the mask's pixels, a
uniform error of up to half a pixel (1 / sqrt(12))."""
_SHRUNK = 0.25
"""Depth, in pixels: a body that covers half of the free pixels beside the mask this deep is larger than its mask."""
_SHARPER = 0.7
"""Factor of the last estimate of the outline's standard deviation that a new one must fall below for another round."""
_HIT_TOLERANCE = 3e-3
"""Error of g where a ray meets the body.  A search remembers where that was, so that it vanishes as it converges."""
_PLANE_SIGMA, _GAP_SIGMA, _REST_SIGMA = 0.001, 0.005, 0.05
"""Standard deviations, metres, of a body's reach below the plane and above it, and of the sine of the angle between the
normal and an axis of the body: how well a plane fitted to a depth image is known, and a wide prior with long tails
(:mod:`sq_perception.fitting.priors`).  Both lengths shrink with the model error of small things: without, household
things 0.4 times as large lost 0.7 +- 0.3 % of IoU."""
_VOLUME_PRICE = 0.5
"""Price of log(a1 a2 a3) in the cost: what the image does not determine is not to grow.  Chosen on scanned objects."""
_ROUND_SIGMA = 0.06
"""Scale of log(a1 / a2) and 1 - e2 by which most things are round; see :mod:`sq_perception.fitting.priors`."""
_HUBER = 1.0
"""Noise levels up to which Huber's loss of a thing's rays is quadratic, and scale of Cauchy's loss behind its surface:
what strays farther is another part of the thing, a neck or a handle."""
TAPER_SIGMA = 0.3
"""Standard deviation of the prior of a taper: of household things bottles have the largest ones, up to 0.6."""
SPREAD = 2.5**2
"""Factor of the covariance of what a camera saw where no hull is predicted: errors of residuals are alike."""
_AS_HULL = ("like the convex hull of the object",)


def problem_of(observation: Observation, options: FitOptions, deadline: float) -> Problem:
    """The problem of an object as a superquadric, or as a thing where its observation knows a model error."""
    plane, model_error = options.plane, observation.model_error
    hull = options.predicted_hull() if model_error else None
    terms = Terms(
        hit_tolerance=_HIT_TOLERANCE, pinhole=1.0 if observation.camera.is_pinhole else 0.0,
        outline_stiffness=1 / observation.outline,
        proportion_stiffness=1.0,  # a factor e about the mean of the three: a wide prior
    )
    if plane is not None:
        scale = min((model_error or MODEL_ERROR) / MODEL_ERROR, 1.0)
        terms = terms._replace(
            plane=plane, plane_stiffness=1 / (_PLANE_SIGMA * scale), gap_stiffness=1 / (_GAP_SIGMA * scale),
            rest_stiffness=1 / _REST_SIGMA, volume_price=_VOLUME_PRICE,
        )
    if model_error:
        observation = observation.of_hull()
        terms = terms._replace(huber=_HUBER, inner_cauchy=_HUBER)
        if hull is None:
            terms = terms._replace(volume_price=_VOLUME_PRICE, roundness_stiffness=1 / _ROUND_SIGMA)
        else:
            terms = _add_hull(hull, terms)
    bounds = limits(observation.points, 0.0 if hull is None else TAPER)
    return Problem(observation, options, terms, bounds, deadline, INDEPENDENT if model_error else None)


def _add_hull(hull: HullPrior, terms: Terms) -> Terms:
    return terms._replace(
        proportion_stiffness=0.0,
        volume_price=0.0,
        # Writable and of double precision: kernels would be compiled again for other arrays.
        hull_directions=np.array(hull.directions, float, order="C"),
        hull_support=np.array(hull.support, float, order="C"),
        hull_root=hull.root,
        hull_freedom=float(hull.freedom),
        taper_stiffness=1 / TAPER_SIGMA,
    )


def fit_superquadric(
    problem: Problem, groups: Iterable[Callable[[], Sequence[State]]], patient: bool = True
) -> Solution | None:
    """The best superquadric from groups of starts, as many as it takes to explain the image; the nearest one where none
    does, or None if not ``patient``."""
    enough = EXPLAINS * problem.floor(BASIN[-1].rays)
    finalists: list[State] = []
    for starts in filter(None, (group() for group in groups)):
        finalists = within_doubt([*finalists, *problem.search(starts, (COARSE, *BASIN))])[: COARSE.kept]
        if problem.late or finalists[0].cost < enough:
            return _finish(problem, finalists)
    return Solution(problem, finalists[0], problem.draw(SAMPLE, 0.3)) if patient else None


def _finish(problem: Problem, finalists: Sequence[State]) -> Solution:
    """The best of the finalists on all rays, enough that the noise of their mean is well below a pixel's width; the
    precision of the outline is read from the misfit of their favourite."""
    favourite, *others = finalists
    if not problem.late:
        problem, favourite = drop_lost_edge(problem, favourite)
    ratio = problem.observation.sigma / problem.observation.footprint
    enough = int(np.clip(FINAL_RAYS * (ratio / _FINE_NOISE) ** 2, FINAL_RAYS, _MOST_FINAL_RAYS))
    rays = problem.draw(problem.options.pixels or enough, 0.3)
    few = problem.draw(enough // 4, 0.3)
    problem, favourite = sharpen_outline(problem, favourite, rays.free, few)
    settled = by_cost(problem.descend(state, few) for state in [favourite, *others])
    # Few rays do not tell these apart.
    near = [state for state in settled if state.cost <= settled[0].cost + SLACK]
    refined = by_cost(problem.refine(state, rays) for state in (near[:1] if problem.late else near))
    return Solution(problem, refined[0], rays)


def fit_thing(problem: Problem, starts: Sequence[State]) -> Solution:
    """The most probable body of a thing, its misfit estimated with it."""
    found = problem.straight().search(starts, THING)
    misfit = max(1.0, _mean_loss(problem, found[0]) / EXPLAINED)
    if misfit > 1.0 and problem.has_hull:
        problem = replace(problem, independent=INDEPENDENT / misfit)
        found = found if problem.late else problem.search(found, THING[1:])
    rays = problem.draw(problem.options.pixels or SAMPLE, 0.3)
    spread = 1.0 if problem.has_hull else SPREAD
    solution = Solution(problem, problem.descend(found[0], rays, 30), rays, spread_factor=spread)
    solution = _straighten(solution) if problem.has_hull and not problem.late else solution
    left = _mean_loss(problem, solution.state)
    solution = replace(solution, rays=rays.scale(1 / max(1.0, left / EXPLAINED)))
    # As far off as noise reaches at most: points of a bowl or a pair of pliers typically are.
    if left > _HUBER * (2 * INLIER - _HUBER):
        solution = solution.annotate(notes=_AS_HULL, as_hull=True)
    return solution


def _straighten(solution: Solution) -> Solution:
    """The solution without a taper that hardly lowers its cost."""
    straight = solution.problem.straight()
    state = straight.descend(solution.state, solution.rays, 30)
    is_as_good = state.cost < solution.state.cost + SLACK
    return replace(solution, problem=straight, state=state) if is_as_good else solution


def _mean_loss(problem: Problem, body: State) -> float:
    """Mean loss of the object's rays: c of the module."""
    return mean_loss(problem.observation.sample, problem.terms.huber, body.parameters, body.rotation)


# The outline of a superquadric


def drop_lost_edge(problem: Problem, state: State) -> tuple[Problem, State]:
    """Forget the free rays next to the mask if the mask turns out to be smaller than the body."""
    full = problem.observation
    if _depth_inside(problem, state, full.ring(1)) < _SHRUNK:
        return problem, state
    problem = replace(problem, observation=full.beyond(BAND_PIXELS))
    state = problem.descend(state, problem.draw(FINAL_RAYS, 0.6), tolerance=FINAL_TOLERANCE)
    rings = (k for k in range(1, BAND_PIXELS + 1) if _depth_inside(problem, state, full.ring(k)) < _SHRUNK)
    band = next(rings, BAND_PIXELS + 1) - 1
    return replace(problem, observation=full.beyond(band) if band > 0 else full), state


def sharpen_outline(problem: Problem, state: State, free: np.ndarray, rays: Rays) -> tuple[Problem, State]:
    """Estimate the outline's precision from a body's misfit to free rays, and again from the better body it allows.

    It does not fall below a pixel: else pixels that miss a body would cost next to nothing, and it might leave them.
    """
    sigma, before = _outline_sigma(problem, state, free), math.inf
    while True:
        sigma = min(sigma, problem.observation.footprint)
        if not sigma < _SHARPER * before or problem.late:  # so that it ends for any sigma
            return problem, state
        problem = problem.with_terms(outline_stiffness=1 / sigma)
        state = problem.descend(state, rays)
        before, sigma = sigma, _outline_sigma(problem, state, free)


def _depth_inside(problem: Problem, state: State, pixels: np.ndarray) -> float:
    """Depth, in pixels, to which the body covers half of these free pixels.

    Half: a body that is merely too long covers those around the mask on one side only.
    """
    rays = problem.observation.free_rays_of(pixels)
    if len(rays) == 0:
        return 0.0
    depth = penetration(rays, problem.terms, state.parameters, state.rotation)
    return quantile(depth, 0.5) / problem.observation.footprint


def _outline_sigma(problem: Problem, state: State, free: np.ndarray) -> float:
    """Standard deviation of the outline, metres, from how far the body reaches into free rays beside the mask."""
    sharp = _SHARP * problem.observation.footprint
    if len(free) == 0:
        return sharp
    depth = penetration(free, problem.terms, state.parameters, state.rotation)
    reached = depth[depth > 0]
    return max(sharp, float(np.sqrt(np.mean(reached**2)))) if len(reached) else sharp
