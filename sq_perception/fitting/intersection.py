"""Rays and a superquadric, a block of rays at a time: where they meet it, and how near they pass; compiled.

A block is an array ``lanes`` (ROWS, LANES), one ray per column, its values in the rows named below, in the object
frame.  Every line of the mathematics is a loop over the block without a branch, which the compiler turns into vector
code.  Lanes in use are a multiple of a vector's length (:func:`padded`): one lane takes as long as eight.

The gauge g is convex along a ray, or nearly so for bodies that taper.  Where the ray enters the body, g = 1 with a
falling slope, is found by Newton's method; how near a ray that misses passes, by a bracket around the smallest g.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np

from sq_perception.fitting.cost import LANES, Ray, Terms
from sq_perception.geometry.kernels import Form, gauge_derivatives, in_object_frame, inline_kernel, inside_box, kernel

Lane = IntEnum(
    "Lane",
    # The ray in the object frame, q + shift e; the gauge there and its derivatives, the last one along the ray.
    "QX QY QZ EX EY EZ SHIFT G GX GY GZ G1 G2 GK1 GK2 SLOPE "
    # What the pixel measured, 1 / sigma and weight of the ray, the depth of q, OFFSET and SIDE.
    "MEASURED PRECISION SHARE START EXPECTED ONE_SIDED "
    # A bracket around the smallest gauge.
    "LOW HIGH G_LOW G_HIGH S_LOW S_HIGH",
    start=0,
)
"""Rows of a ray in a block."""
ROWS = len(Lane)
_VECTOR = 8
"""Doubles of the longest vectors of today's processors, 512 bits."""
LOWEST_TOLERANCE = 1e-9
"""How near to a lower bound of the smallest gauge on a ray the search for it ends."""


@kernel
def place(part: np.ndarray, met: np.ndarray, parameters: np.ndarray, rotation: np.ndarray, lanes: np.ndarray) -> None:
    """Write object rays, in the object frame, to the lanes; q at the measured depth, or where they met the body before,
    if any such depths are given."""
    t1, t2, t3 = parameters[5], parameters[6], parameters[7]
    m11, m12, m13 = rotation[0]
    m21, m22, m23 = rotation[1]
    m31, m32, m33 = rotation[2]
    for i in range(part.shape[0]):
        dx, dy = part[i, Ray.DIRECTION_X], part[i, Ray.DIRECTION_Y]
        start = met[i] if met.shape[0] > 0 else part[i, Ray.DEPTH]
        x, y, z = part[i, Ray.ORIGIN_X] - t1 + start * dx, part[i, Ray.ORIGIN_Y] - t2 + start * dy, start - t3
        lanes[Lane.QX, i] = m11 * x + m21 * y + m31 * z
        lanes[Lane.QY, i] = m12 * x + m22 * y + m32 * z
        lanes[Lane.QZ, i] = m13 * x + m23 * y + m33 * z
        lanes[Lane.EX, i] = m11 * dx + m21 * dy + m31
        lanes[Lane.EY, i] = m12 * dx + m22 * dy + m32
        lanes[Lane.EZ, i] = m13 * dx + m23 * dy + m33
        lanes[Lane.SHIFT, i] = 0.0
        lanes[Lane.MEASURED, i] = part[i, Ray.DEPTH]
        lanes[Lane.PRECISION, i], lanes[Lane.SHARE, i] = part[i, Ray.STIFFNESS], part[i, Ray.WEIGHT]
        lanes[Lane.EXPECTED, i], lanes[Lane.ONE_SIDED, i] = part[i, Ray.OFFSET], part[i, Ray.SIDE]
        lanes[Lane.START, i] = start


@kernel
def padded(count: int, lanes: np.ndarray) -> int:
    """The number of lanes to work on: ``count`` and repetitions of the last, without weight, up to whole vectors."""
    filled = (count + _VECTOR - 1) // _VECTOR * _VECTOR
    for i in range(count, filled):
        lanes[:, i] = lanes[:, count - 1]
        lanes[Lane.SHARE, i] = 0.0
    return filled


@inline_kernel
def form_of(parameters: np.ndarray) -> Form:
    """The sizes, exponents and tapers of ``parameters``."""
    return parameters[0], parameters[1], parameters[2], parameters[3], parameters[4], parameters[8], parameters[9]


