"""Objects of a depth image: the support plane away, what stands on it taken apart, and what is no thing left out.

Steps
-----
1. The support plane, bent as the sensor bends it (:mod:`sq_perception.segmentation.support_plane`), and what is clearly
   above it.
2. Components of it that no depth step cuts, taken apart where lines of sight within them cross empty space, and joined
   where none between them does (:mod:`sq_perception.segmentation.bodies`).
3. What stands on the level top of one is looked for again, with that top as its support: where it rises by little more
   than the noise, it was taken for a part of the segment (:mod:`sq_perception.segmentation.level_faces`).
4. Walls of a bin or a tray around things go (:mod:`sq_perception.segmentation.container_walls`).
5. Each is a thing with a probability (:mod:`sq_perception.segmentation.objectness`), which a network that sees it in
   its surroundings sharpens (:mod:`sq_perception.recovery.own_segments`).
6. Limits of size and place, and of number, are asked of what then remains.

Bodies are taken to be convex, or vessels.  Two bodies whose faces lie flush cannot be told apart by their depth.
Things on a higher table are found as well, those on a lower one are not.  Where no support is seen, or the readings are
a silhouette no larger than a thing, as of a masked image, all of them are taken apart.  An orthographic camera sees the
thesis' world: there is no plane, and every connected set of pixels in the workspace is an object, of any size.

Metres and pixels.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import cv2
import numpy as np

from sq_perception.imaging import depth_steps, regions
from sq_perception.imaging.camera import Camera
from sq_perception.segmentation import bodies, container_walls, convex_parts, level_faces, objectness, support_plane
from sq_perception.segmentation.evidence import UNKNOWN_SIGMA, FrameEvidence
from sq_perception.segmentation.objectness import HeightEvidence
from sq_perception.segmentation.options import EVERYTHING, LARGEST_THING, POINTS, SegmentationOptions, largest_edge

_LEAST_PIXELS, _LEAST_SHARE = 30, 5e-4
"""What an object has at least, pixels and share of the image; at VGA a square of 2 cm at 0.8 m."""
_SIDE_MEASURED = 0.6
"""Share of a side of the readings' box from which on they go on beyond it: a silhouette touches it here and there."""
_LEAST_PIECE = 0.02
"""Share of a silhouette no larger than a thing that one of several things in it has at least."""


def segment(depth: np.ndarray, camera: Camera, options: SegmentationOptions | None = None) -> FrameEvidence:
    """Find the objects in a depth image.

    Parameters
    ----------
    depth : float (height, width)
        Metres in the optical frame, not finite where nothing was measured.
    camera : Camera

    Returns
    -------
    FrameEvidence
        Without objects for an empty table, a wall, or an image without depth.

    Raises
    ------
    ValueError
        If the image does not fit the camera.
    """
    options = options or SegmentationOptions()
    return limited(judged(proposed(depth, camera, options.depth_range)), depth, camera, options)


def proposed(depth: np.ndarray, camera: Camera, depth_range: tuple[float, float] = EVERYTHING) -> FrameEvidence:
    """Segments that may be objects; neither judged nor limited.  Arguments and errors as for :func:`segment`."""
    depth, valid = _checked(depth, camera, depth_range)
    least = least_pixels(depth.size)
    if not camera.is_pinhole:
        return _ordered(FrameEvidence(depth_steps.components(valid)), least)
    if np.count_nonzero(valid) < least:
        return FrameEvidence(np.zeros(depth.shape, np.int32))
    known = cv2.copyTo(depth, valid.view(np.uint8))  # and 0 elsewhere
    is_silhouette = _is_silhouette(valid)
    if is_silhouette and _size(valid, known, camera) <= LARGEST_THING:
        return _without_support(known, valid, camera, max(least, round(_LEAST_PIECE * np.count_nonzero(valid))))
    planes = support_plane.planes(depth, valid, camera)
    plane = support_plane.support(planes, depth, valid, camera)
    if plane is None:
        return _without_support(known, valid, camera, least)
    support = support_plane.measured(plane, known, valid, camera)
    relative = support.image_relative(known, camera)
    labels = bodies.above(known, camera, relative, valid, support)
    tops = level_faces.samples(labels, known, camera, least)
    for face in level_faces.found(tops, labels, known, camera, support, least):
        labels = _unloaded(labels, face, known, camera, least)
    around = container_walls.walls(tops, plane.equation)
    labels = np.where(np.isin(labels, list(around)), 0, labels) if around else labels
    found = _ordered(FrameEvidence(labels, support=support), least)
    if is_silhouette and not found.ids:
        return _without_support(known, valid, camera, least)
    return replace(found, heights=HeightEvidence(relative, found.labels, support.sigma))


