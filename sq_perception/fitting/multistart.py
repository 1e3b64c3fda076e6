"""One object to fit as data, and the search from many starts that every fit is.

The cost of a body is minus twice the logarithm of its posterior, docs/surface_fit.md:

    cost = sum_i w_i rho(r_i) + priors,     r_i = (rendered - measured depth) / sqrt(s^2 + m^2)

over the object's rays and those of free space (:mod:`sq_perception.fitting.residuals`), with the noise s, the model
error m, and the priors of :mod:`sq_perception.fitting.priors`.  A body that leaves nothing but noise costs about the
total weight of the object's rays.  A superquadric (m = 0) and a thing that strays from one (m > 0) are one cost with
other terms.

A search goes through stages (:class:`Stage`): from each body at hand so many steps with a residual on so many rays;
the best ones that the noise does not tell apart go on.

Metres, optical frame.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from sq_perception.fitting.cost import Ray, Rays, Terms
from sq_perception.fitting.levenberg_marquardt import State, minimize
from sq_perception.fitting.observation import Observation
from sq_perception.fitting.options import MODEL_ERROR, TAPER, FitOptions, limits
from sq_perception.fitting.quality import UNTAPERED, Alternative, covariance_at
from sq_perception.fitting.residuals import RENDERED, SAMPSON, surface_distance


class Stage(NamedTuple):
    """A stage of a search: the residual, object rays, steps from each body, bodies that go on, and the place between
    two pixels, 0 to 1, where the draw of rays begins: others take other pixels."""

    residual: int
    rays: int
    steps: int
    kept: int
    offset: float


# Chosen on benchmarks/single_body and benchmarks/household_things.
SUPERQUADRIC = (
    Stage(SAMPSON, 150, 8, 3, 0.5), Stage(SAMPSON, 300, 15, 3, 0.7), Stage(RENDERED, 300, 15, 3, 0.7)
)  # fmt: skip
THING = (Stage(RENDERED, 150, 8, 4, 0.7), Stage(RENDERED, 150, 15, 3, 0.7))

INDEPENDENT = 100.0
"""Most rays that a thing counts as.  Chosen on benchmarks/household_things: 200 gain on boxes what bottles lose, 50 the
other way."""
HUBER = 1.0
"""Noise levels up to which Huber's loss of a thing's rays is quadratic, and scale of Cauchy's loss behind its surface:
what strays farther is another part of the thing, a neck or a handle."""
FINAL_TOLERANCE = 3e-5
"""Gain, as a share of the cost, that a step of the last stage must promise: it ends before one that promises less."""
SLACK = 1.0
"""Difference of costs that few rays may hide: noise gives one of D a standard deviation of 2 sqrt(D)."""
SIGNIFICANT = 0.5
"""A difference of costs, by which one body is exp(0.25) = 1.3 times as likely as the other; smaller ones are ties."""


@dataclass(frozen=True, eq=False)
class Problem:
    """One object to fit: what the image shows, what the caller wants, and the constants of residuals and priors.

    ``limits`` are the lower and the upper one (10,) of a1 a2 a3 e1 e2 t1 t2 t3 k_x k_y.  After ``deadline``, by
    ``time.perf_counter``, nothing new is tried.  The object counts as so many ``independent`` rays, however many are
    drawn, where errors of neighbouring pixels are alike; None where every ray counts as one.
    """

    observation: Observation
    options: FitOptions
    terms: Terms
    limits: tuple[np.ndarray, np.ndarray]
    deadline: float
    independent: float | None = None

    @classmethod
    def of(cls, observation: Observation, options: FitOptions, deadline: float) -> Problem:
        """The problem of an object as a superquadric, or as a thing where its observation knows a model error.

        A thing is fitted as its convex hull, which encloses lids below a rim, necks and handles: points behind the
        surface count by Cauchy's loss, and space within the outline's convex hull may be empty.
        """
        model_error = observation.model_error
        hull = options.predicted_hull() if model_error else None
        terms = Terms(
            hit_tolerance=3e-3,  # a search remembers where rays met the body, so that the error vanishes in the end
            pinhole=float(observation.camera.is_pinhole), outline_stiffness=1 / observation.outline,
            proportion_stiffness=1.0,  # a factor e about the mean of the three: a wide prior
        )
        if options.plane is not None:
            # Lengths shrink with the model error of small things: without, household things 0.4 times as large lost
            # 0.7 +- 0.3 % of IoU.
            scale = min((model_error or MODEL_ERROR) / MODEL_ERROR, 1.0)
            terms = terms._replace(
                plane=options.plane,
                plane_stiffness=1 / (0.001 * scale),  # how well a plane fitted to a depth image is known
                gap_stiffness=1 / (0.005 * scale), rest_stiffness=1 / 0.05,  # wide priors with long tails
            )
        if model_error:
            observation = observation.of_hull()
            terms = terms._replace(huber=HUBER, inner_cauchy=HUBER)
        if hull is not None:
            terms = terms._replace(
                proportion_stiffness=0.0,
                taper_stiffness=1 / 0.3,  # of household things bottles have the largest ones, up to 0.6
                # Writable and of double precision: kernels would be compiled again for other arrays.
                hull_directions=np.array(hull.directions, float, order="C"),
                hull_support=np.array(hull.support, float, order="C"),
                hull_root=hull.root, hull_freedom=float(hull.freedom),
            )
        elif model_error or options.plane is not None:
            # What the image does not determine is not to grow.  Chosen on scanned objects.
            terms = terms._replace(volume_price=0.5, roundness_stiffness=1 / 0.06 if model_error else 0.0)
        bounds = limits(observation.points, 0.0 if hull is None else TAPER)
        return cls(observation, options, terms, bounds, deadline, INDEPENDENT if model_error else None)

    @property
    def late(self) -> bool:
        """Whether the time is up."""
        return time.perf_counter() > self.deadline

    @property
    def has_hull(self) -> bool:
        """Whether a predicted hull weighs in."""
        return len(self.terms.hull_directions) > 0

    def with_terms(self, **changed: Any) -> Problem:
        """The problem with some terms changed."""
        return replace(self, terms=self.terms._replace(**changed))

    def straight(self) -> Problem:
        """The problem without tapers."""
        lower, upper = (np.append(limit[:8], np.zeros(2)) for limit in self.limits)
        return replace(self, limits=(lower, upper), terms=self.terms._replace(taper_stiffness=0.0))

    def floor(self, count: int) -> float:
        """Cost of a body that leaves nothing but noise on ``count`` drawn rays: their total weight."""
        return float(min(count, len(self.observation.pixels))) if self.independent is None else self.independent

    def draw(self, count: int, offset: float) -> Rays:
        """About ``count`` object rays, and the free rays that come with them."""
        seen = self.observation
        # An outline has fewer pixels than an area.
        hits, free = seen.object_rays(count, offset), seen.free_rays(count // 4, offset)
        if self.independent is not None:
            hits[:, Ray.WEIGHT] = self.independent / len(hits)
            if len(free):
                free[:, Ray.WEIGHT] = self.independent / len(seen.pixels) * seen.free_pixels / len(free)
        return Rays(hits, free)

    def search(self, starts: Iterable[State], stages: Sequence[Stage]) -> list[State]:
        """The bodies, best first, that go on from the last of some stages; from the first start at least."""
        states = list(starts)
        for stage in stages:
            rays, found = self.draw(stage.rays, stage.offset), list[State]()
            for state in states:
                found.append(self.descend(state, rays, stage.steps, residual=stage.residual))
                if self.late:
                    break
            states = (within_doubt(found) if self.independent is None else distinct(by_cost(found)))[: stage.kept]
        return states

    def descend(
        self, state: State, rays: Rays, steps: int = 15, tolerance: float = 1e-3, residual: int = RENDERED,
        held: int | None = None,
    ) -> State:
        """A body after at most so many steps on rays at hand; its half size along an axis may be held."""
        limits = self.limits
        if held is not None:
            limits = limits[0].copy(), limits[1].copy()
            limits[0][held] = limits[1][held] = state.parameters[held]
        return minimize(residual, *rays, self.terms, state, limits, steps, tolerance)

    def refine(self, state: State, rays: Rays) -> State:
        """A body at the end of its valley, in 30 steps at most: beyond need."""
        return self.descend(state, rays, 30, FINAL_TOLERANCE)


_OF_A_VALLEY = ("distances", "_with_taper")
"""What a solution computes once of its problem, body and rays."""


@dataclass(frozen=True, eq=False)
class Solution:
    """A body on its way through the last steps of a fit; what :mod:`sq_perception.fitting.quality` reads in the end.

    The cost of the body is measured on ``rays``; ``alternatives`` explain the image almost as well.  ``notes`` tell
    what the body rests on beyond the image, ``spread_factor`` multiplies the covariance where residuals err alike.
    ``as_hull``: the body resembles the convex hull of the object only.  ``is_unfinished``: time was up before the
    search came near the noise, so that the body may be off by any distance.
    """

    problem: Problem
    state: State
    rays: Rays
    alternatives: tuple[Alternative, ...] = ()
    notes: tuple[str, ...] = ()
    spread_factor: float = 1.0
    as_hull: bool = False
    is_unfinished: bool = False

    @property
    def misfit(self) -> float:
        """Mean squared residual, in units of the noise and the model error."""
        return self.state.cost / self.rays.weight

    @cached_property
    def distances(self) -> np.ndarray:
        """Sampson distances (n,) of a sample of the object's points to the body, metres, positive outside."""
        return surface_distance(self.problem.observation.sample, self.state.parameters, self.state.rotation)

    @property
    def covariance(self) -> np.ndarray:
        """Covariance (11, 11) from the valley of the cost around the body and its distance to a predicted hull."""
        return self._with_taper[:UNTAPERED, :UNTAPERED] * self.spread_factor

    @property
    def taper_covariance(self) -> np.ndarray:
        """Covariance (2, 2) of the tapers; 0 where the body may not taper."""
        found = self._with_taper[UNTAPERED:, UNTAPERED:] * self.spread_factor
        return found if len(found) else np.zeros((2, 2))

    @cached_property
    def _with_taper(self) -> np.ndarray:
        terms = self.problem.terms._replace(outline_stiffness=1 / self.problem.observation.outline)
        return covariance_at(*self.rays, terms, self.state.parameters, self.state.rotation)

    def annotate(self, **changed: Any) -> Solution:
        """The solution with other fields than its problem, body and rays changed: its valley is the same."""
        other = replace(self, **changed)
        other.__dict__.update({name: self.__dict__[name] for name in _OF_A_VALLEY if name in self.__dict__})
        return other

    def unsure(self) -> np.ndarray:
        """Standard deviations (3,) of the half sizes, as shares of them."""
        deviations = np.sqrt(np.diag(self.covariance)[:3])
        return np.asarray(deviations / self.state.parameters[:3])


def within_doubt(candidates: Iterable[State]) -> list[State]:
    """Candidates, best first, without those that are worse than the best by more than noise can make them."""
    ranked = distinct(by_cost(candidates))
    least = ranked[0].cost
    return [state for state in ranked if state.cost <= least + 0.3 * abs(least)]  # few steps have not converged


def distinct(states: Iterable[State]) -> list[State]:
    """The first of all that are one body in other forms, in their order."""
    found: list[State] = []
    for state in states:
        z = state.rotation[:, 2]
        if not any(alike(state, other) and abs(z @ other.rotation[:, 2]) > 0.95 for other in found):
            found.append(state)
    return found


def alike(state: State, other: State) -> bool:
    """Whether two searches ended in the same valley: at about the same cost and sizes, in any order of the axes."""
    if abs(state.cost - other.cost) > SIGNIFICANT:
        return False
    pairs = zip(sorted(state.parameters[:3].tolist()), sorted(other.parameters[:3].tolist()), strict=True)
    return all(abs(one - another) < 0.01 * one for one, another in pairs)


def by_cost(states: Iterable[State]) -> list[State]:
    """The bodies, cheapest first."""
    return sorted(states, key=lambda state: state.cost)