@kernel
def gauge_along(filled: int, parameters: np.ndarray, lanes: np.ndarray) -> None:
    """Write the gauge and its derivatives at q + shift e to the lanes."""
    a1, a2, a3, e1, e2, k1, k2 = form_of(parameters)
    for i in range(filled):
        ex, ey, ez, shift = lanes[Lane.EX, i], lanes[Lane.EY, i], lanes[Lane.EZ, i], lanes[Lane.SHIFT, i]
        x, y, z = lanes[Lane.QX, i] + shift * ex, lanes[Lane.QY, i] + shift * ey, lanes[Lane.QZ, i] + shift * ez
        g, gx, gy, gz, g1, g2, gk1, gk2 = gauge_derivatives(x, y, z, a1, a2, a3, e1, e2, k1, k2)
        lanes[Lane.G, i], lanes[Lane.GX, i], lanes[Lane.GY, i], lanes[Lane.GZ, i] = g, gx, gy, gz
        lanes[Lane.G1, i], lanes[Lane.G2, i], lanes[Lane.GK1, i], lanes[Lane.GK2, i] = g1, g2, gk1, gk2
        lanes[Lane.SLOPE, i] = gx * ex + gy * ey + gz * ez


@kernel
def meet(
    filled: int, tolerance: float, parameters: np.ndarray, lanes: np.ndarray, missed: np.ndarray, again: np.ndarray
) -> None:
    """Find where the rays meet the surface: shift along the ray and the gauge there; ``missed`` where they do not.

    Newton's method along the ray.  From a point on the near side of the body it cannot fail, as g is convex along the
    ray; from the far side, from far outside, and where it passes the smallest g, it starts again at the bounding box.
    The last point lies within the tolerance of the surface; the caller takes the last step in first order.  For a miss
    it is the point of the smallest g, or q if even the bounding box is missed.  ``again`` (ROWS, LANES) is scratch.
    """
    gauge_along(filled, parameters, lanes)
    for i in range(filled):
        missed[i] = lanes[Lane.SLOPE, i] >= 0.0 or lanes[Lane.G, i] > 2.0
    _approach(filled, tolerance, parameters, lanes, missed)
    count = 0
    for i in range(filled):
        missed[i] = missed[i] or lanes[Lane.SLOPE, i] >= 0.0
        if missed[i]:
            for row in range(Lane.QX, Lane.SHIFT):
                again[row, count] = lanes[row, i]
            count += 1
    if count == 0:
        return
    beside = np.empty(LANES, np.bool_)
    _meet_from_box(padded(count, again), tolerance, parameters, again, beside)
    count = 0
    for i in range(filled):
        if missed[i]:
            for row in range(Lane.SHIFT, Lane.MEASURED):
                lanes[row, i] = again[row, count]
            missed[i] = beside[count]
            count += 1


@kernel
def _approach(filled: int, tolerance: float, parameters: np.ndarray, lanes: np.ndarray, missed: np.ndarray) -> None:
    """Go by Newton's method towards the surface along rays that do not miss, while g falls; LOW is the point before."""
    for _ in range(12):  # at most: it converges quadratically, most rays need 2
        moving = 0
        for i in range(filled):
            over = 1.0 - lanes[Lane.G, i]
            moves = abs(over) >= tolerance and lanes[Lane.SLOPE, i] < 0.0 and not missed[i]
            lanes[Lane.LOW, i] = lanes[Lane.SHIFT, i] if moves else lanes[Lane.LOW, i]
            lanes[Lane.SHIFT, i] += over / lanes[Lane.SLOPE, i] if moves else 0.0
            moving += moves
        if moving == 0:
            break
        gauge_along(filled, parameters, lanes)


@kernel
def _meet_from_box(
    filled: int, tolerance: float, parameters: np.ndarray, lanes: np.ndarray, missed: np.ndarray
) -> None:
    """As :func:`meet`, from where the rays enter the bounding box."""
    for i in range(filled):
        qx, qy, qz = lanes[Lane.QX, i], lanes[Lane.QY, i], lanes[Lane.QZ, i]
        ex, ey, ez = lanes[Lane.EX, i], lanes[Lane.EY, i], lanes[Lane.EZ, i]
        t_in, t_out = inside_box((qx, qy, qz), (ex, ey, ez), form_of(parameters))
        missed[i] = not t_in <= t_out
        lanes[Lane.SHIFT, i] = lanes[Lane.LOW, i] = 0.0 if missed[i] else t_in
    gauge_along(filled, parameters, lanes)
    _approach(filled, tolerance, parameters, lanes, missed)
    # Newton's method passes the smallest g of a ray that misses: it lies between the last two points.
    passed = 0
    for i in range(filled):
        is_off = not missed[i] and abs(lanes[Lane.G, i] - 1.0) >= tolerance
        open_bracket = is_off and lanes[Lane.SLOPE, i] >= 0.0
        lanes[Lane.HIGH, i] = lanes[Lane.SHIFT, i]
        lanes[Lane.LOW, i] = lanes[Lane.LOW, i] if open_bracket else lanes[Lane.SHIFT, i]
        missed[i] = missed[i] or open_bracket
        passed += open_bracket
    if passed > 0:
        above = np.empty(LANES, np.bool_)
        lowest(filled, 1e300, 1e-6, parameters, lanes, above)  # any distance matters


