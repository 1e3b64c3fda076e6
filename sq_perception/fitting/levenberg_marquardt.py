"""Levenberg-Marquardt on the residuals of :mod:`sq_perception.fitting.residuals`, compiled.

A step solves (J^T J + lambda diag(J^T J) + mu) s = -J^T r.  Marquardt's scaling makes it independent of units; mu is a
little absolute damping, so that what the data leave open (the turn of a round body, a hidden size) stays where it is.
Entries of the step are clipped: the residuals are only locally linear.  A parameter that sits on its bound and wants to
leave is held for that step.  Only steps that lower the cost are taken, so the cost never rises.

Reference: K. Madsen, H. B. Nielsen, O. Tingleff, Methods for Non-Linear Least Squares Problems, 2004, section 3.2.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sq_perception.fitting.cost import PARAMETERS, STEP_LENGTH, Ray, Terms
from sq_perception.fitting.residuals import evaluate
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.kernels import inline_kernel, kernel
from sq_perception.geometry.superquadric import Superquadric

_LONGEST_LOG_SIZE, _LONGEST_SHAPE, _LONGEST_TURN = 0.5, 0.3, 0.5
"""Largest changes in one step: beyond, residuals are no longer linear.  A shift is limited to the largest half size."""
_WORSE, _BETTER = 7.0, 0.12
"""Factors of the damping after a step that was refused and one that was taken."""
_LEAST_COST = 1e-12
"""Least cost that a gain is taken as a share of: a body that leaves nothing at all has no gain to go on for."""


class State(NamedTuple):
    """A body inside the optimiser.

    ``parameters`` (10,): a1 a2 a3 e1 e2 t1 t2 t3 k_x k_y, ``rotation`` (3, 3) object to optical frame, ``cost`` there,
    ``iterations`` spent so far.
    """

    parameters: np.ndarray
    rotation: np.ndarray
    cost: float
    iterations: int

    @classmethod
    def of(cls, body: Superquadric) -> State:
        """The state of a single body, its cost unknown."""
        parameters = np.concatenate([body.size, body.shape, body.translation, body.taper]).astype(float)
        return cls(parameters, np.ascontiguousarray(body.rotation_matrix, dtype=float), math.inf, 0)

    @property
    def body(self) -> Superquadric:
        """The body, in whichever of its forms the optimiser reached."""
        p = self.parameters
        return Superquadric(p[0:3], p[3:5], p[5:8], quaternions.from_matrix(self.rotation), p[8:10])


@kernel
def minimize(
    stage: int, rays: np.ndarray, free: np.ndarray, terms: Terms, start: State, limits: tuple[np.ndarray, np.ndarray],
    max_iterations: int, tolerance: float,
) -> State:
    """The best body found from ``start`` in at most ``max_iterations`` steps.

    Stops when a step lowers the cost, or promises to, by less than ``tolerance`` of it, or when none lowers it.
    """
    lower, upper = limits
    parameters = np.minimum(np.maximum(start.parameters, lower), upper)
    rotation = start.rotation.copy()
    sums = np.zeros((STEP_LENGTH + 1, STEP_LENGTH + 1))
    next_sums = np.zeros((STEP_LENGTH + 1, STEP_LENGTH + 1))
    factor = np.zeros((STEP_LENGTH, STEP_LENGTH))
    step = np.zeros(STEP_LENGTH)
    held = np.zeros(STEP_LENGTH, dtype=np.bool_)
    next_parameters = parameters.copy()
    next_rotation = rotation.copy()
    met = rays[:, Ray.DEPTH].copy()
    cost = evaluate(stage, rays, free, terms, parameters, rotation, met, sums)
    damping = 1e-3  # tau of Madsen et al. for starts that are believed to be good
    iterations = 0
    while iterations < max_iterations:
        iterations += 1
        hold(parameters, lower, upper, sums[STEP_LENGTH], held)
        accepted = False
        for _ in range(6):  # in which damping grows 10^5 fold
            if solve_damped(sums, damping, held, factor, step):
                if _promised(sums, step) <= tolerance * max(abs(cost), _LEAST_COST):
                    break
                move(parameters, rotation, step, lower, upper, next_parameters, next_rotation)
                next_cost = evaluate(stage, rays, free, terms, next_parameters, next_rotation, met, next_sums)
                if next_cost < cost:
                    accepted = True
                    break
            damping = max(damping * _WORSE, 1e-6)
        if not accepted:
            break
        gain = cost - next_cost
        cost = next_cost
        parameters, next_parameters = next_parameters, parameters
        rotation, next_rotation = next_rotation, rotation
        sums, next_sums = next_sums, sums
        damping = max(damping * _BETTER, 1e-9)
        if gain <= tolerance * max(abs(cost), _LEAST_COST):
            break
    return State(parameters, rotation, cost, start.iterations + iterations)


@inline_kernel
def _promised(sums: np.ndarray, step: np.ndarray) -> float:
    """-g^T s, half of the slope: a step of little damping lowers the linear model's cost by this, others by more."""
    total = 0.0
    for k in range(STEP_LENGTH):
        total -= sums[STEP_LENGTH, k] * step[k]
    return total


