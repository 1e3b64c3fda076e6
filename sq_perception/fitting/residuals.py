"""The residuals of every fit, their derivatives, and the normal equations J^T J and J^T r, compiled.

Unknowns
--------
A body is ``parameters`` = (a1 a2 a3 e1 e2 t1 t2 t3) and a matrix ``rotation`` R, object to optical frame.  A step has
11 entries: d log a (3), d e (2), d t (3) and a rotation vector w in the object frame, R <- R exp([w]).  At a fixed
point p of the optical frame, with q = R^T (p - t) in the object frame, the gauge g(q) and its gradient g_q,

    dg/d log a_k = -q_k g_k,    dg/de from the kernel,    dg/dt = -R g_q,    dg/dw = g_q x q.

Residuals
---------
A pixel is a ray p = o + z d with o_z = 0 and d_z = 1; :mod:`sq_perception.fitting.rays` names the columns of its row.

classic     sqrt(a1 a2 a3) (g^2 - 1) / sigma at the measured point: Solina and Bajcsy's, as g^2 = F^e1.
Sampson     (g - 1) / (|grad g| sigma) at the measured point: first order distance; wide basin of attraction.
rendered    (z_hit - z) c / sigma, where the ray meets the body at z_hit: the exact statement of a depth image.
            dz_hit = -dg / (grad g . d).  c = cos / sqrt(cos^2 + kappa), with cos the incidence, tames grazing rays.
covered     (min g - 1) / (|grad g| sigma_o) instead, where a pixel of the object misses the body; sigma_o belongs to
            the outline.  A ray that misses even the bounding box counts by its Sampson distance.
free        (1 - min g) / (|grad g| sigma_o), where the smallest g on a free ray, up to its free depth z, is below 1.
            At a minimum the point may be held fixed (envelope theorem).

The scales |grad g| and c are held fixed in the derivatives, which residuals small near the answer justify.  Image
residuals pass through Huber's loss.  The cost is the weighted sum of the losses, r^2 for small r, and of the priors
(:mod:`sq_perception.fitting.priors`).

Rays are worked on in blocks of ``LANES``: every line of the mathematics is a loop over the block without a branch,
which the compiler turns into vector code.  ``lanes`` (ROWS, LANES) holds the block's intermediate values, a row each.
"""

from __future__ import annotations

import math

import numpy as np

from sq_perception.fitting.normal_equations import LANES, STEP_LENGTH, add_block, cauchy_loss, huber_loss
from sq_perception.fitting.priors import prior_cost
from sq_perception.fitting.rays import DEPTH, DIRECTION_X, DIRECTION_Y, LAST, ORIGIN_X, ORIGIN_Y, STIFFNESS, WEIGHT
from sq_perception.fitting.terms import Terms
from sq_perception.geometry.kernels import box_interval, gauge_derivatives, inline_kernel, kernel

CLASSIC, SAMPSON, RENDERED = 0, 1, 2

_QX, _QY, _QZ, _EX, _EY, _EZ, _SHIFT = range(7)
"""A ray in the object frame, q + shift e;"""
_G, _GX, _GY, _GZ, _G1, _G2, _SLOPE = range(7, 14)
"""the gauge there and its derivatives, the last one along the ray;"""
_DEPTH, _STIFFNESS, _WEIGHT, _START = range(14, 18)
"""what the pixel measured, and the depth of q;"""
_LOW, _HIGH, _G_LOW, _G_HIGH, _S_LOW, _S_HIGH = range(18, 24)
"""a bracket around the smallest gauge."""
_ROWS = 24

_HIT_STEPS = 12
"""Of Newton's method on a convex function; it converges quadratically, most rays need 2."""
_LOWEST_STEPS, _LOWEST_TOLERANCE = 20, 1e-9
"""Most steps to the smallest gauge on a ray, and how near to a lower bound it ends."""
_ANY, _COVERED_TOLERANCE = 1e300, 1e-6
"""The same for a ray that should meet the body but misses it: how far it passes always matters."""
_NEAREST = 1e-3
"""A free ray starts this far in front of a pinhole camera, metres."""
_FAR_OUTSIDE = 2.0
"""From a gauge above this, Newton's method starts where the ray enters the bounding box instead."""
_TINY = 1e-12
"""Keeps a division by a squared gradient of the gauge, 1 / metres^2, finite."""


