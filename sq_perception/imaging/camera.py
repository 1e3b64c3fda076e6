"""Pinhole and orthographic cameras.

Conventions
-----------
Optical frame: x right, y down, z forward, metres.  A pixel's centre has integer coordinates (u, v) = (column, row).
A depth image holds, per pixel, the z coordinate of what the pixel sees: float, NaN where nothing was measured.

    pinhole         u = fx x / z + cx,   v = fy y / z + cy       (fx, fy in pixels)
    orthographic    u = fx x + cx,       v = fy y + cy           (fx, fy in pixels per metre)

Every pixel is a ray p = o + z d with d_z = 1 and o_z = 0, so that the ray parameter is the depth itself:

    pinhole         o = 0,  d = ((u - cx) / fx, (v - cy) / fy, 1)
    orthographic    o = ((u - cx) / fx, (v - cy) / fy, 0),  d = (0, 0, 1)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

Projection = Literal["pinhole", "orthographic"]
LEAST_DEPTH, GREATEST_DEPTH = 1e-4, 1e5
"""Depths, metres; no sensor measures beyond, and squares and products of numbers beyond are no numbers."""


class Lens(NamedTuple):
    """The numbers of a camera, as compiled code takes them."""

    fx: float
    fy: float
    cx: float
    cy: float
    is_pinhole: bool


@dataclass(frozen=True)
class Camera:
    """Intrinsics of one image; see the module for the equations.

    Raises ValueError for a size that is no whole number of pixels or below one, a focal length that is not positive, or
    of a pinhole camera up to one pixel, or anything not finite.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    projection: Projection = "pinhole"

    def __post_init__(self) -> None:
        if self.projection not in ("pinhole", "orthographic"):
            raise ValueError(f"projection: expected 'pinhole' or 'orthographic', got {self.projection!r}")
        if not all(isinstance(side, int | np.integer) and side >= 1 for side in (self.width, self.height)):
            raise ValueError(f"image size: expected whole numbers, at least 1 x 1, got {self.width} x {self.height}")
        numbers = [float(number) for number in (self.fx, self.fy, self.cx, self.cy)]
        if not all(map(math.isfinite, numbers)):
            raise ValueError(f"fx fy cx cy: expected finite numbers, got {numbers}")
        if self.fx <= 0 or self.fy <= 0:
            raise ValueError(f"focal lengths: expected positive, got fx = {self.fx:g}, fy = {self.fy:g}")
        if self.is_pinhole and min(self.fx, self.fy) <= 1:
            raise ValueError(
                f"focal lengths: expected pixels, some hundreds, got fx = {self.fx:g}, fy = {self.fy:g}: an identity "
                "in place of the camera's matrix, or one that was divided by the size of the image?"
            )

    @classmethod
    def from_matrix(cls, matrix: np.ndarray, width: int, height: int) -> Camera:
        """A pinhole camera from a 3 x 3 matrix K; one with skew, as no depth camera has any, or transposed is
        refused."""
        k = np.asarray(matrix, dtype=float)
        if k.shape != (3, 3):
            raise ValueError(f"camera matrix: expected 3 x 3, got {k.shape}")
        if abs(k[0, 1]) > 1e-6 * abs(k[0, 0]):
            raise ValueError(f"camera matrix: expected no skew, got {k[0, 1]:g}")
        camera = cls(width, height, float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]))
        if not np.allclose(k[2], [0, 0, 1]):
            turned = "; it seems to be transposed" if k[2, :2].any() and not k[:2, 2].any() else ""
            raise ValueError(f"camera matrix: expected 0 0 1 in its last row, got {k[2].tolist()}{turned}")
        return camera

    @property
    def matrix(self) -> np.ndarray:
        """The 3 x 3 matrix K."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    @cached_property
    def lens(self) -> Lens:
        """The numbers of the camera, for compiled code."""
        return Lens(float(self.fx), float(self.fy), float(self.cx), float(self.cy), self.is_pinhole)

    @property
    def is_pinhole(self) -> bool:
        return self.projection == "pinhole"

    def rays(self, u: np.ndarray | float, v: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
        """Origins and directions (..., 3) of pixels (...): p = origin + depth * direction."""
        u, v = np.broadcast_arrays(np.asarray(u, dtype=float), np.asarray(v, dtype=float))
        x, y, zero, one = (u - self.cx) / self.fx, (v - self.cy) / self.fy, np.zeros(u.shape), np.ones(u.shape)
        if self.is_pinhole:
            return np.stack([zero, zero, zero], axis=-1), np.stack([x, y, one], axis=-1)
        return np.stack([x, y, zero], axis=-1), np.stack([zero, zero, one], axis=-1)

    def unproject(self, u: np.ndarray, v: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Points (..., 3) in the optical frame of pixels (...) at the given depths (...)."""
        z = np.asarray(depth, dtype=float)
        scale = z if self.is_pinhole else np.ones_like(z)
        x, y = scale * ((np.asarray(u) - self.cx) / self.fx), scale * ((np.asarray(v) - self.cy) / self.fy)
        points = np.empty((*np.broadcast_shapes(x.shape, y.shape), 3))
        points[..., 0], points[..., 1], points[..., 2] = x, y, z
        return points

    def points(self, depth: np.ndarray) -> np.ndarray:
        """The organised cloud (height, width, 3) of a depth image; NaN where the depth is."""
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        return self.unproject(u, v, self.readings(depth))

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixel coordinates (..., 2) = (u, v) of points (..., 3); NaN for points not in front of a pinhole camera."""
        points = np.asarray(points, dtype=float)
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        scale: np.ndarray | float = 1.0
        if self.is_pinhole:
            scale = 1.0 / np.where(z > 0, z, np.nan)
        return np.stack([self.fx * x * scale + self.cx, self.fy * y * scale + self.cy], axis=-1)

    def cropped(self, left: int, top: int, width: int, height: int) -> Camera:
        """The camera of an image cut out at column ``left`` and row ``top``."""
        return Camera(width, height, self.fx, self.fy, self.cx - left, self.cy - top, self.projection)

    def readings(self, depth: np.ndarray) -> np.ndarray:
        """A depth image as a plain array, NaN where it is masked.  Raises ValueError unless it is a float image
        (height, width) of this camera's size: whole numbers are no metres."""
        image = np.asanyarray(depth)
        if image.ndim != 2 or image.dtype.kind != "f":
            given = f"{image.dtype} {image.shape}"
            raise ValueError(f"depth: expected a float image (height, width) in metres, got {given}")
        self.check_image(image)
        return np.asarray(np.ma.filled(image, np.nan))

    def check_image(self, image: np.ndarray) -> None:
        """Raise ValueError unless the image has this camera's size."""
        if image.ndim != 2:
            raise ValueError(f"expected an image (height, width), got an array of shape {image.shape}")
        if image.shape != (self.height, self.width):
            raise ValueError(
                f"image of {image.shape[1]} x {image.shape[0]} pixels does not fit a camera of "
                f"{self.width} x {self.height}"
            )
