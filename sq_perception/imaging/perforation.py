"""Perforated depth images: readings with gaps of a pixel or two between them all over the image.

Depth that was registered to a colour camera of more pixels, every other line of a fast mode, projected dots and dropped
readings look so.  Such a gap says nothing of the scene, but views and segments ask what is beside a pixel: it takes the
reading nearest to it.  Images float32 (height, width), metres, NaN where nothing was measured; labels int32.
"""

from __future__ import annotations

import cv2
import numpy as np

_GAPS = 0.1
"""Share of gaps among readings and gaps from which on an image is perforated: recorded frames of four kinds of cameras
have up to 0.016, every second line missing makes 0.5."""
_REACH = cv2.getStructuringElement(cv2.MORPH_RECT, (3, 3))
"""Closes gaps that are up to two pixels wide."""


def filled(depth: np.ndarray, labels: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray | None]:
    """A perforated image with its gaps closed, and labels that go with the readings; any other image as it is."""
    measured = np.isfinite(depth)
    if measured.all():
        return depth, labels
    readings = measured.astype(np.uint8)
    closed = cv2.morphologyEx(readings, cv2.MORPH_CLOSE, _REACH)
    gaps = (closed > 0) & ~measured
    if np.count_nonzero(gaps) <= _GAPS * np.count_nonzero(closed):
        return depth, labels
    _, nearest = cv2.distanceTransformWithLabels(1 - readings, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    reading = np.zeros(nearest.max() + 1, np.int64)
    reading[nearest[measured]] = np.flatnonzero(measured)
    source = reading[nearest[gaps]]
    depth = depth.copy()
    depth[gaps] = depth.ravel()[source]
    if labels is not None:
        labels = labels.copy()
        labels[gaps] = labels.ravel()[source]
    return depth, labels
