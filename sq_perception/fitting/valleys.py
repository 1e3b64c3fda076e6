"""Other bodies that the image allows: what the valley of the cost around the result does not tell.

Other valleys.  Seen from one side, a body's own axes and the face it shows are mostly certain, while the order of its
axes and the half size that runs away from the camera are not: the cost has a valley for each.

Open half sizes.  The curvature of the cost tells how sure a size is where the valley is a parabola.  It is none

- of a face that looks at the camera, read in whole steps q of depth with little noise: all readings of the face err
  alike, by up to q / 2, and least squares takes that error for information on the outline.  The true body certainly
  passes every reading at no more than q / 2: residuals count beyond that only (a dead zone; M. Milanese, A. Vicino,
  Optimal estimation theory for dynamic systems with set membership uncertainty, Automatica 27(6), 1991);
- where the border of the image, or of its readings, cuts an object: the cost has a wall where the body would be too
  short to reach the border and is flat beyond.  A predicted hull does not count there: it mostly ends at the border
  too;
- where what the image shows leaves a size open, and priors decide.

Of the first two, bodies are held at one half size after another and the rest is fitted; what the image allows adds to
the covariance.  Of the last, other sizes are tried, the one of a predicted body among them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sq_perception.fitting import starts
from sq_perception.fitting.cost import SAMPLE, Ray, Rays
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.multistart import SIGNIFICANT, SLACK, Problem, Solution, alike, by_cost, distinct
from sq_perception.fitting.observation import Observation
from sq_perception.fitting.quality import Alternative, undetermined
from sq_perception.fitting.starts import resized
from sq_perception.imaging import regions

_SETTLED, _UNSURE = 1.03, 0.01
"""Final mean squared residual, and standard deviation of a half size as a share of it, above either of which other
valleys of the cost are tried; chosen on benchmarks/single_body."""
_FEW = 300, 0.2
"""Object rays on which other bodies are settled, and where their draw begins: others than those of the search."""
_OTHER_SIZES = (0.5, 1.4)
"""Factors of the half size of rivals."""
_FACE_SHARE = 0.04
"""Share of all rays that have a depth in common, from which on it is that of a face."""
_DEAD_ZONE = 0.5 * 1.01
"""Residual, in steps, up to which it counts as 0: half a step, and a little for single precision."""
_PACES = (1.05, 1.08, 1.12, 1.18, 1.25, 1.25, 1.25, 1.25, 1.25, 1.25)
"""Factors from one half size to the next, up and down from the one at hand."""
_UNLIKELY = 12.0
"""Excess of the cost over the least, twice in a row, at which a walk ends."""
_CERTAIN, _OPEN = 0.02, 0.1
"""Standard deviation of the log size below which nothing is open, and from which on the mean of all bodies replaces the
best."""
_FACE_SPREAD = 1.5
"""Factor of the other standard deviations: all readings of a face err alike."""
_ALLOWED = 3.0
"""Cost up to which the readings allow a body, without which no walk ends early: the true one costs nothing."""
_LONGER = (1.25, 1.6)
"""Factors of a half size whose end is beyond the border."""
_NO_EVIDENCE = 12.5
"""Excess of a cost that is no evidence against a length: through noise its standard deviation is 7."""
_OVAL = 0.25
"""Share of things that are not round among those of which the image does not tell."""
_EXPECTATION_SIGMA = 0.25
"""Sigma of a log half size from a predicted body's: its errors on household things, of which one in ten is far off."""


def explore(solution: Solution) -> Solution:
    """The best superquadric once other valleys were searched, of which noise and a poor view may hide a deeper one.

    Rivals are the same body with the half size that the image determines least made smaller or larger, the seen face in
    place, turned by 45 degrees, and the same box with each of its other axes as z.  They are fitted with the rendered
    residual: Sampson's would make them grow, as g is convex and noise enters it.  Those that are no better are
    alternatives.
    """
    problem, rays, others = solution.problem, solution.rays, list[State]()
    while not problem.late and (solution.misfit > _SETTLED or solution.unsure().max() > _UNSURE):
        best, axis = solution.state, int(np.argmax(solution.unsure()))
        sizes = best.parameters[axis] * np.array(_OTHER_SIZES)
        rivals = [*(resized(best, axis, size) for size in sizes), starts.turned(best), *starts.other_orders(best)]
        # On other rays the body may already find its way out of a shallow valley.
        few = problem.draw(*_FEW)
        on_time = itertools.takewhile(lambda _: not problem.late, rivals)
        reference, *settled = (problem.descend(state, few) for state in itertools.chain([best], on_time))
        near = [state for state in distinct(by_cost(settled)) if state.cost < reference.cost + SLACK]
        found = [problem.refine(state, rays) for state in near if not alike(state, reference)]
        better = min(found, key=lambda state: state.cost, default=best)
        others += found
        if better.cost >= best.cost - SIGNIFICANT:
            break
        others.append(best)
        solution = replace(solution, state=better)
    best = solution.state
    others = [state for state in others if not alike(state, best)]
    weights = np.array([math.exp(-0.5 * max(state.cost - best.cost, 0.0)) for state in others])
    more = (Alternative(s, weight / (1 + weights.sum())) for s, weight in zip(others, weights, strict=True))
    return solution.annotate(alternatives=(*solution.alternatives, *more))


