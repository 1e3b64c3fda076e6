"""Regions of a label image: int32 (height, width), 0 for nothing, labels from 1; and of a mask."""

from __future__ import annotations

import cv2
import numpy as np

from sq_perception.geometry.kernels import kernel

_OPEN = 0.1
"""Share of a region's border from which on it is not enclosed by others."""


def nearest(wanted: np.ndarray) -> np.ndarray:
    """Of each pixel (height, width) the nearest one of some, bool, at least one: its index into the flat image."""
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
    """Of each label (count + 1, 5): how many pixels it has, its first row, the one after its last, and its columns
    alike.  All 0 for a label without pixels and for 0."""
    labels = np.ascontiguousarray(labels, dtype=np.int32)
    return np.asarray(_extents(labels, int(labels.max(initial=0))))


def pixels(labels: np.ndarray, label: int, extent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of a label's pixels, by its extent."""
    rows, columns = _pixels(np.ascontiguousarray(labels, dtype=np.int32), int(label), *extent.tolist())
    return rows, columns


def box(mask: np.ndarray) -> tuple[int, int, int, int]:
    """Left, top, width and height of the set pixels of a mask, bool (height, width); all 0 where none is set."""
    left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
    return left, top, width, height


@kernel
def renumbered(labels: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Labels int32 (height, width) with other ones in their place: number (count + 1,) of each."""
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


def contacts(labels: np.ndarray, known: np.ndarray, count: int) -> np.ndarray:
    """How often each two of the labels 0 to ``count`` (count + 1, count + 1) are next to each other along the rows and
    the columns of an image, across pixels that are not ``known``; the image's border is of label 0."""
    labels = np.ascontiguousarray(labels, dtype=np.int32)
    met = _contacts(labels, np.ascontiguousarray(known), count)
    return np.asarray(met + met.T)


def enclosed(met: np.ndarray) -> np.ndarray:
    """Which labels (n,) are next to others nearly all around, hardly to 0, by their :func:`contacts`."""
    return np.asarray(met[:, 0] < _OPEN * met.sum(axis=1))


@kernel
def _contacts(labels: np.ndarray, known: np.ndarray, count: int) -> np.ndarray:
    met = np.zeros((count + 1, count + 1))
    above = np.zeros(labels.shape[1], np.int32)
    for v in range(labels.shape[0]):
        left = 0
        for u in range(labels.shape[1]):
            if known[v, u]:
                label = labels[v, u]
                met[left, label] += left != label
                met[above[u], label] += above[u] != label
                left = above[u] = label
        met[left, 0] += left != 0
    for u in range(labels.shape[1]):
        met[above[u], 0] += above[u] != 0
    return met
