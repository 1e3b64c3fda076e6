"""Segments of simulated scenes, with the truth of which readings belong to their object: training data.

Objects on a table (:mod:`~sq_perception.simulation.things_on_table`) that ends in sight in many scenes
(:mod:`~sq_perception.simulation.furniture`), or in and on furniture (:mod:`~sq_perception.simulation.furniture`), or
crowds of superquadrics (:mod:`~sq_perception.simulation.scenes`), before a random camera, are measured by a known
sensor or by a random one (:mod:`~sq_perception.simulation.thing_views`); many images are cropped, so that their
borders cut objects.  Each image is segmented as in recovery, and each segment becomes a
:class:`~sq_perception.imaging.segment_view.SegmentView`.  Its object is the one that most of its pixels show; a
segment that shows table, furniture or room at half of its pixels, and no object at 30 % of them, has none.  A reading
belongs to the object if its pixel shows the object and its error is at most 10 mm + 1 %, which excludes smeared
edges.

The network also learns whether a segment is one object.  So the views include compact pieces of segments
and of two merged neighbours, each with the object that it shows; the rest
of the segment counts as other segments.  For a segment of several objects there is a view of each one's part. """

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from sq_perception.imaging import regions, segment_view
from sq_perception.imaging.camera import Camera
from sq_perception.imaging.segment_view import SegmentView
from sq_perception.segmentation import segments
from sq_perception.segmentation.evidence import FrameEvidence
from sq_perception.simulation import furniture, scenes, sensor_noise, thing_views
from sq_perception.simulation.camera_stages import Stages
from sq_perception.simulation.things_on_table import TABLE_CAMERA, things_on_table

NO, YES, UNKNOWN = 0, 1, 2
_SMEARED, _NO_OBJECT = -1, -2
"""In place of an object's label: what a cell shows that a sensor smeared, and the object of a segment that has none."""


@dataclass(frozen=True, eq=False)
class SegmentViews:
    """Views of n segments, p x p cells."""

    images: np.ndarray  # float16 (n, p, p, CHANNELS), as in :class:`~sq_perception.imaging.segment_view.SegmentView`
    truth: np.ndarray
    """uint8 (n, p, p), whether the cell's reading is one of the object: NO, YES, or UNKNOWN where there is none."""


def draw_segment_views(scenes: int, rng: np.random.Generator) -> SegmentViews:
    """Draw views of all segments of some random scenes, and of pieces of them."""
    images, truth = [], []
    for _ in range(scenes):
        for image, own in _views(_measure(rng), rng):
            if np.count_nonzero(image[..., segment_view.MEASURED] * image[..., segment_view.SEGMENT]) >= 8:
                images.append(image.astype(np.float16))
                truth.append(own)
    size = segment_view.PIXELS
    shape = (len(images), size, size)
    return SegmentViews(
        np.array(images, np.float16).reshape(*shape, segment_view.CHANNELS), np.array(truth, np.uint8).reshape(shape)
    )


@dataclass(frozen=True, eq=False)
class _Measured:
    """An image (height, width) that a sensor took; ``shown`` are the labels of its objects, 0 for none."""

    depth: np.ndarray
    true_depth: np.ndarray
    shown: np.ndarray
    camera: Camera

    def view(self, labels: np.ndarray, label: int, plane: np.ndarray | None) -> SegmentView:
        window = regions.window(regions.extents(labels)[label])
        return segment_view.from_segment(self.depth, labels, label, window, self.camera, plane)

    def in_cells(self, view: SegmentView) -> tuple[np.ndarray, np.ndarray]:
        """Return what the cells (p, p) of a view show, labels or ``_SMEARED``, and whether they have a reading."""
        height, width = self.depth.shape
        grid = np.ix_(np.clip(view.rows, 0, height - 1), np.clip(view.columns, 0, width - 1))
        near = np.abs(self.depth[grid] - self.true_depth[grid]) < 0.01 + 0.01 * self.depth[grid]
        return np.where(near, self.shown[grid], _SMEARED), view.image[..., segment_view.MEASURED] > 0


def _measure(rng: np.random.Generator) -> _Measured:
    """Draw a random image."""
    true_depth, shown, camera = _scene(rng)
    # As if all of it were larger and as much farther away: a large object is not refused for its size.
    if rng.random() < 0.35:
        true_depth = rng.uniform(1.0, 2.5) * true_depth
    if rng.random() < 0.35:
        depth = thing_views.measure_by_any(true_depth, shown > 0, camera, Stages(), rng)
    else:
        sensors = ("realsense_d435", "kinect_v1", "realsense_d435", "kinect_v1", "azure_kinect", "zed")
        depth = sensor_noise.preset(str(rng.choice(sensors))).measure(true_depth, camera, rng)
    window = _cut(shown, rng)
    depth, true_depth, shown = (np.ascontiguousarray(each[window]) for each in (depth, true_depth, shown))
    camera = camera.cropped(window[1].start, window[0].start, depth.shape[1], depth.shape[0])
    return _Measured(depth, true_depth, shown, camera)