@inline_kernel
def enter(
    ray: np.ndarray, terms: Terms, parameters: np.ndarray, rotation: np.ndarray, i: int, lanes: np.ndarray
) -> int:
    """Put a free ray into lane i if it crosses the bounding box in free space; 1 if so, 0 if not."""
    x, y, z = ray[Ray.ORIGIN_X] - parameters[5], ray[Ray.ORIGIN_Y] - parameters[6], -parameters[7]
    origin = in_object_frame(rotation, x, y, z)
    way = in_object_frame(rotation, ray[Ray.DIRECTION_X], ray[Ray.DIRECTION_Y], 1.0)
    t_in, t_out = inside_box(origin, way, form_of(parameters))
    low = max(t_in, 1e-3 if terms.pinhole > 0.0 else -1e300)  # from a millimetre before a pinhole camera on
    high = min(t_out, ray[Ray.DEPTH])
    if low >= high:
        return 0
    lanes[Lane.QX, i], lanes[Lane.QY, i], lanes[Lane.QZ, i] = origin
    lanes[Lane.EX, i], lanes[Lane.EY, i], lanes[Lane.EZ, i] = way
    lanes[Lane.LOW, i], lanes[Lane.HIGH, i] = low, high
    lanes[Lane.PRECISION, i], lanes[Lane.SHARE, i] = ray[Ray.STIFFNESS], ray[Ray.WEIGHT]
    return 1


@kernel
def lowest(
    filled: int, matters: float, tolerance: float, parameters: np.ndarray, lanes: np.ndarray, missed: np.ndarray
) -> None:
    """Find the smallest gauge on each ray between LOW and HIGH, as far as it matters: shift and gauge there.

    Convexity brackets the minimum between two tangents; their intersection is a lower bound, and the search of a ray
    ends once that is above ``matters`` (``missed``) or within the tolerance of the best point.  The next point is the
    minimum of the cubic through both ends, exact for smooth g, or the intersection, exact for edges, by turns.
    """
    for i in range(filled):
        missed[i] = False
        lanes[Lane.SHIFT, i] = lanes[Lane.LOW, i]
    gauge_along(filled, parameters, lanes)
    for i in range(filled):
        lanes[Lane.G_LOW, i], lanes[Lane.S_LOW, i] = lanes[Lane.G, i], lanes[Lane.SLOPE, i]
        lanes[Lane.SHIFT, i] = lanes[Lane.HIGH, i]
    gauge_along(filled, parameters, lanes)
    for i in range(filled):
        lanes[Lane.G_HIGH, i], lanes[Lane.S_HIGH, i] = lanes[Lane.G, i], lanes[Lane.SLOPE, i]
        # A minimum at an end closes the bracket there.
        if lanes[Lane.S_LOW, i] >= 0.0:
            lanes[Lane.HIGH, i] = lanes[Lane.LOW, i]
        elif lanes[Lane.S_HIGH, i] <= 0.0:
            lanes[Lane.LOW, i] = lanes[Lane.HIGH, i]
        lanes[Lane.SHIFT, i] = lanes[Lane.HIGH, i]
    for step in range(20):  # at most
        searching = 0
        for i in range(filled):
            low, high, shift = lanes[Lane.LOW, i], lanes[Lane.HIGH, i], lanes[Lane.SHIFT, i]
            g_low, g_high = lanes[Lane.G_LOW, i], lanes[Lane.G_HIGH, i]
            s_low, s_high = lanes[Lane.S_LOW, i], lanes[Lane.S_HIGH, i]
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
            lanes[Lane.SHIFT, i] = low + ahead if goes_on else settled
            searching += goes_on
        gauge_along(filled, parameters, lanes)
        if searching == 0:
            break
        for i in range(filled):
            shift, slope = lanes[Lane.SHIFT, i], lanes[Lane.SLOPE, i]
            within = shift > lanes[Lane.LOW, i] and shift < lanes[Lane.HIGH, i]
            above = within and slope > 0.0
            below = within and slope <= 0.0
            lanes[Lane.HIGH, i] = shift if above else lanes[Lane.HIGH, i]
            lanes[Lane.G_HIGH, i] = lanes[Lane.G, i] if above else lanes[Lane.G_HIGH, i]
            lanes[Lane.S_HIGH, i] = slope if above else lanes[Lane.S_HIGH, i]
            lanes[Lane.LOW, i] = shift if below else lanes[Lane.LOW, i]
            lanes[Lane.G_LOW, i] = lanes[Lane.G, i] if below else lanes[Lane.G_LOW, i]
            lanes[Lane.S_LOW, i] = slope if below else lanes[Lane.S_LOW, i]
