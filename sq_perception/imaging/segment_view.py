"""The view that shows which readings of a segment are of its object: the segment in its surroundings.

A window of the image about the segment, square to the camera, larger than its longer side L by L / 2 + 8 pixels, in
``PIXELS`` x ``PIXELS`` cells; of pixels that are not square, lengths count those of the same area that are.  A cell
shows the pixel under its middle, by the channels

    measured    1 where there is a reading
    nearness    (m - z) / s, clipped to [-1, 1], of depths z; m is the segment's median depth
    height      h / s above the support plane, clipped to [-0.3, 1.5]
    segment     1 within it
    others      1 within other segments
    image       1 where the image is
    scale       log(s / 0.2 m), of the largest s that things have in training for what is larger
    grain       log of the pixels to a cell's side
    plane       1 if there is a support plane

z and h are means over 3 x 3 points of the cell, without those that a step in depth parts from its middle: less of the
sensor's noise, and no edge is smoothed.  s, metres, is the side of the window at the depth m; what is not known is 0.
The last three channels are the same in all cells.  Pinhole cameras; metres, optical frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from sq_perception.geometry.kernels import kernel
from sq_perception.geometry.quantiles import quantile
from sq_perception.imaging.camera import Camera, Lens
from sq_perception.imaging.depth_steps import STEP

PIXELS = 64
CHANNELS = 9
MEASURED, NEARNESS, HEIGHT, SEGMENT, OTHERS, IMAGE, SCALE, GRAIN, PLANE = range(CHANNELS)
_POINTS = 3  # points of a cell along each axis


@dataclass(frozen=True, eq=False)
class SegmentView:
    """A segment and what is around it."""

    image: np.ndarray  # float32 (PIXELS, PIXELS, CHANNELS), see the module
    rows: np.ndarray
    columns: np.ndarray
    """rows and columns: int (PIXELS,), pixels of the image under the middles of the cells; some may be outside of
    it."""
    left: float
    top: float
    side: float
    height: float  # the window, in pixels: its corner, where the image's is (0, 0), its width and its height

    def of_part(self, cells: np.ndarray) -> np.ndarray:
        """The image as it would be if the segment had these cells alone, bool (PIXELS, PIXELS), and the rest of them
        were of other segments; what it is measured by stays."""
        image = self.image.copy()
        image[..., SEGMENT] = cells
        image[..., OTHERS] += self.image[..., SEGMENT] * ~cells
        return image

    def at_pixels(self, values: np.ndarray, window: tuple[slice, slice]) -> np.ndarray:
        """Values (PIXELS, PIXELS) of the cells, between them interpolated, at the pixels of a window of the image."""
        down, across = window
        cells = len(values) / np.array([self.side, self.height])
        first = np.array([across.start + 0.5 - self.left, down.start + 0.5 - self.top]) * cells - 0.5
        matrix = np.column_stack([np.diag(cells), first])
        size = across.stop - across.start, down.stop - down.start
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpAffine(values, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE))


def from_segment(
    depth: np.ndarray, labels: np.ndarray, label: int, window: tuple[slice, slice], camera: Camera,
    plane: np.ndarray | None,
) -> SegmentView:
    """The view of a segment with at least one reading, in an image of metres, not finite or 0 where nothing was
    measured; ``window`` is the least one around it, ``plane`` (4,) or None its support, height = n.p + d."""
    down, across = window
    tall, wide = down.stop - down.start, across.stop - across.start
    focal = math.sqrt(camera.fx * camera.fy)
    # Side of the window in sides of the segment, and pixels added to it.
    length = 1.5 * max(tall * focal / camera.fy, wide * focal / camera.fx) + 8
    side, high = length * camera.fx / focal, length * camera.fy / focal
    top, left = down.start + 0.5 * (tall - high), across.start + 0.5 * (wide - side)
    points = (np.arange(_POINTS * PIXELS) + 0.5) / (_POINTS * PIXELS)
    rows, columns = np.floor(top + high * points).astype(int), np.floor(left + side * points).astype(int)
    own = depth[window][labels[window] == label]
    middle = quantile(own[np.isfinite(own)], 0.5)
    scale = length * middle / focal

    image = np.zeros((PIXELS, PIXELS, CHANNELS), np.float32)
    known = np.zeros(4) if plane is None else np.asarray(plane, dtype=float)
    _show(image, depth, labels, label, rows, columns, camera.lens, known, middle, scale)
    # The s, metres, for which the channel of the scale is 0.
    # Largest s, metres, that the network is told: what is larger is known by its shape. An earlier network that was
    # told all sizes missed 45 %, not 31 %, of household things of three times their size before a simulated D435.
    image[..., SCALE] = np.log(min(scale, 0.3) / 0.2)
    image[..., GRAIN] = np.log(length / PIXELS)
    image[..., PLANE] = plane is not None
    centre = slice(_POINTS // 2, None, _POINTS)
    return SegmentView(image, rows[centre], columns[centre], left, top, side, high)


def compact_pieces(cells: np.ndarray, count: int, place: tuple[float, float]) -> np.ndarray:
    """The piece, from 0, of each of some cells, bool (rows, columns), at most ``count`` of about one size; else -1.

    The first centre is the cell farthest from a ``place``, row and column, each further one the cell farthest from
    those before.  Every cell belongs to the nearest centre; centres move to the means of their cells (Lloyd 1982),
    twice, then no piece is a sliver at an end.
    """
    pieces = np.full(cells.shape, -1)
    pieces[cells] = _compact(np.argwhere(cells).astype(float), count, float(place[0]), float(place[1]))
    return pieces


@kernel
def _compact(at: np.ndarray, count: int, row: float, column: float) -> np.ndarray:
    """The piece of each of some places (n, 2), as by :func:`compact_pieces`; a number whose piece is empty is left."""
    count = min(count, len(at))
    centres, of = np.empty((count, 2)), np.zeros(len(at), np.int64)
    square = (at[:, 0] - row) ** 2 + (at[:, 1] - column) ** 2
    for k in range(count):
        centres[k] = at[square.argmax()]
        from_it = (at[:, 0] - centres[k, 0]) ** 2 + (at[:, 1] - centres[k, 1]) ** 2
        square = from_it if k == 0 else np.minimum(square, from_it)
    for step in range(3):
        for i in range(len(at)):
            of[i] = ((centres[:, 0] - at[i, 0]) ** 2 + (centres[:, 1] - at[i, 1]) ** 2).argmin()
        for k in range(count if step < 2 else 0):
            some = at[of == k]
            if len(some):
                centres[k] = some[:, 0].mean(), some[:, 1].mean()
    return of


@kernel
def _show(
    image: np.ndarray, depth: np.ndarray, labels: np.ndarray, label: int, rows: np.ndarray, columns: np.ndarray,
    lens: Lens, plane: np.ndarray, middle: float, scale: float,
) -> None:
    """Write what the cells of an empty view show.  ``rows`` and ``columns`` (POINTS PIXELS,) are the pixels under the
    points of the cells, ``middle`` and ``scale`` the module's m and s; a ``plane`` that is not known is 0."""
    fx, fy, cx, cy, _ = lens
    height, width = depth.shape
    least, most = -0.3, 1.5
    for i in range(PIXELS):
        for j in range(PIXELS):
            v, u = rows[_POINTS * i + _POINTS // 2], columns[_POINTS * j + _POINTS // 2]
            if v < 0 or v >= height or u < 0 or u >= width:
                continue
            image[i, j, IMAGE] = 1
            image[i, j, SEGMENT] = labels[v, u] == label
            image[i, j, OTHERS] = labels[v, u] > 0 and labels[v, u] != label
            z = depth[v, u]
            if not (np.isfinite(z) and z > 0):
                continue
            depths, heights, count = 0.0, 0.0, 0
            for v in rows[_POINTS * i : _POINTS * (i + 1)]:
                for u in columns[_POINTS * j : _POINTS * (j + 1)]:
                    if 0 <= v < height and 0 <= u < width and abs(depth[v, u] - z) < STEP * z:
                        depths += depth[v, u]
                        heights += depth[v, u] * (plane[0] * (u - cx) / fx + plane[1] * (v - cy) / fy + plane[2])
                        count += 1
            image[i, j, MEASURED] = 1
            image[i, j, NEARNESS] = min(max((middle - depths / count) / scale, -1.0), 1.0)
            image[i, j, HEIGHT] = min(max((heights / count + plane[3]) / scale, least), most)
