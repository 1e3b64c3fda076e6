"""Volume IoU of superquadrics with a convex hull, and the superquadric that has the most of it: the oracle.

The hull is cut into columns along z, a regular grid of them.  Column and hull, column and body meet in one interval
each, so that, with h and s those intervals and dA the area of a column,

    intersection = sum dA |h n s|,   IoU = intersection / (V_hull + V_body - intersection),

where the body's volume is known in closed form.  128 x 128 columns are within 0.1 % of the limit.

The oracle sees the whole noise-free hull: least squares of the Sampson distance of points all over it, from every
order of the axes and sharp to round exponents, then IoU itself by the method of Nelder and Mead, from the best few.
Its exponents keep to the bounds of the fits, so that nothing is asked of them that they are not allowed.

Metres, in the frame of the mesh.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.optimize import least_squares, minimize
from scipy.spatial import ConvexHull

from sq_perception.fitting import options
from sq_perception.geometry import Superquadric
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.kernels import in_object_frame, kernel, ray_interval

COLUMNS = 128
POLISH_COLUMNS = 64
SURFACE_POINTS = 1000
EXPONENTS = ((0.2, 0.2), (0.2, 0.9), (0.9, 0.9))
STARTS_EVALUATIONS = 25
POLISHED = 4
POLISH_EVALUATIONS = 3000
_SEED = 41


@dataclass(frozen=True)
class Columns:
    """A convex body cut into columns along z: where each begins and ends (n, n), empty where low > high."""

    corner: np.ndarray
    step: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray, count: int = COLUMNS) -> Columns:
        """The columns of the convex hull of points (n, 3)."""
        hull = ConvexHull(points)
        lower, upper = hull.min_bound, hull.max_bound
        step = (upper[:2] - lower[:2]) / count
        low, high = np.empty((count, count)), np.empty((count, count))
        _cut(np.ascontiguousarray(hull.equations), lower, upper, step, low, high)
        return cls(lower[:2] + step / 2, step, low, high)

    @property
    def volume(self) -> float:
        """Cubic metres."""
        return float(np.maximum(self.high - self.low, 0.0).sum() * np.prod(self.step))

    def iou(self, body: Superquadric) -> float:
        """Volume IoU with a single superquadric, 0 to 1."""
        flat, matrix = np.array(body.to_flat(), dtype=float), np.ascontiguousarray(body.rotation_matrix, dtype=float)
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
    form = body[0], body[1], body[2], body[3], body[4]
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


def oracle(hull: trimesh.Trimesh) -> Superquadric:
    """The superquadric with the largest volume IoU with a convex mesh."""
    points = trimesh.sample.sample_surface(hull, SURFACE_POINTS, seed=_SEED)[0]
    columns = Columns.of(hull.vertices, POLISH_COLUMNS)
    bodies = [_least_squares(start, points) for start in _starts(hull, points)]
    bodies.sort(key=columns.iou, reverse=True)
    return max((_polished(body, columns) for body in bodies[:POLISHED]), key=Columns.of(hull.vertices).iou)


def _starts(hull: trimesh.Trimesh, points: np.ndarray) -> list[Superquadric]:
    """Every order of the axes of the smallest box and of the principal axes, as they are and turned by 45 degrees."""
    box, _ = trimesh.bounds.oriented_bounds(hull)
    starts = []
    for axes in (box[:3, :3].T, np.linalg.eigh(np.cov(points.T))[1]):
        axes = axes * np.sign(np.linalg.det(axes))
        for order in range(3):
            for degrees in (0, 45):
                turn = quaternions.to_matrix(quaternions.from_rotation_vector(np.array([0, 0, np.deg2rad(degrees)])))
                frame = np.roll(axes, order, axis=1) @ turn
                along = points @ frame
                middle = (along.min(axis=0) + along.max(axis=0)) / 2
                half = np.ptp(along, axis=0) / 2
                for shape in EXPONENTS:
                    rotation = quaternions.from_matrix(frame)
                    starts.append(Superquadric(half, np.array(shape), frame @ middle, rotation))
    return starts


def _moved(start: Superquadric, change: np.ndarray) -> Superquadric:
    """The body changed by log sizes (3), exponents (2), shares of its sizes (3) and a rotation vector (3)."""
    size = start.size * np.exp(np.clip(change[:3], -3, 3))
    shape = np.clip(start.shape + change[3:5], *options.EXPONENTS)
    translation = start.translation + start.rotation_matrix @ (change[5:8] * start.size)
    turn = quaternions.multiply(start.rotation, quaternions.from_rotation_vector(change[8:11]))
    return Superquadric(size, shape, translation, turn)


def _least_squares(start: Superquadric, points: np.ndarray) -> Superquadric:
    found = least_squares(
        lambda change: _moved(start, change).sampson_distance(points) / start.size.min(),
        np.zeros(11),
        diff_step=1e-5,
        max_nfev=STARTS_EVALUATIONS,
    )
    return _moved(start, found.x)


def _polished(start: Superquadric, columns: Columns) -> Superquadric:
    simplex = np.vstack([np.zeros(11), np.diag([0.05] * 3 + [0.1] * 2 + [0.03] * 3 + [0.05] * 3)])
    # An exponent at its upper limit must move inwards, or its corner of the simplex is the start itself.
    simplex[[4, 5], [3, 4]] *= np.where(start.shape > np.mean(options.EXPONENTS), -1.0, 1.0)
    found = minimize(
        lambda change: -columns.iou(_moved(start, change)),
        np.zeros(11),
        method="Nelder-Mead",
        options={
            "initial_simplex": simplex,
            "maxfev": POLISH_EVALUATIONS,
            "xatol": 1e-4,
            "fatol": 1e-5,
            "adaptive": True,
        },
    )
    return _moved(start, found.x)
