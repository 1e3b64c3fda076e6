"""Convex bodies among the segments of a depth image, found by lines of sight within them.

Equation
--------
Two points of a convex body are joined by a straight line inside it.  In a pinhole image that line is straight again,
and the inverse depth w = 1/z is linear along it:

    w(t) = (1 - t) w_i + t w_j    at the pixel    (1 - t) (u, v)_i + t (u, v)_j,    0 < t < 1.

Where a pixel on the way measured something farther than the line, by more than the noise, the line crosses empty space,
and the two points belong to two bodies, or to one that is not convex.  Something nearer hides the line and says
nothing.  Within a body next to no pair of samples is crossed; among bodies that touch, half of the pairs or more.
That holds over the whole width of the bodies: noise that bends the surface where they touch is outvoted.

Steps
-----
1. A segment is taken apart into the convex pieces that it has (:mod:`sq_perception.segmentation.convex_pieces`).
2. Neighbouring segments between which few pairs are crossed are one body; if one is a bit, up to nearly half of them.
3. So are the inside of a vessel and its wall, of which the inside is a step behind the near rim: a hollow segment and
   one before it, if a large share of the border of both is such a step.
4. So are two segments that go on behind something nearer: lines leave the one along its surface, pass behind another
   segment, and enter the other one along its surface.  A box behind a post is such; what is seen between two things
   that stand apart is farther than the line.

Metres and pixels; depth is 0 where there is none.
Reference: S. Asafi, A. Goren, D. Cohen-Or, Weak Convex Decomposition by Lines-of-sight, SGP 2013.
"""

from __future__ import annotations

import numpy as np

from sq_perception.imaging import regions
from sq_perception.imaging.camera import Camera
from sq_perception.segmentation import convex_pieces, line_of_sight
from sq_perception.segmentation.convex_pieces import AS_ONE
from sq_perception.segmentation.sampled_image import FEW, SampledImage, Samples, least_area

_NEAR = 0.03
"""Neighbouring segments are no farther apart, metres: along the line of sight where they meet in the image, or beyond
the distance of their samples."""
_RIM = 0.12
"""Share of an inside's border that lies behind another segment, and of the border of that."""
_OF_RIM = 0.1
"""Share of that border at which a piece of the other segment is a part of the wall: noise may take a wall apart, and
other things touch it."""
_BIT_AS_ONE = 0.45
"""Share of crossed pairs below which a bit, too small to be a body beside one, is one body with what it is beside:
handles and what noise broke off."""
_HOLLOW_DEPTH = 0.3
"""A step down into a hollow is not deeper, metres; no vessel on a table is."""
_ALONG = 0.15
"""Share of lines that go along both surfaces, of two segments that are one behind a nearer one: two of a box show two
faces each, of which a fourth or more of the lines stay in one."""


