"""Raw images as an ideal pinhole camera in the same place would have taken them, and back.

The optical frame stays that of the raw camera: nothing is turned (camera_info's R is for stereo pairs and not used), so
that z stays z, and a rectified depth is a depth that was measured.  Per pixel of the one image a table holds the place
in the other one; it is computed once, from the forward map of :mod:`sq_perception.imaging.distortion` for the way there
and from its inverse for the way back.

The pinhole camera has the focal lengths of K and its pixels on the raw grid, so that the middle of the image stays as
sharp as it is, and an image without distortion stays what it is.  Its window is as large as all that the raw image
sees; only a window of more than twice the pixels of the raw image, as of a fisheye that sees more than 90 degrees
across, is cut to that, about the middle (of the raw pixels 0.6 % are lost at 90 degrees, 15 % at 120).  P is not used:
it is the same camera with another zoom, chosen for a window that must not change its size.

Depth between pixels is interpolated in 1/z, in which planes are flat, where the four neighbours show one surface, and
is nothing elsewhere: so no value lies between two surfaces, where nothing is, and none beside one.  With the
depth of the nearest pixel bodies came out up to 10 % too large.  The price is a rim of half a pixel.

Neighbours show one surface if it would be seen at less than 84 degrees, a relative step of 10 / f, as in
:mod:`sq_perception.imaging.inverse_depth`.  A smaller step may still be the edge of something flat; then a pixel is
wrong by at most that step.  Single pixels without depth inside a surface, and the gaps of a perforated image
(:mod:`sq_perception.imaging.hole_filling`), are no edge: they are bridged for their neighbours' sake, and stay empty.
Labels are those of the nearest pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import cv2
import numpy as np

from sq_perception.files.unpacking import MOST_PIXELS
from sq_perception.imaging import depth_steps, hole_filling
from sq_perception.imaging.camera import Camera
from sq_perception.imaging.distortion import Distortion
from sq_perception.imaging.inverse_depth import STEEPEST

LARGEST_SIDE = 2**15 - 2  # largest side of an image that OpenCV can look up, pixels
_OUTSIDE = -9.0  # a column and row that no image has


@dataclass(frozen=True)
class Rectification:
    """From a raw pinhole camera (K) to the one in its place; :func:`rectification` keeps their tables.  Raises
    ValueError if the images are too large, or the distortion cannot be undone in the middle."""

    raw: Camera
    distortion: Distortion

    def __post_init__(self) -> None:
        raw = self.raw
        if not raw.is_pinhole:
            raise ValueError(f"camera: expected a pinhole camera, got an {raw.projection} one")
        if max(raw.width, raw.height) > LARGEST_SIDE or raw.width * raw.height > MOST_PIXELS:
            raise ValueError(
                f"image size: expected at most {MOST_PIXELS} pixels and {LARGEST_SIDE} a side to undo distortion, "
                f"got {raw.width} x {raw.height}"
            )
        _ = self.camera

    @cached_property
    def camera(self) -> Camera:
        """The pinhole camera that the rectified images are of."""
        left, top, right, bottom = _window(self.raw, self.distortion)
        return self.raw.cropped(left, top, right - left + 1, bottom - top + 1)

    @cached_property
    def there(self) -> Lookup:
        """Lookup of images of :attr:`camera` in raw ones."""
        rays = _rays(self.camera, *_grid(self.camera))
        return Lookup.of(_pixels(self.raw, self.distortion.forward(rays)), self.raw)

    @cached_property
    def back(self) -> Lookup:
        """Lookup of raw images in those of :attr:`camera`."""
        images = _rays(self.raw, *_grid(self.raw))
        return Lookup.of(_pixels(self.camera, self.distortion.inverse(images)), self.camera)


rectification = lru_cache(maxsize=16)(Rectification)
"""The :class:`Rectification` of a calibration: equal ones share it, and its tables."""


@dataclass(frozen=True, eq=False)
class Lookup:
    """Where the pixels (height, width) of one image lie in another, the source."""

    source: Camera  # camera of the images that are looked up in; others raise ValueError
    u: np.ndarray
    v: np.ndarray  # float32 (height, width), column u and row v in the source, far outside of it where it sees nothing
    left: np.ndarray
    top: np.ndarray  # float32 (height, width), column and row of the upper left one of the four neighbours
    close: np.ndarray  # uint8 (height, width), 1 where the place is as good as that of the nearest pixel
    step: float  # relative difference of depths beyond which neighbours show different surfaces

    @classmethod
    def of(cls, places: np.ndarray, source: Camera) -> Lookup:
        """The lookup of places (height, width, 2) in the image of ``source``, NaN where it sees nothing."""
        places = np.nan_to_num(places, nan=_OUTSIDE, posinf=_OUTSIDE, neginf=_OUTSIDE)
        places = np.clip(places, _OUTSIDE, LARGEST_SIDE + 1).astype(np.float32)
        u, v = np.ascontiguousarray(places[..., 0]), np.ascontiguousarray(places[..., 1])
        left, top = np.floor(u), np.floor(v)
        off = np.maximum(np.abs(u - np.rint(u)), np.abs(v - np.rint(v)))
        step = math.sqrt(2.0) * STEEPEST / min(source.fx, source.fy)
        # Distance of two places that are as good as one, pixels.
        return cls(source, u, v, left, top, (off <= 0.01).view(np.uint8), min(step, 0.5))

    def depth(self, image: np.ndarray) -> np.ndarray:
        """The depth image, float32 in metres, from one of the source: positive, NaN or +inf where there is nothing.
        The result is NaN where there is no depth, also where the source does not see."""
        image = np.ascontiguousarray(image, dtype=np.float32)
        nearest = self._nearest(image, np.nan)
        # Warnings for pixels without depth only.
        with np.errstate(divide="ignore", invalid="ignore"):
            bridged, _, _ = hole_filling.fill(image)
            inverse = cv2.patchNaNs(1 / bridged, 0)
            closed = cv2.morphologyEx(inverse, cv2.MORPH_CLOSE, depth_steps.CROSS)
            inverse = cv2.copyTo(closed, (inverse == 0).view(np.uint8), inverse)
            # Extremes over each pixel and its neighbours to the right, below, and across.
            least, most = (find(inverse, np.ones((2, 2), np.uint8), anchor=(0, 0)) for find in (cv2.erode, cv2.dilate))
            smooth: np.ndarray = (least > np.float32(1 - self.step) * most).view(np.uint8)
            smooth[-1], smooth[:, -1] = 0, 0
            smooth = cv2.remap(smooth, self.left, self.top, cv2.INTER_NEAREST, borderValue=0)
            smooth = cv2.bitwise_and(smooth, (nearest < np.inf).view(np.uint8))
            between = 1 / cv2.remap(inverse, self.u, self.v, cv2.INTER_LINEAR, borderValue=0)
        result = np.full(nearest.shape, np.nan, np.float32)
        return cv2.copyTo(nearest, self.close, cv2.copyTo(between, smooth, result))

    def labels(self, image: np.ndarray) -> np.ndarray:
        """The label image, int32, from one of the source; 0 where there is none, also where the source does not see."""
        # OpenCV looks up no int32; bits are moved as they are.
        return self._nearest(np.ascontiguousarray(image, dtype=np.int32).view(np.float32), 0.0).view(np.int32)

    def _nearest(self, image: np.ndarray, nothing: float) -> np.ndarray:
        self.source.check_image(image)
        return cv2.remap(image, self.u, self.v, cv2.INTER_NEAREST, borderValue=nothing)


def _grid(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    return np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float)


def _rays(camera: Camera, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Normalised points (len(v), len(u), 2) of columns and rows."""
    x, y = np.meshgrid((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
    return np.stack([x, y], axis=-1)


def _pixels(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Columns and rows of normalised points (..., 2)."""
    return points * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def _window(raw: Camera, distortion: Distortion) -> tuple[int, int, int, int]:
    """First and last column and row (left, top, right, bottom) of the pinhole image, on the grid of the raw one."""
    places = 64  # places on each side of the raw image whose rays bound what it sees
    width, height = float(raw.width), float(raw.height)
    across, down = np.linspace(0, width - 1, places), np.linspace(0, height - 1, places)
    ends = np.array([0.0, 1.0])
    sides = _rays(raw, across, ends * (height - 1)), _rays(raw, ends * (width - 1), down)
    border = np.concatenate([_pixels(raw, distortion.inverse(side)).reshape(-1, 2) for side in sides])
    middle = _rays(raw, np.array([(width - 1) / 2]), np.array([(height - 1) / 2]))
    centre = _pixels(raw, distortion.inverse(middle)).reshape(2)
    if not np.isfinite(centre).all():
        raise ValueError(f"distortion {distortion}: cannot be undone in the middle of the image")
    if np.isfinite(border).all():
        low, high = border.min(axis=0), border.max(axis=0)
    else:
        low, high = np.full(2, -np.inf), np.full(2, np.inf)
    # Sides as distances from the middle: first no side endless, then the area.
    size = np.array([width, height])
    before, after = np.clip(centre - low, 0, 2 * size), np.clip(high - centre, 0, 2 * size)
    area = np.prod(before + after + 1)
    # Factor by which the number of pixels grows, at most.
    scale = min(1.0, math.sqrt(2.0 * width * height / area))
    # A border that hits the grid must not gain a pixel by rounding.
    left, top = np.floor(centre - scale * before + 1e-6).astype(int)
    right, bottom = np.ceil(centre + scale * after - 1e-6).astype(int)
    return int(left), int(top), int(right), int(bottom)
