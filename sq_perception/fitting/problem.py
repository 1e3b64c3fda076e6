"""One surface fit as data, and the steps that every course of it shares.

    draw      rays of the object and of free space, for one stage
    coarse    a few Levenberg-Marquardt steps from each start, with Sampson's residual on few rays: a wide basin
    select    bodies that the noise does not distinguish, on more rays, then with the rendered residual
    settle    some more steps of one body with the rendered residual, on rays at hand
    refine    steps of one body with the rendered residual to convergence, on all rays

All of them are methods of a :class:`Problem` and return bodies (:class:`State`).  Costs are mean squared residuals in
units of the noise times the rays' weight, so that a body that leaves nothing but noise costs about that weight.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sq_perception.fitting.cost import Terms
from sq_perception.fitting.covariance import UNTAPERED, Alternative, covariance_at
from sq_perception.fitting.hull_prior import HullPrior
from sq_perception.fitting.levenberg_marquardt import State, minimize
from sq_perception.fitting.observation import ON_SUPPORT, Observation
from sq_perception.fitting.options import MODEL_ERROR, FitOptions, limits
from sq_perception.fitting.rays import SAMPLE, WEIGHT, Rays
from sq_perception.fitting.residuals import RENDERED, SAMPSON, surface_distance
from sq_perception.geometry.quantiles import quantile
from sq_perception.geometry.superquadric import Superquadric

# Rays and steps of the stages: chosen on benchmarks/single_body.
COARSE_RAYS, COARSE_STEPS = 150, 8
BASIN_RAYS, BASIN_STEPS = 300, 15
FIRST_STEPS = 5
"""Steps after which a rival that costs far more than the body at hand is given up."""
REFINE_STEPS = 15
FINAL_RAYS = 3000
"""Object rays of the last stage: a depth error of a third of a pixel's width averages out to a two hundredth.  Chosen
on benchmarks/single_body, like those above."""
FREE_SHARE = 0.25
"""Free rays per object ray: an outline has fewer pixels than an area."""
TOLERANCE, FINAL_TOLERANCE = 1e-3, 3e-5
"""Gain, as a share of the cost, that a step must promise: a stage ends before one that promises less."""
FINAL_GATE = 1.4
"""Mean squared residual up to which a body explains an image: 1, but for a sample of few rays and a search that is
not finished.  Chosen on benchmarks/single_body."""
DOUBT = 25.0
"""Excess of a cost over the best up to which bodies go on together: on the same rays, noise gives a difference D a
standard deviation of 2 sqrt(D), of which this is 2.5."""
RIVAL = 1.3
"""Factor of the best cost up to which bodies go on too, as they have not converged yet."""
FINALISTS = 3
"""Bodies that go on from a selection; chosen on benchmarks/single_body."""
RIVAL_SLACK = 4.0
"""Difference of costs that few rays may hide: one such standard deviation."""
INDEPENDENT_RAYS = 50.0
"""Number of independent rays that an object counts as where its model errs: errors of neighbouring pixels are alike.
Chosen on scanned objects."""
HIT_TOLERANCE = 3e-3
"""Error of g where a ray meets the body.  Rays remember where that was, so that it vanishes as the search converges."""
PLANE_SIGMA, GAP_SIGMA, REST_SIGMA = 0.001, 0.005, 0.05
"""Standard deviations, metres, of a body's reach below the plane and above it, and of the sine of the angle between the
normal and an axis of the body: how well a plane fitted to a depth image is known, and a wide prior with long tails
(:mod:`sq_perception.fitting.priors`).  Both lengths shrink with the model error of small things."""
PROPORTION_SIGMA = 1.0
"""Standard deviation of a log size about the mean of the three: a factor e, a wide prior."""
VOLUME_PRICE = 0.5
"""Price of log(a1 a2 a3) in the cost: what the image does not determine is not to grow.  Chosen on scanned objects."""


class PlaneError(ValueError):
    """A support plane that most of the object lies behind."""


@dataclass(frozen=True, eq=False)
class Problem:
    """One object to fit.

    Attributes
    ----------
    observation
        What the image shows of the object.
    options
        What the caller wants.
    terms
        Constants of the residuals and priors.
    limits
        Lower and upper limit (10,) of a1 a2 a3 e1 e2 t1 t2 t3 k_x k_y.
    deadline
        ``time.perf_counter`` after which nothing new is tried.
    independent
        Number of independent rays that the object counts as, however many are drawn, where errors of neighbouring
        pixels are alike; None where every ray counts as one.
    prior
        A predicted body whose half sizes weigh in, by ``terms.expectation_stiffness``.
    hull
        A prediction of the thing's hull, which weighs in through the terms.
    """

    observation: Observation
    options: FitOptions
    terms: Terms
    limits: tuple[np.ndarray, np.ndarray]
    deadline: float
    independent: float | None = None
    prior: Superquadric | None = None
    hull: HullPrior | None = None

    @classmethod
    def of(cls, observation: Observation, options: FitOptions, began: float) -> Problem:
        """The problem of a superquadric that leaves nothing but noise; ``began`` as by ``time.perf_counter``.

        Raises
        ------
        PlaneError
            If most of the object lies behind its support, as where the normal of that has the wrong sign.
        """
        if options.plane is not None:
            height = quantile(observation.points @ options.plane[:3] + options.plane[3], 0.5)
            if height < -ON_SUPPORT:
                turned = "is it what this object stands on, and does its normal n point away from that?"
                raise PlaneError(f"plane: expected one under the object, got one {-height:.3g} m above it: {turned}")
        terms, bounds = terms_of(observation, options), limits(observation.points)
        return cls(observation, options, terms, bounds, began + options.time_budget)

    @property
    def late(self) -> bool:
        """Whether the time is up."""
        return time.perf_counter() > self.deadline

    def terms_at(self, state: State) -> Terms:
        """The terms with the predicted half sizes along the axes that a body has now."""
        if self.prior is None:
            return self.terms
        return self.terms._replace(expected=self.prior.support(state.rotation.T))

    def with_terms(self, **changed: float) -> Problem:
        """The problem with some terms changed."""
        return replace(self, terms=Terms(**{**self.terms._asdict(), **changed}))

    def within(self, taper: float) -> Problem:
        """The problem with tapers up to a limit."""
        lower, upper = (limit.copy() for limit in self.limits)
        lower[8:], upper[8:] = -taper, taper
        return replace(self, limits=(lower, upper))

    def without_hull(self) -> Problem:
        """The problem as if no hull had been predicted."""
        return replace(self, terms=self.terms._replace(hull_directions=self.terms.hull_directions[:0]), hull=None)

    def floor(self, count: int) -> float:
        """Cost of a body that leaves nothing but noise on ``count`` drawn rays: their total weight."""
        return float(min(count, len(self.observation.pixels))) if self.independent is None else self.independent

    def explained_by(self, finalists: Sequence[State]) -> bool:
        """Whether the first of some selected bodies leaves nothing but noise."""
        return bool(finalists) and finalists[0].cost < FINAL_GATE * self.floor(BASIN_RAYS)

    def draw(self, count: int, offset: float) -> Rays:
        """About ``count`` object rays, and the free rays that come with them; other offsets take other pixels."""
        seen = self.observation
        hits, free = seen.object_rays(count, offset), seen.free_rays(int(FREE_SHARE * count), offset)
        if self.independent is not None:
            hits[:, WEIGHT] = self.independent / len(hits)
            if len(free):
                free[:, WEIGHT] = self.independent / len(seen.pixels) * seen.free_pixels / len(free)
        return Rays(hits, free)

    def coarse(self, starts: Iterable[State]) -> list[State]:
        """Bodies after a few steps from each start, in the order of the starts; from the first one at least."""
        rays = self.draw(COARSE_RAYS, 0.5)
        return self.in_time(starts, lambda start: self._minimized(SAMPSON, start, rays, COARSE_STEPS, TOLERANCE))

    def in_time(self, states: Iterable[State], search: Callable[[State], State]) -> list[State]:
        """Where a search leads from each state, in their order, while there is time; from the first one at least."""
        found: list[State] = []
        for state in states:
            found.append(search(state))
            if self.late:
                break
        return found

    def select(self, candidates: Sequence[State], kept: Sequence[State] = ()) -> list[State]:
        """The best of some candidates, refined, and of those kept before: at most FINALISTS, best first."""
        rays = self.draw(BASIN_RAYS, 0.7)
        for stage in (SAMPSON, RENDERED):
            candidates = [
                self._minimized(stage, candidate, rays, BASIN_STEPS, TOLERANCE)
                for candidate in within_doubt(candidates)[:FINALISTS]
            ]
        return within_doubt([*kept, *candidates])[:FINALISTS]

    def settle(self, state: State, rays: Rays, steps: int = BASIN_STEPS) -> State:
        """A body after some steps with the rendered residual."""
        return self._minimized(RENDERED, state, rays, steps, TOLERANCE)

    def held(self, state: State, axis: int, rays: Rays) -> State:
        """A body after some steps with the rendered residual, its half size along an axis kept, within its limits."""
        lower, upper = (limit.copy() for limit in self.limits)
        lower[axis] = upper[axis] = min(max(state.parameters[axis], lower[axis]), upper[axis])
        return minimize(RENDERED, *rays, self.terms, state, (lower, upper), BASIN_STEPS, TOLERANCE)

    def refine(self, state: State, rays: Rays, steps: int = REFINE_STEPS) -> State:
        """A body after steps with the rendered residual to the end of its valley."""
        return self._minimized(RENDERED, state, rays, steps, FINAL_TOLERANCE)

    def refined_best(self, settled: Sequence[State], rays: Rays, steps: int = REFINE_STEPS) -> State:
        """The best body on these rays of the first two ranked on few; the second one only if the ranking is close."""
        close = [state for state in settled[:2] if state.cost < settled[0].cost + RIVAL_SLACK]
        return least([self.refine(state, rays, steps) for state in close])

    def _minimized(self, stage: int, state: State, rays: Rays, steps: int, tolerance: float) -> State:
        return minimize(stage, *rays, self.terms_at(state), state, self.limits, steps, tolerance)


@dataclass(frozen=True, eq=False)
class Solution:
    """A body on its way through the last steps of a course; what :mod:`sq_perception.fitting.quality` reads in the end.

    Attributes
    ----------
    problem
        The problem of the last stage, with its observation, terms and prior.
    state, rays
        The body, and the rays on which its cost is measured.
    alternatives
        Other bodies that explain the image almost as well.
    notes
        What the body rests on beyond the image, for the message.
    spread_factor
        Factor of the covariance, where residuals err alike.
    as_hull
        Whether the body resembles the convex hull of the object only.
    is_unfinished
        Whether time was up before the search came near the noise, so that the body may be off by any distance.
    """

    problem: Problem
    state: State
    rays: Rays
    alternatives: tuple[Alternative, ...] = ()
    notes: tuple[str, ...] = ()
    spread_factor: float = 1.0
    as_hull: bool = False
    is_unfinished: bool = False

    @cached_property
    def distances(self) -> np.ndarray:
        """Sampson distances (n,) of a sample of the object's points to the body, metres, positive outside."""
        rays = self.problem.observation.object_rays(SAMPLE)
        return surface_distance(rays, self.state.parameters, self.state.rotation)

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariance (11, 11) from the valley of the cost around the body and its distance to a predicted hull."""
        return np.ascontiguousarray(self._with_taper[:UNTAPERED, :UNTAPERED])

    @property
    def taper_covariance(self) -> np.ndarray:
        """Covariance (2, 2) of the tapers; 0 where the body may not taper."""
        found = self._with_taper[UNTAPERED:, UNTAPERED:]
        return np.ascontiguousarray(found) if len(found) else np.zeros((2, 2))

    @cached_property
    def _with_taper(self) -> np.ndarray:
        terms, outline = self.problem.terms_at(self.state), self.problem.observation.outline
        return covariance_at(self.state, self.rays, terms, outline, self.problem.hull) * self.spread_factor

    def unsure(self) -> np.ndarray:
        """Standard deviations (3,) of the half sizes, as shares of them."""
        deviations = np.sqrt(np.diag(self.covariance)[:3])
        return np.asarray(deviations / self.state.parameters[:3])


def terms_of(observation: Observation, options: FitOptions) -> Terms:
    """The terms of an observation, with those of the plane where one is known."""
    terms = Terms(
        hit_tolerance=HIT_TOLERANCE,
        pinhole=1.0 if observation.camera.is_pinhole else 0.0,
        outline_stiffness=1 / observation.outline,
        proportion_stiffness=1 / PROPORTION_SIGMA,
    )
    if options.plane is None:
        return terms
    scale = min((options.model_error or MODEL_ERROR) / MODEL_ERROR, 1.0)
    return terms._replace(
        plane=options.plane,
        plane_stiffness=1 / (PLANE_SIGMA * scale),
        gap_stiffness=1 / (GAP_SIGMA * scale),
        rest_stiffness=1 / REST_SIGMA,
        volume_price=VOLUME_PRICE,
    )


def within_doubt(candidates: Iterable[State]) -> list[State]:
    """Candidates, best first, without those that are worse than the best by more than noise can make them."""
    ranked = by_cost(candidates)
    least = ranked[0].cost
    return [state for state in ranked if state.cost <= least + max(DOUBT, (RIVAL - 1) * abs(least))]


def by_cost(states: Iterable[State]) -> list[State]:
    """The bodies, cheapest first."""
    return sorted(states, key=lambda state: state.cost)


def least(states: Iterable[State]) -> State:
    """The cheapest body."""
    return min(states, key=lambda state: state.cost)
