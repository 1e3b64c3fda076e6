"""Signed distance to superquadrics, for planners: a lower bound, its gradient, and what the body's doubt takes from it.

A convex body with the support function h is where n.p <= h(n) for all unit n, so that its signed distance is

    s(p) = max over unit n of  n.p - h(n)                                  (p relative to the centre)

and each single n gives a lower bound, outside and inside.  With the gauge g, every point y has one whose h is known:
the plane {x: grad g(y).x = 1} supports the body, so

    s(p) >= (grad g(y).p - 1) / |grad g(y)|.

At y = p this is the Sampson distance; y then goes to the foot of p on the plane found, twice: the foot on the surface
is the y of the exact distance.  The planes of the bounding box join.  The result is the largest, and its gradient the
normal of that plane.  A tapered body, with exponents up to 1, is bounded by the planes of its hull with these normals.

Doubt: with the covariance C of the parameters, the distance to one plane has the variance J C J^T, J = (-dh/da, -dh/de,
-n, m x dh/dm) for sizes, exponents, centre and rotation vector, m = R^T n; k of its standard deviations are taken off.

Union: the smallest of its bodies' distances; a lower bound outside of all, and inside of that of the deepest.

Reference for h: :meth:`Superquadric.support`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sq_perception.geometry.kernels import gauge_derivatives, in_object_frame, kernel, support, support_derivatives

_LANES = 64
_OF_COVARIANCE = 11


def signed_distance(
    body: Any, points: np.ndarray, covariance: np.ndarray | None = None, k_sigma: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return a lower bound (n,) of the signed distance of points to the nearest body, metres, negative inside.

    And its gradient (n, 3), unit vectors.  ``body``: Superquadric, one or a batch (k,), NumPy.  ``points`` (n, 3): in
    the parent frame, metres.  ``covariance`` (11, 11) or (k, 11, 11): that of :class:`sq_perception.fitting.fit.Fit`,
    needed for ``k_sigma``, the standard deviations of the distance that are taken off, 0 or more.

    Raises ValueError if the arguments have the wrong form, or deviations are asked for that are not known.
    """
    points = np.ascontiguousarray(points, dtype=float)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points: expected shape (n, 3), got {points.shape}")
    if len(body.batch_shape) > 1 or body.batch_shape == (0,):
        raise ValueError(f"expected one body or a batch (k,) of them, got shape {body.batch_shape}")
    if not (math.isfinite(k_sigma) and k_sigma >= 0):
        raise ValueError(f"k_sigma: expected 0 or more, got {k_sigma}")
    numbers = np.ascontiguousarray(np.reshape(body.to_numbers(), (-1, 14)), dtype=float)
    turns = np.ascontiguousarray(np.reshape(body.rotation_matrix, (-1, 3, 3)), dtype=float)
    doubts = np.zeros((len(numbers), _OF_COVARIANCE, _OF_COVARIANCE))
    if k_sigma > 0:
        if covariance is None or not np.isfinite(covariance).all():
            raise ValueError("k_sigma: expected 0 for bodies without a covariance")
        doubts[:] = np.reshape(covariance, (-1, *np.shape(covariance)[-2:]))[:, :_OF_COVARIANCE, :_OF_COVARIANCE]
    return _nearest(numbers, turns, doubts, float(k_sigma), points)


