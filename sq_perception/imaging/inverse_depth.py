"""The inverse of a depth image: what triangulating sensors measure, and flat where surfaces are.

With w = 1 / z a plane a.p = 1 of the optical frame is affine in the pixels of a pinhole camera, since w = a.d(u, v) for
the ray d = ((u - cx) / fx, (v - cy) / fy, 1).  So plain differences of w give slopes without any bias on planes, the
normal from them,

    a = (fx dw/du, fy dw/dv, w - dw/du (u - cx) - dw/dv (v - cy)),    cosine of incidence = a.d / |a||d| = w / |a||d|,

and extrapolation along a plane is exact.  Where nothing is seen w = 0: infinitely far.

A second eye, imager or projector, beside the camera at x = b sees a point of column u in its own column u - fx b w.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sq_perception.imaging.camera import Camera

STEEPEST = 10.0  # tangent of the incidence, of 84 degrees, beyond which neighbouring pixels show two surfaces: a jump


@dataclass(frozen=True, eq=False)
class InverseDepth:
    """An image of inverse depths with its slopes."""

    camera: Camera  # pinhole
    w: np.ndarray  # float32 (height, width), 1 / z, 0 where nothing is seen
    slope_u: np.ndarray
    slope_v: np.ndarray
    """float32 (height, width), dw/du and dw/dv of the surface in the pixel: the smaller of the
    differences to either side, which lies within the surface where the other one crosses a jump."""

    @classmethod
    def of(cls, depth: np.ndarray, camera: Camera) -> InverseDepth:
        """The inverse of a depth image (height, width), metres, positive; +inf or NaN where nothing is seen.  Raises
        ValueError if the camera is no pinhole, or a depth is not positive."""
        if not camera.is_pinhole:
            raise ValueError(f"camera: expected a pinhole camera, got an {camera.projection} one")
        with np.errstate(divide="ignore"):
            w = np.divide(1.0, depth, dtype=np.float32, casting="same_kind")
        w[np.isnan(w)] = 0.0
        if (depth <= 0).any() or np.isinf(w).any():
            raise ValueError("depth: expected positive metres, +inf or NaN, got depths of 0 or less")
        return cls(camera, w, _smaller_difference(w, 1), _smaller_difference(w, 0))

    def cosine(self) -> np.ndarray:
        """Cosine of the angle between the surface's normal and the ray, float32 (height, width); 0 where w is 0."""
        camera = self.camera
        u = np.arange(camera.width, dtype=np.float32) - np.float32(camera.cx)
        v = np.arange(camera.height, dtype=np.float32)[:, None] - np.float32(camera.cy)
        ahead = self.w - self.slope_u * u - self.slope_v * v
        square = ahead * ahead + np.square(self.slope_u * np.float32(camera.fx))
        square += np.square(self.slope_v * np.float32(camera.fy))
        square *= np.square(u / np.float32(camera.fx)) + np.square(v / np.float32(camera.fy)) + np.float32(1)
        return self.w / np.sqrt(np.maximum(square, np.float32(1e-30)))

    def jumps(self) -> tuple[np.ndarray, np.ndarray]:
        """Whether pixels and their right (height, width - 1) or lower neighbours (height - 1, width) are apart."""
        return _apart(self.w[:, :-1], self.w[:, 1:], self.camera.fx), _apart(self.w[:-1], self.w[1:], self.camera.fy)

    def hidden_from(self, baseline: float) -> np.ndarray:
        """Which pixels (height, width) an eye at x = ``baseline`` metres, on the camera's own rows, does not see.

        A point is hidden where another one of its row falls on the same column of that eye and is nearer, by more than
        a pixel of disparity; or where its surface turns its back.  Beside an edge at 1 / w1 before a background at
        1 / w2 the shadow is fx |baseline| (w1 - w2) wide, to the left for an eye on the right.
        """
        height, width = self.w.shape
        # The limit is nearer than any sensor reads, and bounds the memory.
        disparity = np.clip(self.w * np.float32(self.camera.fx * baseline), -2 * width, 2 * width)
        column = np.arange(width, dtype=np.float32) - disparity
        cell = np.floor(column).astype(np.intp)
        first = int(cell.min()) - 1
        columns = int(cell.max()) + 3 - first
        cell += np.arange(height, dtype=np.intp)[:, None] * columns - first
        nearest = np.zeros(height * columns, np.float32)
        np.maximum.at(nearest, cell.ravel(), self.w.ravel())
        # A sample covers the two cells around it; a point lies behind whatever covers both of its cells.
        covering = np.maximum(nearest[1:], nearest[:-1])
        covering = np.minimum(covering[1:], covering[:-1])
        behind = np.abs(np.float32(self.camera.fx * baseline)) * (covering[cell - 1] - self.w) > 1
        # Steep surfaces crowd into few cells; they hide themselves only where the order of columns is lost.
        if baseline > 0:
            behind &= column > np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
        else:
            behind &= column < np.maximum.accumulate(column, axis=1)
        return behind | (self.slope_u * np.float32(self.camera.fx * baseline) >= 1)

    def shift(self, v: np.ndarray, u: np.ndarray, down: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Inverse depth in pixels (n,) of the surfaces that pixels ``down`` and ``right`` of them see, continued."""
        seen = self.w[v + down, u + right]
        moved = seen - self.slope_u[v + down, u + right] * right - self.slope_v[v + down, u + right] * down
        return np.where(seen > 0, np.maximum(moved, 0), 0).astype(np.float32)

    def dilate(self, pixels: int) -> tuple[InverseDepth, np.ndarray]:
        """The image with its foregrounds grown, and where they have grown to."""
        brush = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))
        near_jump = cv2.dilate(beside(self.jumps()).view(np.uint8), brush).view(bool)
        nearest = cv2.dilate(self.w, brush)
        # More than a surface seen at 84 degrees rises within the brush: another surface.
        covered = near_jump & ((nearest - self.w) * np.float32(self.camera.fx / STEEPEST) > (pixels + 1) * self.w)
        grown = np.where(covered, nearest, self.w)
        flat = [np.where(covered, np.float32(0), slope) for slope in (self.slope_u, self.slope_v)]
        return InverseDepth(self.camera, grown, *flat), covered


def beside(jumps: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Pixels (height, width) on either side of a jump."""
    across, down = jumps
    found = np.zeros((across.shape[0], down.shape[1]), dtype=bool)
    found[:, :-1] |= across
    found[:, 1:] |= across
    found[:-1] |= down
    found[1:] |= down
    return found


def _apart(first: np.ndarray, second: np.ndarray, focal: float) -> np.ndarray:
    return np.abs(first - second) * np.float32(focal / STEEPEST) > np.minimum(first, second)


def _smaller_difference(w: np.ndarray, axis: int) -> np.ndarray:
    """The one nearer to 0 of the differences of each pixel to its two neighbours; at the border the only one."""
    if w.shape[axis] == 1:
        return np.zeros_like(w)
    step = np.diff(w, axis=axis)
    before = np.concatenate([np.take(step, [0], axis), step], axis)
    after = np.concatenate([step, np.take(step, [-1], axis)], axis)
    return np.where(np.abs(before) < np.abs(after), before, after)
