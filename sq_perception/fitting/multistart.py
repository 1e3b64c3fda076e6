"""One object to fit as data, and the search from many starts that every fit is.

The cost of a body is minus twice the logarithm of its posterior, docs/surface_fit.md:

    cost = sum_i w_i rho(r_i) + priors,     r_i = (rendered - measured depth) / sqrt(s^2 + m^2)

over the object's rays and those of free space (:mod:`sq_perception.fitting.residuals`), with the noise s, the model
error m, and the priors of :mod:`sq_perception.fitting.priors`.  A body that leaves nothing but noise costs about the
total weight of the object's rays.

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
from sq_perception.fitting.options import FitOptions
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
COARSE = Stage(SAMPSON, 150, 8, 3, 0.5)
BASIN = (Stage(SAMPSON, 300, 15, 3, 0.7), Stage(RENDERED, 300, 15, 3, 0.7))
THING = (Stage(RENDERED, 150, 8, 4, 0.7), Stage(RENDERED, 150, 15, 3, 0.7))
SETTLE = Stage(RENDERED, 300, 15, 3, 0.2)

FREE_SHARE = 0.25
"""Free rays per object ray: an outline has fewer pixels than an area."""
TOLERANCE, FINAL_TOLERANCE = 1e-3, 3e-5
"""Gain, as a share of the cost, that a step must promise: a stage ends before one that promises less."""
DOUBT = 0.3
"""Excess of a cost over the best, as a share of it, up to which bodies go on together: few steps have not converged."""
SLACK = 1.0
"""Difference of costs that few rays may hide: noise gives one of D a standard deviation of 2 sqrt(D)."""
SIGNIFICANT = 0.5
"""A difference of costs, by which one body is exp(0.25) = 1.3 times as likely as the other; smaller ones are ties."""
_ALIKE, _ALONG = 0.01, 0.95
"""Half sizes that differ by less than this share are the same, and axes with a cosine above this one."""


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
    """

    observation: Observation
    options: FitOptions
    terms: Terms
    limits: tuple[np.ndarray, np.ndarray]
    deadline: float
    independent: float | None = None

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
        hits, free = seen.object_rays(count, offset), seen.free_rays(int(FREE_SHARE * count), offset)
        if self.independent is not None:
            hits[:, Ray.WEIGHT] = self.independent / len(hits)
            if len(free):
                free[:, Ray.WEIGHT] = self.independent / len(seen.pixels) * seen.free_pixels / len(free)
        return Rays(hits, free)

    def search(self, starts: Iterable[State], stages: Sequence[Stage]) -> list[State]:
        """The bodies, best first, that go on from the last of some stages; from the first start at least."""
        states = list(starts)
        for stage in stages:
            found = self.advance(states, stage)
            states = (within_doubt(found) if self.independent is None else distinct(by_cost(found)))[: stage.kept]
        return states

    def advance(self, states: Iterable[State], stage: Stage) -> list[State]:
        """Where a stage leads from each body, in their order, while there is time; from the first one at least."""
        rays = self.draw(stage.rays, stage.offset)
        found: list[State] = []
        for state in states:
            found.append(self.descend(state, rays, stage.steps, residual=stage.residual))
            if self.late:
                break
        return found

    def descend(
        self, state: State, rays: Rays, steps: int = SETTLE.steps, tolerance: float = TOLERANCE,
        residual: int = RENDERED, held: int | None = None,
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
    return [state for state in ranked if state.cost <= least + DOUBT * abs(least)]


def distinct(states: Iterable[State]) -> list[State]:
    """The first of all that are one body in other forms, in their order."""
    found: list[State] = []
    for state in states:
        z = state.rotation[:, 2]
        if not any(alike(state, other) and abs(z @ other.rotation[:, 2]) > _ALONG for other in found):
            found.append(state)
    return found


def alike(state: State, other: State) -> bool:
    """Whether two searches ended in the same valley: at about the same cost and sizes, in any order of the axes."""
    if abs(state.cost - other.cost) > SIGNIFICANT:
        return False
    pairs = zip(sorted(state.parameters[:3].tolist()), sorted(other.parameters[:3].tolist()), strict=True)
    return all(abs(one - another) < _ALIKE * one for one, another in pairs)


def by_cost(states: Iterable[State]) -> list[State]:
    """The bodies, cheapest first."""
    return sorted(states, key=lambda state: state.cost)