def judged(found: FrameEvidence) -> FrameEvidence:
    """Segments that are things by their heights alone: for use without a network."""
    if found.heights is None:
        return found
    rise = found.heights.rise(found.labels, found.ids).tolist()
    likely = {k: objectness.probability(objectness.logit(z)) for k, z in zip(found.ids, rise, strict=True)}
    return found.kept({label: each for label, each in likely.items() if each >= objectness.LEAST})


def limited(found: FrameEvidence, depth: np.ndarray, camera: Camera, options: SegmentationOptions) -> FrameEvidence:
    """Segments that are no larger than ``max_size``, in the workspace, and no more than ``max_objects``."""
    depth, valid = _checked(depth, camera, options.depth_range)
    up = None if found.plane is None else found.plane[:3]
    larger, outside = set(), set()
    extents = regions.extents(found.labels)
    for label in found.ids:
        rows, columns = regions.pixels(found.labels, label, extents[label])
        seen = valid[rows, columns]
        points = regions.some_points(rows[seen], columns[seen], depth, camera, POINTS)
        if camera.is_pinhole and not options.is_small(points, up):
            larger.add(label)
        elif not options.is_within(points):
            outside.add(label)
    left = [label for label in found.ids if label not in larger | outside]
    ids = left[: options.max_objects]
    likely = found.likely()
    is_cut = found.is_cut or len(left) > len(ids)
    found = replace(found, is_cut=is_cut, larger=len(larger), outside=len(outside), heights=None)
    return found.kept({label: likely[label] for label in ids})


def from_labels(
    labels: np.ndarray, depth: np.ndarray, camera: Camera, options: SegmentationOptions | None = None
) -> FrameEvidence:
    """Objects given from outside as a label image; the support plane comes from the pixels around them.

    Parameters
    ----------
    labels : integer (height, width)
        0 (and anything negative) is background; other values are kept as they are, without those that have no depth.
    depth, camera
        As in :func:`segment`.

    Raises
    ------
    ValueError
        If either image does not fit the camera, or labels are no integers, or some are beyond 32 bits.
    """
    options = options or SegmentationOptions()
    labels = np.asarray(labels)
    if labels.dtype.kind not in "iub":
        raise ValueError(f"labels: expected an integer image, got {labels.dtype}")
    if labels.max(initial=0) > np.iinfo(np.int32).max:
        raise ValueError(f"labels: expected numbers below 2^31, got {labels.max()}")
    if labels.ndim != 2:
        raise ValueError(f"labels: expected shape (height, width), got {labels.shape}")
    camera.check_image(labels)
    depth, valid = _checked(depth, camera, options.depth_range)
    labels = np.maximum(labels, 0).astype(np.int32)
    inside = np.flatnonzero(valid & (labels > 0))  # of a table with few things, few pixels: these are sorted
    values, counts = np.unique(labels.flat[inside], return_counts=True)
    order = np.argsort(-counts, kind="stable").tolist()
    if options.workspace is not None:
        rows, columns = np.unravel_index(inside[np.argsort(labels.flat[inside], kind="stable")], labels.shape)
        points = np.split(camera.unproject(columns, rows, depth[rows, columns]), np.cumsum(counts)[:-1])
        # No more are asked than are wanted: a depth image that was taken for masks has thousands.
        order = list(islice((k for k in order if options.is_within(points[k])), options.max_objects + 1))
    ids = tuple(int(values[k]) for k in order)
    is_cut = len(ids) > options.max_objects
    ids = ids[: options.max_objects]
    around = support_plane.around(labels, ids, depth, valid, camera) if ids and camera.is_pinhole else None
    return FrameEvidence(labels, ids, None if around is None else support_plane.flat(around), is_cut=is_cut)


def least_pixels(size: int) -> int:
    """The least number of pixels of an object, in an image of ``size`` pixels."""
    return max(_LEAST_PIXELS, round(_LEAST_SHARE * size))


