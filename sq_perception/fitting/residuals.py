"""The residuals of every fit, their derivatives, and the normal equations J^T J and J^T r, compiled.

Unknowns
--------
A body is ``parameters`` = (a1 a2 a3 e1 e2 t1 t2 t3) and a matrix ``rotation`` R, object to optical frame.  A step has
11 entries: d log a (3), d e (2), d t (3) and a rotation vector w in the object frame, R <- R exp([w]).  At a fixed
point p of the optical frame, with q = R^T (p - t) in the object frame, the gauge g(q) and its gradient g_q,

    dg/d log a_k = -q_k g_k,    dg/de from the kernel,    dg/dt = -R g_q,    dg/dw = g_q x q.

Residuals
---------
A pixel is a ray p = o + z d with o_z = 0 and d_z = 1; its row is (o_x, o_y, d_x, d_y, z, 1/sigma, weight,
last).  ``last`` is the pixel's index for a free ray; for an object ray it is the depth at which the ray met the body
last time, where the next search for the intersection starts.

classic     sqrt(a1 a2 a3) (g^2 - 1) / sigma at the measured point: Solina and Bajcsy's, as g^2 = F^e1.
Sampson     (g - 1) / (|grad g| sigma) at the measured point: first order distance; wide basin of attraction.
rendered    (z_hit - z) c / sigma, where the ray meets the body at z_hit: the exact statement of a depth image.
            dz_hit = -dg / (grad g . d).  c = cos / sqrt(cos^2 + kappa), with cos the incidence, tames grazing rays.
covered     (min g - 1) / (|grad g| sigma_o) instead, where a pixel of the object misses the body; sigma_o belongs to
            the outline.  A ray that misses even the bounding box counts by its Sampson distance.
free        (1 - min g) / (|grad g| sigma_o), where the smallest g on a free ray, up to its free depth z, is below 1.
            At a minimum the point may be held fixed (envelope theorem).
plane       (lowest point above the plane) / sigma where negative: n.t + d - h(R^T n), h the support function.
rest        the two components of R^T n across the axis nearest to the normal, over sigma, Cauchy: bodies lie on a face.
proportion  log a_k minus the mean of the three, over sigma: what the image leaves open resembles what it shows.
volume      a linear price on log(a1 a2 a3), for the smaller of two bodies that explain the image alike.

The scales |grad g| and c are held fixed in the derivatives, which residuals small near the answer justify.  Image
residuals pass through Huber's loss.  The cost is the weighted sum of the losses, r^2 for small r.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sq_perception.geometry.kernels import box_interval, gauge_derivatives, kernel, p_norm, ray_minimum

CLASSIC, SAMPSON, RENDERED = 0, 1, 2
STEP_LENGTH = 11
RAY_COLUMNS = 8

_BLOCK = 64
_HIT_STEPS = 12
_MINIMUM_STEPS = 8
_NEAREST = 1e-3
"""A free ray starts this far in front of a pinhole camera, metres."""
_TINY = 1e-12


Derivatives = tuple[float, float, float, float, float, float]
"""A value g or h and its derivatives by x, y, z, e1 and e2."""


class Scene(NamedTuple):
    """What holds for all rays: losses, and what is known beyond the image.

    A rendered depth is found by Newton's method until |g - 1| < ``hit_tolerance``, then in first order.
    ``outline_stiffness`` is 1/sigma_o; the plane is n.x + d = height; a stiffness or price of 0 switches its term off.
    """

    huber: float = 3.0
    outline_huber: float = 3.0
    grazing: float = 0.01
    hit_tolerance: float = 1e-4
    outline_stiffness: float = 1.0
    pinhole: float = 0.0
    normal_x: float = 0.0
    normal_y: float = 0.0
    normal_z: float = 0.0
    offset: float = 0.0
    plane_stiffness: float = 0.0
    rest_stiffness: float = 0.0
    proportion_stiffness: float = 0.0
    volume_price: float = 0.0


@kernel
def evaluate(
    stage: int,
    rays: np.ndarray,
    free: np.ndarray,
    scene: Scene,
    parameters: np.ndarray,
    rotation: np.ndarray,
    sums: np.ndarray,
) -> float:
    """Cost at a body; fills ``sums`` (12, 12), lower triangle: J^T J in rows 0 to 10, J^T r in row 11."""
    sums[:] = 0.0
    block = np.zeros((STEP_LENGTH + 1, _BLOCK))
    cost = _object_cost(stage, rays, scene, parameters, rotation, block, sums)
    cost += _free_cost(free, scene, parameters, rotation, block, sums)
    if scene.plane_stiffness > 0.0 or scene.rest_stiffness > 0.0:
        cost += _support_cost(scene, parameters, rotation, block, sums)
    if scene.proportion_stiffness > 0.0:
        cost += _proportion_cost(scene, parameters, block, sums)
    if scene.volume_price > 0.0:
        for k in range(3):
            cost += scene.volume_price * math.log(parameters[k])
            sums[STEP_LENGTH, k] += 0.5 * scene.volume_price
    return cost


@kernel
def _object_cost(
    stage: int,
    rays: np.ndarray,
    scene: Scene,
    parameters: np.ndarray,
    rotation: np.ndarray,
    block: np.ndarray,
    sums: np.ndarray,
) -> float:
    a1, a2, a3, e1, e2, t1, t2, t3 = parameters
    m = rotation
    classic_scale = math.sqrt(a1 * a2 * a3)
    cost = 0.0
    filled = 0
    for i in range(rays.shape[0]):
        dx, dy, depth, stiffness = rays[i, 2], rays[i, 3], rays[i, 4], rays[i, 5]
        start = rays[i, 7] if stage == RENDERED else depth
        x, y, z = rays[i, 0] - t1 + start * dx, rays[i, 1] - t2 + start * dy, start - t3
        qx = m[0, 0] * x + m[1, 0] * y + m[2, 0] * z
        qy = m[0, 1] * x + m[1, 1] * y + m[2, 1] * z
        qz = m[0, 2] * x + m[1, 2] * y + m[2, 2] * z
        at = gauge_derivatives(qx, qy, qz, a1, a2, a3, e1, e2)
        huber = scene.huber
        if stage == CLASSIC:
            residual = classic_scale * (at[0] * at[0] - 1.0) * stiffness
            factor = 2.0 * at[0] * classic_scale * stiffness
        elif stage == SAMPSON:
            factor = stiffness / _length(at)
            residual = (at[0] - 1.0) * factor
        else:
            ex = m[0, 0] * dx + m[1, 0] * dy + m[2, 0]
            ey = m[0, 1] * dx + m[1, 1] * dy + m[2, 1]
            ez = m[0, 2] * dx + m[1, 2] * dy + m[2, 2]
            hit, shift, at = _meet(qx, qy, qz, ex, ey, ez, a1, a2, a3, e1, e2, at, scene.hit_tolerance)
            qx, qy, qz = qx + shift * ex, qy + shift * ey, qz + shift * ez
            if hit:
                along = at[1] * ex + at[2] * ey + at[3] * ez
                length = _length(at)
                across = scene.grazing * length * length * (dx * dx + dy * dy + 1.0)
                factor = stiffness / math.sqrt(along * along + across)
                hit_depth = start + shift - (at[0] - 1.0) / along
                residual = (depth - hit_depth) * along * factor
                rays[i, 7] = hit_depth
            else:
                factor = scene.outline_stiffness / _length(at)
                residual = (at[0] - 1.0) * factor
                huber = scene.outline_huber
                rays[i, 7] = depth
        loss, scale = _huber(residual, huber, rays[i, 6])
        cost += loss
        _write_row(block, filled, scale, factor, residual, qx, qy, qz, at, m)
        if stage == CLASSIC:
            for k in range(3):
                block[k, filled] += 0.5 * scale * residual
        filled += 1
        if filled == _BLOCK:
            _flush(block, filled, sums)
            filled = 0
    _flush(block, filled, sums)
    return cost


@kernel
def _meet(
    qx: float,
    qy: float,
    qz: float,
    ex: float,
    ey: float,
    ez: float,
    a1: float,
    a2: float,
    a3: float,
    e1: float,
    e2: float,
    at: Derivatives,
    tolerance: float,
) -> tuple[bool, float, Derivatives]:
    """Where the ray through q along e meets the surface: (hit, shift along the ray, gauge and derivatives there).

    Newton's method along the ray from the given point, whose gauge and derivatives are ``at``.  From a point on the
    near side of the body it cannot fail, as g is convex along the ray; from the far side it starts again where the ray
    enters the bounding box.  The last point lies within the tolerance of the surface; the caller takes the last step
    in first order.  For a miss it is the point of the smallest g, or the given point if even the box is missed.
    """
    shift = 0.0
    here = at
    slope = here[1] * ex + here[2] * ey + here[3] * ez
    if slope >= 0.0 or here[0] > 2.0:
        t_in, t_out = box_interval(qx, qy, qz, ex, ey, ez, a1, a2, a3)
        if t_in > t_out:
            return False, 0.0, at
        shift = t_in
        here = gauge_derivatives(qx + shift * ex, qy + shift * ey, qz + shift * ez, a1, a2, a3, e1, e2)
        slope = here[1] * ex + here[2] * ey + here[3] * ez
        if slope >= 0.0 and here[0] > 1.0:
            return False, shift, here
    for _ in range(_HIT_STEPS):
        if abs(here[0] - 1.0) < tolerance:
            return True, shift, here
        step = (1.0 - here[0]) / slope
        before = shift
        shift += step
        here = gauge_derivatives(qx + shift * ex, qy + shift * ey, qz + shift * ez, a1, a2, a3, e1, e2)
        slope = here[1] * ex + here[2] * ey + here[3] * ez
        if slope >= 0.0:
            break
    if slope < 0.0:
        return True, shift, here
    low, high = min(before, shift), max(before, shift)
    for _ in range(_MINIMUM_STEPS):
        shift = 0.5 * (low + high)
        here = gauge_derivatives(qx + shift * ex, qy + shift * ey, qz + shift * ez, a1, a2, a3, e1, e2)
        if here[1] * ex + here[2] * ey + here[3] * ez > 0.0:
            high = shift
        else:
            low = shift
    return False, shift, here


@kernel
def _free_cost(
    free: np.ndarray, scene: Scene, parameters: np.ndarray, rotation: np.ndarray, block: np.ndarray, sums: np.ndarray
) -> float:
    a1, a2, a3, e1, e2, t1, t2, t3 = parameters
    m = rotation
    nearest = _NEAREST if scene.pinhole > 0.0 else -1e300
    cost = 0.0
    filled = 0
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
        at = gauge_derivatives(qx, qy, qz, a1, a2, a3, e1, e2)
        factor = -scene.outline_stiffness * free[i, 5] / _length(at)
        residual = (at[0] - 1.0) * factor
        loss, scale = _huber(residual, scene.outline_huber, free[i, 6])
        cost += loss
        _write_row(block, filled, scale, factor, residual, qx, qy, qz, at, m)
        filled += 1
        if filled == _BLOCK:
            _flush(block, filled, sums)
            filled = 0
    _flush(block, filled, sums)
    return cost


@kernel
def support_derivatives(
    nx: float, ny: float, nz: float, a1: float, a2: float, a3: float, e1: float, e2: float
) -> Derivatives:
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
def _support_cost(
    scene: Scene, parameters: np.ndarray, rotation: np.ndarray, block: np.ndarray, sums: np.ndarray
) -> float:
    a1, a2, a3, e1, e2, t1, t2, t3 = parameters
    normal = np.array([scene.normal_x, scene.normal_y, scene.normal_z])
    n = np.zeros(3)
    for k in range(3):
        n[k] = rotation[0, k] * normal[0] + rotation[1, k] * normal[1] + rotation[2, k] * normal[2]
    cost = 0.0
    h, hx, hy, hz, h1, h2 = support_derivatives(n[0], n[1], n[2], a1, a2, a3, e1, e2)
    lowest = normal[0] * t1 + normal[1] * t2 + normal[2] * t3 + scene.offset - h
    if scene.plane_stiffness > 0.0 and lowest < 0.0:
        s = scene.plane_stiffness
        residual = s * lowest
        cost += residual * residual
        block[0, 0], block[1, 0], block[2, 0] = -s * hx * n[0], -s * hy * n[1], -s * hz * n[2]
        block[3, 0], block[4, 0] = -s * h1, -s * h2
        block[5, 0], block[6, 0], block[7, 0] = s * normal[0], s * normal[1], s * normal[2]
        block[8, 0] = -s * (hy * n[2] - hz * n[1])
        block[9, 0] = -s * (hz * n[0] - hx * n[2])
        block[10, 0] = -s * (hx * n[1] - hy * n[0])
        block[11, 0] = residual
        _flush(block, 1, sums)
    if scene.rest_stiffness > 0.0:
        s = scene.rest_stiffness
        upright = 0
        for k in range(1, 3):
            if abs(n[k]) > abs(n[upright]):
                upright = k
        square = (n[0] * n[0] + n[1] * n[1] + n[2] * n[2] - n[upright] * n[upright]) * s * s
        cost += math.log1p(square)
        scale = s / math.sqrt(1.0 + square)
        for k in range(3):
            if k == upright:
                continue
            for j in range(STEP_LENGTH):
                block[j, 0] = 0.0
            after, before = (k + 1) % 3, (k + 2) % 3
            block[8 + before, 0] = scale * n[after]
            block[8 + after, 0] = -scale * n[before]
            block[STEP_LENGTH, 0] = scale * n[k]
            _flush(block, 1, sums)
    return cost


@kernel
def _proportion_cost(scene: Scene, parameters: np.ndarray, block: np.ndarray, sums: np.ndarray) -> float:
    mean = (math.log(parameters[0]) + math.log(parameters[1]) + math.log(parameters[2])) / 3.0
    cost = 0.0
    for k in range(3):
        for j in range(STEP_LENGTH):
            block[j, 0] = 0.0
        for j in range(3):
            block[j, 0] = scene.proportion_stiffness * ((1.0 if j == k else 0.0) - 1.0 / 3.0)
        residual = scene.proportion_stiffness * (math.log(parameters[k]) - mean)
        block[STEP_LENGTH, 0] = residual
        cost += residual * residual
        _flush(block, 1, sums)
    return cost


@kernel
def _length(at: Derivatives) -> float:
    return math.sqrt(at[1] * at[1] + at[2] * at[2] + at[3] * at[3]) + _TINY


@kernel
def _huber(residual: float, huber: float, weight: float) -> tuple[float, float]:
    """Weighted loss of a residual, and the square root of its weight in the normal equations."""
    size = abs(residual)
    if size > huber:
        return weight * huber * (2.0 * size - huber), math.sqrt(weight * huber / size)
    return weight * residual * residual, math.sqrt(weight)


@kernel
def _write_row(
    block: np.ndarray,
    i: int,
    scale: float,
    factor: float,
    residual: float,
    qx: float,
    qy: float,
    qz: float,
    at: Derivatives,
    m: np.ndarray,
) -> None:
    """Put the derivatives of ``factor * g`` and the residual into column i of the block."""
    s = scale * factor
    gx, gy, gz = s * at[1], s * at[2], s * at[3]
    block[0, i], block[1, i], block[2, i] = -qx * gx, -qy * gy, -qz * gz
    block[3, i], block[4, i] = s * at[4], s * at[5]
    block[5, i] = -(m[0, 0] * gx + m[0, 1] * gy + m[0, 2] * gz)
    block[6, i] = -(m[1, 0] * gx + m[1, 1] * gy + m[1, 2] * gz)
    block[7, i] = -(m[2, 0] * gx + m[2, 1] * gy + m[2, 2] * gz)
    block[8, i] = gy * qz - gz * qy
    block[9, i] = gz * qx - gx * qz
    block[10, i] = gx * qy - gy * qx
    block[11, i] = scale * residual


@kernel
def _flush(block: np.ndarray, filled: int, sums: np.ndarray) -> None:
    """Add the outer products of the block's columns to the sums; long inner loops are what vectorises."""
    for k in range(STEP_LENGTH + 1):
        for j in range(k + 1):
            total = 0.0
            for i in range(filled):
                total += block[k, i] * block[j, i]
            sums[k, j] += total


