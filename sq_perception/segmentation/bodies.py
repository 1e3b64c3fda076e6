"""Bodies among the pixels that are above a support, or among all pixels where there is no support.

Steps 2 to 4 of :mod:`sq_perception.segmentation.segments`: components that no depth step cuts; these taken apart and
joined; and each body continued down to its foot.  Metres and pixels.
"""

from __future__ import annotations

import cv2
import numpy as np

from sq_perception.geometry.quantiles import MEDIAN_TO_SIGMA, quantile
from sq_perception.imaging import depth_steps, regions
from sq_perception.imaging.camera import Camera
from sq_perception.segmentation import convex_parts
from sq_perception.segmentation.evidence import LEAST_SIGMA
from sq_perception.segmentation.support_plane import CLEARLY, TOLERANCE, SupportSurface

_WIDE = 9
"""Pixels a side of the windows by whose means low things are told from noise."""
_LEAST_AREA = 1e-4
"""Least area of a component without a step in it, square metres across the line of sight."""
MOST = 128
"""Components, and segments, that are looked at: bounds the time of frames that are noise alone."""
_GROWN = 3
"""Pixels that components grow by: those beside a step, where they are narrow, and down to the foot of a thing."""
_GAP = 0.1
"""Share of the depth by which pixels of a surface with steps in it differ at most: what lies behind a fringe is
farther."""


def above(
    known: np.ndarray, camera: Camera, relative: np.ndarray, valid: np.ndarray, support: SupportSurface
) -> np.ndarray:
    """Bodies of what is above the support: labels (height, width) from 1, in no order, 0 elsewhere.

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
    inside = taken_apart(known, clear, camera, support.sigma)
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


def taken_apart(depth: np.ndarray, wanted: np.ndarray, camera: Camera, sigma: float) -> np.ndarray:
    """Bodies (labels from 1, unordered) of the wanted pixels, taken apart at steps and by lines of sight."""
    labels = _components(depth, wanted, camera)
    return convex_parts.corrected(labels, depth, camera, max(sigma, LEAST_SIGMA))


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
    kept = counts >= max(least, np.sort(counts)[-MOST:][0])
    return regions.renumber(labels, (kept * np.cumsum(kept)).astype(np.int32))