@kernel
def evaluate(
    stage: int,
    rays: np.ndarray,
    free: np.ndarray,
    terms: Terms,
    parameters: np.ndarray,
    rotation: np.ndarray,
    sums: np.ndarray,
) -> float:
    """Cost at a body; fills ``sums`` (12, 12), lower triangle: J^T J in rows 0 to 10, J^T r in row 11.

    The RENDERED stage keeps in the column LAST of ``rays`` where each ray met the body.
    """
    sums[:] = 0.0
    block = np.empty((STEP_LENGTH + 1, LANES))
    lanes = np.empty((_ROWS, LANES))
    again = np.empty((_ROWS, LANES))
    missed = np.empty(LANES, np.bool_)
    cost = 0.0
    for begin in range(0, rays.shape[0], LANES):
        filled = min(LANES, rays.shape[0] - begin)
        part = rays[begin : begin + filled]
        _place(part, stage == RENDERED, parameters, rotation, lanes)
        if stage == RENDERED:
            _meet(filled, terms.hit_tolerance, parameters, lanes, missed, again)
            cost += _rendered_rows(part, terms, lanes, missed, block)
        else:
            _gauge(filled, parameters, lanes)
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
        filled += _enter(free[i], terms, parameters, rotation, filled, lanes)
        if filled == LANES:
            cost += _free_rows(filled, terms, parameters, rotation, lanes, missed, block, sums)
            filled = 0
    if filled > 0:
        cost += _free_rows(filled, terms, parameters, rotation, lanes, missed, block, sums)
    return cost + prior_cost(terms, parameters, rotation, sums)


@kernel
def _place(part: np.ndarray, resume: bool, parameters: np.ndarray, rotation: np.ndarray, lanes: np.ndarray) -> None:
    """Rays of the object, in its frame; q at the measured depth, or where the ray met the body last time."""
    t1, t2, t3 = parameters[5], parameters[6], parameters[7]
    m11, m12, m13 = rotation[0]
    m21, m22, m23 = rotation[1]
    m31, m32, m33 = rotation[2]
    for i in range(part.shape[0]):
        dx, dy = part[i, DIRECTION_X], part[i, DIRECTION_Y]
        start = part[i, LAST] if resume else part[i, DEPTH]
        x, y, z = part[i, ORIGIN_X] - t1 + start * dx, part[i, ORIGIN_Y] - t2 + start * dy, start - t3
        lanes[_QX, i] = m11 * x + m21 * y + m31 * z
        lanes[_QY, i] = m12 * x + m22 * y + m32 * z
        lanes[_QZ, i] = m13 * x + m23 * y + m33 * z
        lanes[_EX, i] = m11 * dx + m21 * dy + m31
        lanes[_EY, i] = m12 * dx + m22 * dy + m32
        lanes[_EZ, i] = m13 * dx + m23 * dy + m33
        lanes[_SHIFT, i] = 0.0
        lanes[_DEPTH, i] = part[i, DEPTH]
        lanes[_STIFFNESS, i], lanes[_WEIGHT, i] = part[i, STIFFNESS], part[i, WEIGHT]
        lanes[_START, i] = start


@kernel
def _gauge(filled: int, parameters: np.ndarray, lanes: np.ndarray) -> None:
    """The gauge and its derivatives at q + shift e."""
    a1, a2, a3, e1, e2 = parameters[0], parameters[1], parameters[2], parameters[3], parameters[4]
    for i in range(filled):
        ex, ey, ez, shift = lanes[_EX, i], lanes[_EY, i], lanes[_EZ, i], lanes[_SHIFT, i]
        x, y, z = lanes[_QX, i] + shift * ex, lanes[_QY, i] + shift * ey, lanes[_QZ, i] + shift * ez
        g, gx, gy, gz, g1, g2 = gauge_derivatives(x, y, z, a1, a2, a3, e1, e2)
        lanes[_G, i], lanes[_GX, i], lanes[_GY, i], lanes[_GZ, i] = g, gx, gy, gz
        lanes[_G1, i], lanes[_G2, i] = g1, g2
        lanes[_SLOPE, i] = gx * ex + gy * ey + gz * ez


