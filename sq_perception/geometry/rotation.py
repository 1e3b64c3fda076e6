"""Rotations as unit quaternions in ROS order, x y z w.

Conventions
-----------
A quaternion q = (x, y, z, w) turns object coordinates into parent coordinates: p_parent = R(q) p_object
(thesis, equation 3.8).  Products read like matrix products: R(q r) = R(q) R(r).  q and -q are the same rotation.
Every function takes NumPy arrays or torch tensors with leading batch dimensions and answers in kind.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from array_api_compat import array_namespace

Array = Any  # a NumPy array or a torch tensor


def normalize(quaternion: Array) -> Array:
    """Scale quaternions (..., 4) to unit length; a zero quaternion becomes NaN, as there is no rotation to name."""
    if _is_one(quaternion):
        return quaternion / np.sqrt(quaternion @ quaternion)
    xp = array_namespace(quaternion)
    return quaternion / xp.sqrt(xp.sum(quaternion * quaternion, axis=-1, keepdims=True))


def multiply(left: Array, right: Array) -> Array:
    """Return the Hamilton product (..., 4): first the right rotation, then the left one."""
    x1, y1, z1, w1 = _components(left)
    x2, y2, z2, w2 = _components(right)
    product = [
        w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
        w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
        w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
    ]
    return _join(product, left, right)


def conjugate(quaternion: Array) -> Array:
    """Return the inverse of unit quaternions (..., 4)."""
    xp = array_namespace(quaternion)
    return xp.concat([-quaternion[..., :3], quaternion[..., 3:]], axis=-1)


def to_matrix(quaternion: Array) -> Array:
    """Return rotation matrices (..., 3, 3) of quaternions (..., 4) of any non-zero length (thesis, equation 3.8)."""
    x, y, z, w = _components(quaternion)
    square = x * x + y * y + z * z + w * w
    s = 2 / square if not _is_one(quaternion) or square > 0 else math.nan
    entries = [
        1 - s * (y * y + z * z),
        s * (x * y - z * w),
        s * (x * z + y * w),
        s * (x * y + z * w),
        1 - s * (x * x + z * z),
        s * (y * z - x * w),
        s * (x * z - y * w),
        s * (y * z + x * w),
        1 - s * (x * x + y * y),
    ]
    return _join(entries, quaternion).reshape((*quaternion.shape[:-1], 3, 3))


def from_matrix(matrix: Array) -> Array:
    """Return unit quaternions (..., 4) of rotation matrices (..., 3, 3).

    The four products 4 q_i q_j are read off the matrix for each choice of i; the row with the largest q_i is the well
    conditioned one (Shepperd 1978).  Only that row is divided by its root, so gradients stay finite for every rotation.
    """
    if isinstance(matrix, np.ndarray) and matrix.ndim == 2:
        squares, rows = _products(matrix.tolist())
        return normalize(np.array(rows[squares.index(max(squares))], dtype=matrix.dtype))
    xp = array_namespace(matrix)
    squares, rows = _products([[matrix[..., i, j] for j in range(3)] for i in range(3)])
    best = xp.argmax(xp.stack(squares, axis=-1), axis=-1)
    row = xp.stack(rows[0], axis=-1)
    for i in range(1, 4):
        row = xp.where((best == i)[..., None], xp.stack(rows[i], axis=-1), row)
    return normalize(row)


def _products(m: list[list[Any]]) -> tuple[list[Any], list[list[Any]]]:
    """Return the products 4 q_i q_j of a matrix's quaternion: those of i = j, and the rows of all."""
    xx, yy = 1 + m[0][0] - m[1][1] - m[2][2], 1 - m[0][0] + m[1][1] - m[2][2]
    zz, ww = 1 - m[0][0] - m[1][1] + m[2][2], 1 + m[0][0] + m[1][1] + m[2][2]
    xy, xz, yz = m[0][1] + m[1][0], m[0][2] + m[2][0], m[1][2] + m[2][1]
    xw, yw, zw = m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]
    return [xx, yy, zz, ww], [[xx, xy, xz, xw], [xy, yy, yz, yw], [xz, yz, zz, zw], [xw, yw, zw, ww]]


