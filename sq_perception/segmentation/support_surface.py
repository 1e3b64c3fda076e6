"""The support as a sensor shows it: a plane that its calibration bends.

Equation
--------
With the height h of a point above the plane and the growth g(z) of the noise, a table is where

    | h / g - b(x, y) | < tolerance,    b = b_0 + b_1 x + b_2 y + b_3 x^2 + b_4 x y + b_5 y^2,

x = (u - cx)/fx and y = (v - cy)/fy.  b is fitted to a band about itself again and again, so that it grows from the part
of a table that lies in one plane over all of it.  It is bounded by what the calibration of a depth camera may be off, a
share of the depth.

Metres and pixels.  Reference: P. J. Besl, R. C. Jain, Segmentation through variable-order surface fitting, IEEE PAMI 10
(1988).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sq_perception.geometry.kernels import kernel
from sq_perception.geometry.quantiles import deviation, quantile
from sq_perception.imaging.camera import Camera
from sq_perception.segmentation.support_plane import (
    LEAST_GROWTH,
    TOLERANCE,
    Plane,
    noise_growth,
)

_SAMPLES = 120
"""Samples along the shorter side of the image that the surface is fitted to."""
_ROUNDS = 6
"""Rounds of reweighting, at most: it ends when it is settled."""
_TERMS = 6
"""Coefficients of a quadratic surface."""
CLEARLY = 4.0
"""Standard deviations of the noise from which on a height is none of it."""
_DISTORTION = 0.02
"""Makers of depth cameras promise an error of at most 2 % of the depth."""


@dataclass(frozen=True, eq=False)
class SupportSurface:
    """A plane, and how the sensor bends it.

    Attributes
    ----------
    plane
        The support plane, with the noise about it.
    bend : (6,)
        Coefficients of the height at one metre, by 1, x, y, x^2, x y and y^2.
    limit
        The most that the surface bends, metres at one metre.
    sigma
        Standard deviation of the heights above the bent surface at a depth of one metre, metres.
    """

    plane: Plane
    bend: np.ndarray
    limit: float
    sigma: float

    @property
    def clear_height(self) -> float:
        """Height from which on something is clearly above the surface, metres at one metre of depth.

        Half of the tolerance is a compromise: bent depth of real cameras stays below, thin objects stay above.
        """
        return max(0.5 * TOLERANCE, CLEARLY * self.sigma)

    def image_relative(self, depth: np.ndarray, camera: Camera) -> np.ndarray:
        """Height, float32 (height, width), above the bent surface as at one metre of depth, 0 for depth 0; of a pinhole
        camera's depth image."""
        x = (np.arange(camera.width) - camera.cx) / camera.fx
        y = (np.arange(camera.height) - camera.cy) / camera.fy
        return np.asarray(_relative(depth, x, y, self.plane.equation, self.bend, self.limit))


def flat(plane: Plane) -> SupportSurface:
    """A plane that is not known to be bent."""
    return SupportSurface(plane, np.zeros(_TERMS), 0.0, plane.sigma)


def measured(plane: Plane, depth: np.ndarray, valid: np.ndarray, camera: Camera) -> SupportSurface:
    """The surface that a plane was seen as.

    Parameters
    ----------
    plane
        Found in this image.
    depth, valid : (height, width)
        Metres, and where they are a measurement.
    camera
        A pinhole camera.
    """
    k = max(1, min(depth.shape) // _SAMPLES)
    rows, columns = np.nonzero(valid[::k, ::k])
    points = camera.unproject(k * columns, k * rows, depth[::k, ::k][rows, columns])
    z = points[:, 2]
    x, y, growth = points[:, 0] / z, points[:, 1] / z, noise_growth(z)
    height = plane.height(points) / growth
    on = np.abs(height) < TOLERANCE
    if not on.any():
        return flat(plane)
    limit = _DISTORTION * quantile(z[on] / growth[on], 0.5)
    bend, off = np.zeros(_TERMS), height
    for _ in range(_ROUNDS):
        gram, right = _normal_equations(x, y, height, off)
        if gram[0, 0] < 10 * _TERMS:
            return flat(plane)
        bend = np.linalg.lstsq(gram, right, rcond=None)[0]
        off, is_settled = _off(x, y, height, bend, limit, off)
        if is_settled:
            break
    within = np.abs(off)
    return SupportSurface(plane, bend, limit, deviation(within[within < TOLERANCE]))


@kernel
def _normal_equations(
    x: np.ndarray, y: np.ndarray, height: np.ndarray, off: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The normal equations of b by least squares, from the heights of samples within the tolerance of the last b."""
    gram, right = np.zeros((_TERMS, _TERMS)), np.zeros(_TERMS)
    for i in range(len(x)):
        if abs(off[i]) < TOLERANCE:
            term = (1.0, x[i], y[i], x[i] * x[i], x[i] * y[i], y[i] * y[i])
            for j in range(_TERMS):
                right[j] += term[j] * height[i]
                for k in range(_TERMS):
                    gram[j, k] += term[j] * term[k]
    return gram, right


@kernel
def _off(
    x: np.ndarray, y: np.ndarray, height: np.ndarray, bend: np.ndarray, limit: float, last: np.ndarray
) -> tuple[np.ndarray, bool]:
    """Heights above a bent support, and whether those within the tolerance are the same as last time."""
    off, is_same = np.empty_like(height), True
    for i in range(len(x)):
        b = bend[0] + x[i] * (bend[1] + bend[3] * x[i] + bend[4] * y[i]) + y[i] * (bend[2] + bend[5] * y[i])
        off[i] = height[i] - min(max(b, -limit), limit)
        is_same &= (abs(off[i]) < TOLERANCE) == (abs(last[i]) < TOLERANCE)
    return off, is_same


@kernel
def _relative(
    depth: np.ndarray, x: np.ndarray, y: np.ndarray, plane: np.ndarray, bend: np.ndarray, limit: float
) -> np.ndarray:
    """The rest of a row is constant, and no pixel branches: a row becomes vector code."""
    height = np.empty(depth.shape, np.float32)
    for v in range(depth.shape[0]):
        slope, first = plane[1] * y[v] + plane[2], bend[0] + y[v] * (bend[2] + bend[5] * y[v])
        second = bend[1] + bend[4] * y[v]
        for u in range(depth.shape[1]):
            z = np.float64(depth[v, u])
            above = z * (plane[0] * x[u] + slope) + plane[3]
            off = first + x[u] * (second + bend[3] * x[u])
            relative = above / max(z * z, LEAST_GROWTH) - min(max(off, -limit), limit)
            height[v, u] = relative if z > 0 else 0.0
    return height