def corrected(
    labels: np.ndarray,
    depth: np.ndarray,
    camera: Camera,
    sigma: float,
) -> np.ndarray:
    """Segments taken apart where they are several convex bodies, and joined where they are one.

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
    image = SampledImage(np.ascontiguousarray(depth, dtype=np.float32), np.array(labels, order="C"), camera, sigma)
    rims = _rims(image)
    parts, origin = _parted(image)
    insides = _insides(image, rims, parts, origin)
    number_of = np.arange(len(origin), dtype=np.int32)
    if len(parts) > 1:
        names = np.array([part.label for part in parts])
        crossed = _crossed_between(image, parts, np.array(origin), insides)
        group = convex_pieces.linked(crossed, np.array([len(part.z) for part in parts], float), AS_ONE)
        first = np.unique(group, return_index=True)[1]
        number_of[names] = names[first[group]]
    return regions.renumber(image.labels, number_of)


def warm_up() -> None:
    """Compile, or load from disk, every kernel by parting and joining two balls."""
    camera = Camera(64, 48, 120.0, 120.0, 31.5, 23.5)
    v, u = np.indices((camera.height, camera.width))
    radius = np.hypot(np.abs(u - camera.cx) - 12, v - camera.cy) / 12
    depth = np.where(radius < 1, 0.7 - 0.07 * np.sqrt(np.maximum(1 - radius**2, 0)), 1.0)
    corrected((radius < 1).astype(np.int32), depth, camera, 1e-3)


def _rims(image: SampledImage) -> np.ndarray:
    """Pairs (n, 2) of labels of which the first lies a depth step behind the second along a large share of the borders
    of both."""
    met, _, behind = regions.borders(image.labels, image.depth, int(image.labels.max()), _NEAR, _HOLLOW_DEPTH)
    border = met.sum(axis=1)
    return np.argwhere(behind > _RIM * np.maximum(border[:, None], border[None, :]))


def _insides(image: SampledImage, rims: np.ndarray, parts: list[Samples], origin: list[int]) -> list[tuple[int, int]]:
    """The pairs of :func:`_rims`, an inside and its wall, that are of a vessel.

    The inside of a vessel is a segment that was not parted and whose surface lies behind its own lines.
    """
    whole = [part for part in parts if part.label in rims[:, 0] and origin.count(part.label) == 1]
    hollow = [part.label for part in whole if _is_hollow(image, part)]
    return [(inside, wall) for inside, wall in rims.tolist() if inside in hollow]


def _is_hollow(image: SampledImage, part: Samples) -> bool:
    """Whether the surface lies behind its own lines, as that of a vessel does."""
    gap = line_of_sight.gaps(part.pixels, part.points, image.depth, image.labels).mean()
    return bool(gap > convex_pieces.HOLLOW * image.sigma * part.distance**2)


def _parted(image: SampledImage) -> tuple[list[Samples], list[int]]:
    """Give the parts of segments that are several convex bodies labels of their own, in the image.

    Returns samples of all segments and parts that are large enough to have some, and, for each label, the label of the
    segment that it was a part of.
    """
    extents = regions.extents(image.labels)
    origin = list(range(len(extents)))
    order = np.argsort(-extents[:, 0], kind="stable")
    parts = []
    for label in order[extents[order, 0] > 0].tolist():
        part = image.sampled(label, extents[label], FEW)
        if part is None:
            continue
        pieces = convex_pieces.pieces(image, part, extents[label])
        if not pieces:
            parts.append(part)
        for k, (rows, columns) in enumerate(pieces):
            name = len(origin) if k > 0 else label
            if k > 0:
                origin.append(label)
            image.labels[rows, columns] = name
            sides = rows.min(), rows.max() + 1, columns.min(), columns.max() + 1
            sampled = image.sampled(name, np.array([len(rows), *sides]), FEW)
            parts += [] if sampled is None else [sampled]
    return parts, origin


def _crossed_between(
    image: SampledImage,
    parts: list[Samples],
    origin: np.ndarray,
    insides: list[tuple[int, int]],
) -> np.ndarray:
    """Share (n, n) of crossed lines between each two segments.

    0 where two go on behind something nearer or are of one vessel; inf where they are neither these nor near each
    other.
    """
    names = np.array([part.label for part in parts])
    together = pixels, points, ends = _together(parts)
    borders = regions.borders(image.labels, image.depth, len(origin) - 1, _NEAR, _HOLLOW_DEPTH)
    beside, behind = (each[np.ix_(names, names)] for each in borders[1:])
    reach = _NEAR / 2 + 0.7 * np.array([part.spacing for part in parts])
    crossed = line_of_sight.between(pixels, points, ends, reach, beside > 0, image.depth, *image.limits)
    extents = regions.extents(image.labels)
    is_bit = np.array([image.area(part, extents[part.label]) < least_area(part.distance) for part in parts])
    crossed[(is_bit[:, None] != is_bit) & (beside > 0)] *= AS_ONE / _BIT_AS_ONE
    far = np.isinf(crossed) & ~(is_bit[:, None] & is_bit)
    crossed[_go_on(image, names, together, far)] = 0.0
    for inside, wall in insides:
        before = behind[names == inside].sum(axis=0) * (origin[names] == wall)
        vessel = np.flatnonzero((before > _OF_RIM * before.sum()) | (names == inside))
        crossed[np.ix_(vessel, vessel)] = 0.0
    return crossed


def _go_on(
    image: SampledImage, names: np.ndarray, together: tuple[np.ndarray, np.ndarray, np.ndarray], wanted: np.ndarray
) -> np.ndarray:
    """Which of ``wanted`` pairs of segments, bool (n, n), are one surface that goes on behind something nearer.

    ``names`` are the labels (n,) of the segments, ``together`` their samples as by :func:`_together`.
    """
    along, over = line_of_sight.hidden(*together, names, wanted, image.depth, image.labels, *image.limits)
    return np.asarray(wanted & (along > _ALONG) & (over < AS_ONE))


def _together(parts: list[Samples]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels and points of the samples of all segments, and where those of each end."""
    pixels, points = (np.concatenate([getattr(part, name) for part in parts]) for name in ("pixels", "points"))
    return pixels, points, np.cumsum([0] + [len(part.z) for part in parts])
