"""Volume IoU of superquadrics with a convex hull.

The hull is cut into columns along z, a regular grid of them.  Column and hull, column and body meet in one interval
each, so that, with h and s those intervals and dA the area of a column,

    intersection = sum dA |h n s|,   IoU = intersection / (V_hull + V_body - intersection),

where the body's volume is known in closed form.  128 x 128 columns are within 0.1 % of the limit.

Metres, in the frame of the mesh.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from sq_perception.geometry import Superquadric
from sq_perception.geometry.kernels import in_object_frame, kernel, ray_interval

COLUMNS = 128


@dataclass(frozen=True)
class Columns:
    """A convex body cut into columns along z: where each begins and ends (n, n), empty where low > high."""

    corner: np.ndarray
    step: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray) -> Columns:
        """The columns of the convex hull of points (n, 3)."""
        hull = ConvexHull(points)
        lower, upper = hull.min_bound, hull.max_bound
        step = (upper[:2] - lower[:2]) / COLUMNS
        low, high = np.empty((2, COLUMNS, COLUMNS))
        _cut(np.ascontiguousarray(hull.equations), lower, upper, step, low, high)
        return cls(lower[:2] + step / 2, step, low, high)

    @property
    def volume(self) -> float:
        """Cubic metres."""
        return float(np.maximum(self.high - self.low, 0.0).sum() * np.prod(self.step))

    def iou(self, body: Superquadric) -> float:
        """Volume IoU with a single superquadric, 0 to 1."""
        flat, matrix = np.array(body.to_numbers(), dtype=float), np.ascontiguousarray(body.rotation_matrix, dtype=float)
        common = _common(flat, matrix, self.corner, self.step, self.low, self.high) * float(np.prod(self.step))
        return common / (self.volume + float(body.volume()) - common)


@kernel
def _cut(
    equations: np.ndarray, lower: np.ndarray, upper: np.ndarray, step: np.ndarray, low: np.ndarray, high: np.ndarray
) -> None:
    for i in range(low.shape[0]):
        for j in range(low.shape[1]):
            x, y = lower[0] + (i + 0.5) * step[0], lower[1] + (j + 0.5) * step[1]
            first, last = lower[2], upper[2]
            for k in range(equations.shape[0]):
                height = equations[k, 0] * x + equations[k, 1] * y + equations[k, 3]
                slope = equations[k, 2]
                if slope > 1e-12:
                    last = min(last, -height / slope)
                elif slope < -1e-12:
                    first = max(first, -height / slope)
                elif height > 0.0:
                    last = first - 1.0
            low[i, j], high[i, j] = first, last


@kernel
def _common(
    body: np.ndarray, m: np.ndarray, corner: np.ndarray, step: np.ndarray, low: np.ndarray, high: np.ndarray
) -> float:
    """Summed length of what the columns share with the body."""
    form = body[0], body[1], body[2], body[3], body[4], body[12], body[13]
    total = 0.0
    for i in range(low.shape[0]):
        for j in range(low.shape[1]):
            if low[i, j] >= high[i, j]:
                continue
            x, y = corner[0] + i * step[0] - body[5], corner[1] + j * step[1] - body[6]
            origin = in_object_frame(m, x, y, -body[7])
            hit, first, last = ray_interval(origin, (m[2, 0], m[2, 1], m[2, 2]), form)
            if hit:
                total += max(0.0, min(last, high[i, j]) - max(first, low[i, j]))
    return total
