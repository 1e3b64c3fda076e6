"""Lens distortion as OpenCV and ROS describe it: where a lens puts what a pinhole camera would see elsewhere.

Both sides are normalised: (x, y) is the ray (x, y, 1) of the ideal pinhole camera, (x', y') the place of its image, so
that the raw pixel is (fx x' + cx, fy y' + cy).  With s = r^2 = x^2 + y^2,

    plumb_bob, rational_polynomial     D = k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tx ty]]]]
        q  = (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3)
        x' = q x + 2 p1 x y + p2 (s + 2 x^2)
        y' = q y + p1 (s + 2 y^2) + 2 p2 x y

    equidistant (fisheye)              D = k1 k2 k3 k4
        x' = q x,  y' = q y,  q = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) / r,  theta = atan r

The polynomials only describe a lens as long as a ray farther out has its image farther out.  Beyond, where they turn
back and would show the scene a second time, both maps give NaN, as they do for rays within a thousandth of a radian of
the image plane, which no pinhole image can hold.

The inverse has no closed form.  Newton's method solves for both coordinates at once, from a start that a table of
r -> r' gives: three to five steps to 1e-15.  OpenCV's undistortPoints does not converge where distortion is strong.

Reference: OpenCV, Camera Calibration and 3D Reconstruction; J. Kannala and S. Brandt, A generic camera model and
calibration method for conventional, wide-angle, and fish-eye lenses, PAMI 2006; REP 104.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

FISHEYE = "equidistant"
POLYNOMIAL = ("plumb_bob", "rational_polynomial")
MODELS = (*POLYNOMIAL, FISHEYE)


@dataclass(frozen=True)
class Distortion:
    """One lens; see the module for the equations.

    model: One of ``MODELS``.
    coefficients: In OpenCV's order.  As for OpenCV, their number determines the terms, for plumb_bob and
        rational_polynomial alike: 4, 5, 8, or 12 and 14 where thin prism and tilt are zero.

    Raises ValueError for another model, another number of coefficients, a coefficient that is not finite or absurdly
    large, thin prism or tilt.
    """

    model: str
    coefficients: tuple[float, ...]

    def __post_init__(self) -> None:
        largest = 1e6  # the largest coefficient; whatever is larger is no lens
        if self.model not in MODELS:
            raise ValueError(f"distortion_model: expected {', '.join(MODELS)}, got {self.model!r}")
        given: Sequence[float] = self.coefficients
        coefficients = tuple(float(value) for value in given)
        lengths = {**dict.fromkeys(POLYNOMIAL, (4, 5, 8, 12, 14)), FISHEYE: (4,)}[self.model]
        if len(coefficients) not in lengths:
            expected = " or ".join(map(str, lengths))
            raise ValueError(f"distortion {self.model}: expected {expected} coefficients, got {len(coefficients)}")
        if not all(abs(value) <= largest for value in coefficients):
            numbers = " ".join(f"{value:g}" for value in coefficients)
            raise ValueError(f"distortion {self.model}: expected finite coefficients up to {largest:g}, got {numbers}")
        if self.model in POLYNOMIAL and any(coefficients[8:]):
            raise ValueError(f"distortion {self.model}: thin prism and tilt (coefficients 9 to 14) are not supported")
        object.__setattr__(self, "coefficients", coefficients)

    def __str__(self) -> str:
        return " ".join([self.model, *(f"{value:g}" for value in self.coefficients)])

    def forward(self, points: np.ndarray) -> np.ndarray:
        """Places (..., 2) of the images of rays (..., 2); NaN where the model has turned back."""
        points = np.asarray(points, dtype=float)
        x, y = points[..., 0], points[..., 1]
        with np.errstate(all="ignore"):
            image_x, image_y, (xx, xy, yy) = self._map(x, y)
            known = (np.hypot(x, y) <= self._table[0][-1]) & (xx * yy - xy * xy > 0) & (xx + yy > 0)
        return np.where(known[..., None], np.stack([image_x, image_y], axis=-1), np.nan)

    def inverse(self, images: np.ndarray) -> np.ndarray:
        """Rays (..., 2) of images at (..., 2); NaN where no ray has its image."""
        exact = 1e-13  # tolerance of the place of an image: a ten-thousandth of a millionth of a pixel
        images = np.asarray(images, dtype=float)
        if self.model != FISHEYE and not any(self.coefficients):
            return images.copy()
        flat = images.reshape(-1, 2)
        table, reached = self._table
        with np.errstate(all="ignore"):
            radius = np.hypot(flat[:, 0], flat[:, 1])
            start = np.where(radius > 0, np.interp(radius, reached, table) / radius, 1.0)
            x, y = flat[:, 0] * start, flat[:, 1] * start
            for _ in range(20):
                image_x, image_y, (xx, xy, yy) = self._map(x, y)
                miss_x, miss_y = flat[:, 0] - image_x, flat[:, 1] - image_y
                # Relative: the farther out, the larger the numbers.
                if not (np.abs(miss_x) + np.abs(miss_y) > exact * (1 + radius)).any():
                    break
                det = xx * yy - xy * xy
                x, y = x + (yy * miss_x - xy * miss_y) / det, y + (xx * miss_y - xy * miss_x) / det
            rays = np.stack([x, y], axis=-1)
            wrong = np.abs(self.forward(rays) - flat).sum(axis=-1)
            rays[~(wrong <= 100 * exact * (1 + radius))] = np.nan
        return rays.reshape(images.shape)

    def _map(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, ...]]:
        """Images (x', y'), and dx'/dx, dx'/dy = dy'/dx, dy'/dy."""
        s = x * x + y * y
        q, slope = self._radial(s)
        image_x, image_y = q * x, q * y
        xx, xy, yy = q + 2 * slope * x * x, 2 * slope * x * y, q + 2 * slope * y * y
        if self.model in POLYNOMIAL:
            p1, p2 = self.coefficients[2:4]
            image_x = image_x + 2 * p1 * x * y + p2 * (s + 2 * x * x)
            image_y = image_y + p1 * (s + 2 * y * y) + 2 * p2 * x * y
            xx = xx + 2 * p1 * y + 6 * p2 * x
            xy = xy + 2 * p1 * x + 2 * p2 * y
            yy = yy + 6 * p1 * y + 2 * p2 * x
        return image_x, image_y, (xx, xy, yy)

    def _radial(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """q and dq/ds at squared radii."""
        if self.model in POLYNOMIAL:
            k1, k2, _, _, k3, k4, k5, k6 = (*self.coefficients, 0.0, 0.0, 0.0, 0.0)[:8]
            over, over_slope = 1 + s * (k1 + s * (k2 + s * k3)), k1 + s * (2 * k2 + 3 * k3 * s)
            under, under_slope = 1 + s * (k4 + s * (k5 + s * k6)), k4 + s * (2 * k5 + 3 * k6 * s)
            q = over / under
            return q, (over_slope - q * under_slope) / under
        k1, k2, k3, k4 = self.coefficients
        r = np.sqrt(s)
        theta = np.arctan(r)
        t = theta * theta
        turned = theta * (1 + t * (k1 + t * (k2 + t * (k3 + t * k4))))
        rate = (1 + t * (3 * k1 + t * (5 * k2 + t * (7 * k3 + 9 * k4 * t)))) / (1 + s)
        # s below which the fisheye's q is its series.
        near = s < 1e-6
        safe = np.where(near, 1.0, r)
        q = np.where(near, 1 + (k1 - 1 / 3) * s, turned / safe)
        return q, np.where(near, k1 - 1 / 3, (rate - q) / (2 * safe * safe))

    @cached_property
    def _table(self) -> tuple[np.ndarray, np.ndarray]:
        """Radii r of rays and r' of their images, tangential part left out, both rising, up to where r' turns back."""
        samples = 4096
        radius = np.tan(np.linspace(0.0, (math.pi / 2 - 1e-3), samples))
        with np.errstate(all="ignore"):
            reached = radius * self._radial(radius * radius)[0]
            back = np.flatnonzero(~(np.diff(reached) > 0))
        count = int(back[0]) + 1 if back.size else samples
        return radius[:count], reached[:count]
