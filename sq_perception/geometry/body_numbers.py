"""Which numbers are those of a superquadric."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

LENGTHS = {"size": 3, "shape": 2, "translation": 3, "rotation": 4}
_LEAST_SQUARE = 1e-18
"""Of the length of a quaternion."""


def floating(part: Any) -> np.ndarray:
    """An array of single or double precision."""
    part = np.asarray(part)
    return part if part.dtype == np.float64 else part.astype(np.result_type(part.dtype, np.float32), copy=False)


def is_body(size: list[float], shape: list[float], translation: list[float], rotation: list[float]) -> bool:
    """Whether :func:`check` lets these numbers pass: so few are checked ten times as fast in Python."""
    return (
        all(map(math.isfinite, (*size, *shape, *translation, *rotation)))
        and min(size) > 0
        and min(shape) > 0
        and max(shape) <= 2
        and sum(q * q for q in rotation) >= _LEAST_SQUARE
    )


def check(parts: list[np.ndarray]) -> None:
    """Raise ValueError unless these size, shape, translation and rotation are those of bodies."""
    for name, part in zip(LENGTHS, parts, strict=True):
        if not np.isfinite(part).all():
            raise ValueError(f"{name}: expected finite numbers, got {part}")
    size, shape, _, rotation = parts
    if (size <= 0).any():
        raise ValueError(f"size: expected positive half sizes, got {size}")
    if ((shape <= 0) | (shape > 2)).any():
        raise ValueError(f"shape: expected exponents in (0, 2], got {shape}")
    if (np.einsum("...i,...i->...", rotation, rotation) < _LEAST_SQUARE).any():
        raise ValueError("rotation: expected a quaternion of non-zero length")
