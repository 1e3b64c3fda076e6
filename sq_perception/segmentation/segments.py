"""Objects of a depth image: the support plane away, what stands on it taken apart, and what is no thing left out.

Steps
-----
1. The support plane (:mod:`sq_perception.segmentation.support_plane`), and what is clearly above it.
2. Components of it that no depth step cuts, taken apart where lines of sight within them cross empty space, joined
   where none between them does (:mod:`sq_perception.segmentation.convex_parts`), and continued down to their foot.
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

from collections.abc import Mapping
from dataclasses import replace
from itertools import islice

import cv2
import numpy as np

from sq_perception.geometry.quantiles import MEDIAN_TO_SIGMA, quantile
from sq_perception.imaging import depth_steps, regions
from sq_perception.imaging.camera import Camera
from sq_perception.segmentation import container_walls, convex_parts, level_faces, objectness, support_plane
from sq_perception.segmentation.evidence import UNKNOWN_SIGMA, FrameEvidence
from sq_perception.segmentation.objectness import HeightEvidence
from sq_perception.segmentation.options import EVERYTHING, LARGEST_THING, POINTS, SegmentationOptions, largest_edge
from sq_perception.segmentation.support_plane import CLEARLY, LEAST_SIGMA, TOLERANCE, Plane

_LEAST_PIXELS, _LEAST_SHARE = 30, 5e-4
"""What an object has at least, pixels and share of the image; at VGA a square of 2 cm at 0.8 m."""
_SIDE_MEASURED = 0.6
"""Share of a side of the readings' box from which on they go on beyond it: a silhouette touches it here and there."""
_LEAST_PIECE = 0.02
"""Share of a silhouette no larger than a thing that one of several things in it has at least."""
_WIDE = 9
"""Pixels a side of the windows by whose means low things are told from noise."""
_LEAST_AREA = 1e-4
"""Least area of a component without a step in it, square metres across the line of sight."""
_MOST = 128
"""Components, and segments, that are looked at: bounds the time of frames that are noise alone."""
_GROWN = 3
"""Pixels that components grow by: those beside a step, where they are narrow, and down to the foot of a thing."""
_GAP = 0.1
"""Share of the depth by which pixels of a surface with steps in it differ at most: what lies behind a fringe is
farther."""


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
    return limit(judge(propose(depth, camera, options.depth_range)), depth, camera, options)


def propose(depth: np.ndarray, camera: Camera, depth_range: tuple[float, float] = EVERYTHING) -> FrameEvidence:
    """Find segments that may be objects; neither judged nor limited.  Arguments and errors as for :func:`segment`."""
    depth, valid = select_readings(depth, camera, depth_range)
    least = least_pixels(depth.size)
    if not camera.is_pinhole:
        return _order(FrameEvidence(depth_steps.components(valid)), least)
    if np.count_nonzero(valid) < least:
        return FrameEvidence(np.zeros(depth.shape, np.int32))
    known = cv2.copyTo(depth, valid.view(np.uint8))  # and 0 elsewhere
    is_silhouette, (rows, columns) = _is_silhouette(valid), np.nonzero(valid)
    if is_silhouette and largest_edge(regions.some_points(rows, columns, known, camera, POINTS)) <= LARGEST_THING:
        return _without_support(known, valid, camera, max(least, round(_LEAST_PIECE * np.count_nonzero(valid))))
    support = support_plane.support(depth, valid, camera)
    if support is None:
        return _without_support(known, valid, camera, least)
    relative = support.image_relative(known, camera)
    labels = _find_raised(known, camera, relative, valid, support)
    tops = level_faces.samples(labels, known, camera, least)
    for label, face in level_faces.find_faces(tops, labels, known, camera, support, least).items():
        valid = level_faces.find_above(label, tops[label], face, labels, known, camera)
        labels = _unload(labels, valid, face, known, camera, least)
    around = container_walls.walls(tops, support.equation)
    labels = np.where(np.isin(labels, list(around)), 0, labels) if around else labels
    found = _order(FrameEvidence(labels, support=support), least)
    if is_silhouette and not found.ids:
        return _without_support(known, valid, camera, least)
    return replace(found, heights=HeightEvidence(relative, found.labels, support.sigma))


def judge(found: FrameEvidence, medians: Mapping[int, float] | None = None) -> FrameEvidence:
    """Keep segments that are things by their heights, and by the median logits of a network that saw them; where there
    is no support, all of them."""
    likely = dict.fromkeys(found.ids, 1.0)
    if found.heights is not None:
        rise = found.heights.rise(found.labels, found.ids).tolist()
        asked = dict.fromkeys(found.ids) if medians is None else medians
        likely = {k: objectness.prior(z, asked[k]) for k, z in zip(found.ids, rise, strict=True)}
    return found.keep({label: each for label, each in likely.items() if each >= objectness.LEAST})


