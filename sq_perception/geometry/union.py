"""Unions of superquadrics, as numbers (k, 14) or, without tapers, (k, 12), compiled: the support of their hull, motion.

The hull of a union has the support function h(n) = max over the parts of n.t + h_part(R^T n).  Training draws
thousands of objects and needs it some ten times for each; :class:`Superquadric` computes it for one body at a time.
"""

from __future__ import annotations

import numpy as np

from sq_perception.geometry.kernels import in_object_frame, kernel, support
from sq_perception.geometry.superquadric import Superquadric


def support_of_union(parts: Superquadric, directions: np.ndarray) -> np.ndarray:
    """Return max n.p over the hull of a batch (k,) of NumPy bodies, for directions n (J, 3), shape (J,)."""
    return flat_support(np.ascontiguousarray(parts.to_numbers(), dtype=float), np.asarray(directions, dtype=float))


@kernel
def flat_support(flat: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the support function (J,) of :func:`support_of_union`, for flat parameters (k, 12 or 14)."""
    reach = np.full(directions.shape[0], -np.inf)
    for k in range(flat.shape[0]):
        m = _matrix(flat[k, 8:12])
        k1, k2 = (flat[k, 12], flat[k, 13]) if flat.shape[1] > 12 else (0.0, 0.0)
        for j in range(directions.shape[0]):
            x, y, z = directions[j]
            nx, ny, nz = in_object_frame(m, x, y, z)
            far = x * flat[k, 5] + y * flat[k, 6] + z * flat[k, 7]
            far += support(nx, ny, nz, flat[k, 0], flat[k, 1], flat[k, 2], flat[k, 3], flat[k, 4], k1, k2)
            reach[j] = max(reach[j], far)
    return reach


@kernel
def move(flat: np.ndarray, rotation: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Return flat parameters (k, 12 or 14) after p -> R p + shift, with the rotation as a unit quaternion (4,)."""
    m = _matrix(rotation)
    out = flat.copy()
    a, b, c, d = rotation
    for k in range(flat.shape[0]):
        for axis in range(3):
            out[k, 5 + axis] = shift[axis]
            for other in range(3):
                out[k, 5 + axis] += m[axis, other] * flat[k, 5 + other]
        x, y, z, w = flat[k, 8:12]
        out[k, 8] = d * x + a * w + b * z - c * y
        out[k, 9] = d * y - a * z + b * w + c * x
        out[k, 10] = d * z + a * y - b * x + c * w
        out[k, 11] = d * w - a * x - b * y - c * z
    return out


@kernel
def _matrix(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) of a unit quaternion (4,)."""
    x, y, z, w = quaternion
    m = np.empty((3, 3))
    m[0, 0], m[0, 1], m[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    m[1, 0], m[1, 1], m[1, 2] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    m[2, 0], m[2, 1], m[2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
    return m