@kernel
def _meet(
    filled: int, tolerance: float, parameters: np.ndarray, lanes: np.ndarray, missed: np.ndarray, again: np.ndarray
) -> None:
    """Where the rays meet the surface: shift along the ray and the gauge there; ``missed`` where they do not.

    Newton's method along the ray.  From a point on the near side of the body it cannot fail, as g is convex along the
    ray; from the far side, from far outside, and where it passes the smallest g, it starts again at the bounding box.
    The last point lies within the tolerance of the surface; the caller takes the last step in first order.  For a miss
    it is the point of the smallest g, or q if even the bounding box is missed.  ``again`` (ROWS, LANES) is scratch.
    """
    _gauge(filled, parameters, lanes)
    for i in range(filled):
        missed[i] = lanes[_SLOPE, i] >= 0.0 or lanes[_G, i] > _FAR_OUTSIDE
    for _ in range(_HIT_STEPS):
        moving = 0
        for i in range(filled):
            over = 1.0 - lanes[_G, i]
            moves = abs(over) >= tolerance and lanes[_SLOPE, i] < 0.0 and not missed[i]
            lanes[_SHIFT, i] += over / lanes[_SLOPE, i] if moves else 0.0
            moving += moves
        if moving == 0:
            break
        _gauge(filled, parameters, lanes)
        for i in range(filled):
            missed[i] = missed[i] or lanes[_SLOPE, i] >= 0.0
    count = 0
    for i in range(filled):
        if missed[i]:
            for row in range(_QX, _SHIFT):
                again[row, count] = lanes[row, i]
            count += 1
    if count == 0:
        return
    _meet_from_box(count, tolerance, parameters, again)
    count = 0
    for i in range(filled):
        if missed[i]:
            for row in range(_SHIFT, _SLOPE + 1):
                lanes[row, i] = again[row, count]
            missed[i] = again[_WEIGHT, count] == 0.0
            count += 1


@kernel
def _meet_from_box(filled: int, tolerance: float, parameters: np.ndarray, lanes: np.ndarray) -> None:
    """The same from where the rays enter the bounding box; WEIGHT says whether one meets the surface, 1 or 0."""
    for i in range(filled):
        qx, qy, qz = lanes[_QX, i], lanes[_QY, i], lanes[_QZ, i]
        ex, ey, ez = lanes[_EX, i], lanes[_EY, i], lanes[_EZ, i]
        t_in, t_out = box_interval(qx, qy, qz, ex, ey, ez, parameters[0], parameters[1], parameters[2])
        inside = t_in <= t_out
        lanes[_WEIGHT, i] = 1.0 if inside else 0.0
        lanes[_SHIFT, i] = lanes[_LOW, i] = t_in if inside else 0.0
    _gauge(filled, parameters, lanes)
    for _ in range(_HIT_STEPS):
        moving = 0
        for i in range(filled):
            moves = lanes[_WEIGHT, i] > 0.0 and lanes[_SLOPE, i] < 0.0 and abs(lanes[_G, i] - 1.0) >= tolerance
            lanes[_LOW, i] = lanes[_SHIFT, i] if moves else lanes[_LOW, i]
            lanes[_SHIFT, i] += (1.0 - lanes[_G, i]) / lanes[_SLOPE, i] if moves else 0.0
            moving += moves
        if moving == 0:
            break
        _gauge(filled, parameters, lanes)
    # Newton's method passes the smallest g of a ray that misses: it lies between the last two points.
    passed = 0
    for i in range(filled):
        open_bracket = lanes[_WEIGHT, i] > 0.0 and lanes[_SLOPE, i] >= 0.0 and abs(lanes[_G, i] - 1.0) >= tolerance
        lanes[_HIGH, i] = lanes[_SHIFT, i]
        lanes[_LOW, i] = lanes[_LOW, i] if open_bracket else lanes[_SHIFT, i]
        lanes[_WEIGHT, i] = 0.0 if open_bracket else lanes[_WEIGHT, i]
        passed += open_bracket
    if passed > 0:
        above = np.empty(LANES, np.bool_)
        _lowest(filled, _ANY, _COVERED_TOLERANCE, parameters, lanes, above)


