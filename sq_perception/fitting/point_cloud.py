"""A point cloud made ready to be fitted: the same numbers, whatever its frame, its scale, its order and its density.

Coordinates are taken along the principal axes of the cloud, about its median, in units of its radius (root mean
square).  A cloud of more points than a fit needs is thinned evenly in space: along a curve that visits neighbours one
after the other (G. M. Morton 1966), every so manieth point stays, so that the share of outliers stays too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sq_perception.fitting.point_cost import Cloud
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.kernels import kernel
from sq_perception.geometry.superquadric import Superquadric

_NEIGHBOURS = 9
"""Points in a neighbourhood, its middle included, that tell how dense a cloud is there."""
_PROBE_STEP, _PROBE_WEIGHT = 0.05, 100.0
"""How far along the normals probes lie, in radii of the cloud, and the weight of their squared distance: a quarter of
what a point weighs whose noise is as large."""
_BITS = 10
"""Cells of Morton's curve along an axis, as a power of 2."""


@dataclass(frozen=True, eq=False)
class UnitCloud:
    """A cloud in its own frame: p = centre + scale axes q.

    Attributes
    ----------
    points : (n, 3)
        q, along Morton's curve.
    normals : (n, 3) or None
        Outward, in the same frame.
    centre, axes, scale
        The cloud's frame: (3,) metres, a rotation (3, 3), metres.
    """

    points: np.ndarray
    normals: np.ndarray | None
    centre: np.ndarray
    axes: np.ndarray
    scale: float

    @classmethod
    def of(cls, points: np.ndarray, normals: np.ndarray | None, most: int) -> UnitCloud:
        """The cloud of finite points (n, 3), at most so many of them."""
        centre = np.median(points, axis=0)
        centred = points - centre
        scale = float(np.sqrt(np.mean(np.einsum("ij,ij->i", centred, centred)))) or 1.0
        centred /= scale
        _, axes = np.linalg.eigh(centred.T @ centred)
        skew = np.sum((centred @ axes) ** 3, axis=0)
        axes = axes * np.where(skew < 0, -1.0, 1.0)
        if np.linalg.det(axes) < 0:
            axes[:, 0] *= -1
        centred = centred @ axes
        order = np.argsort(_morton(centred), kind="stable")
        if len(order) > most:
            order = order[np.linspace(0, len(order) - 1, most).astype(int)]
        turned = None
        if normals is not None:
            length = np.linalg.norm(normals[order], axis=1, keepdims=True)
            turned = normals[order] @ axes / np.where(length > 0, length, 1.0)
        return cls(np.ascontiguousarray(centred[order]), turned, centre, axes, scale)

    @property
    def extent(self) -> float:
        """Half of the diagonal of the box, in units of the cloud."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0))) / 2

    @property
    def background(self) -> float:
        """Density of outliers, which may be anywhere in the box."""
        sides = np.ptp(self.points, axis=0)
        return 1 / float(np.prod(np.maximum(sides, 0.01 * max(float(sides.max()), 1e-9))))

    def surface(self, count: int | None = None) -> Cloud:
        """About ``count`` points, or all of them; normals give each a probe on either side."""
        step = 1 if count is None else max(1, round(len(self.points) / count))
        points = np.ascontiguousarray(self.points[::step])
        if self.normals is None:
            return Cloud(points, np.empty((0, 3)), np.empty(0), np.empty(0, np.int64), self.background, 0.0)
        step_out = _PROBE_STEP * self.normals[::step]
        owners = np.tile(np.arange(len(points)), 2)
        sides = np.repeat([1.0, -1.0], len(points))
        probes = np.concatenate([points + step_out, points - step_out])
        return Cloud(points, probes, sides, owners, self.background, _PROBE_WEIGHT)

    def body(self, numbers: np.ndarray, turn: np.ndarray) -> Superquadric:
        """A body (10,) with its rotation (3, 3) in the frame of the user."""
        return Superquadric(
            numbers[0:3] * self.scale, numbers[3:5], self.centre + self.scale * (self.axes @ numbers[5:8]),
            quaternions.from_matrix(self.axes @ turn), numbers[8:10],
        )


def densest(points: np.ndarray, share: float) -> np.ndarray:
    """The points (n, 3) with the nearest neighbours, this share of all."""
    from scipy.spatial import cKDTree  # here: a node that recovers does without

    reach = cKDTree(points).query(points, k=min(_NEIGHBOURS, len(points)))[0][:, -1]
    return points[np.argsort(reach, kind="stable")[: max(3, round(share * len(points)))]]


def _morton(points: np.ndarray) -> np.ndarray:
    """The place (n,) of points along Morton's curve."""
    low = points.min(axis=0)
    side = max(float((points.max(axis=0) - low).max()), 1e-300)
    return _interleaved(((points - low) / side * ((1 << _BITS) - 1)).astype(np.int64))


@kernel
def _interleaved(cells: np.ndarray) -> np.ndarray:
    code = np.zeros(cells.shape[0], np.int64)
    for i in range(cells.shape[0]):
        for bit in range(_BITS):
            for k in range(3):
                code[i] |= ((cells[i, k] >> bit) & 1) << (3 * bit + k)
    return code
