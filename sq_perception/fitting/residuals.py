"""The residuals of every fit, their derivatives, and the normal equations J^T J and J^T r, compiled.

Unknowns
--------
A body is ``parameters`` = (a1 a2 a3 e1 e2 t1 t2 t3 k_x k_y) and a matrix ``rotation`` R, object to optical frame.  A
step has 13 entries: d log a (3), d e (2), d t (3), a rotation vector w in the object frame, R <- R exp([w]), and d k
(2).  At a fixed
point p of the optical frame, with q = R^T (p - t) in the object frame, the gauge g(q) and its gradient g_q,

    dg/d log a_k = -q_k g_k,    dg/de, dg/dk from the kernel,    dg/dt = -R g_q,    dg/dw = g_q x q.

Residuals
---------
A pixel is a ray p = o + z d with o_z = 0 and d_z = 1; :mod:`sq_perception.fitting.cost` names the columns of its row.

classic     sqrt(a1 a2 a3) (g^2 - 1) / sigma at the measured point: Solina and Bajcsy's, as g^2 = F^e1.
Sampson     (g - 1) / (|grad g| sigma) at the measured point: first order distance; wide basin of attraction.
foot        the same of points without a camera, less the distance to expect, 0 on the right side of the surface; it
            changes with the body as the surface does at the point's foot, where the derivatives are taken.
rendered    (z_hit - z) c / sigma, where the ray meets the body at z_hit: the exact statement of a depth image.
            dz_hit = -dg / (grad g . d).  c = cos / sqrt(cos^2 + kappa), with cos the incidence, tames grazing rays.
covered     (min g - 1) / (|grad g| sigma_o) instead, where the ray of an object pixel misses the body; sigma_o is that
            of the outline.  A ray that misses even the bounding box counts by its Sampson distance.
free        (1 - min g) / (|grad g| sigma_o), where the smallest g on a free ray, up to its free depth z, is below 1.
            At a minimum the point may be held fixed (envelope theorem).

The scales |grad g| and c are held fixed in the derivatives, as residuals are small near the solution.  Image residuals
pass through Huber's loss.  The cost is the weighted sum of the losses, r^2 for small r, and of the priors
(:mod:`sq_perception.fitting.priors`).

Rays are processed in blocks (:mod:`sq_perception.fitting.intersection`).
"""

from __future__ import annotations

import math

import numpy as np

from sq_perception.fitting.cost import LANES, STEP_LENGTH, Ray, Terms, add_block, cauchy_loss, huber_loss
from sq_perception.fitting.intersection import (
    LOWEST_TOLERANCE,
    ROWS,
    Lane,
    enter,
    gauge_along,
    lowest,
    meet,
    padded,
    place,
)
from sq_perception.fitting.priors import prior_cost
from sq_perception.geometry.kernels import inline_kernel, kernel

CLASSIC, SAMPSON, RENDERED, FOOT = range(4)

_TINY = 1e-12
"""Number added to a squared gradient of the gauge, 1 / metres^2, to keep divisions by it finite."""


@kernel
def evaluate(
    stage: int, rays: np.ndarray, free: np.ndarray, terms: Terms, parameters: np.ndarray, rotation: np.ndarray,
    met: np.ndarray, sums: np.ndarray,
) -> float:
    """Cost at a body; fills ``sums`` (14, 14), lower triangle: J^T J in rows 0 to 12, J^T r in row 13.

    ``met`` (n,) are the depths where the rays met a body nearby, the measured ones at first: the RENDERED stage begins
    there to look for the intersection, and writes where it is.
    """
    sums[:] = 0.0
    block = np.empty((STEP_LENGTH + 1, LANES))
    lanes = np.empty((ROWS, LANES))
    again = np.empty((ROWS, LANES))
    missed = np.empty(LANES, np.bool_)
    cost = 0.0
    for begin in range(0, rays.shape[0], LANES):
        part = rays[begin : begin + LANES]
        before = met[begin : begin + LANES] if stage == RENDERED else met[:0]
        place(part, before, parameters, rotation, lanes)
        filled = padded(part.shape[0], lanes)
        if stage == RENDERED:
            meet(filled, terms.hit_tolerance, parameters, lanes, missed, again)
            cost += _rendered_rows(filled, before, terms, lanes, missed, block)
        else:
            if stage == FOOT:
                to_foot(filled, parameters, lanes)
            else:
                gauge_along(filled, parameters, lanes)
            cost += _measured_rows(filled, stage, terms, parameters, lanes, block)
        _differentiate(filled, rotation, lanes, block)
        if stage == CLASSIC:
            # The volume factor's own derivative by log a_k is half the residual.
            for k in range(3):
                for i in range(filled):
                    block[k, i] += 0.5 * block[STEP_LENGTH, i]
        add_block(block, filled, sums)
    filled = 0
    for i in range(free.shape[0]):
        filled += enter(free[i], terms, parameters, rotation, filled, lanes)
        if filled == LANES:
            cost += _free_rows(filled, terms, parameters, rotation, lanes, missed, block, sums)
            filled = 0
    if filled > 0:
        cost += _free_rows(padded(filled, lanes), terms, parameters, rotation, lanes, missed, block, sums)
    return cost + prior_cost(terms, parameters, rotation, sums)