@kernel
def _rendered_rows(part: np.ndarray, terms: Terms, lanes: np.ndarray, missed: np.ndarray, block: np.ndarray) -> float:
    """Rendered and covered residuals: their cost, and in the block's first and last row their scale and value."""
    cost = 0.0
    for i in range(part.shape[0]):
        gx, gy, gz, along = lanes[_GX, i], lanes[_GY, i], lanes[_GZ, i], lanes[_SLOPE, i]
        ex, ey, ez = lanes[_EX, i], lanes[_EY, i], lanes[_EZ, i]
        square = gx * gx + gy * gy + gz * gz + _TINY
        over = lanes[_G, i] - 1.0
        across = terms.grazing * square * (ex * ex + ey * ey + ez * ez)
        covered = terms.outline_stiffness / math.sqrt(square)
        factor = covered if missed[i] else lanes[_STIFFNESS, i] / math.sqrt(along * along + across)
        short = lanes[_DEPTH, i] - lanes[_START, i] - lanes[_SHIFT, i]
        residual = over * covered if missed[i] else (short * along + over) * factor
        if terms.dead_zone > 0.0 and not missed[i]:
            excess = max(abs(residual) - terms.dead_zone, 0.0)
            factor = factor if excess > 0.0 else 0.0
            residual = math.copysign(excess, residual)
        loss, scale = huber_loss(residual, terms.outline_huber if missed[i] else terms.huber, lanes[_WEIGHT, i])
        if terms.inner_cauchy > 0.0 and residual < 0.0:
            loss, scale = cauchy_loss(residual, terms.inner_cauchy, lanes[_WEIGHT, i])
        cost += loss
        block[0, i] = scale * factor
        block[STEP_LENGTH, i] = scale * residual
    for i in range(part.shape[0]):
        reached = lanes[_START, i] + lanes[_SHIFT, i] - (lanes[_G, i] - 1.0) / lanes[_SLOPE, i]
        part[i, LAST] = lanes[_DEPTH, i] if missed[i] else reached
    return cost


@kernel
def _measured_rows(
    filled: int, stage: int, terms: Terms, parameters: np.ndarray, lanes: np.ndarray, block: np.ndarray
) -> float:
    """Classic or Sampson residuals at the measured points, likewise."""
    root_of_volume = math.sqrt(parameters[0] * parameters[1] * parameters[2])
    cost = 0.0
    for i in range(filled):
        gx, gy, gz, g = lanes[_GX, i], lanes[_GY, i], lanes[_GZ, i], lanes[_G, i]
        sampson = lanes[_STIFFNESS, i] / math.sqrt(gx * gx + gy * gy + gz * gz + _TINY)
        classic = (g + 1.0) * root_of_volume * lanes[_STIFFNESS, i]
        residual = (g - 1.0) * (classic if stage == CLASSIC else sampson)
        factor = 2.0 * g * root_of_volume * lanes[_STIFFNESS, i] if stage == CLASSIC else sampson
        loss, scale = huber_loss(residual, terms.huber, lanes[_WEIGHT, i])
        if terms.inner_cauchy > 0.0 and residual < 0.0:
            loss, scale = cauchy_loss(residual, terms.inner_cauchy, lanes[_WEIGHT, i])
        cost += loss
        block[0, i] = scale * factor
        block[STEP_LENGTH, i] = scale * residual
    return cost


@kernel
def _differentiate(filled: int, rotation: np.ndarray, lanes: np.ndarray, block: np.ndarray) -> None:
    """The derivatives of scale * g by a step, scale from the block's first row, into rows 0 to 10."""
    m11, m12, m13 = rotation[0]
    m21, m22, m23 = rotation[1]
    m31, m32, m33 = rotation[2]
    for i in range(filled):
        scale, shift = block[0, i], lanes[_SHIFT, i]
        x = lanes[_QX, i] + shift * lanes[_EX, i]
        y = lanes[_QY, i] + shift * lanes[_EY, i]
        z = lanes[_QZ, i] + shift * lanes[_EZ, i]
        gx, gy, gz = scale * lanes[_GX, i], scale * lanes[_GY, i], scale * lanes[_GZ, i]
        block[0, i], block[1, i], block[2, i] = -x * gx, -y * gy, -z * gz
        block[3, i], block[4, i] = scale * lanes[_G1, i], scale * lanes[_G2, i]
        block[5, i] = -(m11 * gx + m12 * gy + m13 * gz)
        block[6, i] = -(m21 * gx + m22 * gy + m23 * gz)
        block[7, i] = -(m31 * gx + m32 * gy + m33 * gz)
        block[8, i] = gy * z - gz * y
        block[9, i] = gz * x - gx * z
        block[10, i] = gx * y - gy * x