def from_rotation_vector(vector: Array) -> Array:
    """Return unit quaternions (..., 4) of rotation vectors (..., 3), axis times angle, smooth through zero."""
    xp = array_namespace(vector)
    square = xp.sum(vector * vector, axis=-1, keepdims=True)
    small = square < 1e-12
    angle = xp.sqrt(xp.where(small, xp.ones_like(square), square))
    half_sinc = xp.where(small, 0.5 - square / 48, xp.sin(angle / 2) / angle)
    cosine = xp.where(small, 1 - square / 8, xp.cos(angle / 2))
    return xp.concat([vector * half_sinc, cosine], axis=-1)


def to_rotation_vector(quaternion: Array) -> Array:
    """Return rotation vectors (..., 3) of unit quaternions (..., 4), at most pi long, smooth through zero."""
    xp = array_namespace(quaternion)
    sign = xp.where(quaternion[..., 3:] < 0, -xp.ones_like(quaternion[..., 3:]), xp.ones_like(quaternion[..., 3:]))
    vector, cosine = sign * quaternion[..., :3], sign * quaternion[..., 3:]
    square = xp.sum(vector * vector, axis=-1, keepdims=True)
    small = square < 1e-12
    sine = xp.sqrt(xp.where(small, xp.ones_like(square), square))
    return vector * xp.where(small, 2 + square / 3, 2 * xp.atan2(sine, cosine) / sine)


def from_six(six: Array) -> Array:
    """Return unit quaternions (..., 4) of the 6D form (..., 6), two orthonormalised columns (Zhou et al. 2019)."""
    xp = array_namespace(six)
    first = _unit(six[..., :3])
    second = six[..., 3:]
    second = _unit(second - xp.sum(first * second, axis=-1, keepdims=True) * first)
    third = cross(first, second)
    return from_matrix(xp.stack([first, second, third], axis=-1))


def cross(left: Array, right: Array) -> Array:
    """Return the vector product of (..., 3) arrays."""
    a1, a2, a3 = _components(left)
    b1, b2, b3 = _components(right)
    return _join([a2 * b3 - a3 * b2, a3 * b1 - a1 * b3, a1 * b2 - a2 * b1], left, right)


def random(count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw ``count`` uniformly distributed rotations as quaternions (count, 4) (Shoemake 1992)."""
    u = rng.random((count, 3))
    inner, outer = np.sqrt(1 - u[:, 0]), np.sqrt(u[:, 0])
    a, b = 2 * math.pi * u[:, 1], 2 * math.pi * u[:, 2]
    return np.stack([inner * np.sin(a), inner * np.cos(a), outer * np.sin(b), outer * np.cos(b)], axis=-1)


def geodesic_angle(left: Array, right: Array) -> Array:
    """Return the angle in radians, 0 to pi, of the rotation between two unit quaternions (..., 4)."""
    xp = array_namespace(left, right)
    difference = multiply(conjugate(left), right)
    vector = xp.sqrt(xp.sum(difference[..., :3] ** 2, axis=-1))
    return 2 * xp.atan2(vector, xp.abs(difference[..., 3]))


def _is_one(array: Array) -> bool:
    """Return whether this is one NumPy vector: Python computes with its numbers ten times as fast as NumPy."""
    return isinstance(array, np.ndarray) and array.ndim == 1


def _components(array: Array) -> Any:
    """Return the entries along the last axis: numbers of one NumPy vector, arrays otherwise."""
    return array.tolist() if _is_one(array) else [array[..., k] for k in range(array.shape[-1])]


def _join(components: list[Any], *parts: Array) -> Array:
    """Join components that were computed from those of ``parts`` in one array."""
    if type(components[0]) in (float, int):
        return np.array(components, dtype=np.result_type(*parts, np.float32))
    return array_namespace(*parts).stack(components, axis=-1)


def _unit(vector: Array) -> Array:
    xp = array_namespace(vector)
    square = xp.sum(vector * vector, axis=-1, keepdims=True)
    return vector / xp.sqrt(square + 1e-12)
