"""What rounded readings leave open: the half size behind a face that looks at the camera.

A sharp body seen face-on shows its depth only in the last pixels before its outline.  Where readings are whole steps
q of depth with little noise, all those of the face err alike, by up to q / 2, and least squares takes that error for
news of the outline.  What is certain is that the true body passes every reading at no more than q / 2.  So the half
size along the view is held at one value after another, the rest is fitted with residuals that count only beyond q / 2
(a dead zone), and each value has the weight exp(-cost / 2).  Their mean is the estimate, their spread the standard
deviation.

Reference for the bounded-error view: M. Milanese, A. Vicino, Optimal estimation theory for dynamic systems with set
membership uncertainty, Automatica 27(6), 1991.
"""

from __future__ import annotations

import math

import numpy as np

from sq_perception.fitting.covariance import Alternative
from sq_perception.fitting.levenberg_marquardt import State, minimize
from sq_perception.fitting.residuals import RENDERED
from sq_perception.fitting.rivals import resized
from sq_perception.fitting.scene import Scene

_FACE_SHARE = 0.04
"""A depth that this share of all rays has in common is that of a face."""
_DEAD_ZONE = math.sqrt(3.0) * 1.01
"""Half a step in standard deviations q / sqrt(12) of its noise, and a little for single precision."""
_RAYS, _STEPS, _TOLERANCE = 1000, 12, 1e-3
_VALUES = np.exp(np.linspace(math.log(0.2), math.log(3.2), 13))
"""Of the half size, in geometric means of the other two."""
_NEIGHBOURS, _UNLIKELY = (0.8, 1.25), 12.0
"""If both of these shares of the half size cost so much more, there is no need to look further."""
_CERTAIN = 0.9
"""With so much weight on one value, the readings leave nothing open."""


def faces_camera(rays: np.ndarray, quantum: float) -> bool:
    """Whether many rays (n, 8) read the same depth."""
    level = np.rint((rays[:, 4] - rays[:, 4].min()) / quantum).astype(np.int64)
    return bool(np.bincount(level).max() > _FACE_SHARE * len(rays))


def plausible(
    best: State, rays: np.ndarray, free: np.ndarray, scene: Scene, limits: tuple[np.ndarray, np.ndarray]
) -> tuple[State, list[Alternative]]:
    """The mean of the bodies that the rounded readings allow, and these; the given body if they allow no other."""
    axis = int(np.argmax(np.abs(best.rotation[2])))
    stride = max(1, len(rays) // _RAYS)
    rays, free = rays[::stride].copy(), free[::stride].copy()
    scene = scene._replace(dead_zone=_DEAD_ZONE)

    def held(start: State, size: float) -> State:
        lower, upper = limits[0].copy(), limits[1].copy()
        size = min(max(size, lower[axis]), upper[axis])
        lower[axis] = upper[axis] = size
        return minimize(RENDERED, rays, free, scene, resized(start, axis, size), (lower, upper), _STEPS, _TOLERANCE)

    typical = math.exp(float(np.mean(np.log(np.delete(best.parameters[:3], axis)))))
    values = typical * _VALUES
    nearest = int(np.argmin(np.abs(np.log(values / best.parameters[axis]))))
    here = held(best, best.parameters[axis])
    if all(held(best, share * best.parameters[axis]).cost > here.cost + _UNLIKELY for share in _NEIGHBOURS):
        return best, []
    states: dict[int, State] = {}
    # Each value starts from its neighbour's body, outwards from the one at hand.
    for values_in_turn in (range(nearest, len(values)), range(nearest - 1, -1, -1)):
        state = states.get(nearest, best)
        for k in values_in_turn:
            state = states[k] = held(state, values[k])
    least = min(state.cost for state in states.values())
    weights = np.array([math.exp(-0.5 * (states[k].cost - least)) for k in range(len(values))])
    weights /= weights.sum()
    if weights.max() > _CERTAIN:
        return best, []
    mean = math.exp(float(weights @ np.log(values)))
    middle = held(states[int(np.argmin(np.abs(np.log(values / mean))))], mean)
    return middle, [Alternative(states[k], float(weights[k])) for k in range(len(values))]