def support_under(
    found: FrameEvidence, label: int, depth: np.ndarray, camera: Camera, options: SegmentationOptions | None = None
) -> np.ndarray | None:
    """The plane (4,) that the surroundings of one object show below it; None if they show none but the segmentation's.

    For objects that do not stand on that one: a frame may show a table, a shelf and the floor.  ``depth`` and
    ``camera`` are those of the segmentation.
    """
    options = options or SegmentationOptions()
    depth, valid = _checked(depth, camera, options.depth_range)
    if not camera.is_pinhole or not ((found.labels == label) & valid).any():
        return None
    around = support_plane.around(found.labels, (label,), depth, valid, camera, found.plane)
    return None if around is None else around.equation


def warm_up() -> None:
    """Compile, or load from disk, every kernel by a ball on a table, beside a hole, and by two that touch."""
    convex_parts.warm_up()
    camera = Camera(96, 72, 180.0, 180.0, 47.5, 35.5)
    v, u = np.indices((camera.height, camera.width))
    radius = np.hypot(u - camera.cx, v - camera.cy) / 20
    depth = (0.7 - 0.08 * np.sqrt(np.maximum(1 - radius**2, 0))).astype(np.float32)
    segment(np.where(np.abs(radius - 1.2) < 0.1, np.float32(np.nan), depth), camera)


def _checked(depth: np.ndarray, camera: Camera, limits: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    depth = camera.readings(depth).astype(np.float32, copy=False)
    near, far = limits
    valid = np.isfinite(depth) if np.isinf(far) else depth <= far
    if camera.is_pinhole:
        valid &= depth > 0
    if near > 0 or not camera.is_pinhole:
        valid &= depth >= near
    return depth, valid


def _size(valid: np.ndarray, depth: np.ndarray, camera: Camera) -> float:
    rows, columns = np.nonzero(valid)
    return largest_edge(regions.some_points(rows, columns, depth, camera, POINTS))


def _is_silhouette(valid: np.ndarray) -> bool:
    """Whether the readings (height, width) end within their box, and not at its sides, as a view's do."""
    left, top, width, height = regions.box(valid)
    inside = valid[top : top + height, left : left + width]
    sides = [side.mean() for side in (inside[0], inside[-1], inside[:, 0], inside[:, -1])]
    return bool(sorted(sides)[-2] < _SIDE_MEASURED)


def _without_support(known: np.ndarray, valid: np.ndarray, camera: Camera, least: int) -> FrameEvidence:
    """The segments of an image that shows no support plane, but those that fill it, as a wall does."""
    labels = bodies.taken_apart(known, valid, camera, UNKNOWN_SIGMA)
    found = _ordered(FrameEvidence(labels), least)
    extents = regions.extents(found.labels)[:, [3, 1, 4, 2]]
    boxes = {k: (extents[k, 0], extents[k, 1], *(extents[k, 2:] - extents[k, :2])) for k in found.ids}
    return found.kept({k: 1.0 for k, box in boxes.items() if _is_silhouette(valid) or not regions.fills(box, valid)})


def _unloaded(
    labels: np.ndarray, face: level_faces.LevelFace, known: np.ndarray, camera: Camera, least: int
) -> np.ndarray:
    """Labels in which what stands on a level face of a segment has its own, found with the face as support."""
    relative = face.surface.image_relative(known, camera)
    valid = face.under(labels, known, camera) & (relative > -support_plane.TOLERANCE)
    parts = _ordered(FrameEvidence(bodies.above(known, camera, relative * valid, valid, face.surface)), least)
    heights = HeightEvidence(relative, np.where(valid, parts.labels, 1), face.surface.sigma)
    parts = judged(replace(parts, heights=heights))
    return np.where(parts.labels > 0, parts.labels + labels.max(), labels)


def _ordered(found: FrameEvidence, least: int) -> FrameEvidence:
    """The largest segments of at least so many pixels."""
    counts = regions.extents(found.labels)[:, 0]
    order = np.argsort(-counts, kind="stable")
    order = order[counts[order] >= least]
    most = bodies.MOST
    return replace(found, is_cut=len(order) > most).kept(dict.fromkeys(order[:most].tolist(), 1.0))