def limit(found: FrameEvidence, depth: np.ndarray, camera: Camera, options: SegmentationOptions) -> FrameEvidence:
    """Keep segments that are no larger than ``max_size``, in the workspace, and no more than ``max_objects``."""
    depth, valid = select_readings(depth, camera, options.depth_range)
    up = None if found.plane is None else found.plane[:3]
    larger, outside = set(), set()
    extents = regions.extents(found.labels)
    for label in found.ids:
        rows, columns = regions.pixels(found.labels, label, extents[label])
        seen = valid[rows, columns]
        points = regions.some_points(rows[seen], columns[seen], depth, camera, POINTS)
        if camera.is_pinhole and largest_edge(points, up) > options.max_size:
            larger.add(label)
        elif not options.is_within(points):
            outside.add(label)
    left = [label for label in found.ids if label not in larger | outside]
    ids = left[: options.max_objects]
    likely = found.objectness_by_label()
    is_cut = found.is_cut or len(left) > len(ids)
    found = replace(found, is_cut=is_cut, larger=len(larger), outside=len(outside), heights=None)
    return found.keep({label: likely[label] for label in ids})


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
    depth, valid = select_readings(depth, camera, options.depth_range)
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
    return FrameEvidence(labels, ids, around, is_cut=is_cut)


def least_pixels(size: int) -> int:
    """The least number of pixels of an object, in an image of ``size`` pixels."""
    return max(_LEAST_PIXELS, round(_LEAST_SHARE * size))


def warm_up() -> None:
    """Compile, or load from disk, every kernel by a ball on a table, beside a hole, and by two that touch."""
    convex_parts.warm_up()
    camera = Camera(96, 72, 180.0, 180.0, 47.5, 35.5)
    v, u = np.indices((camera.height, camera.width))
    radius = np.hypot(u - camera.cx, v - camera.cy) / 20
    depth = (0.7 - 0.08 * np.sqrt(np.maximum(1 - radius**2, 0))).astype(np.float32)
    segment(np.where(np.abs(radius - 1.2) < 0.1, np.float32(np.nan), depth), camera)


