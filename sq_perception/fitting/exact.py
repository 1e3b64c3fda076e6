"""The exact course: for images that a superquadric explains down to the noise.

1. Starts, cheap ones first: given bodies, central symmetry, its axes turned by 45 degrees.  From each, few steps on few
   rays; the best go on with more rays.  More starts, of every kind, only while the best residual stays above the noise
   floor.  What no superquadric explains after that is left to :mod:`sq_perception.fitting.tolerant`, which goes on from
   the bodies that were tried.
2. The winner goes on to all rays: free rays where the mask lost its edge and object rays far off the surface are
   dropped, and the outline's precision is estimated from its misfit.
3. The finalists that few rays do not distinguish are refined on all of them.
4. Where something is left unexplained, or a half size is not certain to 1 %, the rivals of the result are tried.  Those
   that explain the image almost as well stay as alternatives and add to the covariance.
5. Half sizes along the view that rounded readings leave open are scanned (:mod:`sq_perception.fitting.rounding`).
6. Where the border of the image cuts the object off, longer bodies are tried (:mod:`sq_perception.fitting.unseen`).
7. A half size that stays open is weighed against a prediction (the same module).

The noise floor is a mean squared residual of 1, as residuals are in units of the noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from sq_perception.fitting import rounding, starts, tolerant, unseen
from sq_perception.fitting.covariance import Alternative
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.observation import Observation
from sq_perception.fitting.outline import sharpened, without_shrunk_edge
from sq_perception.fitting.problem import (
    BASIN_RAYS,
    BASIN_STEPS,
    COARSE_RAYS,
    FINAL_RAYS,
    FINALISTS,
    FIRST_STEPS,
    RIVAL_SLACK,
    Problem,
    Solution,
    by_cost,
    least,
)
from sq_perception.fitting.residuals import surface_distance
from sq_perception.fitting.rivals import SIGNIFICANT, alike, other_axes, other_depths
from sq_perception.geometry.quantiles import deviation

_MORE_RAYS, _MOST_FINAL_RAYS = 1500, 6000
"""Rays that distinguish finalists, and most rays of the last stage under much noise: half of and twice
:data:`~sq_perception.fitting.problem.FINAL_RAYS`."""
_FINE_NOISE = 0.3
"""Noise, in pixel widths, that the fewest rays of the last stage average out; their number grows with its square."""
_OUTLIER = 5.0
"""Distance from the winner's surface, in standard deviations, beyond which object rays are dropped: noise reaches there
once in two million.  Kept, they look like something left to explain, and rivals are sought in vain."""
_SETTLED, _UNSURE = 1.03, 0.01
"""Final mean squared residual, and standard deviation of a half size as a share of it, above either of which other
valleys of the cost are tried; chosen on benchmarks/single_body."""
_GATE = 3.6
"""Mean squared residual after the few steps from a start, above which the next group is tried; chosen on
benchmarks/single_body."""
_PROMISING = 2.0
"""Mean squared residual after the few steps from a cheap start, above which it is not followed.  Of 42 images that a
body explains, none left more than 0.8; of 80 that none explains, nine in ten left more than this."""
_UNFINISHED = 1.06
"""Mean squared residual up to which a search that the time budget ended has come near the noise.  Of 30 bodies of the
thesis' protocol and 120 on tables, all but one in thirty below it erred by less than three standard deviations, and
nine in ten above it by more, typically by 5 to 40."""
_HANDED_OVER = 8
"""Number of tried bodies, the cheapest ones, that the tolerant course starts from."""
_HOPELESS = 2.0
"""Cost of a rival after its first steps, as a multiple of the body's at hand, from which on it is given up."""


def solve(problem: Problem, given: Sequence[State]) -> Solution:
    """The best body from the given starts and, as far as needed, from automatic ones."""
    tried = problem.coarse(given)
    finalists = problem.select(tried) if given else []
    if not given or _goes_on(problem, finalists):
        found = _automatic(problem)
        tried += found
        finalists = problem.select(found, finalists)
        if _goes_on(problem, finalists):
            found = problem.coarse(starts.everything(problem.observation))
            tried += found
            finalists = problem.select(found, finalists)
        if _goes_on(problem, finalists):
            return tolerant.take_over(problem, finalists[0], [*given, *by_cost(tried)[:_HANDED_OVER]])
    return _decide(problem, finalists)


def solve_cheaply(problem: Problem, given: Sequence[State], later: Callable[[], list[State]] | None) -> Solution | None:
    """The best body from the given starts and the first ones of symmetry only; None if it leaves more than noise.

    ``later`` returns further starts that cost time: it is called only if the others do not suffice.
    """
    finalists: list[State] = []
    symmetric = starts.groups(problem.observation)
    groups: list[Callable[[], Sequence[State]]] = [lambda: given, lambda: next(symmetric)]
    for group in groups if later is None else [*groups, later]:
        candidates = group()
        tried = problem.coarse(candidates) if candidates else []
        if tried and least(tried).cost < _PROMISING * problem.floor(COARSE_RAYS):
            finalists = problem.select(tried, finalists)
        if problem.explained_by(finalists):
            return _decide(problem, finalists)
    return None


def _automatic(problem: Problem) -> list[State]:
    """Bodies after a few steps from the first groups of starts, as many groups as it takes to come near the noise."""
    found: list[State] = []
    for group in starts.groups(problem.observation):
        found += problem.coarse(group)
        if least(found).cost < _GATE * problem.floor(COARSE_RAYS) or problem.late:
            break
    return found


