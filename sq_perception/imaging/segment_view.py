"""What shows which readings of a segment are of its object: the segment in its surroundings.

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

where s, metres, is the side of the window at the depth m; what is not known is 0.  The last three are the same in all
cells.  Pinhole cameras; metres, optical frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from sq_perception.geometry.quantiles import quantile
from sq_perception.imaging.camera import Camera

PIXELS = 64
CHANNELS = 9
MEASURED, HEIGHT, SEGMENT, OTHERS, IMAGE, PLANE = 0, 2, 3, 4, 5, 8
"""Channels that others than the network look at."""
_USUAL_SIDE = 0.2
"""Metres; that the channel of the scale is 0 for it."""
_LARGEST = 0.3
"""Metres of s that the network is told at most: what is larger is known by its shape.  An earlier network that was told
all sizes missed 45 %, not 31 %, of 226 household things of three times their size before a simulated D435."""
_WIDER, _MORE = 1.5, 8
"""The window's side in that of the segment, and pixels beyond."""
_HEIGHTS = (-0.3, 1.5)


@dataclass(frozen=True, eq=False)
class SegmentView:
    """A segment and what is around it.

    Attributes
    ----------
    image : float32 (PIXELS, PIXELS, CHANNELS)
        See the module.
    rows, columns : int (PIXELS,)
        Pixels of the image under the middles of the cells; some may be outside of it.
    left, top, side, height
        The window, in pixels: its corner, where the image's is (0, 0), its width and its height.
    """

    image: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    left: float
    top: float
    side: float
    height: float

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
    depth: np.ndarray,
    labels: np.ndarray,
    label: int,
    window: tuple[slice, slice],
    camera: Camera,
    plane: np.ndarray | None,
) -> SegmentView:
    """The view of a segment with at least one reading.

    Parameters
    ----------
    depth : float (height, width)
        Metres, not finite or 0 where nothing was measured.
    labels : int32 (height, width)
        Segments, 0 for background.
    label, window
        The segment, and the least window of the image that holds it.
    plane : (4,) or None
        Support plane, height above it = n.p + d.
    """
    down, across = window
    tall, wide = down.stop - down.start, across.stop - across.start
    focal = math.sqrt(camera.fx * camera.fy)
    length = _WIDER * max(tall * focal / camera.fy, wide * focal / camera.fx) + _MORE
    side, high = length * camera.fx / focal, length * camera.fy / focal
    top, left = down.start + 0.5 * (tall - high), across.start + 0.5 * (wide - side)
    middles = (np.arange(PIXELS) + 0.5) / PIXELS
    rows, columns = np.floor(top + high * middles).astype(int), np.floor(left + side * middles).astype(int)
    height, width = depth.shape
    within = ((rows >= 0) & (rows < height))[:, None] & ((columns >= 0) & (columns < width))
    grid = np.ix_(np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1))
    z, shown = depth[grid].astype(np.float64), np.where(within, labels[grid], 0)
    measured = within & np.isfinite(z) & (z > 0)
    z = np.where(measured, z, 0.0)
    own = depth[window][labels[window] == label]
    middle = quantile(own[np.isfinite(own)], 0.5)
    scale = length * middle / focal

    image = np.zeros((PIXELS, PIXELS, CHANNELS), np.float32)
    image[..., MEASURED] = measured
    image[..., 1] = np.where(measured, np.clip((middle - z) / scale, -1, 1), 0)
    if plane is not None:
        x, y = (columns - camera.cx) / camera.fx * z, ((rows - camera.cy) / camera.fy)[:, None] * z
        heights = plane[0] * x + plane[1] * y + plane[2] * z + plane[3]
        image[..., HEIGHT] = np.where(measured, np.clip(heights / scale, *_HEIGHTS), 0)
    image[..., SEGMENT] = shown == label
    image[..., OTHERS] = (shown > 0) & (shown != label)
    image[..., IMAGE] = within
    image[..., 6:] = np.log(min(scale, _LARGEST) / _USUAL_SIDE), np.log(length / PIXELS), plane is not None
    return SegmentView(image, rows, columns, left, top, side, high)