@inline_kernel
def _enter(
    ray: np.ndarray, terms: Terms, parameters: np.ndarray, rotation: np.ndarray, i: int, lanes: np.ndarray
) -> int:
    """Put a free ray into lane i if it crosses the bounding box in free space; 1 if so, 0 if not."""
    m = rotation
    x, y, z = ray[ORIGIN_X] - parameters[5], ray[ORIGIN_Y] - parameters[6], -parameters[7]
    dx, dy = ray[DIRECTION_X], ray[DIRECTION_Y]
    ox = m[0, 0] * x + m[1, 0] * y + m[2, 0] * z
    oy = m[0, 1] * x + m[1, 1] * y + m[2, 1] * z
    oz = m[0, 2] * x + m[1, 2] * y + m[2, 2] * z
    ex = m[0, 0] * dx + m[1, 0] * dy + m[2, 0]
    ey = m[0, 1] * dx + m[1, 1] * dy + m[2, 1]
    ez = m[0, 2] * dx + m[1, 2] * dy + m[2, 2]
    t_in, t_out = box_interval(ox, oy, oz, ex, ey, ez, parameters[0], parameters[1], parameters[2])
    low = max(t_in, _NEAREST if terms.pinhole > 0.0 else -1e300)
    high = min(t_out, ray[DEPTH])
    if low >= high:
        return 0
    lanes[_QX, i], lanes[_QY, i], lanes[_QZ, i], lanes[_EX, i], lanes[_EY, i], lanes[_EZ, i] = ox, oy, oz, ex, ey, ez
    lanes[_LOW, i], lanes[_HIGH, i] = low, high
    lanes[_STIFFNESS, i], lanes[_WEIGHT, i] = ray[STIFFNESS], ray[WEIGHT]
    return 1


@kernel
def _lowest(
    filled: int, matters: float, tolerance: float, parameters: np.ndarray, lanes: np.ndarray, missed: np.ndarray
) -> None:
    """The smallest gauge on each ray between LOW and HIGH, as far as it matters: shift and gauge there.

    Convexity brackets the minimum between two tangents; their intersection is a lower bound, and the search of a ray
    ends once that is above ``matters`` (``missed``) or within the tolerance of the best point.  The next point is the
    minimum of the cubic through both ends, exact for smooth g, or the intersection, exact for edges, by turns.
    """
    for i in range(filled):
        missed[i] = False
        lanes[_SHIFT, i] = lanes[_LOW, i]
    _gauge(filled, parameters, lanes)
    for i in range(filled):
        lanes[_G_LOW, i], lanes[_S_LOW, i] = lanes[_G, i], lanes[_SLOPE, i]
        lanes[_SHIFT, i] = lanes[_HIGH, i]
    _gauge(filled, parameters, lanes)
    for i in range(filled):
        lanes[_G_HIGH, i], lanes[_S_HIGH, i] = lanes[_G, i], lanes[_SLOPE, i]
        # A minimum at an end closes the bracket there.
        if lanes[_S_LOW, i] >= 0.0:
            lanes[_HIGH, i] = lanes[_LOW, i]
        elif lanes[_S_HIGH, i] <= 0.0:
            lanes[_LOW, i] = lanes[_HIGH, i]
        lanes[_SHIFT, i] = lanes[_HIGH, i]
    for step in range(_LOWEST_STEPS):
        searching = 0
        for i in range(filled):
            low, high, shift = lanes[_LOW, i], lanes[_HIGH, i], lanes[_SHIFT, i]
            g_low, g_high, s_low, s_high = lanes[_G_LOW, i], lanes[_G_HIGH, i], lanes[_S_LOW, i], lanes[_S_HIGH, i]
            width = high - low
            tangents = (g_low - g_high + s_high * width) / (s_high - s_low)
            bound = g_low + s_low * tangents
            open_bracket = width > 0.0
            missed[i] = missed[i] or (open_bracket and bound > matters)
            best = min(g_low, g_high)
            goes_on = open_bracket and not missed[i] and best - bound > tolerance
            bend = 3.0 * (g_low - g_high) / width + s_low + s_high
            root = math.sqrt(max(bend * bend - s_low * s_high, 0.0))
            cubic = width - width * (s_high + root - bend) / (s_high - s_low + 2.0 * root)
            ahead = tangents if step % 2 == 1 else cubic
            ahead = min(max(ahead, 0.02 * width), 0.98 * width)
            settled = (low if g_low < g_high else high) if open_bracket else shift
            lanes[_SHIFT, i] = low + ahead if goes_on else settled
            searching += goes_on
        _gauge(filled, parameters, lanes)
        if searching == 0:
            break
        for i in range(filled):
            shift, slope = lanes[_SHIFT, i], lanes[_SLOPE, i]
            within = shift > lanes[_LOW, i] and shift < lanes[_HIGH, i]
            above = within and slope > 0.0
            below = within and slope <= 0.0
            lanes[_HIGH, i] = shift if above else lanes[_HIGH, i]
            lanes[_G_HIGH, i] = lanes[_G, i] if above else lanes[_G_HIGH, i]
            lanes[_S_HIGH, i] = slope if above else lanes[_S_HIGH, i]
            lanes[_LOW, i] = shift if below else lanes[_LOW, i]
            lanes[_G_LOW, i] = lanes[_G, i] if below else lanes[_G_LOW, i]
            lanes[_S_LOW, i] = slope if below else lanes[_S_LOW, i]