def _goes_on(problem: Problem, finalists: list[State]) -> bool:
    """Whether something is left to explain, and time to do so."""
    return not problem.explained_by(finalists) and not problem.late


def _decide(problem: Problem, finalists: list[State]) -> Solution:
    """Steps 2 to 7: the finalists on the full budget of rays, the same terms for all of them."""
    favourite, *others = finalists
    if not problem.late:
        problem, favourite = without_shrunk_edge(problem, favourite)
    enough = _enough_rays(problem.observation)
    rays = problem.draw(problem.options.pixels or enough, 0.3)
    rays = rays._replace(hits=_without_outliers(problem.observation, rays.hits, favourite))
    problem, favourite = sharpened(problem, favourite, rays.free, problem.draw(enough // 4, 0.3))

    if others:
        more = problem.draw(_MORE_RAYS, 0.3)
        settled = by_cost(problem.settle(state, more) for state in [favourite, *others])
        favourite, *others = _distinct(settled, settled[0].cost + RIVAL_SLACK)
    best = least(problem.in_time([favourite, *others], lambda state: problem.refine(state, rays)))

    solution = _varied(Solution(problem, best, rays))
    if not problem.late:
        solution = rounding.spread_along_view(solution)
    if not problem.late:
        solution = unseen.with_open_ends(solution)
    if not problem.late:
        solution = unseen.weighed(solution)
    if problem.late and solution.state.cost > _UNFINISHED * solution.rays.weight:
        solution = replace(solution, is_unfinished=True)
    return solution


def _enough_rays(observation: Observation) -> int:
    """Number of rays that bring the noise of their mean well below a pixel's width."""
    ratio = observation.sigma / observation.footprint
    return int(np.clip(FINAL_RAYS * (ratio / _FINE_NOISE) ** 2, FINAL_RAYS, _MOST_FINAL_RAYS))


def _without_outliers(observation: Observation, hits: np.ndarray, state: State) -> np.ndarray:
    """The rays (k, 8) whose points lie near the surface, measured by the typical distance of all."""
    distance = np.abs(surface_distance(hits, state.parameters, state.rotation))
    spread = max(observation.sigma, deviation(distance))
    return hits[distance < _OUTLIER * spread]


def _distinct(states: Sequence[State], most: float, known: Sequence[State] = ()) -> list[State]:
    """The bodies cheaper than ``most``, one a valley of the cost, outside the valleys of ``known``."""
    chosen = list(known)
    for state in states:
        if state.cost < most and not any(alike(state, other) for other in chosen):
            chosen.append(state)
    return chosen[len(known) :]


# Other valleys of the cost


def _varied(solution: Solution) -> Solution:
    """The solution after a search of other valleys of the cost, of which noise and a poor view may hide a deeper one.

    Rivals are the same body with a half size that the image hardly determines made smaller or larger, the seen face in
    place, and, where something is left unexplained, the same box of axes with another z or turned by 45 degrees.  They
    are fitted with the rendered residual: Sampson's would make them grow, as g is convex and noise enters it.
    """
    found: list[State] = []
    while True:
        best = solution.state
        unexplained = best.cost > _SETTLED * solution.rays.weight or rounding.contradicts(solution)
        unsure = solution.unsure()
        if solution.problem.late or not (unexplained or unsure.max() > _UNSURE):
            break
        rivals = other_depths(best, int(np.argmax(unsure)))
        if unexplained:
            rivals += other_axes(best)
        better, refined = _better(solution, rivals)
        found += refined
        if better is best:
            break
        found.append(best)
        solution = replace(solution, state=better)
    return replace(solution, alternatives=_alternatives(solution.state, found)) if found else solution


def _better(solution: Solution, rivals: list[State]) -> tuple[State, list[State]]:
    """The best of a body and its rivals, and the refined rivals: few rays first, all rays for those that hold there."""
    problem, best = solution.problem, solution.state
    few = problem.draw(BASIN_RAYS, 0.2)
    reference = problem.settle(best, few)
    hopeless = _HOPELESS * reference.cost

    def followed(rival: State) -> State:
        state = problem.settle(rival, few, FIRST_STEPS)
        return problem.settle(state, few, BASIN_STEPS - FIRST_STEPS) if state.cost < hopeless else state

    # On other rays the body may already find its way out of a shallow valley.
    settled = [reference, *(state for state in problem.in_time(rivals, followed) if state.cost < hopeless)]
    chosen = _distinct(settled, reference.cost + RIVAL_SLACK, [best._replace(cost=reference.cost)])
    if not chosen:
        return best, []
    found = problem.in_time(by_cost(chosen)[:FINALISTS], lambda rival: problem.refine(rival, solution.rays))
    for state in found:
        if state.cost < best.cost - SIGNIFICANT:
            best = state
    return best, found


def _alternatives(best: State, found: list[State]) -> tuple[Alternative, ...]:
    """Bodies of other valleys that explain the image almost as well, weighted by their likelihood."""
    others = [state for state in found if not alike(state, best)]
    weights = np.array([math.exp(-0.5 * max(state.cost - best.cost, 0.0)) for state in others])
    return tuple(Alternative(s, weight / (1 + weights.sum())) for s, weight in zip(others, weights, strict=True))
