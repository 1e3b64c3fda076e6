"""A depth image on a coarse grid: every k-th row and column, which is enough to see what is large.

Rows and columns of the grid are counted by its samples, k pixels apart; points are in the optical frame, metres.
"""

from __future__ import annotations

import numpy as np

from sq_perception.imaging import depth_steps
from sq_perception.imaging.camera import Camera

_SAMPLES = 120
"""Samples along the shorter side of the image that surfaces are searched on."""


def stride(shape: tuple[int, ...]) -> int:
    """Pixels from a sample of a coarse image to the next."""
    return max(1, min(shape) // _SAMPLES)


def samples(depth: np.ndarray, valid: np.ndarray, camera: Camera) -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
    """Every k-th pixel of an image that is valid: k, rows and columns counted by it, and points (n, 3)."""
    k = stride(depth.shape)
    rows, columns = np.nonzero(valid[::k, ::k])
    return k, rows, columns, camera.unproject(k * columns, k * rows, depth[::k, ::k][rows, columns])


def connected_parts(rows: np.ndarray, columns: np.ndarray, on: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The number, from 1, of the connected part that each sample (n,) of a coarse image of this shape belongs to.

    Parts are those of the samples that are set in ``on``, bool (n,); the others have 0.
    """
    mask = np.zeros(shape, bool)
    mask[rows[on], columns[on]] = True
    return np.asarray(depth_steps.components(mask)[rows, columns])
