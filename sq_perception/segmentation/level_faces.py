"""Level faces of segments: the tops of cartons and stools, on which other things may stand.

A thing that stands on a larger one is often low before the noise, or its surface goes on into that of the larger one:
then both are one segment.  The larger one's top is a plane as level as the support, and above that plane the smaller
one stands alone.  Of the heights of a segment above the support

    a face is where most of them lie within a tolerance of one height,

clearly higher than the support, and more points lie on it than above it: the bottom of a vessel lies low, and its wall
is most of what is seen of it.

Metres, optical frame.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sq_perception.geometry.quantiles import densest, deviation, quantile
from sq_perception.imaging import regions
from sq_perception.imaging.camera import Camera
from sq_perception.segmentation.options import POINTS, TURNS, across
from sq_perception.segmentation.support_plane import TOLERANCE, Plane, noise_growth

_LOWEST = 5.0
"""Tolerances above the support at which a face lies at least: lower ones are books and bumps."""
_LAYER = 0.7
"""Share of the points within two tolerances that lie within one: of a plane nearly all, of noise half."""


def samples(labels: np.ndarray, depth: np.ndarray, camera: Camera, least: int) -> dict[int, np.ndarray]:
    """Some hundred points (n, 3) of each segment of at least so many pixels, evenly taken; the largest one first."""
    extents = regions.extents(labels)
    order = np.argsort(-extents[:, 0], kind="stable")
    order = order[(extents[order, 0] >= least) & (order > 0)].tolist()
    return {k: regions.some_points(*regions.pixels(labels, k, extents[k]), depth, camera, POINTS) for k in order}


def find_faces(
    segments: Mapping[int, np.ndarray], labels: np.ndarray, depth: np.ndarray, camera: Camera, support: Plane,
    least: int,
) -> dict[int, Plane]:
    """Find the level faces, as supports, of the segments that have one, and at least ``least`` pixels above it; in the
    order of ``segments``, samples of what stands on the ``support``."""
    extents, faces = regions.extents(labels), {}
    for label, points in segments.items():
        if (face := _face(points, support)) is not None:
            pixels = regions.pixels(labels, label, extents[label])
            everything = camera.unproject(*pixels[::-1], depth[pixels])
            off = face.height(everything) / noise_growth(everything[:, 2])
            if np.count_nonzero(off > face.clear_height) >= least:
                faces[label] = face
    return faces


def find_above(
    label: int, points: np.ndarray, face: Plane, labels: np.ndarray, depth: np.ndarray, camera: Camera
) -> np.ndarray:
    """Find the pixels (height, width) of a segment with a level face, known by its points (n, 3), and of all segments
    whose middle is right above it.  Other faces may have taken all pixels of the segment by now."""
    axes = TURNS @ across(face.equation[:3]).T
    low, high = (axes @ points.T).min(axis=1), (axes @ points.T).max(axis=1)
    is_over = np.zeros(int(labels.max()) + 1, bool)
    for other, some in samples(labels, depth, camera, 1).items():
        middle = np.median(axes @ some.T, axis=1)
        is_over[other] = other == label or ((middle > low) & (middle < high)).all()
    return is_over[labels]


def _face(points: np.ndarray, support: Plane) -> Plane | None:
    """The level face that most points (n, 3) of a segment lie on; None where more of them are above it."""
    growth = noise_growth(points[:, 2])
    height = support.height(points)
    reach = TOLERANCE * quantile(growth, 0.5)
    ordered = np.sort(height[height >= _LOWEST * reach])
    level = ordered[densest(ordered, reach)]
    if not len(level):
        return None
    at = float(np.median(level))
    off = (height - at) / growth
    on = np.abs(off) < TOLERANCE
    count = np.count_nonzero(on)
    within, above = (int(np.count_nonzero(some)) for some in (np.abs(off) < 2 * TOLERANCE, off > TOLERANCE))
    if count < max(_LAYER * within, above):
        return None
    sigma = max(support.sigma, deviation(np.abs(off[on])))
    return Plane(support.equation - np.array([0, 0, 0, at]), count / len(points), sigma)
