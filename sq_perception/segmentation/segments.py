"""Objects on a table: the support plane away, what stands on it taken apart.

Steps
-----
1. The support plane (:mod:`sq_perception.segmentation.support_plane`) and what is clearly above it; walls and other
   planes larger than a thing go first.
2. Components of it that no depth step cuts (steps 2 to 4: :mod:`sq_perception.segmentation.bodies`).
3. A component within which lines of sight cross empty space is several bodies.  Two components are one body if no line
   between them does, or if they go on behind something nearer (:mod:`sq_perception.segmentation.convex_parts`).
4. Each body is continued down to the edge of the noise on the table.
5. What stands on the level top of a segment is looked for again, with that top as its support: where it rises by little
   more than the noise, it was taken for a part of the segment (:mod:`sq_perception.segmentation.level_faces`).
6. Walls of a bin around things go (:mod:`sq_perception.segmentation.enclosures`).
7. What remains is an object if it stands on the support and is no larger than a thing
   (:mod:`sq_perception.segmentation.standing`).

Bodies are taken to be convex, or vessels.  Two bodies whose faces lie flush cannot be told apart by their depth.
Things on a higher table are found as well, those on a lower one are not.  An orthographic camera sees the thesis'
world: there is no plane, and every connected set of pixels in the workspace is an object, of any size.

Metres and pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice

import cv2
import numpy as np

from sq_perception.imaging import depth_steps, regions
from sq_perception.imaging.camera import Camera
from sq_perception.segmentation import (
    bodies,
    convex_parts,
    enclosures,
    level_faces,
    pieces,
    standing,
    support_plane,
    support_surface,
)
from sq_perception.segmentation.options import EVERYTHING, SegmentationOptions

_LEAST_PIXELS, _LEAST_SHARE = 30, 5e-4
"""What an object has at least, pixels and share of the image; at VGA a square of 2 cm at 0.8 m.  Smaller ones are bits
of noise."""
_UNKNOWN_SIGMA = 1.5e-3
"""Noise of the depth at one metre where no support shows it, metres: that of structured light (Khoshelham and Oude
Elberink, Sensors 2012)."""


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Objects of one image.

    Attributes
    ----------
    labels : int32 (height, width)
        0 for background; own labels run from 1, largest object first, labels given from outside keep their values.
    plane : (4,) or None
        n and d of the support plane, height above it = n.p + d; None where there is none.
    ids : tuple of int
        Labels in the image, the one with most pixels first.
    sigma
        Noise of the depth at one metre as measured on the plane, or a guess where there is none, metres.
    is_cut
        Whether there were more objects than ``max_objects``.
    strays : bool (height, width) or None
        Pixels of objects that did not measure them; None: not a single one that is known.
    """

    labels: np.ndarray
    plane: np.ndarray | None
    ids: tuple[int, ...]
    sigma: float = _UNKNOWN_SIGMA
    is_cut: bool = False
    strays: np.ndarray | None = None


def segment(depth: np.ndarray, camera: Camera, options: SegmentationOptions | None = None) -> Segmentation:
    """Find the objects in a depth image.

    Parameters
    ----------
    depth : float (height, width)
        Metres in the optical frame, not finite where nothing was measured.
    camera : Camera

    Returns
    -------
    Segmentation
        Without objects for an empty table, a wall, or an image without depth.

    Raises
    ------
    ValueError
        If the image does not fit the camera.
    """
    options = options or SegmentationOptions()
    depth, valid = _checked(depth, camera, options.depth_range)
    if not camera.is_pinhole:
        return _in_cube(depth, valid, camera, options)
    if np.count_nonzero(valid) < least_pixels(depth.size):
        return Segmentation(np.zeros(depth.shape, np.int32), None, ())
    planes = support_plane.planes(depth, valid, camera)
    plane = support_plane.support(planes, depth, valid, camera, options.is_small)
    known = cv2.copyTo(depth, valid.view(np.uint8))  # and 0 elsewhere
    everything = known
    if options.depth_range != EVERYTHING:
        # What is out of range holds things up and hides them all the same.
        everything, measured = _checked(depth, camera, EVERYTHING)
        everything = cv2.copyTo(everything, measured.view(np.uint8))
    seen = standing.Seen(everything, known, camera, [other for other in planes if other is not plane], options)
    return _without_support(seen, valid) if plane is None else _on_support(seen, valid, plane)


