"""How close two superquadrics are: volume IoU.

IoU counts grid points inside either and both bodies (equation 5.1).  Bodies are convex (e <= 2), so a grid column meets
each in one interval, and points are counted per column from the interval's ends: exact for the grid, at the cost of a
surface instead of a volume.  Of one that tapers and is not convex all between its first and last point counts.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from sq_perception.geometry.kernels import in_object_frame, kernel, parallel_kernel, ray_interval
from sq_perception.geometry.superquadric import Superquadric


def thesis_iou(prediction: Superquadric, truth: Superquadric, resolution: int = 64) -> np.ndarray:
    """Compute IoU on the thesis' grid: ``resolution``^3 points of the unit cube, ends included; cube frame.  What lies
    outside of the cube does not count, and two bodies that both lie outside have IoU 0."""
    count = _batch(prediction, truth)
    return _iou(prediction, truth, np.zeros((count, 3)), np.ones((count, 3)), resolution)


def volume_iou(prediction: Superquadric, truth: Superquadric, resolution: int = 64) -> np.ndarray:
    """Compute IoU of whole bodies anywhere: ``resolution``^3 points of the box around both."""
    lower, upper = (np.reshape(corner, (-1, 3)) for corner in prediction.bounding_box())
    truth_lower, truth_upper = (np.reshape(corner, (-1, 3)) for corner in truth.bounding_box())
    _batch(prediction, truth)
    return _iou(prediction, truth, np.minimum(lower, truth_lower), np.maximum(upper, truth_upper), resolution)


def _batch(prediction: Superquadric, truth: Superquadric) -> int:
    if prediction.batch_shape != truth.batch_shape or len(truth.batch_shape) > 1:
        raise ValueError(
            f"expected two single bodies or two batches (n,), got {prediction.batch_shape} and {truth.batch_shape}"
        )
    return int(np.prod(truth.batch_shape))


def _iou(a: Superquadric, b: Superquadric, lower: np.ndarray, upper: np.ndarray, resolution: int) -> np.ndarray:
    if resolution < 2:
        raise ValueError(f"expected a resolution of at least 2 points an axis, got {resolution}")
    flats = [np.ascontiguousarray(body.to_numbers().reshape(-1, 14), dtype=float) for body in (a, b)]
    matrices = [np.ascontiguousarray(body.rotation_matrix.reshape(-1, 3, 3), dtype=float) for body in (a, b)]
    out = np.empty(len(flats[0]))
    _iou_batch(flats[0], matrices[0], flats[1], matrices[1], lower, upper, resolution, out)
    return out.reshape(a.batch_shape)


@kernel
def _column(body: np.ndarray, m: np.ndarray, x: float, y: float, z0: float, step: float, count: int) -> tuple[int, int]:
    """Return first and last grid index inside the body on the column (x, y, z0 + k step)."""
    origin = in_object_frame(m, x - body[5], y - body[6], z0 - body[7])
    form = body[0], body[1], body[2], body[3], body[4], body[12], body[13]
    hit, first, last = ray_interval(origin, (m[2, 0], m[2, 1], m[2, 2]), form)
    if not hit:
        return 0, -1
    return max(0, math.ceil(first / step - 1e-9)), min(count - 1, math.floor(last / step + 1e-9))


@parallel_kernel
def _iou_batch(
    a: np.ndarray, a_matrix: np.ndarray, b: np.ndarray, b_matrix: np.ndarray, lower: np.ndarray, upper: np.ndarray,
    resolution: int, out: np.ndarray,
) -> None:
    for k in numba.prange(a.shape[0]):
        step = (upper[k] - lower[k]) / (resolution - 1)
        in_a = in_b = in_both = 0
        for i in range(resolution):
            for j in range(resolution):
                x, y = lower[k, 0] + i * step[0], lower[k, 1] + j * step[1]
                a_first, a_last = _column(a[k], a_matrix[k], x, y, lower[k, 2], step[2], resolution)
                b_first, b_last = _column(b[k], b_matrix[k], x, y, lower[k, 2], step[2], resolution)
                in_a += max(0, a_last - a_first + 1)
                in_b += max(0, b_last - b_first + 1)
                in_both += max(0, min(a_last, b_last) - max(a_first, b_first) + 1)
        union = in_a + in_b - in_both
        out[k] = in_both / union if union > 0 else 0.0