@inline_kernel
def _loss(residual: float, huber: float, terms: Terms, weight: float) -> tuple[float, float]:
    """The loss of an object's ray and the square root of its weight: Cauchy's behind the surface if asked for."""
    loss, scale = huber_loss(residual, huber, weight)
    if terms.inner_cauchy > 0.0:
        inner_loss, inner_scale = cauchy_loss(residual, terms.inner_cauchy, weight)
        return (inner_loss, inner_scale) if residual < 0.0 else (loss, scale)
    return loss, scale


@kernel
def _rendered_rows(
    filled: int, met: np.ndarray, terms: Terms, lanes: np.ndarray, missed: np.ndarray, block: np.ndarray
) -> float:
    """Cost of rendered and covered residuals; writes their scale and value to the block's first and last row."""
    cost = 0.0
    for i in range(filled):
        gx, gy, gz, along = lanes[Lane.GX, i], lanes[Lane.GY, i], lanes[Lane.GZ, i], lanes[Lane.SLOPE, i]
        ex, ey, ez = lanes[Lane.EX, i], lanes[Lane.EY, i], lanes[Lane.EZ, i]
        square = gx * gx + gy * gy + gz * gz + _TINY
        over = lanes[Lane.G, i] - 1.0
        across = terms.grazing * square * (ex * ex + ey * ey + ez * ez)
        covered = terms.outline_stiffness / math.sqrt(square)
        factor = covered if missed[i] else lanes[Lane.PRECISION, i] / math.sqrt(along * along + across)
        short = lanes[Lane.MEASURED, i] - lanes[Lane.START, i] - lanes[Lane.SHIFT, i]
        residual = over * covered if missed[i] else (short * along + over) * factor
        if terms.dead_zone > 0.0 and not missed[i]:
            excess = max(abs(residual) - terms.dead_zone, 0.0)
            factor = factor if excess > 0.0 else 0.0
            residual = math.copysign(excess, residual)
        loss, scale = _loss(residual, terms.outline_huber if missed[i] else terms.huber, terms, lanes[Lane.SHARE, i])
        cost += loss
        block[0, i] = scale * factor
        block[STEP_LENGTH, i] = scale * residual
    for i in range(met.shape[0]):
        reached = lanes[Lane.START, i] + lanes[Lane.SHIFT, i] - (lanes[Lane.G, i] - 1.0) / lanes[Lane.SLOPE, i]
        met[i] = lanes[Lane.MEASURED, i] if missed[i] else reached
    return cost


@kernel
def _measured_rows(
    filled: int, stage: int, terms: Terms, parameters: np.ndarray, lanes: np.ndarray, block: np.ndarray
) -> float:
    """Cost of residuals at the measured points; writes to the block as :func:`_rendered_rows`."""
    root_of_volume = math.sqrt(parameters[0] * parameters[1] * parameters[2])
    cost = 0.0
    for i in range(filled):
        gx, gy, gz, g = lanes[Lane.GX, i], lanes[Lane.GY, i], lanes[Lane.GZ, i], lanes[Lane.G, i]
        stiffness = lanes[Lane.PRECISION, i]
        first_order = stiffness / math.sqrt(gx * gx + gy * gy + gz * gz + _TINY)
        factor = 2.0 * g * root_of_volume * stiffness if stage == CLASSIC else first_order
        residual = (g - 1.0) * ((g + 1.0) * root_of_volume * stiffness if stage == CLASSIC else first_order)
        share = lanes[Lane.SHARE, i]
        if stage == FOOT:
            residual = (lanes[Lane.START, i] - lanes[Lane.EXPECTED, i]) * stiffness
            share = 0.0 if lanes[Lane.ONE_SIDED, i] * residual > 0.0 else share
        loss, scale = _loss(residual, terms.huber, terms, share)
        cost += loss
        block[0, i] = scale * factor
        block[STEP_LENGTH, i] = scale * residual
    return cost


@kernel
def _differentiate(filled: int, rotation: np.ndarray, lanes: np.ndarray, block: np.ndarray) -> None:
    """Write the derivatives of scale * g by a step to rows 0 to 12 of the block; its first row holds the scale."""
    m11, m12, m13 = rotation[0]
    m21, m22, m23 = rotation[1]
    m31, m32, m33 = rotation[2]
    for i in range(filled):
        scale, shift = block[0, i], lanes[Lane.SHIFT, i]
        x = lanes[Lane.QX, i] + shift * lanes[Lane.EX, i]
        y = lanes[Lane.QY, i] + shift * lanes[Lane.EY, i]
        z = lanes[Lane.QZ, i] + shift * lanes[Lane.EZ, i]
        gx, gy, gz = scale * lanes[Lane.GX, i], scale * lanes[Lane.GY, i], scale * lanes[Lane.GZ, i]
        block[0, i], block[1, i], block[2, i] = -x * gx, -y * gy, -z * gz
        block[3, i], block[4, i] = scale * lanes[Lane.G1, i], scale * lanes[Lane.G2, i]
        block[5, i] = -(m11 * gx + m12 * gy + m13 * gz)
        block[6, i] = -(m21 * gx + m22 * gy + m23 * gz)
        block[7, i] = -(m31 * gx + m32 * gy + m33 * gz)
        block[8, i] = gy * z - gz * y
        block[9, i] = gz * x - gx * z
        block[10, i] = gx * y - gy * x
        block[11, i], block[12, i] = scale * lanes[Lane.GK1, i], scale * lanes[Lane.GK2, i]


