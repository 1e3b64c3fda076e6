"""Superquadrics and points: a mixture of surfaces and background, and the step that lowers its cost; compiled.

Model.  A point p comes with probability 1 - w from the surface of a body, spread evenly over its area A, displaced by
normal noise of standard deviation s, or with probability w from anywhere in the volume V of the cloud's box:

    P(p) = (1 - w) / A  N(d(p); 0, s^2)  +  w / V,        d = (g - 1) / |grad g|

with the gauge g and the first-order (Sampson) distance d.  Expectation-maximisation (Liu et al., Robust and Accurate
Superquadric Recovery: a Probabilistic Approach, CVPR 2022): the probability r that each point belongs to the body, then
w and s from r, then a step of weighted least squares on d / s.  Several bodies share the points: each takes those that
are nearest to it, softly.

A probe is a point known to lie outside, or inside, of the object: d is then held at 0 or above, or at 0 or below.

A body is a vector (10,): a1 a2 a3 e1 e2 t1 t2 t3 k1 k2, and a rotation (3, 3), object to parent.  A step has 13
entries: log sizes, exponents, centre, rotation vector in the object frame, tapers.  Lengths are in units of the cloud,
about 1.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np

from sq_perception.fitting.levenberg_marquardt import STEP_LENGTH, hold, move, solve_damped
from sq_perception.geometry.kernels import gauge_derivatives, in_object_frame, inline_kernel, kernel

Body: TypeAlias = tuple[float, float, float, float, float, float, float, float, float, float]
BODY_LENGTH = 10
_LANES = 64
_TINY = 1e-12
"""Added to a squared gradient to keep divisions by it finite."""
_ATTEMPTS = 5
"""Refused steps in a row, damping growing 10^4 fold, before the search ends."""


class Prior(NamedTuple):
    """What is believed of a body before its points.

    ``lower`` and ``upper`` bound the body (10,).  ``taper`` is the precision of both tapers about 0, ``volume`` the
    price of the logarithm of each half size: the smaller of two bodies through the same points is preferred.
    """

    lower: np.ndarray
    upper: np.ndarray
    taper: float
    volume: float


@inline_kernel
def _numbers(body: np.ndarray) -> Body:
    return body[0], body[1], body[2], body[3], body[4], body[5], body[6], body[7], body[8], body[9]


@inline_kernel
def _first_order(x: float, y: float, z: float, body: Body) -> tuple[float, float, float, float]:
    """Sampson distance of a point of the object's frame, and the unit gradient of the gauge."""
    a1, a2, a3, e1, e2, _, _, _, k1, k2 = body
    g, gx, gy, gz, _, _, _, _ = gauge_derivatives(x, y, z, a1, a2, a3, e1, e2, k1, k2)
    scale = 1.0 / math.sqrt(gx * gx + gy * gy + gz * gz + _TINY)
    return (g - 1.0) * scale, gx * scale, gy * scale, gz * scale


@inline_kernel
def _local(points: np.ndarray, first: int, body: Body, m: np.ndarray, local: np.ndarray) -> int:
    """Write up to 64 points from ``first`` in the object's frame, the last one again where there are fewer."""
    count = min(_LANES, points.shape[0] - first)
    for i in range(_LANES):
        at = first + min(i, count - 1)
        x, y, z = points[at, 0] - body[5], points[at, 1] - body[6], points[at, 2] - body[7]
        local[0, i], local[1, i], local[2, i] = in_object_frame(m, x, y, z)
    return count


@kernel
def distances(points: np.ndarray, body: np.ndarray, m: np.ndarray) -> np.ndarray:
    """Sampson distance (n,) of points (n, 3) to a body, positive outside."""
    numbers = _numbers(body)
    local, out = np.empty((3, _LANES)), np.empty(points.shape[0])
    d = np.empty(_LANES)
    for first in range(0, points.shape[0], _LANES):
        count = _local(points, first, numbers, m, local)
        for i in range(_LANES):
            d[i], _, _, _ = _first_order(local[0, i], local[1, i], local[2, i], numbers)
        out[first : first + count] = d[:count]
    return out


