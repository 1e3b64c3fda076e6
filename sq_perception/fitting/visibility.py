"""How much of a body's surface, and of each of its sizes, the camera saw.

Directions d, evenly over the unit sphere, meet the surface at q = d / g(d).  With Euler's theorem for the gauge,
d.grad g = g, the piece of surface behind a solid angle dw has the area

    dA = |q|^2 / cos(d, n) dw = |grad g| / g^3 dw

A piece is seen if it looks at the camera, falls on a pixel of the object, and lies where that pixel measured.
"""

from __future__ import annotations

import math

import numpy as np

from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.observation import Observation
from sq_perception.geometry.kernels import gauge_derivatives, kernel
from sq_perception.geometry.superquadric import Superquadric

_DIRECTIONS = 800
_TAIL = 0.01
"""Of the points, at either end: outliers."""
_NOISE_LEVELS, _PIXELS, _FLATTEST = 3.0, 1.5, 0.3
"""A measured depth may differ from the surface's by so many noise levels, and by what so many widths of a pixel across
the line of sight make along it; the cosine of incidence counts down to the last number."""


def visible_share(state: State, observation: Observation) -> float:
    """Share of the surface, 0 to 1, that the object's pixels measured."""
    c = observation.camera
    seen, total = _areas(
        state.parameters,
        state.rotation,
        observation.depth,
        observation.mask,
        (c.fx, c.fy, c.cx, c.cy),
        c.is_pinhole,
        _NOISE_LEVELS * observation.sigma,
        _PIXELS * observation.footprint,
    )
    return float(seen / total)


def seen_extents(body: Superquadric, points: np.ndarray) -> np.ndarray:
    """Share (3,) of each full size of a single body that points (n, 3) span along its axis, 0 to 1."""
    local = (points - body.translation) @ body.rotation_matrix
    low, high = np.quantile(local, [_TAIL, 1 - _TAIL], axis=0)
    low, high = np.maximum(low, -body.size), np.minimum(high, body.size)
    return np.clip((high - low) / (2 * body.size * (1 - 2 * _TAIL)), 0.0, 1.0)


@kernel
def _areas(
    parameters: np.ndarray,
    rotation: np.ndarray,
    depth: np.ndarray,
    mask: np.ndarray,
    intrinsics: tuple[float, float, float, float],
    pinhole: bool,
    noise: float,
    width: float,
) -> tuple[float, float]:
    """The seen and the whole surface."""
    a1, a2, a3, e1, e2, t1, t2, t3 = parameters
    fx, fy, cx, cy = intrinsics
    m = rotation
    turn = math.pi * (3.0 - math.sqrt(5.0))
    seen, total = 0.0, 0.0
    for i in range(_DIRECTIONS):
        # Fibonacci's spiral: equal steps in height, the golden angle between neighbours.
        dz = 1.0 - (2.0 * i + 1.0) / _DIRECTIONS
        across = math.sqrt(1.0 - dz * dz)
        dx, dy = across * math.cos(i * turn), across * math.sin(i * turn)
        g, gx, gy, gz, _, _ = gauge_derivatives(dx, dy, dz, a1, a2, a3, e1, e2)
        area = math.sqrt(gx * gx + gy * gy + gz * gz) / (g * g * g)
        total += area
        x = (m[0, 0] * dx + m[0, 1] * dy + m[0, 2] * dz) / g + t1
        y = (m[1, 0] * dx + m[1, 1] * dy + m[1, 2] * dz) / g + t2
        z = (m[2, 0] * dx + m[2, 1] * dy + m[2, 2] * dz) / g + t3
        rx, ry = (x / z, y / z) if pinhole else (x, y)
        nx = m[0, 0] * gx + m[0, 1] * gy + m[0, 2] * gz
        ny = m[1, 0] * gx + m[1, 1] * gy + m[1, 2] * gz
        nz = m[2, 0] * gx + m[2, 1] * gy + m[2, 2] * gz
        towards = nx * rx + ny * ry + nz if pinhole else nz
        if towards >= 0.0:
            continue
        u, v = math.floor(fx * rx + cx + 0.5), math.floor(fy * ry + cy + 0.5)
        if u < 0 or v < 0 or u >= depth.shape[1] or v >= depth.shape[0] or not mask[v, u]:
            continue
        cosine = -towards / math.sqrt((nx * nx + ny * ny + nz * nz) * (rx * rx + ry * ry + 1.0 if pinhole else 1.0))
        if abs(depth[v, u] - z) < noise + width / max(cosine, _FLATTEST):
            seen += area
    return seen, total
