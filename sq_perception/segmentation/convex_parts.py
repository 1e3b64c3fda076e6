"""Convex bodies among the segments of a depth image, found by lines of sight within and between them.

Within a body next to no pair of samples is crossed (:mod:`sq_perception.segmentation.line_of_sight`); among bodies that
touch, half of the pairs or more.  That holds over the whole width of the bodies: noise that bends the surface where
they touch is outvoted.

1. A segment of whose pairs of samples many are crossed is taken apart: its samples are clustered by average linkage,
   the distance being the share of crossed pairs (and a little of the metric one, which orders those that nothing
   parts).  The pieces need not be convex themselves: a third body among them, a handle and smeared edges cross their
   lines as well.  Pixels go to the piece of the nearest sample; where near ones disagree, to the piece to which most
   lines are free.
2. Neighbouring segments between which few pairs are crossed are one body.
3. So are two segments that go on behind something nearer: lines leave the one along its surface, pass behind another
   segment, and enter the other one along its surface.  A box behind a post is such; what is seen between two things
   that stand apart is farther than the line.

What is of one thing and not convex, as the inside of a vessel and its wall, a network joins afterwards
(:mod:`sq_perception.recovery.own_segments`).

Metres and pixels; depth is 0 where there is none.
Reference: S. Asafi, A. Goren, D. Cohen-Or, Weak Convex Decomposition by Lines-of-sight, SGP 2013.
"""

from __future__ import annotations

from itertools import count

import numpy as np

from sq_perception.geometry.kernels import kernel
from sq_perception.imaging import regions
from sq_perception.imaging.camera import Camera
from sq_perception.segmentation import line_of_sight
from sq_perception.segmentation.line_of_sight import LEAST_SAMPLES, SampledImage, Samples
from sq_perception.segmentation.support_plane import CLEARLY

_FEW, _MANY = 30, 160
"""Samples of a segment: to see whether its lines are crossed, 435 pairs, and to take it apart."""
_SUSPICIOUS = 0.12
"""Share of crossed pairs from which on a segment may be several bodies."""
_APART = 0.55
"""Share of crossed pairs, on average, between pieces of a segment: more than half, as between bodies that touch."""
_METRIC = 0.3
"""What the metric distance adds to that between samples, at most."""
_LEAST_PIECE, _CLOSE = 8e-4, 0.85
"""A piece that shows less, square metres across the line of sight at so many metres and farther, is a part of what it
is attached to; nearer, at the same angle."""
_AS_ONE = 0.3
"""Share of crossed pairs below which two segments are one body."""
_NEAR = 0.03
"""Neighbouring segments are no farther apart, metres."""
_ALONG = 0.15
"""Share of lines that go along both surfaces, of two segments that are one behind a nearer one."""


def correct(labels: np.ndarray, depth: np.ndarray, camera: Camera, sigma: float) -> np.ndarray:
    """Take segments apart where they are several convex bodies, and join them where they are one.

    Parameters
    ----------
    labels : int32 (height, width)
        Segments from 1, 0 for nothing; each has a depth.
    depth : float32 (height, width)
        Metres, 0 where nothing was measured.
    camera
        A pinhole camera.
    sigma
        Noise of the depth at one metre, metres; it grows with the square of the depth.

    Returns
    -------
    labels : int32 (height, width)
        From 1, in no order; of the same pixels.
    """
    # The one layout that kernels are compiled for; labels are written to.
    depth, labels = np.ascontiguousarray(depth, dtype=np.float32), np.array(labels, order="C")
    image = SampledImage(depth, labels, camera, CLEARLY * sigma)
    parts = _part(image)
    number_of = np.arange(labels.max() + 1, dtype=np.int32)
    if len(parts) > 1:
        names = np.array([part.label for part in parts])
        group = link(_crossed_between(image, parts, names), _AS_ONE)
        first = np.unique(group, return_index=True)[1]
        number_of[names] = names[first[group]]
    return regions.renumber(image.labels, number_of)


def warm_up() -> None:
    """Compile, or load from disk, every kernel by parting and joining two balls."""
    camera = Camera(64, 48, 120.0, 120.0, 31.5, 23.5)
    v, u = np.indices((camera.height, camera.width))
    radius = np.hypot(np.abs(u - camera.cx) - 12, v - camera.cy) / 12
    depth = np.where(radius < 1, 0.7 - 0.07 * np.sqrt(np.maximum(1 - radius**2, 0)), 1.0)
    correct((radius < 1).astype(np.int32), depth, camera, 1e-3)


