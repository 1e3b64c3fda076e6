"""Checks that numbers are those of a superquadric."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

LENGTHS = {"size": 3, "shape": 2, "translation": 3, "rotation": 4, "taper": 2}
LARGEST_TAPER = 0.95  # largest |k|: at 1 a body ends in a point, and the equation divides by 0 there
LEAST_CONJUGATE = 1e-3
"""Least 2 - e, the exponent of the dual norm: 0 would be the maximum of an octahedron, from which this differs by at
most 0.04 % for each norm, and without a division by 0."""
_LEAST_SQUARE = 1e-18  # least squared length of a quaternion


def floating(part: Any) -> np.ndarray:
    """Return an array of single or double precision."""
    part = np.asarray(part)
    return part if part.dtype == np.float64 else part.astype(np.result_type(part.dtype, np.float32), copy=False)


def one_body(parts: list[Any]) -> np.ndarray | None:
    """Check size, shape, translation, rotation, which becomes a unit quaternion, and taper of one NumPy body: (14,).
    So few numbers are checked ten times as fast in Python.  None for anything else, numbers of no body included."""
    for part in parts:
        if not (type(part) is np.ndarray and part.ndim == 1 and part.dtype == np.float64):
            return None
    size, shape, translation, rotation, taper = (part.tolist() for part in parts)
    if (len(size), len(shape), len(translation), len(rotation), len(taper)) != (3, 2, 3, 4, 2):
        return None
    x, y, z, w = rotation
    square = x * x + y * y + z * z + w * w
    # A sum is finite where all of its numbers are.
    is_finite = math.isfinite(square + sum(size) + sum(translation) + sum(taper))
    is_body = min(size) > 0 and min(shape) > 0 and max(shape) <= 2 and max(map(abs, taper)) <= LARGEST_TAPER
    if not (is_finite and is_body and square >= _LEAST_SQUARE):
        return None
    length = math.sqrt(square)
    numbers = np.array([*size, *shape, *translation, x / length, y / length, z / length, w / length, *taper])
    numbers.flags.writeable = False
    return numbers


def check_turn(parts: list[np.ndarray]) -> np.ndarray:
    """Check size, shape, translation, rotation and taper; return unit quaternions (..., 4).  Raises ValueError unless
    these are the numbers of bodies."""
    for name, part in zip(LENGTHS, parts, strict=True):
        if not np.isfinite(part).all():
            raise ValueError(f"{name}: expected finite numbers, got {part}")
    size, shape, _, rotation, taper = parts
    if (size <= 0).any():
        raise ValueError(f"size: expected positive half sizes, got {size}")
    if ((shape <= 0) | (shape > 2)).any():
        raise ValueError(f"shape: expected exponents in (0, 2], got {shape}")
    if (np.abs(taper) > LARGEST_TAPER).any():
        raise ValueError(f"taper: expected numbers from -{LARGEST_TAPER} to {LARGEST_TAPER}, got {taper}")
    with np.errstate(over="ignore"):
        square = np.einsum("...i,...i->...", rotation, rotation)
    if not ((square >= _LEAST_SQUARE) & np.isfinite(square)).all():
        raise ValueError(f"rotation: expected a quaternion of non-zero, finite length, got {rotation}")
    return rotation / np.sqrt(square)[..., None]
