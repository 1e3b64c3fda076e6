"""Bodies of revolution: the simpler family that many things of a household belong to, tried where a side is unseen.

A can, a bottle, a bowl or a fruit shows half of its mantle.  Fitted as any superquadric, its depth stays open; as a
body of revolution, a1 = a2 and e2 = 1, the half that is seen determines the other one.  The family has 3 parameters
less: one half size, one exponent, and the turn about z.  By the Bayesian information criterion (G. Schwarz, Annals of
Statistics 6(2), 1978), and as more things are round than of any one oval shape, it is the better description if

    D(cost(round)) < D(cost(free)) + 3 log W + 2 log ODDS,    D(c) = c for c <= W,  W + W log(c / W) above,

W the total weight of the object's rays, the number of independent residuals that the cost stands for.  D is twice the
negative log likelihood with variance max(1, c / W): where no superquadric explains a bottle with its neck, the rest is
no reason to prefer the body that happens to leave less.

Both bodies stay, with weights exp(-difference / 2), and what they disagree about widens the covariance.  But where the
round one is chosen the weight of the free one leaves 3 log W out: that is the price of parameters that the image
determines, and a depth that it leaves open is as broad after the image as before.  How open it is, the covariance of
the free one, joins as well.  Of 339 things of benchmarks/household_things (scenes from 87000 on, plane given) 17 % had
a half size that erred by more than three deviations with the price and without that covariance, now 9 %.

Metres, optical frame; costs are those of :mod:`sq_perception.fitting.residuals`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sq_perception.fitting.covariance import Alternative
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.observation import span
from sq_perception.fitting.problem import (
    BASIN_RAYS,
    Solution,
    by_cost,
)
from sq_perception.fitting.rivals import resized
from sq_perception.fitting.starts import ORDERS, standing_axes
from sq_perception.geometry import rotation as quaternions

SPARED = 3
"""Number of parameters that a body of revolution has less than any superquadric."""
ODDS = 3.0
"""How many times more of the things whose unseen side is in question are round than have any one oval shape."""
SIGMA = 0.01
"""Standard deviation of log(a1 / a2) and of 1 - e2: how exactly round."""
_FINALISTS = 2
"""Round bodies that go on from the few steps on few rays."""
_START_EXPONENT = 0.4
"""Exponent e1 of a start: between a can's and a fruit's."""


def weighed(solution: Solution) -> Solution:
    """The solution, replaced by a body of revolution where that describes the image better."""
    problem, free, rays = solution.problem, solution.state, solution.rays
    round_ = problem.with_terms(roundness_stiffness=1 / SIGMA)
    starts = from_body(free)
    if problem.options.plane is not None:
        starts += on_plane(problem.observation.points, problem.options.plane)
    promising = by_cost(round_.coarse(starts))[:_FINALISTS]
    few = problem.draw(BASIN_RAYS, 0.7)
    settled = by_cost(round_.settle(state, few) for state in promising)
    best = round_.refined_best(settled, rays)
    better = gain(free.cost, best.cost, rays.weight)
    is_round = better > 0
    odds = math.exp(0.5 * (price(rays.weight) - better if is_round else better))
    share = odds / (1 + odds)
    other = Alternative(free, share, solution.covariance) if is_round else Alternative(best, share)
    solution = replace(solution, alternatives=(*solution.alternatives, other))
    if not is_round:
        return solution
    notes = (*solution.notes, "taken for a body of revolution")
    return replace(solution, problem=round_, state=best, notes=notes)


def gain(free_cost: float, round_cost: float, weight: float) -> float:
    """How much better a body of revolution describes rays of a total weight than a free body; see the module."""
    simpler = price(weight) + 2 * math.log(ODDS)
    return _deviance(free_cost, weight) - _deviance(round_cost, weight) + simpler


def price(weight: float) -> float:
    """What the criterion asks of a free body for its further parameters, on rays of a total weight."""
    return SPARED * math.log(max(weight, 1.0))


def _deviance(cost: float, weight: float) -> float:
    return cost if cost <= weight else weight * (1.0 + math.log(cost / weight))


def from_body(state: State) -> list[State]:
    """Round bodies about each axis of a body; of the two half sizes across, the one across the line of sight holds."""
    found = []
    sight = state.parameters[5:8] / np.linalg.norm(state.parameters[5:8])
    for order in ORDERS:
        rotation = np.ascontiguousarray(state.rotation[:, order])
        parameters = state.parameters.copy()
        parameters[:3] = parameters[order]
        parameters[3] = state.parameters[3] if order[2] == 2 else _START_EXPONENT
        parameters[4] = 1.0
        turned = State(parameters, rotation, math.inf, state.iterations)
        hidden = int(np.argmax(np.abs(sight @ rotation[:, :2])))
        found.append(resized(turned, hidden, float(parameters[1 - hidden])))
    return found


def on_plane(points: np.ndarray, plane: np.ndarray) -> list[State]:
    """Round bodies that stand on a plane, or lie on it along either side of the footprint's smallest rectangle.

    A standing one is as thick as it is wide across the view, a lying one as it is high.  Both begin where the points
    are nearest.
    """
    axes = standing_axes(points, plane[:3])
    normal = axes[:, 2]
    middle = points.mean(axis=0)
    ahead = middle - (middle @ normal) * normal
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    side = quaternions.cross(normal, ahead)
    directions = np.stack([normal, side, ahead, axes[:, 0], axes[:, 1]])
    spans = span(points, directions)
    ground = -float(plane[3])
    high = max(float(spans[0, 1]) - ground, 1e-4)
    found = [_round(normal, (ground, ground + high), side, spans[1], ahead, spans[2, 0])]
    for k in (0, 1):
        along, across, nearest = axes[:, k], axes[:, 1 - k], spans[4 - k, 0]
        if across @ ahead < 0:
            across, nearest = -across, -spans[4 - k, 1]
        found.append(_round(along, spans[3 + k], normal, (ground, ground + high), across, nearest))
    return found


def _round(
    axis: np.ndarray,
    along: Sequence[float] | np.ndarray,
    side: np.ndarray,
    across: Sequence[float] | np.ndarray,
    away: np.ndarray,
    nearest: float,
) -> State:
    """A round body that spans ``along`` the axis and ``across`` along ``side``, and begins at ``nearest`` ``away``."""
    radius = max(float(0.5 * (across[1] - across[0])), 1e-4)
    half = max(float(0.5 * (along[1] - along[0])), 1e-4)
    centre = 0.5 * (along[0] + along[1]) * axis + 0.5 * (across[0] + across[1]) * side + (nearest + radius) * away
    rotation = np.ascontiguousarray(np.stack([side, quaternions.cross(axis, side), axis], axis=1))
    parameters = np.concatenate([[radius, radius, half, _START_EXPONENT, 1.0], centre, [0.0, 0.0]])
    return State(parameters, rotation, math.inf, 0)