def _scene(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, Camera]:
    """Draw the true depth (height, width), +inf for no surface, and labels of a random scene."""
    camera, kind = _camera(rng), rng.random()
    if kind < 0.2:
        depth, shown = scenes.draw_crowd(rng, int(rng.integers(1, scenes.MOST + 1)), camera).render()
        return np.where(np.isnan(depth), np.inf, depth), shown, camera
    if kind < 0.5:
        drawn = furniture.things_in_furniture(str(rng.choice(furniture.KINDS)), rng, camera)
        return drawn.depth, drawn.labels, camera
    elevations = (6.0, 20.0), (20.0, 70.0), (70.0, 90.0)
    drawn = things_on_table(rng, camera=camera, elevation=elevations[rng.choice(3, p=(0.2, 0.65, 0.15))])
    return furniture.add_room(drawn, rng) if rng.random() < 0.6 else drawn.depth, drawn.labels, camera


def _views(measured: _Measured, rng: np.random.Generator) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Return images and truth of segments, and of pieces of them."""
    found = segments.segment(measured.depth, measured.camera)
    for label in found.ids:
        view = measured.view(found.labels, label, found.plane)
        counts = np.bincount(measured.shown[found.labels == label], minlength=2)
        thing = int(counts[1:].argmax()) + 1
        if counts[0] >= 0.5 * counts.sum() and counts[thing] <= 0.3 * counts.sum():
            thing = _NO_OBJECT
        yield view.image, _truth(*measured.in_cells(view), thing)
        yield from _views_of_pieces(view, measured, rng)
        yield from _views_of_merged(label, found, measured, rng)


def _views_of_merged(
    label: int, found: FrameEvidence, measured: _Measured, rng: np.random.Generator
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Return images and truth of each object in a merged segment, and of pieces of it joined to a neighbour."""
    mask = found.labels == label
    counts = np.bincount(measured.shown[mask], minlength=1)
    things = np.flatnonzero(counts[1:] > 0.1 * counts.sum()) + 1
    for thing in things if len(things) > 1 else ():
        free = int(found.labels.max()) + 1
        parts = np.where(mask & (measured.shown == thing), np.int32(free), found.labels)
        view = measured.view(parts, free, found.plane)
        yield view.image, _truth(*measured.in_cells(view), int(thing))
    # Neighbours are within three pixels.
    others = np.unique(found.labels[cv2.dilate(mask.view(np.uint8), np.ones((7, 7), np.uint8)) > 0])
    others = others[others > label]
    if len(others) and rng.random() < 0.3:
        both = np.where(found.labels == rng.choice(others), np.int32(label), found.labels)
        yield from _views_of_pieces(measured.view(both, label, found.plane), measured, rng)


def _views_of_pieces(
    view: SegmentView, measured: _Measured, rng: np.random.Generator
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Return images and truth of pieces of a segment that show one object: one piece, or all if they show several."""
    cells, known = measured.in_cells(view)
    segment = view.image[..., segment_view.SEGMENT] > 0
    some, of = [], []
    count, (row, column) = int(rng.integers(3, 7)), rng.uniform(0, segment_view.PIXELS, 2)
    numbers = segment_view.compact_pieces(segment, count, (row, column))
    for number in range(numbers.max() + 1):
        piece = numbers == number
        counts = np.bincount(cells[piece & known & (cells >= 0)], minlength=1)
        if counts.max() >= max(1, 0.7 * np.count_nonzero(piece & known)):
            some.append(piece)
            of.append(int(counts.argmax()))
    for k in range(len(some)) if len(set(of)) > 1 else rng.permutation(len(some))[:1]:
        yield view.of_part(some[k]), _truth(cells, known, of[k] or _NO_OBJECT)


def _camera(rng: np.random.Generator) -> Camera:
    width = int(rng.choice((160, 320, 640, 1280), p=(0.1, 0.1, 0.65, 0.15)))
    height = width * (9 if width == 1280 else 12) // 16
    # Focal lengths at VGA of depth cameras, 49 to 73 degrees wide.
    focal = (rng.uniform(430.0, 700.0) if rng.random() < 0.5 else TABLE_CAMERA.fx) * width / TABLE_CAMERA.width
    return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def _cut(shown: np.ndarray, rng: np.random.Generator) -> tuple[slice, slice]:
    """Return a window of the image; some are small, at or beside an object, so that their borders cut objects."""
    height, width = shown.shape
    if rng.random() >= 0.6:
        return slice(0, height), slice(0, width)
    size = np.rint(rng.uniform(0.35, 0.9) * np.array([height, width])).astype(int)
    things = np.unique(shown[shown > 0])
    middle = np.mean(np.nonzero(shown == rng.choice(things)), axis=1) if len(things) else 0.5 * size
    first = np.rint(middle + (rng.uniform(-0.5, 0.5, 2) - 0.5) * size).astype(int)
    top, left = np.clip(first, 0, np.array([height, width]) - size)
    return slice(int(top), int(top + size[0])), slice(int(left), int(left + size[1]))


def _truth(cells: np.ndarray, known: np.ndarray, thing: int) -> np.ndarray:
    """Return NO, YES or UNKNOWN (p, p)."""
    return np.where(known, np.where(cells == thing, YES, NO), UNKNOWN).astype(np.uint8)