@kernel
def _rows(points: np.ndarray, first: int, body: np.ndarray, m: np.ndarray, rows: np.ndarray) -> int:
    """Write d and its derivatives by a step for up to 64 points from ``first``: rows (14, 64).

    A distance changes with the body as the surface does at the point's foot: derivatives are taken there.
    """
    numbers = _numbers(body)
    a1, a2, a3, e1, e2, _, _, _, k1, k2 = numbers
    m11, m12, m13 = m[0]
    m21, m22, m23 = m[1]
    m31, m32, m33 = m[2]
    count = _local(points, first, numbers, m, rows)
    for i in range(_LANES):
        x, y, z = rows[0, i], rows[1, i], rows[2, i]
        d, nx, ny, nz = _first_order(x, y, z, numbers)
        rows[0, i], rows[1, i], rows[2, i] = x - d * nx, y - d * ny, z - d * nz
        rows[13, i] = d
    for i in range(_LANES):
        x, y, z = rows[0, i], rows[1, i], rows[2, i]
        _, gx, gy, gz, g_e1, g_e2, g_k1, g_k2 = gauge_derivatives(x, y, z, a1, a2, a3, e1, e2, k1, k2)
        scale = 1.0 / math.sqrt(gx * gx + gy * gy + gz * gz + _TINY)
        gx, gy, gz = gx * scale, gy * scale, gz * scale
        rows[0, i], rows[1, i], rows[2, i] = -x * gx, -y * gy, -z * gz
        rows[3, i], rows[4, i], rows[11, i], rows[12, i] = g_e1 * scale, g_e2 * scale, g_k1 * scale, g_k2 * scale
        rows[5, i] = -(m11 * gx + m12 * gy + m13 * gz)
        rows[6, i] = -(m21 * gx + m22 * gy + m23 * gz)
        rows[7, i] = -(m31 * gx + m32 * gy + m33 * gz)
        rows[8, i], rows[9, i], rows[10, i] = gy * z - gz * y, gz * x - gx * z, gx * y - gy * x
    return count


@kernel
def normal_equations(
    points: np.ndarray, offsets: np.ndarray, sides: np.ndarray, weights: np.ndarray, body: np.ndarray, m: np.ndarray,
    prior: Prior, sums: np.ndarray,
) -> float:
    """Sum of weights times squared residuals and prior; fills ``sums`` (14, 14): J^T J, and J^T r in the last row.

    ``sides``: 0 for points of the surface, 1 and -1 for probes outside and inside.
    """
    sums[:] = 0.0
    rows, roots = np.empty((STEP_LENGTH + 1, _LANES)), np.empty(_LANES)
    cost = 0.0
    for first in range(0, points.shape[0], _LANES):
        count = _rows(points, first, body, m, rows)
        roots[:] = 0.0
        for i in range(count):
            rows[STEP_LENGTH, i] -= offsets[first + i]
            roots[i] = 0.0 if sides[first + i] * rows[STEP_LENGTH, i] > 0.0 else math.sqrt(weights[first + i])
        for k in range(STEP_LENGTH + 1):
            for i in range(_LANES):
                rows[k, i] *= roots[i]
        for i in range(_LANES):
            cost += rows[STEP_LENGTH, i] * rows[STEP_LENGTH, i]
        for k in range(0, STEP_LENGTH + 1, 2):
            for j in range(0, k + 2, 2):
                total, right, below, across = 0.0, 0.0, 0.0, 0.0
                for i in range(_LANES):
                    total += rows[k, i] * rows[j, i]
                    right += rows[k, i] * rows[j + 1, i]
                    below += rows[k + 1, i] * rows[j, i]
                    across += rows[k + 1, i] * rows[j + 1, i]
                sums[k, j] += total
                sums[k, j + 1] += right
                sums[k + 1, j] += below
                sums[k + 1, j + 1] += across
    for k in range(3):
        cost += 2.0 * prior.volume * math.log(body[k])
        sums[STEP_LENGTH, k] += prior.volume
    for k in range(2):
        cost += prior.taper * body[8 + k] ** 2
        sums[11 + k, 11 + k] += prior.taper
        sums[STEP_LENGTH, 11 + k] += prior.taper * body[8 + k]
    return cost