# Open half sizes


def weigh_depths(solution: Solution) -> Solution:
    """The solution with all half sizes along the view that the image allows, where readings are rounded.

    The body stays, as it averages roundings out, unless the readings leave a size open: then it is the mean of all.
    """
    observation, best = solution.problem.observation, solution.state
    quantum = observation.noise.quantum
    if not (quantum > 0 and faces_camera(solution.rays.hits, quantum)):
        return solution
    rays = solution.rays.every(max(1, len(solution.rays.hits) // SAMPLE))
    problem = solution.problem.with_terms(dead_zone=_DEAD_ZONE * quantum / observation.sigma)
    walk = _walk(problem, rays, best, math.inf)
    if _weigh(walk)[1] < _CERTAIN:
        return solution
    own = next(each.state for each in walk if each.log_size == math.log(best.parameters[_view_axis(best)]))
    for rival in starts.other_orders(best):
        walk += _walk(problem, rays, rival, min(each.state.cost for each in walk))
    mean, deviation, weights = _weigh(walk)
    others = tuple(Alternative(each.state, float(weight)) for each, weight in zip(walk, weights, strict=True))
    least = min(each.state.cost for each in walk)
    if deviation > _OPEN or own.cost > least + _ALLOWED:
        likely = (each for each in walk if each.state.cost < least + _ALLOWED)
        best = _hold(problem, rays, min(likely, key=lambda each: abs(each.log_size - mean)).state, mean)
    return replace(solution, state=best).annotate(alternatives=others, spread_factor=_FACE_SPREAD**2)


def weigh_open_sizes(solution: Solution) -> Solution:
    """The solution, or a better one once half sizes that the image leaves open are left to priors and a prediction.

    Of a thing each competes with bodies of which that size is like the other two.
    """
    problem, state, rays, expected = solution.problem, solution.state, solution.rays, solution.problem.options.expected
    if problem.has_hull or (expected is None and problem.independent is None):
        return solution
    weak = [int(k) for k in np.flatnonzero(undetermined(solution.covariance, state.parameters[:3]))]
    if not weak:
        return solution
    rivals, notes = [state], solution.notes
    if problem.independent is not None:
        for k in weak:
            typical = float(np.exp(np.mean(np.log(np.delete(state.parameters[:3], k)))))
            rivals.append(resized(state, k, typical))
    if expected is not None:
        prior = expected() if callable(expected) else expected
        extents = prior.support(state.rotation.T)
        problem = problem.with_terms(expectation_stiffness=1 / _EXPECTATION_SIGMA, expected=extents)
        rivals += [resized(state, k, float(extents[k])) for k in weak]
        notes = (*notes, "half sizes weighed against a prediction")
    few = problem.draw(*_FEW)
    few = few.scale(rays.weight / few.weight)
    settled = by_cost(problem.descend(rival, few) for rival in rivals)
    return replace(solution, problem=problem, state=problem.refine(settled[0], rays), notes=notes)


def add_oval(solution: Solution) -> Solution:
    """The solution of a thing, with the body that the image prefers without regard to roundness as another one."""
    problem, rays = solution.problem, solution.rays
    free = problem.with_terms(roundness_stiffness=0.0)
    oval = replace(solution, problem=free, state=free.refine(solution.state, rays))
    dearer = problem.descend(oval.state, rays, 0).cost - problem.descend(solution.state, rays, 0).cost
    share = _OVAL / (_OVAL + (1 - _OVAL) * math.exp(0.5 * max(dearer, 0.0)))
    return solution.annotate(alternatives=(*solution.alternatives, Alternative(oval.state, share, oval.covariance)))


def faces_camera(hits: np.ndarray, quantum: float) -> bool:
    """Whether many rays (n, 7) read the same depth."""
    depth = hits[:, Ray.DEPTH]
    level = np.rint((depth - depth.min()) / quantum).astype(np.int64)
    return bool(np.bincount(level).max() > _FACE_SHARE * len(hits))


def _view_axis(state: State) -> int:
    """The axis of the body that is nearest to the camera's."""
    return int(np.argmax(np.abs(state.rotation[2])))


class _Held(NamedTuple):
    """A body of a given half size along the view, and the width of the sizes that it stands for."""

    log_size: float
    pace: float
    state: State


def _walk(problem: Problem, rays: Rays, start: State, least: float) -> list[_Held]:
    """Bodies of one size after another, from a start up and down, until the readings forbid to go on.

    ``least`` is the least cost of any body so far.
    """
    first = math.log(start.parameters[_view_axis(start)])
    found = {first: _hold(problem, rays, start, first)}
    least = min(least, found[first].cost)
    for direction in (1, -1):
        state, log_size, unlikely = found[first], first, 0
        for pace in _PACES:
            log_size += direction * math.log(pace)
            state = found[log_size] = _hold(problem, rays, state, log_size)
            least = min(least, state.cost)
            unlikely = unlikely + 1 if state.cost > least + _UNLIKELY else 0
            if unlikely == 2 and least < _ALLOWED:
                break
    sizes = sorted(found)
    return [_Held(size, pace, found[size]) for size, pace in zip(sizes, np.gradient(sizes), strict=True)]


def _hold(problem: Problem, rays: Rays, start: State, log_size: float) -> State:
    axis = _view_axis(start)
    size = min(max(math.exp(log_size), problem.limits[0][axis]), problem.limits[1][axis])
    return problem.descend(resized(start, axis, size), rays, held=axis)


def _weigh(walk: list[_Held]) -> tuple[float, float, np.ndarray]:
    """Mean and standard deviation of the log size, uniform before the image, and the weights (n,) of the bodies."""
    sizes, paces, cost = np.array([(each.log_size, each.pace, each.state.cost) for each in walk]).T
    weights = np.exp(-0.5 * (cost - cost.min())) * paces
    weights /= weights.sum()
    mean = weights @ sizes
    return float(mean), math.sqrt(weights @ (sizes - mean) ** 2), weights


def lengthen_open_ends(solution: Solution) -> Solution:
    """The solution, with longer bodies as alternatives where the image's border hides how long it is."""
    problem, state = solution.problem, solution.state
    ends = list(_hidden_ends(problem.observation, state))
    if not ends:
        return solution
    problem = problem.with_terms(hull_directions=problem.terms.hull_directions[:0])
    rays = solution.rays.every(max(1, len(solution.rays.hits) // SAMPLE))
    most = problem.descend(state, rays, 0).cost + _NO_EVIDENCE
    found = []
    for axis, sign in ends:
        for factor in _LONGER:
            longer = min(factor * state.parameters[axis], problem.limits[1][axis])
            other = problem.descend(resized(state, axis, longer, sign), rays, held=axis)
            if other.cost < most:
                found.append(other)
        if problem.late:
            break
    others = tuple(Alternative(other, 1 / (1 + len(found))) for other in found)
    return solution.annotate(alternatives=(*solution.alternatives, *others))


def _hidden_ends(observation: Observation, state: State) -> Iterator[tuple[int, float]]:
    """Axis and sign of each end of a body beyond all readings, on a side where readings end within the object.

    They end at the image's border, or at a band without readings along it: of a rectified image, of a stereo camera.
    """
    known, mask, camera = np.isfinite(observation.depth), observation.mask, observation.camera
    known.flat[observation.free] = True  # some are known to be empty without a reading
    left, top, width, height = regions.box(known)
    right, bottom = left + width - 1, top + height - 1
    cut = np.array([mask[:, left].any(), mask[top].any(), mask[:, right].any(), mask[bottom].any()])
    for axis, sign in itertools.product(range(3), (1.0, -1.0)) if cut.any() else ():
        u, v = camera.project(state.parameters[5:8] + sign * state.parameters[axis] * state.rotation[:, axis])
        if (cut & [u < left, v < top, u > right, v > bottom]).any():
            yield axis, sign
