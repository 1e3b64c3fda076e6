"""What rounded readings leave open: the half size behind a face that looks at the camera.

A sharp body seen face-on shows its depth only in the last pixels before its outline.  Where readings are whole steps q
of depth with little noise, all those of the face err alike, by up to q / 2, and least squares takes that error for
information on the outline.  The true body certainly passes every reading at no more than q / 2.  So the half size along
the view is held at one value after another, the rest is fitted with residuals that count only beyond q / 2 (a dead
zone), and each value has the weight exp(-cost / 2).  Their mean is the estimate, their spread the standard deviation.

Reference for the bounded-error view: M. Milanese, A. Vicino, Optimal estimation theory for dynamic systems with set
membership uncertainty, Automatica 27(6), 1991.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from sq_perception.fitting.covariance import Alternative
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.problem import Problem, Solution
from sq_perception.fitting.rays import DEPTH, Rays
from sq_perception.fitting.rivals import other_orders, resized

_FACE_SHARE = 0.04
"""Share of all rays that have a depth in common, from which on it is that of a face."""
_DEAD_ZONE = 0.5 * 1.01
"""Residual, in steps, up to which it counts as 0: half a step, and a little for single precision."""
_RAYS = 1000
"""Rays of the search for each of up to 21 bodies, which begins at a neighbour's."""
_PACES = (1.05, 1.08, 1.12, 1.18, 1.25, 1.25, 1.25, 1.25, 1.25, 1.25)
"""Factors from one half size to the next, up and down from the one at hand."""
_UNLIKELY = 12.0
"""Excess of the cost over the least, twice in a row, at which a walk ends."""
_ALLOWED = 3.0
"""Cost up to which the readings allow a body, without which no walk ends early: the true one costs nothing."""
_CERTAIN = 0.02
"""Standard deviation of the log size below which nothing is open."""
_OPEN = 0.1
"""Standard deviation of the log size from which on the mean of all bodies replaces that of least squares."""
_FACE_SPREAD = 1.5
"""Factor of the other standard deviations: all readings of a face err alike."""
_CONTRADICTED = 0.003
"""Mean squared residual beyond half a step, in units of the noise, above which a body is wrong.  Of 1000 of the thesis'
images all but one leave 0.0007 at most; a body 3 % too long left 0.01, its mean squared residual was 0.85, the right
one's 0.76."""


def spread_along_view(solution: Solution) -> Solution:
    """The solution with all half sizes along the view that the image allows, where readings are rounded."""
    quantum = solution.problem.observation.noise.quantum
    if quantum > 0 and faces_camera(solution.rays.hits, quantum):
        best, allowed = plausible(solution)
        solution = replace(solution, state=best)
        if allowed:
            solution = replace(solution, alternatives=tuple(allowed), spread_factor=_FACE_SPREAD**2)
    return solution


def contradicts(solution: Solution) -> bool:
    """Whether the body passes rounded readings at more than half a step, as the true one does not.

    The sum of squares hardly shows it: below half a step a residual is the rounding's, and says nothing.
    """
    if solution.problem.observation.noise.quantum == 0.0:
        return False
    left = _rounded(solution.problem).refine(solution.state, solution.rays, steps=0)
    return left.cost > _CONTRADICTED * solution.rays.weight


def _rounded(problem: Problem) -> Problem:
    """The problem with residuals that count only beyond half a step."""
    observation = problem.observation
    return problem.with_terms(dead_zone=_DEAD_ZONE * observation.noise.quantum / observation.sigma)


def faces_camera(hits: np.ndarray, quantum: float) -> bool:
    """Whether many rays (n, 8) read the same depth."""
    depth = hits[:, DEPTH]
    level = np.rint((depth - depth.min()) / quantum).astype(np.int64)
    return bool(np.bincount(level).max() > _FACE_SHARE * len(hits))


def plausible(solution: Solution) -> tuple[State, list[Alternative]]:
    """The best body, and those that the rounded readings allow, none if no other than the given one.

    The best is the given one, which averages roundings out, as long as the readings hardly leave a size open, else the
    mean of all.
    """
    best, rays = solution.state, solution.rays
    rays = rays.every(max(1, len(rays.hits) // _RAYS))
    walk = _Walk(_rounded(solution.problem), rays)
    walk.along_view(best)
    if walk.least < _ALLOWED and walk.deviation() < _CERTAIN:
        return best, []
    start = walk.states[walk.sizes.index(math.log(best.parameters[_view_axis(best)]))]
    for rival in other_orders(best):
        walk.along_view(rival)
    if walk.deviation() < _OPEN and start.cost < walk.least + _ALLOWED:
        return best, walk.alternatives()
    return walk.mean(), walk.alternatives()


class _Walk:
    """Bodies held at one half size along the view after another, from starts outwards, and their weights."""

    def __init__(self, problem: Problem, rays: Rays) -> None:
        self.problem, self.rays = problem, rays
        self.states: list[State] = []
        self.sizes: list[float] = []
        self.paces: list[float] = []
        self.least = math.inf

    def along_view(self, start: State) -> None:
        """Walk from one start, up and down, until the readings forbid to go on."""
        axis = _view_axis(start)
        log_size = math.log(start.parameters[axis])
        here = self._held(start, log_size)
        found = {log_size: here}
        self.least = min(self.least, here.cost)
        for direction in (1, -1):
            state, position, unlikely = here, log_size, 0
            for pace in _PACES:
                position += direction * math.log(pace)
                state = found[position] = self._held(state, position)
                self.least = min(self.least, state.cost)
                unlikely = unlikely + 1 if state.cost > self.least + _UNLIKELY else 0
                if unlikely == 2 and self.least < _ALLOWED:
                    break
        sizes = sorted(found)
        self.sizes += sizes
        self.states += [found[x] for x in sizes]
        self.paces += np.gradient(sizes).tolist()

    def weights(self) -> np.ndarray:
        """Weights (n,) of the bodies for a uniform density of the log size; they sum to 1."""
        cost = np.array([state.cost for state in self.states])
        weights = np.exp(-0.5 * (cost - self.least)) * np.array(self.paces)
        return np.asarray(weights / weights.sum())

    def deviation(self) -> float:
        """Standard deviation of the log size."""
        weights, sizes = self.weights(), np.array(self.sizes)
        return math.sqrt(weights @ (sizes - weights @ sizes) ** 2)

    def mean(self) -> State:
        """The body of the mean log size, fitted from the likeliest one near it."""
        weights, sizes = self.weights(), np.array(self.sizes)
        mean = float(weights @ sizes)
        near = np.argsort(np.abs(sizes - mean))[:3]
        nearest = min((self.states[k] for k in near), key=lambda state: state.cost)
        return self._held(nearest, mean)

    def alternatives(self) -> list[Alternative]:
        return [Alternative(state, float(w)) for state, w in zip(self.states, self.weights(), strict=True)]

    def _held(self, start: State, log_size: float) -> State:
        axis = _view_axis(start)
        lower, upper = self.problem.limits
        size = min(max(math.exp(log_size), lower[axis]), upper[axis])
        return self.problem.held(resized(start, axis, size), axis, self.rays)


def _view_axis(state: State) -> int:
    """The axis of the body that is nearest to the camera's."""
    return int(np.argmax(np.abs(state.rotation[2])))
