"""What an object stands on: the frame's plane, another one right below it, or the level top of another object.

The lowest pixels that show an object are h above the frame's plane.  If h is more than the noise, it may stand on
another object.  That one has a top at a height t, no higher than h, if a good many of its points lie within the noise
of t.  It may be lower: of a lying bottle the lowest pixels seen are as high as its axis, of a box from above as its
face.  The object stands on the top if most of its feet, seen from above, lie within the convex hull of what is seen of
the top; on the highest of such tops.

Metres, optical frame.
"""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from sq_perception.geometry.quantiles import densest, quantile
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera
from sq_perception.recovery.seen_object import SeenObject, surroundings
from sq_perception.segmentation import segments, support_plane
from sq_perception.segmentation.evidence import FrameEvidence
from sq_perception.segmentation.options import SegmentationOptions, across
from sq_perception.segmentation.support_plane import TOLERANCE

_HOVERING = 0.02  # an object this many metres above its plane, by its lowest points, may stand on another surface


def support(
    obj: SeenObject, others: Iterable[SeenObject], depth: np.ndarray, camera: Camera, found: FrameEvidence,
    options: SegmentationOptions,
) -> np.ndarray | None:
    """The plane (4,) that the object stands on; None where it stands on nothing that is known.

    In this order: the level top of another object, the frame's plane if the object reaches down to it, another plane
    right below it.  Where there is none of these, an object some way above the frame's plane stands on it all the same:
    on top of others, or reaching down unseen, as a box seen from above does.  It does not if it lies behind that plane,
    goes on below it by more than noise, is high above it, as what is held up before a wall, or if something of no
    object, no farther away, is beside it: then it stands on a board of which only the front is seen, before a wall.

    Parameters
    ----------
    others
        All objects of the frame; ``obj`` may be among them.
    depth : (height, width)
        Metres.
    """
    if found.plane is None:
        return None
    low, median = obj.levels(found.plane)
    behind, reach = median <= 0, _reach(obj)
    top = None if behind or low < reach else _top_under(obj, low, others, found.plane)
    if top is not None:
        return top
    if not behind and -reach <= low < _HOVERING:
        return found.plane
    depth, valid = segments.select_readings(depth, camera, options.depth_range)
    other = support_plane.around(found.labels, (obj.label,), depth, valid, camera, found.plane)
    if other is not None:
        lowest, middle = obj.levels(other.equation)
        if abs(lowest) < _HOVERING and middle > 0:
            return other.equation
    # Higher above its plane an object does not even stand on others that stand on it.
    if behind or low < -reach or low > 0.5:
        return None
    is_held = low > 0.1 and _is_held(obj, low, depth, camera, found.labels, found.plane)
    return None if is_held else found.plane


def _is_held(
    obj: SeenObject, low: float, depth: np.ndarray, camera: Camera, labels: np.ndarray, plane: np.ndarray
) -> bool:
    """Whether something holds an object from the side: readings of no object, not behind it and higher than its lowest
    pixels, which are ``low`` metres above a plane, along a good part of its outline."""
    nearest, farthest = 3, 8  # pixels: nearer, a sensor widens its edges
    _, near, names, view = surroundings(obj, depth, labels, camera, farthest)
    own = (names == obj.label).view(np.uint8)
    outer, inner = (cv2.dilate(own, np.ones((2 * k + 1, 2 * k + 1), np.uint8)) for k in (farthest, nearest))
    beside = outer > inner
    seen = beside & (names == 0) & (near < quantile(obj.depth_crop[obj.mask_crop], 0.5) + obj.step)
    above = raycast.heights(near, seen, view.lens, plane) > low
    return bool(np.count_nonzero(above) > 0.15 * np.count_nonzero(beside))


def _reach(obj: SeenObject) -> float:
    """Metres by which what is on a plane may be off it, at the object's distance."""
    return TOLERANCE * float(support_plane.noise_growth(np.array(quantile(obj.depth_crop[obj.mask_crop], 0.5))))


def _top_under(obj: SeenObject, low: float, others: Iterable[SeenObject], plane: np.ndarray) -> np.ndarray | None:
    """The level top (4,) of another object under this one, whose lowest pixels are ``low`` above a plane (4,)."""
    near = [other for other in others if other.label != obj.label and _meet(obj.window, other.window)]
    if not near:
        return None
    reach = _reach(obj)
    axes, best = across(plane[:3]), 0.0
    points = obj.points
    feet = (points[points @ plane[:3] + plane[3] < low + 0.01] @ axes).astype(np.float32)  # within a centimetre
    for other in near:
        points = other.points
        heights = points @ plane[:3] + plane[3]
        ordered = np.sort(heights[heights < low + 2 * reach])
        if not len(ordered):
            continue
        height = float(np.median(ordered[densest(ordered, reach)]))
        hull = cv2.convexHull((points[np.abs(heights - height) < reach] @ axes).astype(np.float32))
        inside = np.median([cv2.pointPolygonTest(hull, foot, True) for foot in feet.tolist()])
        if inside > 0:
            best = max(best, height)
    return plane - np.array([0, 0, 0, best]) if best > 0 else None


def _meet(one: tuple[slice, slice], other: tuple[slice, slice]) -> bool:
    """Whether two windows of an image overlap, or are up to three pixels apart."""
    return all(a.start < b.stop + 3 and b.start < a.stop + 3 for a, b in zip(one, other, strict=True))