@kernel
def surface_distance(rays: np.ndarray, parameters: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Absolute Sampson distance (n,) of the measured points to the surface, metres."""
    a1, a2, a3, e1, e2, t1, t2, t3 = parameters
    m = rotation
    distance = np.empty(rays.shape[0])
    for i in range(rays.shape[0]):
        depth = rays[i, 4]
        x, y, z = rays[i, 0] - t1 + depth * rays[i, 2], rays[i, 1] - t2 + depth * rays[i, 3], depth - t3
        at = gauge_derivatives(
            m[0, 0] * x + m[1, 0] * y + m[2, 0] * z,
            m[0, 1] * x + m[1, 1] * y + m[2, 1] * z,
            m[0, 2] * x + m[1, 2] * y + m[2, 2] * z,
            a1,
            a2,
            a3,
            e1,
            e2,
        )
        distance[i] = abs(at[0] - 1.0) / _length(at)
    return distance


@kernel
def penetration(free: np.ndarray, scene: Scene, parameters: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """How deep (n,) each free ray runs inside the body, metres: (1 - min g) / |grad g|, 0 for rays that miss it."""
    depth = np.zeros(free.shape[0])
    block = np.zeros((STEP_LENGTH + 1, _BLOCK))
    sums = np.zeros((STEP_LENGTH + 1, STEP_LENGTH + 1))
    linear = Scene(0.0, 1e300, 0.0, 1.0, 1.0, scene.pinhole, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for i in range(free.shape[0]):
        row = free[i : i + 1].copy()
        row[0, 5], row[0, 6] = 1.0, 1.0
        depth[i] = math.sqrt(_free_cost(row, linear, parameters, rotation, block, sums))
    return depth
