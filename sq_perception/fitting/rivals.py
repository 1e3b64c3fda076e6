"""Other bodies that might explain the same image: where a search goes on looking once it has found one.

Seen from one side, a body's own axes and the face it shows are mostly certain, while the order of its axes and the half
size that runs away from the camera are not: the cost has a valley for each.  A rival starts in another valley.
"""

from __future__ import annotations

import math

import numpy as np

from sq_perception.fitting import starts
from sq_perception.fitting.levenberg_marquardt import State

SIGNIFICANT = 0.5
"""A difference of costs, by which one body is exp(0.25) = 1.3 times as likely as the other; smaller ones are ties."""
_ALIKE = 0.01
"""Half sizes that differ by less than this share are the same."""


def alike(state: State, other: State) -> bool:
    """Whether two searches ended in the same valley: at about the same cost and sizes, in any of a body's forms."""
    if abs(state.cost - other.cost) > SIGNIFICANT:
        return False
    sizes = np.abs(np.sort(state.parameters[:3]) - np.sort(other.parameters[:3]))
    return bool((sizes < _ALIKE * np.sort(state.parameters[:3])).all())


def other_depths(state: State, axis: int) -> list[State]:
    """The body with half of its half size along an axis, with more of it, and turned."""
    size = state.parameters[axis]
    return [resized(state, axis, 0.5 * size), resized(state, axis, 1.4 * size), _turned(state)]


def _turned(state: State) -> State:
    """The body turned by 45 degrees about its z: a square cross-section and a round one are hard to distinguish."""
    parameters = state.parameters.copy()
    parameters[:2] = math.sqrt(0.5 * (parameters[0] ** 2 + parameters[1] ** 2))
    parameters[4] = starts.START_EXPONENT
    turned = starts.eighth_turns(state.rotation)[2]
    return State(parameters, np.ascontiguousarray(turned), math.inf, state.iterations)


def other_orders(state: State) -> list[State]:
    """Bodies of the same box with each of its other axes as z."""
    found = []
    for order in starts.three_orders(np.eye(3))[:2]:
        parameters = state.parameters.copy()
        parameters[:3] = order.T @ parameters[:3]
        parameters[3:5] = starts.START_EXPONENT
        found.append(State(parameters, np.ascontiguousarray(state.rotation @ order), math.inf, state.iterations))
    return found


def other_axes(state: State) -> list[State]:
    """Bodies of the same moments with each axis as z, and turned by 45 degrees about each axis."""
    moments = state.rotation @ np.diag(state.parameters[:3] ** 2 * starts.MOMENT_SHARE) @ state.rotation.T
    found: list[State] = []
    for axes in [state.rotation, *starts.eighth_turns(state.rotation)]:
        found += starts.states(state.parameters[5:8], moments, axes)
    return found


def resized(state: State, axis: int, size: float) -> State:
    """The body with another half size along one of its axes; the face towards the camera stays in place."""
    parameters = state.parameters.copy()
    direction = state.rotation[:, axis]
    away = 1.0 if direction @ parameters[5:8] > 0 else -1.0
    parameters[5:8] += away * (size - parameters[axis]) * direction
    parameters[axis] = size
    return State(parameters, state.rotation, math.inf, state.iterations)