def select_readings(depth: np.ndarray, camera: Camera, limits: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return the depth, float32, and where it is a measurement within limits."""
    depth = camera.readings(depth).astype(np.float32, copy=False)
    near, far = limits
    valid = np.isfinite(depth) if np.isinf(far) else depth <= far
    if camera.is_pinhole:
        valid &= depth > 0
    if near > 0 or not camera.is_pinhole:
        valid &= depth >= near
    return depth, valid


def _is_silhouette(valid: np.ndarray) -> bool:
    """Whether the readings (height, width) end within their box, and not at its sides, as a view's do."""
    left, top, width, height = regions.box(valid)
    inside = valid[top : top + height, left : left + width]
    sides = [side.mean() for side in (inside[0], inside[-1], inside[:, 0], inside[:, -1])]
    return bool(sorted(sides)[-2] < _SIDE_MEASURED)


def _without_support(known: np.ndarray, valid: np.ndarray, camera: Camera, least: int) -> FrameEvidence:
    """The segments of an image that shows no support plane, but those that fill it, as a wall does."""
    labels = take_apart(known, valid, camera, UNKNOWN_SIGMA)
    found = _order(FrameEvidence(labels), least)
    if _is_silhouette(valid):
        return found
    return found.keep({k: 1.0 for k in found.ids if not regions.fills(regions.box(found.labels == k), valid)})


def _unload(
    labels: np.ndarray, above: np.ndarray, face: Plane, known: np.ndarray, camera: Camera, least: int
) -> np.ndarray:
    """Give what stands on a level face, among the pixels ``above`` it, labels of its own, found with it as support."""
    relative = face.image_relative(known, camera)
    valid = above & (relative > -TOLERANCE)
    parts = _order(FrameEvidence(_find_raised(known, camera, relative * valid, valid, face)), least)
    heights = HeightEvidence(relative, np.where(valid, parts.labels, 1), face.sigma)
    parts = judge(replace(parts, heights=heights))
    return np.where(parts.labels > 0, parts.labels + labels.max(), labels)


def _order(found: FrameEvidence, least: int) -> FrameEvidence:
    """Keep the largest segments of at least so many pixels."""
    counts = regions.extents(found.labels)[:, 0]
    order = np.argsort(-counts, kind="stable")
    order = order[counts[order] >= least]
    return replace(found, is_cut=len(order) > _MOST).keep(dict.fromkeys(order[:_MOST].tolist(), 1.0))


def _find_raised(
    known: np.ndarray, camera: Camera, relative: np.ndarray, valid: np.ndarray, support: Plane
) -> np.ndarray:
    """Find bodies of what is above the support: labels (height, width) from 1, in no order, 0 elsewhere.

    ``known`` and ``relative`` (height, width) are depth, and height above the support as at one metre of depth, both 0
    where nothing is looked for; ``valid`` is where something is.
    """
    labels = np.zeros(known.shape, np.int32)
    clear = cv2.blur(relative, (3, 3)) > support.clear_height
    # The mean beside a tall body is that of its height: the pixel itself decides there.
    raised = relative > 0.5 * support.clear_height
    above_noise, low = _low(relative, valid, support.clear_height)
    clear = (clear & raised) | low
    raised |= above_noise
    left, top, width, height = regions.box(clear)
    if width == 0:
        return labels
    reach = _GROWN + 1
    top, left = max(top - reach, 0), max(left - reach, 0)
    window = slice(top, top + height + 2 * reach), slice(left, left + width + 2 * reach)
    # Contiguous, as kernels are compiled for arrays of a kind.
    known, clear = np.ascontiguousarray(known[window]), np.ascontiguousarray(clear[window])
    camera = camera.cropped(left, top, known.shape[1], known.shape[0])
    inside = take_apart(known, clear, camera, support.sigma)
    foot = raised[window] & (inside == 0)
    labels[window] = depth_steps.grow(inside, foot, known, _GROWN, depth_steps.STEP)
    return labels


def _low(relative: np.ndarray, valid: np.ndarray, clear_height: float) -> tuple[np.ndarray, np.ndarray]:
    """What single readings hide in their noise, as pixels (height, width): those above the support by the median of
    their neighbours, and of them those that the mean of a wide window shows to be clearly above it.

    The deviation of such means is that of windows side by side on the support, which is most of what is not clearly
    above it: it holds what correlated noise and waves of the depth leave of a mean.
    """
    # What is higher counts as if it were just clear, so that tall bodies do not raise what is beside them.
    wide = cv2.blur(np.minimum(relative, clear_height), (_WIDE, _WIDE))
    rows, columns = (length // _WIDE for length in valid.shape)
    apart = slice(_WIDE // 2, None, _WIDE)
    is_full = valid[: rows * _WIDE, : columns * _WIDE].reshape(rows, _WIDE, columns, _WIDE).all(axis=(1, 3))
    means = np.abs(wide[apart, apart][:rows, :columns])[is_full]
    means = means[means < clear_height]
    if not means.size:
        return np.zeros(valid.shape, bool), np.zeros(valid.shape, bool)
    height = max(0.5 * TOLERANCE, CLEARLY * MEDIAN_TO_SIGMA * quantile(means, 0.5))
    near = valid & (cv2.medianBlur(relative, 3) > 0.5 * height)
    return near, near & (wide > height)


def take_apart(depth: np.ndarray, wanted: np.ndarray, camera: Camera, sigma: float) -> np.ndarray:
    """Take the wanted pixels apart at steps and by lines of sight: labels from 1, unordered."""
    labels = _components(depth, wanted, camera)
    return convex_parts.correct(labels, depth, camera, max(sigma, LEAST_SIGMA))


def _components(depth: np.ndarray, wanted: np.ndarray, camera: Camera) -> np.ndarray:
    """Labels (height, width) of the wanted pixels, cut at depth steps, without bits; what a sensor smeared over a step
    is a bridge of few pixels, and does not connect."""
    filled = cv2.copyTo(depth, wanted.view(np.uint8))  # and 0 elsewhere
    some = filled[::4, ::4]
    some = some[some > 0]
    if some.size == 0:
        return np.zeros(depth.shape, np.int32)
    least = _LEAST_AREA * camera.fx * camera.fy / quantile(some, 0.5) ** 2
    inner = (wanted & ~depth_steps.edges(filled, wanted, depth_steps.STEP)).view(np.uint8)
    labels = _large(depth_steps.components(cv2.morphologyEx(inner, cv2.MORPH_OPEN, depth_steps.CROSS)), least)
    labels = depth_steps.grow(labels, wanted & (labels == 0), depth, _GROWN, depth_steps.STEP)
    left = wanted & (labels == 0)
    if np.count_nonzero(left) < least:
        return labels
    # A side that is seen at a grazing angle has steps all over, but all one way.
    steep = _large(depth_steps.separate(depth, left, _GAP), least)
    return np.where(steep > 0, steep + labels.max(), labels)


def _large(labels: np.ndarray, least: float) -> np.ndarray:
    """The labels with at least so many pixels, or the largest of them if there are very many, renumbered from 1."""
    counts = regions.extents(labels)[:, 0]
    kept = counts >= max(least, np.sort(counts)[-_MOST:][0])
    return regions.renumber(labels, (kept * np.cumsum(kept)).astype(np.int32))
