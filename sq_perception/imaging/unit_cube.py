"""The thesis' world: orthographic grey images of a unit cube.

Convention
----------
Cube frame: x right, y UP, z towards the viewer, all in [0, 1].  An image of n x n pixels with grey values 0..255 shows
(thesis, chapter 5.1, and the author's renderer)

    x = column / (n - 1),   y = 1 - row / (n - 1),   z = (grey + 0.5) / 255,   grey 0: background

since a grey value is the floor of z: larger is nearer.  16 bit images hold floor(65535 z) in the same way.  The cube
frame is the optical frame of :func:`camera` turned by diag(1, -1, -1) and shifted by (0, 1, 1), so that depth = 1 - z.
"""

from __future__ import annotations

import numpy as np

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.camera import Camera

THESIS_PIXELS = 256
POSE = (1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 1.0)
"""Pose of the optical frame in the cube frame: a half turn about x, as a quaternion x y z w, and a translation."""
_HALF_TURN_ABOUT_X, _SHIFT = (np.array(part) for part in POSE)


def camera(width: int = THESIS_PIXELS, height: int | None = None) -> Camera:
    """The orthographic camera that sees the cube in ``width`` columns (and ``height`` rows, as many by default)."""
    height = width if height is None else height
    if width < 2 or height < 2:
        raise ValueError(f"an image of the unit cube has at least 2 x 2 pixels, got {width} x {height}")
    return Camera(width, height, width - 1.0, height - 1.0, 0.0, 0.0, "orthographic")


def optical_from_cube(body: Superquadric) -> Superquadric:
    """A body of the cube frame in the optical frame of :func:`camera`."""
    return body.transformed(_HALF_TURN_ABOUT_X, _SHIFT)


cube_from_optical = optical_from_cube  # the inverse; the same map, as a half turn is its own inverse


def depth_from_grey(image: np.ndarray) -> np.ndarray:
    """Depth (float32, NaN for background) of an 8 or 16 bit grey image of the cube."""
    image = np.asarray(image)
    if image.dtype not in (np.uint8, np.uint16) or image.ndim != 2:
        raise ValueError(f"expected a uint8 or uint16 image (height, width), got {image.dtype} {image.shape}")
    full = np.iinfo(image.dtype).max
    z = (image.astype(np.float32) + np.float32(0.5)) / np.float32(full)
    return np.where(image > 0, 1 - z, np.float32(np.nan))


def grey_from_depth(depth: np.ndarray, dtype: type[np.unsignedinteger] = np.uint8) -> np.ndarray:
    """Grey image of a depth image of :func:`camera`; what is not finite or behind the cube is background."""
    full = np.iinfo(dtype).max
    z = np.where(np.isfinite(depth), 1 - depth, 0.0)
    return np.clip(np.floor(z * full + 1e-6), 0, full).astype(dtype)