def from_labels(
    labels: np.ndarray, depth: np.ndarray, camera: Camera, options: SegmentationOptions | None = None
) -> Segmentation:
    """Objects given from outside as a label image; the support plane comes from the pixels around them.

    Parameters
    ----------
    labels : integer (height, width)
        0 (and anything negative) is background; other values are kept as they are.
    depth, camera
        As in :func:`segment`.

    Returns
    -------
    Segmentation
        Labels without a valid depth pixel are left out.

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
    plane = None
    if ids and camera.is_pinhole:
        plane = support_plane.around(labels, ids, depth, valid, camera)
    return Segmentation(labels, plane, ids, is_cut=is_cut)


def least_pixels(size: int) -> int:
    """The least number of pixels of an object, in an image of ``size`` pixels."""
    return max(_LEAST_PIXELS, round(_LEAST_SHARE * size))


def support_under(
    found: Segmentation, label: int, depth: np.ndarray, camera: Camera, options: SegmentationOptions | None = None
) -> np.ndarray | None:
    """The plane (4,) that the surroundings of one object show below it; None if they show none but the segmentation's.

    For objects that do not stand on that one: a frame may show a table, a shelf and the floor.  ``depth`` and
    ``camera`` are those of the segmentation.
    """
    options = options or SegmentationOptions()
    depth, valid = _checked(depth, camera, options.depth_range)
    if not camera.is_pinhole or not ((found.labels == label) & valid).any():
        return None
    return support_plane.around(found.labels, (label,), depth, valid, camera, found.plane)


def warm_up() -> None:
    """Compile, or load from disk, every kernel by a ball on a table, beside a hole, and by two that touch."""
    convex_parts.warm_up()
    pieces.warm_up()
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


def _in_cube(depth: np.ndarray, valid: np.ndarray, camera: Camera, options: SegmentationOptions) -> Segmentation:
    """The objects of an orthographic image."""

    def is_within(rows: np.ndarray, columns: np.ndarray) -> bool:
        return options.is_within(camera.unproject(columns, rows, depth[rows, columns]))

    accept = None if options.workspace is None else is_within
    labels, ids, is_cut = _ordered(depth_steps.components(valid), least_pixels(depth.size), options.max_objects, accept)
    return Segmentation(labels, None, ids, is_cut=is_cut)


def _without_support(seen: standing.Seen, valid: np.ndarray) -> Segmentation:
    """The objects of an image that shows no support plane."""
    free = valid & ~standing.furniture(seen, valid)
    labels = bodies.taken_apart(seen.known, free, seen.camera, _UNKNOWN_SIGMA, seen.options.is_small)
    least = least_pixels(valid.size)
    labels, ids, is_cut = _ordered(labels, least, seen.options.max_objects, standing.alone(seen))
    return Segmentation(labels, None, ids, is_cut=is_cut)


def _on_support(seen: standing.Seen, valid: np.ndarray, plane: support_plane.Plane) -> Segmentation:
    """The objects that stand on a plane of the image."""
    known, camera, least = seen.known, seen.camera, least_pixels(valid.size)
    support = support_surface.measured(plane, known, valid, camera)
    relative = support.image_relative(seen.depth, camera)
    labels = bodies.above(seen, relative * valid, valid, support)
    samples = level_faces.samples(labels, known, camera, least)
    for face in level_faces.found(samples, labels, known, camera, support, least):
        labels = _unloaded(labels, face, seen, least)
    around = enclosures.walls(samples, plane.equation)
    if around:
        labels = np.where(np.isin(labels, list(around)), 0, labels)
    test = standing.standing(seen, relative, labels, support)
    labels, ids, is_cut = _ordered(labels, least, seen.options.max_objects, test)
    return Segmentation(labels, plane.equation, ids, max(support.sigma, bodies.LEAST_SIGMA), is_cut)


def _unloaded(labels: np.ndarray, face: level_faces.LevelFace, seen: standing.Seen, least: int) -> np.ndarray:
    """Labels in which what stands on a level face of a segment has its own, found with the face as support."""
    relative = face.surface.image_relative(seen.depth, seen.camera)
    valid = face.under(labels, seen.known, seen.camera) & (relative > -support_plane.TOLERANCE)
    parts = bodies.above(seen, relative * valid, valid, face.surface)
    test = standing.standing(seen, relative, parts, face.surface)
    parts, _, _ = _ordered(parts, least, parts.max(initial=0), test)
    return np.where(parts > 0, parts + labels.max(), labels)


def _ordered(
    labels: np.ndarray, least: int, most: int, accept: standing.ObjectTest | None = None
) -> tuple[np.ndarray, tuple[int, ...], bool]:
    """Components with at least ``least`` pixels, renumbered from 1 by falling size, at most ``most`` of them, and
    whether there are more.

    Those that are not accepted are asked about once more: the test knows the things beside them then.
    """
    extents = regions.extents(labels)
    order = np.argsort(-extents[:, 0], kind="stable")
    order = order[extents[order, 0] >= least]
    kept: set[int] = set()
    is_cut = False
    for label in np.tile(order, 1 if accept is None else 2).tolist():
        if label not in kept and (accept is None or accept(*regions.pixels(labels, label, extents[label]))):
            is_cut = len(kept) == most
            if is_cut:
                break
            kept.add(label)
    number = np.zeros(len(extents), np.int32)
    number[[label for label in order.tolist() if label in kept]] = np.arange(len(kept)) + 1
    return regions.renumbered(labels, number), tuple(range(1, len(kept) + 1)), is_cut