def _part(image: SampledImage) -> list[Samples]:
    """Give the parts of segments that are several convex bodies labels of their own, in the image.

    Returns samples of all segments and parts that are large enough to have some.
    """
    extents = regions.extents(image.labels)
    parts, new = {k: image.sample(k, extents[k], _FEW) for k in np.flatnonzero(extents[:, 0]).tolist()}, []
    unused = count(len(extents))
    for label, part in parts.items():
        pieces = [] if part is None else _pieces(image, part, extents[label])
        new += [label] if pieces else []
        for rows, columns in pieces[1:]:
            new.append(next(unused))
            image.labels[rows, columns] = new[-1]
    if new:
        extents = regions.extents(image.labels)
        parts |= {k: image.sample(k, extents[k], _FEW) for k in new}
    return [part for part in parts.values() if part is not None]


def _pieces(image: SampledImage, part: Samples, extent: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rows and columns of each convex piece of a segment; nothing where it has no such pieces.

    ``part`` are a few samples of it, ``extent`` is its row of :func:`~sq_perception.imaging.regions.extents`.
    """
    least = _LEAST_PIECE * min(1.0, part.distance / _CLOSE) ** 2
    if part.area < 2 * least or image.within(part)[0].mean() < _SUSPICIOUS:
        return []
    whole = image.sample(part.label, extent, _MANY)
    assert whole is not None  # no fewer than a few
    group = cluster(*image.within(whole), _APART, max(LEAST_SAMPLES, least / whole.spacing**2))
    return image.pieces(extent, whole, group, _MANY) if group.any() else []


def _crossed_between(image: SampledImage, parts: list[Samples], names: np.ndarray) -> np.ndarray:
    """Share (n, n) of crossed lines between each two segments, labelled ``names`` (n,).

    0 where two go on behind something nearer; inf where they are neither this nor near.
    """
    pixels, points = (np.concatenate([getattr(part, name) for part in parts]) for name in ("pixels", "points"))
    together = pixels, points, np.cumsum([0] + [len(part.z) for part in parts])
    beside = regions.beside(image.labels, image.depth, _NEAR)[np.ix_(names, names)]
    reach = _NEAR / 2 + 0.7 * np.array([part.spacing for part in parts])
    crossed = line_of_sight.between(*together, reach, beside, image.depth, image.noise, image.least)
    far = np.isinf(crossed)
    along, over = line_of_sight.hidden(*together, names, far, image.depth, image.labels, image.noise, image.least)
    crossed[far & (along > _ALONG) & (over < _AS_ONE)] = 0.0
    return crossed


def cluster(crossed: np.ndarray, far: np.ndarray, limit: float, least: float) -> np.ndarray:
    """Group samples, numbers (n,) from 0, by whether lines between them (n, n) are crossed, and by their distance; what
    has less than ``least`` samples joins the group that it is nearest to."""
    group = link(crossed + _METRIC * far / max(far.max(), 1e-9), limit)
    keep = np.flatnonzero(np.bincount(group)[group] >= least)
    if not len(keep):
        return np.zeros_like(group)
    return np.unique(group[keep[np.argmin(far[:, keep], axis=1)]], return_inverse=True)[1]


def link(distance: np.ndarray, limit: float) -> np.ndarray:
    """Group by average linkage, numbers (n,) from 0: join the two nearest until none of (n, n) are nearer than a limit.

    inf is no distance: that of the other one holds.
    """
    return np.unique(_linked(distance, limit), return_inverse=True)[1]


@kernel
def _linked(distance: np.ndarray, limit: float) -> np.ndarray:
    n = len(distance)
    far, size, group, nearest = distance.copy(), np.ones(n), np.arange(n), np.zeros(n, np.int64)
    for k in range(n):
        far[k, k] = np.inf
        nearest[k] = np.argmin(far[k])
    while True:
        i = 0
        for k in range(1, n):
            if far[k, nearest[k]] < far[i, nearest[i]]:
                i = k
        j = nearest[i]
        if not far[i, j] < limit:
            return group
        mean = (size[i] * far[i] + size[j] * far[j]) / (size[i] + size[j])
        for k in range(n):
            if np.isinf(mean[k]):
                mean[k] = min(far[i, k], far[j, k])
        mean[i] = np.inf
        far[i], far[:, i], far[j], far[:, j] = mean, mean, np.inf, np.inf
        size[i] += size[j]
        for k in range(n):
            if group[k] == j:
                group[k] = i
            if k == i or nearest[k] == i or nearest[k] == j or far[k, i] < far[k, nearest[k]]:
                nearest[k] = np.argmin(far[k])
