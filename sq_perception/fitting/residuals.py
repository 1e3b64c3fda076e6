"""The residuals of every fit, their derivatives, and the sums J^T J and J^T r, compiled.

Unknowns
--------
A body is ``parameters`` = (a1 a2 a3 e1 e2 t1 t2 t3) and a matrix ``rotation`` R, object to optical frame.  A step has 11
entries: d log a (3), d e (2), d t (3) and a rotation vector w in the object frame, R <- R exp([w]).  At a fixed point p
of the optical frame, with q = R^T (p - t) in the object frame and the gauge g(q) and its gradient g_q,

    dg/d log a_k = -q_k g_k,    dg/de from the kernel,    dg/dt = -R g_q,    dg/dw = g_q x q.

Residuals
---------
A pixel is a ray p = o + z d with o_z = 0 and d_z = 1; its row is (o_x, o_y, d_x, d_y, z, 1/sigma, weight).

classic     sqrt(a1 a2 a3) (g^2 - 1) at the measured point: Solina and Bajcsy's, as g^2 = F^e1.
Sampson     (g - 1) / (|grad g| sigma) at the measured point: first order distance; wide basin of attraction.
rendered    (z_hit - z) c / sigma, where the ray meets the body at z_hit: the exact statement of a depth image.
            dz_hit = -dg / (grad g . d).  c = cos / sqrt(cos^2 + kappa), cos the incidence, tames grazing rays.  A ray
            that misses the body falls back to (g - 1) / sqrt((grad g . d)^2 + kappa |grad g|^2 |d|^2) at its point.
free        (1 - min g) / (|grad g| sigma) where the smallest g on the ray, up to the free depth z, is below 1.  At the
            minimum the point may be held fixed (envelope theorem).
plane       (lowest point above the plane) / sigma where negative: n.t + d - h(R^T n), h the support function.
rest        the two components of R^T n across the axis nearest to the normal, over sigma, Cauchy: bodies lie on a face.
volume      a linear price on log(a1 a2 a3), which decides what the image leaves open.

The scales |grad g| and c are held fixed in the derivatives, which the residual's being small near the answer justifies.
Image residuals pass through Huber's loss.  The cost is the weighted sum of the losses: r^2 for small r.
:func:`statement` is the same in torch, without derivatives, for tests and for the reader.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sq_perception.geometry.kernels import box_interval, gauge_derivatives, kernel, p_norm, ray_minimum

CLASSIC, SAMPSON, RENDERED = 0, 1, 2
STEP_LENGTH = 11
RAY_COLUMNS = 7

_HIT_TOLERANCE = 1e-3
_HIT_STEPS = 12
_NEAREST = 1e-3
"""A free ray starts this far in front of a pinhole camera, metres."""
_TINY = 1e-12


class Scene(NamedTuple):
    """What holds for all rays: loss, and what is known beyond the image.

    ``plane`` n.x + d = height; a stiffness of 0 switches its term off.
    """

    huber: float = 3.0
    free_huber: float = 3.0
    grazing: float = 0.01
    pinhole: float = 0.0
    normal_x: float = 0.0
    normal_y: float = 0.0
    normal_z: float = 0.0
    offset: float = 0.0
    plane_stiffness: float = 0.0
    rest_stiffness: float = 0.0
    volume_price: float = 0.0


@kernel
def evaluate(stage, rays, free, scene, parameters, rotation, normal_matrix, gradient):
    """Cost at a body; fills the lower triangle of J^T J (11, 11) and J^T r (11,)."""
    normal_matrix[:] = 0.0
    gradient[:] = 0.0
    cost = _observed(stage, rays, scene, parameters, rotation, normal_matrix, gradient)
    if free.shape[0] > 0:
        cost += _free_space(free, scene, parameters, rotation, normal_matrix, gradient)
    if scene.plane_stiffness > 0.0 or scene.rest_stiffness > 0.0:
        cost += _support(scene, parameters, rotation, normal_matrix, gradient)
    if scene.volume_price > 0.0:
        for k in range(3):
            cost += scene.volume_price * math.log(parameters[k])
            gradient[k] += 0.5 * scene.volume_price
    return cost


@kernel
def _observed(stage, rays, scene, parameters, rotation, normal_matrix, gradient):
    a1, a2, a3, e1, e2, t1, t2, t3 = parameters
    m = rotation
    classic_scale = math.sqrt(a1 * a2 * a3)
    row = np.zeros(STEP_LENGTH)
    cost = 0.0
    for i in range(rays.shape[0]):
        ox, oy, oz = rays[i, 0] - t1, rays[i, 1] - t2, -t3
        dx, dy = rays[i, 2], rays[i, 3]
        depth = rays[i, 4]
        x, y, z = ox + depth * dx, oy + depth * dy, oz + depth
        qx = m[0, 0] * x + m[1, 0] * y + m[2, 0] * z
        qy = m[0, 1] * x + m[1, 1] * y + m[2, 1] * z
        qz = m[0, 2] * x + m[1, 2] * y + m[2, 2] * z
        g, gx, gy, gz, g1, g2 = gauge_derivatives(qx, qy, qz, a1, a2, a3, e1, e2)
        slope_length = math.sqrt(gx * gx + gy * gy + gz * gz) + _TINY
        if stage == CLASSIC:
            residual = classic_scale * (g * g - 1.0) * rays[i, 5]
            factor = 2.0 * g * classic_scale * rays[i, 5]
        elif stage == SAMPSON:
            factor = rays[i, 5] / slope_length
            residual = (g - 1.0) * factor
        else:
            ex = m[0, 0] * dx + m[1, 0] * dy + m[2, 0]
            ey = m[0, 1] * dx + m[1, 1] * dy + m[2, 1]
            ez = m[0, 2] * dx + m[1, 2] * dy + m[2, 2]
            ray_length = math.sqrt(dx * dx + dy * dy + 1.0)
            hit, shift, g, gx, gy, gz, g1, g2 = _hit_from(
                qx, qy, qz, ex, ey, ez, a1, a2, a3, e1, e2, g, gx, gy, gz, g1, g2
            )
            along = gx * ex + gy * ey + gz * ez
            across = scene.grazing * (gx * gx + gy * gy + gz * gz) * ray_length * ray_length
            if hit:
                qx, qy, qz = qx + shift * ex, qy + shift * ey, qz + shift * ez
                tame = rays[i, 5] / math.sqrt(along * along + across)
                residual = -(shift - (g - 1.0) / along) * along * tame
                factor = tame
            else:
                factor = rays[i, 5] / math.sqrt(along * along + across + _TINY)
                residual = (g - 1.0) * factor
        row[0], row[1], row[2] = -factor * qx * gx, -factor * qy * gy, -factor * qz * gz
        row[3], row[4] = factor * g1, factor * g2
        row[5] = -factor * (m[0, 0] * gx + m[0, 1] * gy + m[0, 2] * gz)
        row[6] = -factor * (m[1, 0] * gx + m[1, 1] * gy + m[1, 2] * gz)
        row[7] = -factor * (m[2, 0] * gx + m[2, 1] * gy + m[2, 2] * gz)
        row[8], row[9], row[10] = (
            factor * (gy * qz - gz * qy),
            factor * (gz * qx - gx * qz),
            factor * (gx * qy - gy * qx),
        )
        if stage == CLASSIC:
            row[0] += 0.5 * residual
            row[1] += 0.5 * residual
            row[2] += 0.5 * residual
        cost += _add_row(row, residual, scene.huber, rays[i, 6], normal_matrix, gradient)
    return cost


@kernel
def _hit_from(qx, qy, qz, ex, ey, ez, a1, a2, a3, e1, e2, g, gx, gy, gz, g1, g2):
    """Where the ray meets the surface, near the given point, by Newton's method along the ray.

    Answers (hit, shift along the ray, gauge and derivatives there).  The last point lies within the tolerance of the
    surface; the caller takes the last step without evaluating again.  From a point on the near side of the body the
    iteration cannot fail (g is convex along the ray); from the far side it starts again at the bounding box.  For a
    miss the values at the given point come back.
    """
    shift = 0.0
    slope = gx * ex + gy * ey + gz * ez
    if slope < 0.0 and abs(g - 1.0) < _HIT_TOLERANCE:
        return True, 0.0, g, gx, gy, gz, g1, g2
    h, hx, hy, hz, h1, h2 = g, gx, gy, gz, g1, g2
    if slope >= 0.0 or g > 2.0:
        t_in, t_out = box_interval(qx, qy, qz, ex, ey, ez, a1, a2, a3)
        if t_in > t_out:
            return False, 0.0, g, gx, gy, gz, g1, g2
        shift = t_in
        h, hx, hy, hz, h1, h2 = gauge_derivatives(qx + shift * ex, qy + shift * ey, qz + shift * ez, a1, a2, a3, e1, e2)
    for _ in range(_HIT_STEPS):
        slope = hx * ex + hy * ey + hz * ez
        if slope >= 0.0:
            break
        if abs(h - 1.0) < _HIT_TOLERANCE:
            return True, shift, h, hx, hy, hz, h1, h2
        shift -= (h - 1.0) / slope
        h, hx, hy, hz, h1, h2 = gauge_derivatives(qx + shift * ex, qy + shift * ey, qz + shift * ez, a1, a2, a3, e1, e2)
    return False, 0.0, g, gx, gy, gz, g1, g2


@kernel
def _free_space(free, scene, parameters, rotation, normal_matrix, gradient):
    a1, a2, a3, e1, e2, t1, t2, t3 = parameters
    m = rotation
    nearest = _NEAREST if scene.pinhole > 0.0 else -1e300
    row = np.zeros(STEP_LENGTH)
    cost = 0.0
    for i in range(free.shape[0]):
        x, y, z = free[i, 0] - t1, free[i, 1] - t2, -t3
        dx, dy = free[i, 2], free[i, 3]
        ox = m[0, 0] * x + m[1, 0] * y + m[2, 0] * z
        oy = m[0, 1] * x + m[1, 1] * y + m[2, 1] * z
        oz = m[0, 2] * x + m[1, 2] * y + m[2, 2] * z
        ex = m[0, 0] * dx + m[1, 0] * dy + m[2, 0]
        ey = m[0, 1] * dx + m[1, 1] * dy + m[2, 1]
        ez = m[0, 2] * dx + m[1, 2] * dy + m[2, 2]
        least, t = ray_minimum(nearest, free[i, 4], ox, oy, oz, ex, ey, ez, a1, a2, a3, e1, e2)
        if least >= 1.0:
            continue
        qx, qy, qz = ox + t * ex, oy + t * ey, oz + t * ez
        g, gx, gy, gz, g1, g2 = gauge_derivatives(qx, qy, qz, a1, a2, a3, e1, e2)
        factor = -free[i, 5] / (math.sqrt(gx * gx + gy * gy + gz * gz) + _TINY)
        residual = (g - 1.0) * factor
        row[0], row[1], row[2] = -factor * qx * gx, -factor * qy * gy, -factor * qz * gz
        row[3], row[4] = factor * g1, factor * g2
        row[5] = -factor * (m[0, 0] * gx + m[0, 1] * gy + m[0, 2] * gz)
        row[6] = -factor * (m[1, 0] * gx + m[1, 1] * gy + m[1, 2] * gz)
        row[7] = -factor * (m[2, 0] * gx + m[2, 1] * gy + m[2, 2] * gz)
        row[8], row[9], row[10] = (
            factor * (gy * qz - gz * qy),
            factor * (gz * qx - gx * qz),
            factor * (gx * qy - gy * qx),
        )
        cost += _add_row(row, residual, scene.free_huber, free[i, 6], normal_matrix, gradient)
    return cost


@kernel
def support_derivatives(nx, ny, nz, a1, a2, a3, e1, e2):
    """Support function h at an object-frame direction and its derivatives: h, h_nx, h_ny, h_nz, h_e1, h_e2."""
    inner, inner_x, inner_y, inner_e = p_norm(a1 * abs(nx), a2 * abs(ny), max(2.0 - e2, 1e-3))
    h, h_inner, h_z, h_e = p_norm(inner, a3 * abs(nz), max(2.0 - e1, 1e-3))
    return (
        h,
        math.copysign(h_inner * inner_x * a1, nx),
        math.copysign(h_inner * inner_y * a2, ny),
        math.copysign(h_z * a3, nz),
        -h_e,
        -h_inner * inner_e,
    )


@kernel
def _support(scene, parameters, rotation, normal_matrix, gradient):
    a1, a2, a3, e1, e2, t1, t2, t3 = parameters
    n = (scene.normal_x, scene.normal_y, scene.normal_z)
    m = np.zeros(3)
    for k in range(3):
        m[k] = rotation[0, k] * n[0] + rotation[1, k] * n[1] + rotation[2, k] * n[2]
    row = np.zeros(STEP_LENGTH)
    cost = 0.0
    h, hx, hy, hz, h1, h2 = support_derivatives(m[0], m[1], m[2], a1, a2, a3, e1, e2)
    lowest = n[0] * t1 + n[1] * t2 + n[2] * t3 + scene.offset - h
    if scene.plane_stiffness > 0.0 and lowest < 0.0:
        s = scene.plane_stiffness
        row[0], row[1], row[2] = -s * hx * m[0], -s * hy * m[1], -s * hz * m[2]
        row[3], row[4] = -s * h1, -s * h2
        row[5], row[6], row[7] = s * n[0], s * n[1], s * n[2]
        row[8] = -s * (hy * m[2] - hz * m[1])
        row[9] = -s * (hz * m[0] - hx * m[2])
        row[10] = -s * (hx * m[1] - hy * m[0])
        cost += _add_row(row, s * lowest, 1e300, 1.0, normal_matrix, gradient)
    if scene.rest_stiffness > 0.0:
        upright = 0
        for k in range(1, 3):
            if abs(m[k]) > abs(m[upright]):
                upright = k
        square = (m[0] * m[0] + m[1] * m[1] + m[2] * m[2] - m[upright] * m[upright]) * scene.rest_stiffness**2
        cost += math.log1p(square)
        weight = 1.0 / (1.0 + square)
        for k in range(3):
            if k == upright:
                continue
            for j in range(STEP_LENGTH):
                row[j] = 0.0
            after, before = (k + 1) % 3, (k + 2) % 3
            row[8 + before] = scene.rest_stiffness * m[after]
            row[8 + after] = -scene.rest_stiffness * m[before]
            _add_row(row, scene.rest_stiffness * m[k], 1e300, weight, normal_matrix, gradient)
    return cost


@kernel
def _add_row(row, residual, huber, weight, normal_matrix, gradient):
    """Add one residual; answers its weighted loss."""
    size = abs(residual)
    loss = residual * residual
    if size > huber:
        loss = huber * (2.0 * size - huber)
        weighted = weight * huber / size
    else:
        weighted = weight
    for k in range(STEP_LENGTH):
        entry = weighted * row[k]
        gradient[k] += entry * residual
        for j in range(k + 1):
            normal_matrix[k, j] += entry * row[j]
    return weight * loss