@kernel
def improve(
    points: np.ndarray, offsets: np.ndarray, sides: np.ndarray, weights: np.ndarray, body: np.ndarray, m: np.ndarray,
    prior: Prior, steps: int, tolerance: float,
) -> tuple[np.ndarray, np.ndarray, float]:
    """The body after up to so many Levenberg-Marquardt steps, its rotation, and the cost; it never rises."""
    sums = np.zeros((STEP_LENGTH + 1, STEP_LENGTH + 1))
    next_sums = np.zeros((STEP_LENGTH + 1, STEP_LENGTH + 1))
    factor = np.zeros((STEP_LENGTH, STEP_LENGTH))
    step = np.zeros(STEP_LENGTH)
    held = np.zeros(STEP_LENGTH, dtype=np.bool_)
    body, m, new, turned = body.copy(), m.copy(), body.copy(), m.copy()
    cost = normal_equations(points, offsets, sides, weights, body, m, prior, sums)
    damping = 1e-3
    for _ in range(steps):
        hold(body, prior.lower, prior.upper, sums[STEP_LENGTH], held)
        accepted = False
        for _ in range(_ATTEMPTS):
            if solve_damped(sums, damping, held, factor, step):
                move(body, m, step, prior.lower, prior.upper, new, turned)
                new_cost = normal_equations(points, offsets, sides, weights, new, turned, prior, next_sums)
                if new_cost < cost:
                    accepted = True
                    break
            damping *= 10.0
        if not accepted:
            break
        gain = cost - new_cost
        cost = new_cost
        body, new = new, body
        m, turned = turned, m
        sums, next_sums = next_sums, sums
        damping = max(0.1 * damping, 1e-9)
        if gain <= tolerance * abs(cost):
            break
    return body, m, cost


@kernel
def area(body: np.ndarray) -> float:
    """Area of the surface, of an ellipsoid by Thomsen's formula and of a box exactly, in between by the exponents."""
    a, b, c = body[0], body[1], body[2]
    p = 1.6075
    round_area = 4.0 * math.pi * (((a * b) ** p + (a * c) ** p + (b * c) ** p) / 3.0) ** (1.0 / p)
    box_area = 8.0 * (a * b + a * c + b * c)
    share = min(0.5 * (body[3] + body[4]), 1.0)
    return box_area + share * share * (round_area - box_area)


class Cloud(NamedTuple):
    """What bodies are fitted to, in units of the cloud.

    ``points`` (n, 3) lie on surfaces, or anywhere; ``probes`` (m, 3) are known to be outside (``sides`` 1) or inside
    (-1), as far as the point that each is derived from, of index ``owners`` (-1 for none), is of a surface.
    ``background`` is 1 / V, ``probe_weight`` the weight of a squared distance of a probe on the wrong side.
    """

    points: np.ndarray
    probes: np.ndarray
    sides: np.ndarray
    owners: np.ndarray
    background: float
    probe_weight: float


class Mixture(NamedTuple):
    """Bodies (k, 10) and their rotations (k, 3, 3), the noise, the share of the background, and the log-likelihood."""

    bodies: np.ndarray
    turns: np.ndarray
    sigma: float
    share: float
    likelihood: float


class Course(NamedTuple):
    """How to settle: what is given and not estimated, the least sigma, most rounds, and the gain a point to end at."""

    keep_sigma: bool
    keep_share: bool
    least_sigma: float
    rounds: int
    tolerance: float
    is_centred: bool


@kernel
def outward(points: np.ndarray, body: np.ndarray, m: np.ndarray, sigma: float) -> np.ndarray:
    """How far (n,) noise moves points of a convex surface outward on average.

    Each point is carried to the surface and displaced six ways, which makes the mean distance exact to the second order
    (S. Julier, J. Uhlmann 1997).
    """
    rows = np.empty((STEP_LENGTH + 1, _LANES))
    on_surface = np.empty_like(points)
    for first in range(0, points.shape[0], _LANES):
        for i in range(_rows(points, first, body, m, rows)):
            for k in range(3):
                on_surface[first + i, k] = points[first + i, k] + rows[STEP_LENGTH, i] * rows[5 + k, i]
    mean = np.zeros(points.shape[0])
    moved = on_surface.copy()
    for k in range(3):
        for step in (-math.sqrt(3.0) * sigma, math.sqrt(3.0) * sigma):
            moved[:, k] = on_surface[:, k] + step
            mean += distances(moved, body, m) / 6.0
        moved[:, k] = on_surface[:, k]
    return mean - distances(on_surface, body, m)


