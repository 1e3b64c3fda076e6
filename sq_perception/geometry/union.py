"""Unions of superquadrics, as numbers (k, 14) or, without tapers, (k, 12), compiled: the support of their hull, motion.

The hull of a union has the support function h(n) = max over the parts of n.t + h_part(R^T n).  Training draws
thousands of objects and needs it some ten times for each; :class:`Superquadric` computes it for one body at a time.

It is sampled in the directions of the 42 vertices of an icosahedron whose 20 faces were divided once.  They are the
same set after a reflection of any one coordinate, so that the mirrored image of a thing has the mirrored support
function: its values change places.
"""

from __future__ import annotations

from itertools import combinations

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


def _icosphere() -> np.ndarray:
    """Return the corners (12, 3) of a regular icosahedron, then the middles (30, 3) of its edges, of length 1."""
    golden = (1 + np.sqrt(5)) / 2
    corners = np.array([[0, a, b * golden] for a in (1, -1) for b in (1, -1)])
    corners = np.concatenate([np.roll(corners, k, axis=1) for k in range(3)])
    pairs = [(i, j) for i, j in combinations(range(12), 2) if np.linalg.norm(corners[i] - corners[j]) < 2.2]
    middles = np.array([corners[i] + corners[j] for i, j in pairs])
    points = np.concatenate([corners, middles])
    points = points / np.linalg.norm(points, axis=1, keepdims=True)
    points.flags.writeable = False
    return points


DIRECTIONS = _icosphere()  # (42, 3) unit vectors, read only


def mirrored(axis: int) -> np.ndarray:
    """Return indices (42,) of the directions after coordinate ``axis`` changes its sign; its own inverse."""
    image = DIRECTIONS * np.where(np.arange(3) == axis, -1, 1)
    return np.asarray(np.argmax(image @ DIRECTIONS.T, axis=1))