@kernel
def _nearest(
    numbers: np.ndarray, turns: np.ndarray, doubts: np.ndarray, k_sigma: float, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    n = points.shape[0]
    distance, gradient = np.full(n, np.inf), np.zeros((n, 3))
    best, normal = np.empty(_LANES), np.empty((3, _LANES))
    for first in range(0, n, _LANES):
        count = min(_LANES, n - first)
        for k in range(numbers.shape[0]):
            _bound(points, first, count, numbers[k], turns[k], best, normal)
            if k_sigma > 0.0:
                for i in range(count):
                    n1, n2, n3 = normal[0, i], normal[1, i], normal[2, i]
                    best[i] -= k_sigma * _deviation(n1, n2, n3, numbers[k], turns[k], doubts[k])
            m = turns[k]
            for i in range(count):
                if best[i] < distance[first + i] or best[i] != best[i]:
                    distance[first + i] = best[i]
                    for j in range(3):
                        gradient[first + i, j] = (
                            m[j, 0] * normal[0, i] + m[j, 1] * normal[1, i] + m[j, 2] * normal[2, i]
                        )
    return distance, gradient


@kernel
def _bound(
    points: np.ndarray, first: int, count: int, body: np.ndarray, m: np.ndarray, best: np.ndarray, normal: np.ndarray
) -> None:
    """Write the bound for up to 64 points from ``first``, and the normal of its plane in the object's frame."""
    a1, a2, a3, e1, e2, t1, t2, t3 = body[0], body[1], body[2], body[3], body[4], body[5], body[6], body[7]
    k1, k2 = body[12], body[13]
    b1, b2 = a1 * (1.0 + abs(k1)), a2 * (1.0 + abs(k2))
    p, foot = np.empty((3, _LANES)), np.empty((3, _LANES))
    for i in range(_LANES):
        at = first + min(i, count - 1)
        x, y, z = in_object_frame(m, points[at, 0] - t1, points[at, 1] - t2, points[at, 2] - t3)
        p[0, i], p[1, i], p[2, i] = x, y, z
        foot[0, i], foot[1, i], foot[2, i] = x, y, z
        # The box: outside of it the distance to its nearest point, inside that to its nearest face.
        u, v, w = abs(x) - b1, abs(y) - b2, abs(z) - a3
        ou, ov, ow = max(u, 0.0), max(v, 0.0), max(w, 0.0)
        beyond = math.sqrt(ou * ou + ov * ov + ow * ow)
        face = max(u, v, w)
        is_out = beyond > 0.0
        scale = 1.0 / (beyond if is_out else 1.0)
        best[i] = beyond if is_out else face
        normal[0, i] = math.copysign(ou * scale if is_out else (1.0 if u == face else 0.0), x)
        normal[1, i] = math.copysign(ov * scale if is_out else (1.0 if (v == face) & (u != face) else 0.0), y)
        last = 1.0 if (w == face) & (u != face) & (v != face) else 0.0
        normal[2, i] = math.copysign(ow * scale if is_out else last, z)
    g, reach = np.empty((3, _LANES)), np.empty(_LANES)
    # Planes a point: at itself and at two feet.
    for _ in range(3):
        for i in range(_LANES):
            x, y, z = foot[0, i], foot[1, i], foot[2, i]
            _, gx, gy, gz, _, _, _, _ = gauge_derivatives(x, y, z, a1, a2, a3, e1, e2, k1, k2)
            # Added to a squared gradient, which is 0 in the centre alone.
            scale = 1.0 / math.sqrt(gx * gx + gy * gy + gz * gz + 1e-24)
            g[0, i], g[1, i], g[2, i], reach[i] = gx * scale, gy * scale, gz * scale, scale
        if k1 != 0.0 or k2 != 0.0:
            for i in range(count):
                # 1 / |grad g|, metres, above which there is no normal: in the centre.
                if reach[i] < 1e11:
                    reach[i] = support(g[0, i], g[1, i], g[2, i], a1, a2, a3, e1, e2, k1, k2)
        for i in range(_LANES):
            gx, gy, gz = g[0, i], g[1, i], g[2, i]
            bound = gx * p[0, i] + gy * p[1, i] + gz * p[2, i] - reach[i]
            is_better = bound > best[i]
            best[i] = bound if is_better else best[i]
            normal[0, i] = gx if is_better else normal[0, i]
            normal[1, i] = gy if is_better else normal[1, i]
            normal[2, i] = gz if is_better else normal[2, i]
            foot[0, i], foot[1, i], foot[2, i] = p[0, i] - bound * gx, p[1, i] - bound * gy, p[2, i] - bound * gz


@kernel
def _deviation(mx: float, my: float, mz: float, body: np.ndarray, turn: np.ndarray, covariance: np.ndarray) -> float:
    """Return the sigma of the distance to the support plane with the normal (mx, my, mz) in the object's frame."""
    a1, a2, a3 = body[0], body[1], body[2]
    _, sx, sy, sz, h_e1, h_e2, _, _ = support_derivatives(mx, my, mz, a1, a2, a3, body[3], body[4], body[12], body[13])
    slope = np.empty(_OF_COVARIANCE)
    slope[0], slope[1], slope[2] = -mx * sx / a1, -my * sy / a2, -mz * sz / a3
    slope[3], slope[4] = -h_e1, -h_e2
    for j in range(3):
        slope[5 + j] = -(turn[j, 0] * mx + turn[j, 1] * my + turn[j, 2] * mz)
    slope[8], slope[9], slope[10] = my * sz - mz * sy, mz * sx - mx * sz, mx * sy - my * sx
    variance = 0.0
    for i in range(_OF_COVARIANCE):
        for j in range(_OF_COVARIANCE):
            variance += slope[i] * covariance[i, j] * slope[j]
    return math.sqrt(max(variance, 0.0))
