"""Where a search begins when nobody says where: the first starts, and all that there are."""

from __future__ import annotations

import math

import numpy as np

from sq_perception.fitting import box_start, symmetry_start
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.observation import Observation

_EXPONENTS = (0.3, 0.8)
"""Of the last starts of all: between box and ellipsoid, nearer to either."""


def symmetric(observation: Observation) -> list[State]:
    """Starts from central symmetry; the points' box where nothing shows the symmetry."""
    completed = symmetry_start.completed_moments(observation)
    if completed is None:
        return box_start.principal(observation.points)
    centre, moments = completed
    return symmetry_start.states(centre, moments, symmetry_start.principal_axes(moments))


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
