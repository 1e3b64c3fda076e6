"""Where a search begins without a given start: groups of starts, in the order in which to try them."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from sq_perception.fitting import box_start, symmetry_start
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.observation import Observation
from sq_perception.fitting.problem import COARSE_RAYS, Problem, coarse, least

_GATE = 3.6
"""Mean squared residual after the few steps from a start, above which the next group is tried; chosen on
benchmarks/single_body."""
_EXPONENTS = (0.3, 0.8)
"""Of the last starts of all: between box and ellipsoid, nearer to either."""


def automatic(problem: Problem) -> list[State]:
    """Where the starts of the first groups lead, as many as it takes to come near the noise."""
    found: list[State] = []
    for tier in symmetric(problem.observation):
        found += coarse(problem, tier)
        if least(found).cost < _GATE * problem.floor(COARSE_RAYS) or problem.late:
            break
    return found


def symmetric(observation: Observation) -> Iterator[list[State]]:
    """Groups of starts from central symmetry; the points' box where nothing shows the symmetry."""
    completed = symmetry_start.completed_moments(observation)
    if completed is None:
        yield box_start.principal(observation.points)
        return
    centre, moments = completed
    axes = symmetry_start.principal_axes(moments)
    for turned in [axes, *symmetry_start.eighth_turns(axes)]:
        yield symmetry_start.states(centre, moments, turned)


def everything(observation: Observation) -> list[State]:
    """All starts at once, for images on which the first ones failed."""
    found = box_start.principal(observation.points)
    completed = symmetry_start.completed_moments(observation)
    if completed is None:
        return found
    centre, moments = completed
    axes = symmetry_start.principal_axes(moments)
    deeper = centre + np.array([0.0, 0.0, 0.5 * math.sqrt(float(np.trace(moments)) / 3)])
    for middle in (centre, deeper):
        for exponent in _EXPONENTS:
            for turned in [axes, *symmetry_start.eighth_turns(axes), *symmetry_start.double_turns(axes)]:
                found += symmetry_start.states(middle, moments, turned, exponent)
    return found
