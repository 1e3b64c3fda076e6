"""Segments of simulated tables, with which of their readings are of their object: training data.

A scene of :mod:`~sq_perception.simulation.things_on_table` before a random camera, of many the table ends in sight
(:mod:`~sq_perception.simulation.room`), is measured by one of the sensors; of many a smaller image is taken, whose
borders cut things.  It is segmented as any image is, and each segment seen as a
:class:`~sq_perception.imaging.segment_view.SegmentView`.  Its object is the thing that most of its pixels show; what
shows the table or the room at half of its pixels, and no thing at 30 % of them, has none.  A reading is one of the
object if its pixel shows the object and it is no more than 10 mm + 1 % off: what a sensor smears over an edge is not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from sq_perception.imaging import segment_view
from sq_perception.imaging.camera import Camera
from sq_perception.segmentation import segments
from sq_perception.simulation import room, sensor_noise
from sq_perception.simulation.things_on_table import TABLE_CAMERA, ThingsOnTable, things_on_table

NO, YES, UNKNOWN = 0, 1, 2
_SENSORS = ("realsense_d435", "kinect_v1", "realsense_d435", "kinect_v1", "azure_kinect", "zed")
_FOCALS, _LARGE_FOCALS = (430.0, 700.0), (800.0, 1000.0)
"""Pixels, at VGA and at 1280 x 720: depth cameras."""
_LARGE = 0.15
"""Share of the scenes at 1280 x 720."""
_WITH_ROOM = 0.6
"""Share of the scenes whose table ends in sight, before a room."""
_SMALLER, _SIDES = 0.6, (0.35, 0.9)
"""Share of the scenes of which a smaller image is taken, and its sides in those of the whole one."""
_OFF, _OFF_SHARE = 0.01, 0.01
_MOSTLY_NOTHING, _SOME_THING = 0.5, 0.3
_LEAST_CELLS = 8


@dataclass(frozen=True, eq=False)
class SegmentViews:
    """Views of n segments, p x p cells.

    Attributes
    ----------
    images : float16 (n, p, p, CHANNELS)
        Of :class:`~sq_perception.imaging.segment_view.SegmentView`.
    truth : uint8 (n, p, p)
        Whether the cell's reading is one of the object: NO, YES, or UNKNOWN where there is none.
    """

    images: np.ndarray
    truth: np.ndarray


def draw_segment_views(scenes: int, rng: np.random.Generator) -> SegmentViews:
    """Views of all segments of some random scenes."""
    images, truth = [], []
    for _ in range(scenes):
        drawn = things_on_table(rng, camera=_camera(rng))
        if rng.random() < _WITH_ROOM:
            drawn = replace(drawn, depth=room.behind(drawn, rng))
        depth = sensor_noise.preset(str(rng.choice(_SENSORS))).measured(drawn.depth, drawn.camera, rng)
        window = _cut(drawn, rng)
        depth, true_depth, labels = (np.ascontiguousarray(each[window]) for each in (depth, drawn.depth, drawn.labels))
        camera = drawn.camera.cropped(window[1].start, window[0].start, depth.shape[1], depth.shape[0])
        found = segments.segment(depth, camera)
        for label in found.ids:
            mask = found.labels == label
            left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
            extent = slice(top, top + height), slice(left, left + width)
            view = segment_view.from_segment(depth, found.labels, label, extent, camera, found.plane)
            shown = view.image[..., segment_view.MEASURED] * view.image[..., segment_view.SEGMENT]
            if np.count_nonzero(shown) >= _LEAST_CELLS:
                images.append(view.image.astype(np.float16))
                truth.append(_truth(view, depth, mask, labels, true_depth))
    size = segment_view.PIXELS
    shape = (len(images), size, size)
    return SegmentViews(
        np.array(images, np.float16).reshape(*shape, segment_view.CHANNELS), np.array(truth, np.uint8).reshape(shape)
    )


def _camera(rng: np.random.Generator) -> Camera:
    if rng.random() < _LARGE:
        focal = rng.uniform(*_LARGE_FOCALS)
        return Camera(1280, 720, focal, focal, 639.5, 359.5)
    focal = rng.uniform(*_FOCALS) if rng.random() < 0.5 else TABLE_CAMERA.fx
    return Camera(640, 480, focal, focal, 319.5, 239.5)


def _cut(scene: ThingsOnTable, rng: np.random.Generator) -> tuple[slice, slice]:
    """A window of the image; some are small, about a thing or beside it, so that their borders cut things."""
    height, width = scene.depth.shape
    if rng.random() >= _SMALLER:
        return slice(0, height), slice(0, width)
    size = np.rint(rng.uniform(*_SIDES) * np.array([height, width])).astype(int)
    thing = scene.placed[int(rng.integers(len(scene.placed)))]
    middle = np.mean(np.nonzero(scene.labels == thing.label), axis=1) if thing.pixels else 0.5 * size
    first = np.rint(middle + (rng.uniform(-0.5, 0.5, 2) - 0.5) * size).astype(int)
    top, left = np.clip(first, 0, np.array([height, width]) - size)
    return slice(int(top), int(top + size[0])), slice(int(left), int(left + size[1]))


def _truth(
    view: segment_view.SegmentView, depth: np.ndarray, mask: np.ndarray, labels: np.ndarray, true_depth: np.ndarray
) -> np.ndarray:
    """NO, YES or UNKNOWN (p, p)."""
    shown = np.bincount(labels[mask], minlength=2)
    most, total = int(shown[1:].argmax()) + 1, shown.sum()
    if shown[0] >= _MOSTLY_NOTHING * total and shown[most] <= _SOME_THING * total:
        most = -1
    grid = np.ix_(np.clip(view.rows, 0, depth.shape[0] - 1), np.clip(view.columns, 0, depth.shape[1] - 1))
    near = np.abs(depth[grid] - true_depth[grid]) < _OFF + _OFF_SHARE * depth[grid]
    truth = np.where((labels[grid] == most) & near, YES, NO)
    return np.where(view.image[..., segment_view.MEASURED] > 0, truth, UNKNOWN).astype(np.uint8)
