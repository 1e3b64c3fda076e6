"""Starts from boxes around the measured points: along their principal axes, or standing on a support plane.

The oriented box of the visible points is a lower bound of the body in every direction; on a plane, its height is exact
as far as the top is seen.  What the camera does not see lies behind: the narrow side is also tried deeper.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.observation import span
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric

_START_EXPONENT = 0.3
"""Nearer to a box than to an ellipsoid; a few steps find the rest."""
ORDERS = np.array([[1, 2, 0], [2, 0, 1], [0, 1, 2]])
"""Which of three right-handed axes are x, y and z, so that each is z once."""


def enclosing_box(points: np.ndarray, footprint: float) -> Superquadric:
    """A valid box-like body around any points (n >= 1, 3): the best that is known when no fit is possible."""
    centre = points.mean(axis=0)
    axes = _axes_of(points)
    local = (points - centre) @ axes
    low, high = local.min(axis=0), local.max(axis=0)
    size = np.maximum((high - low) / 2, max(footprint, 1e-6))
    return Superquadric(size, np.array([0.2, 0.2]), centre + axes @ ((low + high) / 2), quaternions.from_matrix(axes))


def on_one_line(points: np.ndarray) -> bool:
    """Whether points (n >= 1, 3) spread along one direction only."""
    centred = points - points.mean(axis=0)
    spread = np.linalg.eigvalsh(centred.T @ centred)
    return bool(spread[1] <= 1e-6 * spread[2])


def principal(points: np.ndarray, deeper: bool = True) -> list[State]:
    """Boxes along the principal axes of the points, for each choice of z; deeper ones behind them if asked for."""
    return _box_states(points, _axes_of(points), deeper)


def on_plane(points: np.ndarray, plane: np.ndarray, deeper: bool = True) -> list[State]:
    """Boxes that stand on the plane: smallest rectangle around the footprint of the points, down to the plane."""
    axes = standing_axes(points, plane[:3])
    return _box_states(points, axes, deeper, ground=float(-plane[3] * plane[:3] @ axes[:, 2]))


def standing_axes(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Columns (3, 3): the sides of the smallest rectangle around the footprint of the points, and the unit normal."""
    x, y, z = normal
    first = np.array([y, -x, 0.0] if abs(z) < 0.9 else [0.0, z, -y])  # across z, or across x
    first /= np.linalg.norm(first)
    second = quaternions.cross(normal, first)
    flat = np.empty((len(points), 2), np.float32)
    flat[:, 0], flat[:, 1] = points @ first, points @ second
    (_, _), (_, _), angle = cv2.minAreaRect(flat)
    c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    return np.stack([c * first + s * second, -s * first + c * second, normal], axis=1)


def three_orders(axes: np.ndarray) -> list[np.ndarray]:
    """The rotations (3, 3) with these axes (columns, right-handed) whose z axis is each of them in turn."""
    return [np.ascontiguousarray(axes[:, order]) for order in ORDERS]


def principal_axes(moments: np.ndarray) -> np.ndarray:
    """Right-handed eigenvectors (3, 3), as columns."""
    _, axes = np.linalg.eigh(moments)
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    return axes


def _axes_of(points: np.ndarray) -> np.ndarray:
    centred = points - points.mean(axis=0)
    return principal_axes(centred.T @ centred)


def _box_states(points: np.ndarray, axes: np.ndarray, deeper: bool, ground: float | None = None) -> list[State]:
    """Boxes along the axes, as measured, and deeper on the narrow side; down to the ground on the third axis."""
    low, high = span(points, axes.T).T
    if ground is not None:
        low[2] = min(ground, high[2] - 1e-4)
    found = _ordered(low, high, axes)
    if not deeper:
        return found
    extents = high - low
    thin = int(np.argmin(extents[:2] if ground is not None else extents))
    seen_from_below = points.mean(axis=0) @ axes[:, thin] > 0
    for share in (0.5, 1.0):
        extra = share * float(extents.max()) - extents[thin]
        if extra > 0:
            more = np.where(np.arange(3) == thin, extra, 0.0)
            found += _ordered(low, high + more, axes) if seen_from_below else _ordered(low - more, high, axes)
    return found


def _ordered(low: np.ndarray, high: np.ndarray, axes: np.ndarray) -> list[State]:
    """The box from ``low`` to ``high`` along the axes (columns), for each choice of z."""
    parameters = np.full((len(ORDERS), 8), _START_EXPONENT)
    parameters[:, :3] = np.maximum((high - low) / 2, 1e-6)[ORDERS]
    parameters[:, 5:] = axes @ ((low + high) / 2)
    return [State(*each, math.inf, 0) for each in zip(parameters, three_orders(axes), strict=True)]