@kernel
def shares(cloud: Cloud, mixture: Mixture, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The probability (n, k) that each point belongs to each body, its distance (n, k), and its log-likelihood (n,)."""
    bodies, turns, sigma, share, _ = mixture
    n, count = cloud.points.shape[0], bodies.shape[0]
    distance, probability, likelihood = np.empty((n, count)), np.empty((n, count)), np.empty(n)
    whole = 0.0
    for k in range(count):
        distance[:, k] = distances(cloud.points, bodies[k], turns[k]) - offsets[:n, k]
        whole += area(bodies[k])
    inlying = (1.0 - share) / (whole * math.sqrt(2.0 * math.pi) * sigma)
    outlying = share * cloud.background + 1e-300
    for i in range(n):
        total = outlying
        for k in range(count):
            probability[i, k] = inlying * math.exp(-0.5 * min((distance[i, k] / sigma) ** 2, 1400.0))
            total += probability[i, k]
        for k in range(count):
            probability[i, k] /= total
        likelihood[i] = math.log(total)
    return probability, distance, likelihood


@kernel
def settle(cloud: Cloud, start: Mixture, prior: Prior, course: Course) -> Mixture:
    """Expectation-maximisation from a start."""
    bodies, turns, sigma, share, _ = start
    bodies, turns = bodies.copy(), turns.copy()
    n, m, count = cloud.points.shape[0], cloud.probes.shape[0], bodies.shape[0]
    together = np.concatenate((cloud.points, cloud.probes))
    sides, weights = np.zeros(n + m), np.zeros(n + m)
    sides[n:] = cloud.sides
    of_probe, offsets = np.empty((m, count)), np.zeros((n + m, count))
    likelihood = -np.inf
    for turn in range(course.rounds + 1):
        if course.is_centred and (turn < 3 or turn % 4 == 0):  # later it hardly changes
            for k in range(count):
                offsets[:n, k] = outward(cloud.points, bodies[k], turns[k], sigma)
        probability, distance, each = shares(cloud, Mixture(bodies, turns, sigma, share, 0.0), offsets)
        total = each.sum()
        for k in range(count):
            of_probe[:, k] = distances(cloud.probes, bodies[k], turns[k])
        for i in range(m):
            nearest = of_probe[i].min()
            holds = 1.0 if cloud.owners[i] < 0 else probability[cloud.owners[i]].sum()
            total -= 0.5 * holds * cloud.probe_weight * min(cloud.sides[i] * nearest, 0.0) ** 2
        gain = total - likelihood
        likelihood = total
        if turn == course.rounds or (turn > 2 and abs(gain) < course.tolerance * n):
            break
        kept = probability.sum()
        if not course.keep_share:
            share = min(max(1.0 - kept / n, 1e-3), 0.95)
        if not course.keep_sigma:
            square = (probability * distance * distance).sum()
            sigma = max(math.sqrt(square / max(kept - STEP_LENGTH * count, 0.25 * kept + 1e-9)), course.least_sigma)
        for k in range(count):
            for i in range(n):
                weights[i] = probability[i, k] / (sigma * sigma)
            for i in range(m):  # what is inside belongs to the nearest body, what is outside to none
                is_its = cloud.sides[i] > 0.0 or of_probe[i, k] <= of_probe[i].min()
                holds = 1.0 if cloud.owners[i] < 0 else probability[cloud.owners[i]].sum()
                weights[n + i] = holds * cloud.probe_weight if is_its else 0.0
            bodies[k], turns[k], _ = improve(
                together, offsets[:, k].copy(), sides, weights, bodies[k], turns[k], prior, 2, 1e-6
            )
    return Mixture(bodies, turns, sigma, share, likelihood)