@kernel
def hold(parameters: np.ndarray, lower: np.ndarray, upper: np.ndarray, gradient: np.ndarray, held: np.ndarray) -> None:
    """Mark the parameters that sit on a bound and would be pushed beyond it."""
    for k in range(PARAMETERS):
        entry = k if k < 8 else k + 3
        slack = 1e-12 * max(abs(lower[k]), abs(upper[k]))
        at_lower = parameters[k] <= lower[k] + slack and gradient[entry] > 0.0
        at_upper = parameters[k] >= upper[k] - slack and gradient[entry] < 0.0
        held[entry] = at_lower or at_upper or lower[k] == upper[k]


@kernel
def solve_damped(sums: np.ndarray, damping: float, held: np.ndarray, factor: np.ndarray, step: np.ndarray) -> bool:
    """Cholesky solution of the damped normal equations, laid out as by ``evaluate``; False if they are not positive."""
    largest = 0.0
    for k in range(STEP_LENGTH):
        largest = largest if held[k] else max(largest, sums[k, k])
    if not largest > 0.0:
        return False
    for i in range(STEP_LENGTH):
        for j in range(i + 1):
            entry = sums[i, j]
            if i == j:
                absolute = 1e-3 if i < 5 or i > 7 else 1e-12 * largest
                entry = entry * (1.0 + damping) + absolute
            if held[i] or held[j]:
                entry = 1.0 if i == j else 0.0
            for k in range(j):
                entry -= factor[i, k] * factor[j, k]
            if i == j:
                if not entry > 1e-300:
                    return False
                factor[i, i] = math.sqrt(entry)
            else:
                factor[i, j] = entry / factor[j, j]
    for i in range(STEP_LENGTH):
        entry = 0.0 if held[i] else -sums[STEP_LENGTH, i]
        for k in range(i):
            entry -= factor[i, k] * step[k]
        step[i] = entry / factor[i, i]
    for i in range(STEP_LENGTH - 1, -1, -1):
        entry = step[i]
        for k in range(i + 1, STEP_LENGTH):
            entry -= factor[k, i] * step[k]
        step[i] = entry / factor[i, i]
    return True


@kernel
def move(
    parameters: np.ndarray, rotation: np.ndarray, step: np.ndarray, lower: np.ndarray, upper: np.ndarray,
    next_parameters: np.ndarray, next_rotation: np.ndarray,
) -> None:
    """Apply a clipped step: sizes multiply, shape, centre and taper add, the rotation turns about its own axes."""
    largest_size = max(parameters[0], parameters[1], parameters[2])
    for k in range(PARAMETERS):
        if k < 3:
            value = parameters[k] * math.exp(min(max(step[k], -_LONGEST_LOG_SIZE), _LONGEST_LOG_SIZE))
        elif k < 5 or k >= 8:
            along = step[k] if k < 5 else step[k + 3]
            value = parameters[k] + min(max(along, -_LONGEST_SHAPE), _LONGEST_SHAPE)
        else:
            value = parameters[k] + min(max(step[k], -largest_size), largest_size)
        next_parameters[k] = min(max(value, lower[k]), upper[k])
    x, y, z = step[8], step[9], step[10]
    angle = math.sqrt(x * x + y * y + z * z)
    shrink = 1.0
    if angle > _LONGEST_TURN:
        shrink = _LONGEST_TURN / angle
        angle = _LONGEST_TURN
    # R exp([w]) by Rodrigues: exp([w]) = I + s [w] + c [w]^2
    s, c = 1.0, 0.5
    if angle > 1e-8:
        s, c = math.sin(angle) / angle, (1.0 - math.cos(angle)) / (angle * angle)
    x, y, z = x * shrink, y * shrink, z * shrink
    for i in range(3):
        r1, r2, r3 = rotation[i, 0], rotation[i, 1], rotation[i, 2]
        # rows times [w] and [w]^2
        a1, a2, a3 = r2 * z - r3 * y, r3 * x - r1 * z, r1 * y - r2 * x
        b1, b2, b3 = a2 * z - a3 * y, a3 * x - a1 * z, a1 * y - a2 * x
        next_rotation[i, 0] = r1 + s * a1 + c * b1
        next_rotation[i, 1] = r2 + s * a2 + c * b2
        next_rotation[i, 2] = r3 + s * a3 + c * b3
