"""Regions of a label image: int32 (height, width), 0 for nothing, labels from 1; and of a mask."""

from __future__ import annotations

import cv2
import numpy as np

from sq_perception.geometry.kernels import kernel
from sq_perception.imaging.camera import Camera


def nearest(wanted: np.ndarray) -> np.ndarray:
    """For each pixel (height, width), the index into the flat image of the nearest pixel that is set in ``wanted``.
    ``wanted`` is bool (height, width), with at least one pixel set."""
    away = (~wanted).view(np.uint8)
    _, number = cv2.distanceTransformWithLabels(away, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    index = np.zeros(int(number.max()) + 1, np.int64)
    index[number[wanted]] = np.flatnonzero(wanted)
    return np.asarray(index[number])


def convex_hull(mask: np.ndarray) -> np.ndarray:
    """The convex hull of a mask (height, width) of 0 and more, uint8, as one of 0 and 1."""
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    hull = np.zeros_like(mask)
    cv2.fillConvexPoly(hull, cv2.convexHull(np.concatenate(outlines)), 1)
    return hull


def extents(labels: np.ndarray) -> np.ndarray:
    """Number of pixels, first row, last row + 1, first column and last column + 1 of each label, int64 (count + 1, 5);
    all 0 for label 0 and for labels without pixels."""
    labels = np.ascontiguousarray(labels, dtype=np.int32)
    return np.asarray(_extents(labels, int(labels.max(initial=0))))


def pixels(labels: np.ndarray, label: int, extent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of a label's pixels, by its extent."""
    rows, columns = _pixels(np.ascontiguousarray(labels, dtype=np.int32), int(label), *extent.tolist())
    return rows, columns


def window(extent: np.ndarray, margin: int = 0) -> tuple[slice, slice]:
    """The rows and columns of an image that a label's box takes, by its extent, and a margin around it."""
    _, top, bottom, left, right = extent.tolist()
    return slice(max(top - margin, 0), bottom + margin), slice(max(left - margin, 0), right + margin)


def some_points(rows: np.ndarray, columns: np.ndarray, depth: np.ndarray, camera: Camera, count: int) -> np.ndarray:
    """Points (k, 3) that pixels (n,) with these depths (height, width) see: every m-th one, so that ``count`` are left
    at least, or all."""
    step = max(1, rows.size // count)
    rows, columns = rows[::step], columns[::step]
    return camera.unproject(columns, rows, depth[rows, columns])


def box(mask: np.ndarray) -> tuple[int, int, int, int]:
    """Left, top, width and height of the set pixels of a mask, bool (height, width); all 0 where none is set."""
    left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
    return left, top, width, height


def fills(mask_box: tuple[int, int, int, int], measured: np.ndarray) -> bool:
    """Whether the box of a mask, as by :func:`box`, runs out of all readings, bool (height, width), on opposite sides.
    Readings need not reach the border of the image, as those of a rectified one and of a stereo camera do not."""
    # Share of a side of an image: the most of it that a band without readings takes along a border; beyond more there
    # is nothing to measure. That of a D435 takes so much of what is 0.25 m away. Chosen.
    band = 0.1
    (left, top, wide, high), (rows, columns) = mask_box, measured.shape
    across = left <= band * columns and left + wide >= (1 - band) * columns
    down = top <= band * rows and top + high >= (1 - band) * rows
    if not (across or down):
        return False
    first_column, first_row, width, height = box(measured)
    across &= left <= first_column and left + wide >= first_column + width
    return bool(across or (down and top <= first_row and top + high >= first_row + height))


@kernel
def renumber(labels: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Labels int32 (height, width) with other ones in their place: ``number`` (count + 1,) gives that of each."""
    found = np.empty(labels.shape, np.int32)
    for v in range(labels.shape[0]):
        for u in range(labels.shape[1]):
            found[v, u] = number[labels[v, u]]
    return found


@kernel
def _pixels(
    labels: np.ndarray, label: int, count: int, top: int, bottom: int, left: int, right: int
) -> tuple[np.ndarray, np.ndarray]:
    rows, columns, n = np.empty(count, np.int64), np.empty(count, np.int64), 0
    for v in range(top, bottom):
        for u in range(left, right):
            if labels[v, u] == label:
                rows[n], columns[n] = v, u
                n += 1
    return rows, columns


@kernel
def _extents(labels: np.ndarray, count: int) -> np.ndarray:
    height, width = labels.shape
    found = np.zeros((count + 1, 5), np.int64)
    for v in range(height):
        u = 0
        while u < width:
            label, first = labels[v, u], u
            while u < width and labels[v, u] == label:
                u += 1
            if label > 0:
                extent = found[label]
                if extent[0] == 0:
                    extent[1], extent[3] = v, first
                extent[0] += u - first
                extent[2] = v + 1
                extent[3] = min(extent[3], first)
                extent[4] = max(extent[4], u)
    return found


def beside(labels: np.ndarray, depth: np.ndarray, near: float) -> np.ndarray:
    """Which two of the labels of an image are next to each other along a row or a column, across pixels without a
    depth (0), and less than ``near`` metres apart along the line of sight: bool (n, n) by label; none is beside 0."""
    labels = np.ascontiguousarray(labels, dtype=np.int32)
    found = _beside(labels, np.ascontiguousarray(depth, dtype=np.float32), int(labels.max()) + 1, near)
    return np.asarray(found | found.T)


@kernel
def _beside(labels: np.ndarray, depth: np.ndarray, count: int, near: float) -> np.ndarray:
    """As :func:`beside`, for one of the two orders of each pair."""
    found = np.zeros((count, count), np.bool_)
    # The last pixel with a depth in each column, and in this row.
    above, above_z = np.zeros(labels.shape[1], np.int32), np.zeros(labels.shape[1], np.float32)
    for v in range(labels.shape[0]):
        left, left_z = np.int32(0), np.float32(0)
        for u in range(labels.shape[1]):
            z = depth[v, u]
            if z > 0:
                here = labels[v, u]
                for other, other_z in ((left, left_z), (above[u], above_z[u])):
                    if other != here and other > 0 and here > 0 and abs(other_z - z) < near:
                        found[other, here] = True
                left = above[u] = here
                left_z = above_z[u] = z
    return found