@kernel
def _free_rows(
    filled: int, terms: Terms, parameters: np.ndarray, rotation: np.ndarray, lanes: np.ndarray, missed: np.ndarray,
    block: np.ndarray, sums: np.ndarray,
) -> float:
    """Cost of the residuals of free rays that cross the bounding box; adds them to the normal equations."""
    lowest(filled, 1.0, LOWEST_TOLERANCE, parameters, lanes, missed)
    cost = 0.0
    for i in range(filled):
        gx, gy, gz = lanes[Lane.GX, i], lanes[Lane.GY, i], lanes[Lane.GZ, i]
        factor = -terms.outline_stiffness * lanes[Lane.PRECISION, i] / math.sqrt(gx * gx + gy * gy + gz * gz + _TINY)
        residual = 0.0 if missed[i] else max(0.0, (lanes[Lane.G, i] - 1.0) * factor)
        loss, scale = huber_loss(residual, terms.outline_huber, lanes[Lane.SHARE, i])
        cost += loss
        block[0, i] = scale * factor if residual > 0.0 else 0.0
        block[STEP_LENGTH, i] = scale * residual
    if cost > 0.0:
        _differentiate(filled, rotation, lanes, block)
        add_block(block, filled, sums)
    return cost


@inline_kernel
def sampson(lanes: np.ndarray, i: int) -> float:
    """Sampson distance to the surface at a lane's q + shift e, metres, positive outside."""
    gx, gy, gz = lanes[Lane.GX, i], lanes[Lane.GY, i], lanes[Lane.GZ, i]
    return (lanes[Lane.G, i] - 1.0) / math.sqrt(gx * gx + gy * gy + gz * gz + _TINY)


@kernel
def to_foot(filled: int, parameters: np.ndarray, lanes: np.ndarray) -> None:
    """Write the Sampson distance of each point to START and carry it to the surface, with the gauge there."""
    gauge_along(filled, parameters, lanes)
    for i in range(filled):
        gx, gy, gz = lanes[Lane.GX, i], lanes[Lane.GY, i], lanes[Lane.GZ, i]
        lanes[Lane.START, i] = sampson(lanes, i)
        back = lanes[Lane.START, i] / math.sqrt(gx * gx + gy * gy + gz * gz + _TINY)
        lanes[Lane.QX, i] -= back * gx
        lanes[Lane.QY, i] -= back * gy
        lanes[Lane.QZ, i] -= back * gz
    gauge_along(filled, parameters, lanes)


@kernel
def surface_distance(rays: np.ndarray, parameters: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Sampson distance (n,) of the measured points to the surface, metres, positive outside."""
    distance = np.empty(rays.shape[0])
    lanes = np.empty((ROWS, LANES))
    for begin in range(0, rays.shape[0], LANES):
        part = rays[begin : begin + LANES]
        place(part, distance[:0], parameters, rotation, lanes)
        gauge_along(padded(part.shape[0], lanes), parameters, lanes)
        for i in range(part.shape[0]):
            distance[begin + i] = sampson(lanes, i)
    return distance


@kernel
def mean_loss(rays: np.ndarray, huber: float, parameters: np.ndarray, rotation: np.ndarray) -> float:
    """Mean of Huber's losses of the Sampson distances in units of the noise, before and behind the surface alike."""
    distance = surface_distance(rays, parameters, rotation)
    total = 0.0
    for i in range(rays.shape[0]):
        loss, _ = huber_loss(distance[i] * rays[i, Ray.STIFFNESS], huber, 1.0)
        total += loss
    return total / rays.shape[0]


@kernel
def penetration(free: np.ndarray, terms: Terms, parameters: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """How deep (n,) each free ray runs inside the body, metres: (1 - min g) / |grad g|, 0 for rays that miss it."""
    depth = np.zeros(free.shape[0])
    lanes = np.empty((ROWS, LANES))
    missed = np.empty(LANES, np.bool_)
    owner = np.empty(LANES, np.int64)
    filled = 0
    for n in range(free.shape[0] + 1):
        if n < free.shape[0]:
            owner[filled] = n
            filled += enter(free[n], terms, parameters, rotation, filled, lanes)
        if filled == LANES or (n == free.shape[0] and filled > 0):
            lowest(padded(filled, lanes), 1.0, LOWEST_TOLERANCE, parameters, lanes, missed)
            for i in range(filled):
                depth[owner[i]] = 0.0 if missed[i] else max(-sampson(lanes, i), 0.0)
            filled = 0
    return depth