@kernel
def _free_rows(
    filled: int,
    terms: Terms,
    parameters: np.ndarray,
    rotation: np.ndarray,
    lanes: np.ndarray,
    missed: np.ndarray,
    block: np.ndarray,
    sums: np.ndarray,
) -> float:
    """The residuals of free rays that cross the bounding box: their cost, added to the normal equations."""
    _lowest(filled, 1.0, _LOWEST_TOLERANCE, parameters, lanes, missed)
    cost = 0.0
    for i in range(filled):
        gx, gy, gz = lanes[_GX, i], lanes[_GY, i], lanes[_GZ, i]
        factor = -terms.outline_stiffness * lanes[_STIFFNESS, i] / math.sqrt(gx * gx + gy * gy + gz * gz + _TINY)
        residual = 0.0 if missed[i] else max(0.0, (lanes[_G, i] - 1.0) * factor)
        loss, scale = huber_loss(residual, terms.outline_huber, lanes[_WEIGHT, i])
        cost += loss
        block[0, i] = scale * factor if residual > 0.0 else 0.0
        block[STEP_LENGTH, i] = scale * residual
    if cost > 0.0:
        _differentiate(filled, rotation, lanes, block)
        add_block(block, filled, sums)
    return cost


@kernel
def surface_distance(rays: np.ndarray, parameters: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Absolute Sampson distance (n,) of the measured points to the surface, metres."""
    distance = np.empty(rays.shape[0])
    lanes = np.empty((_ROWS, LANES))
    for begin in range(0, rays.shape[0], LANES):
        part = rays[begin : begin + LANES]
        filled = part.shape[0]
        _place(part, False, parameters, rotation, lanes)
        _gauge(filled, parameters, lanes)
        for i in range(filled):
            gx, gy, gz = lanes[_GX, i], lanes[_GY, i], lanes[_GZ, i]
            distance[begin + i] = abs(lanes[_G, i] - 1.0) / math.sqrt(gx * gx + gy * gy + gz * gz + _TINY)
    return distance


@kernel
def penetration(free: np.ndarray, terms: Terms, parameters: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """How deep (n,) each free ray runs inside the body, metres: (1 - min g) / |grad g|, 0 for rays that miss it."""
    depth = np.zeros(free.shape[0])
    lanes = np.empty((_ROWS, LANES))
    missed = np.empty(LANES, np.bool_)
    owner = np.empty(LANES, np.int64)
    filled = 0
    for n in range(free.shape[0] + 1):
        if n < free.shape[0]:
            owner[filled] = n
            filled += _enter(free[n], terms, parameters, rotation, filled, lanes)
        if filled == LANES or (n == free.shape[0] and filled > 0):
            _lowest(filled, 1.0, _LOWEST_TOLERANCE, parameters, lanes, missed)
            for i in range(filled):
                gx, gy, gz = lanes[_GX, i], lanes[_GY, i], lanes[_GZ, i]
                inside = (1.0 - lanes[_G, i]) / math.sqrt(gx * gx + gy * gy + gz * gz + _TINY)
                depth[owner[i]] = 0.0 if missed[i] else max(inside, 0.0)
            filled = 0
    return depth
