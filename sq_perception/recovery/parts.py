"""The parts of an object: bodies that explain its image together, where one body does not.

Proposals.  Two points of a convex body are joined by a line that no pixel saw through (the equation is that of
:mod:`sq_perception.segmentation.convex_parts`).  Samples of the object's pixels are clustered by average linkage, the
distance being 1 for a crossed line and 0 for any other, and a little of the metric one; each limit of the distance
divides the pixels into pieces.  Where these divide no further, those of a handle are tried: what is left of the
object's pixels without all discs in them that are nearly as wide as the widest.  A piece is fitted like an object of
its own: other pieces' pixels beside it saw free space, up to what they measured.  So a part is what some pixels show:
what no pixel shows is no part.

Evidence.  With r the rendered less the measured depth over the noise s, of each of the n pixels of the object, 3 for
one that no body covers, and m the pixels beside it that saw through a body by more than 3 s, k bodies leave

    L = (sum of min(r^2, 9) + 9 m) / n,        D = L N / 2 + (k - 1) 11 / 2 log N.

The shortest description D wins.  Pixels err together where a thing is no superquadric: they count as N witnesses.

Metres, optical frame.  Reference: A. Leonardis, A. Jaklic, F. Solina, Superquadrics for Segmenting and Modeling Range
Data, IEEE PAMI 19(11), 1997.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from sq_perception.fitting.fit import Fit, Parts, Status
from sq_perception.fitting.options import MIN_PIXELS
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.geometry.threads import one_kernel_thread
from sq_perception.imaging import raycast, regions
from sq_perception.imaging.camera import Camera
from sq_perception.recovery.seen_object import SeenObject, surroundings
from sq_perception.segmentation.convex_parts import cluster
from sq_perception.segmentation.line_of_sight import SampledImage

MOST_PARTS = 4
_SAMPLES = 120  # samples of an object between which lines are drawn
_LEAST_SHARE = 0.03  # share of the object's samples that a piece has at least
_WITNESSES = 120.0  # N above
_FARTHEST = 3.0  # deviations of the noise beyond which a pixel is not explained
_PRICE = 11 / 2 * math.log(_WITNESSES) * 2 / _WITNESSES  # what a further body must lessen L by
_FINE = 1.3
"""L of good bodies, mostly: where one leaves no more than the price above it, two are not sought, nor handles where
parts do."""


class Weight(NamedTuple):
    """L and m / n above, and the share (k,) of the object's pixels that each body explains."""

    misfit: float
    through: float
    shares: np.ndarray


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the image says of bodies in an object's place; pixels on a grid around it.  ``depth`` is NaN where nothing
    was measured, ``mask`` that of the object, ``sigma`` the noise, metres."""

    depth: np.ndarray
    mask: np.ndarray
    camera: Camera
    sigma: float

    @classmethod
    def of(cls, obj: SeenObject, depth: np.ndarray, camera: Camera, sigma: float) -> Evidence:
        rows, columns = obj.mask_crop.shape
        step = max(1, math.isqrt(int(np.count_nonzero(obj.mask_crop)) // 500))  # pixels that are compared, about
        _, near, mask, view = surroundings(obj, depth, obj.mask, camera, max(rows, columns) // 4)
        near, mask = near[::step, ::step], mask[::step, ::step]
        fx, fy, cx, cy = (number / step for number in (view.fx, view.fy, view.cx, view.cy))
        height, width = near.shape
        view = replace(view, width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)
        return cls(near, mask & np.isfinite(near), view, sigma)

    def weigh(self, fits: Sequence[Fit]) -> Weight:
        """Compare the bodies of k fits, together, with the image."""
        with one_kernel_thread():
            rendered, index = raycast.render(Superquadric.stack([fit.superquadric for fit in fits]), self.camera)
        off = np.where(np.isfinite(rendered), rendered - self.depth, np.inf) / self.sigma
        count = max(int(np.count_nonzero(self.mask)), 1)
        through = np.count_nonzero((off < -_FARTHEST) & ~self.mask) / count
        misfit = float(np.minimum(off[self.mask] ** 2, _FARTHEST**2).sum()) / count + _FARTHEST**2 * through
        shown = np.bincount(index[self.mask & (np.abs(off) < _FARTHEST)], minlength=len(fits))
        return Weight(misfit, through, shown / count)


class Search:
    """The search for the parts of one object: division by division, as long as the description gets shorter."""

    def __init__(self, obj: SeenObject, alone: Fit, depth: np.ndarray, camera: Camera) -> None:
        self._noise = alone.noise
        self.parts: Parts | None = None  # the best ones so far; None where one body is the shorter description
        self._divisions: list[Iterator[list[SeenObject]]] = []
        self._fitted: list[tuple[SeenObject, Fit]] = []
        self._fresh: list[SeenObject] = []
        self._again: list[Fit] = []
        is_enough = alone.status != Status.FAILED and obj.pixels >= 2 * MIN_PIXELS
        if not (is_enough and camera.is_pinhole and np.isfinite(alone.noise)):
            return
        self._evidence = Evidence.of(obj, depth, camera, alone.noise)
        weight = self._evidence.weigh([alone])
        self._least = weight.misfit
        # A body through which nothing was seen leaves no room between parts.
        if weight.misfit > _FINE + _PRICE and weight.through > 0.012:
            kinds = _divide(obj, 2 * alone.noise), _divide_thin(obj)
            self._divisions = [(list(_make_objects(obj, depth, camera, each)) for each in kind) for kind in kinds]

    def next_pieces(self) -> list[SeenObject]:
        """Return the pieces of the next division that have no body yet; none where the search has ended."""

        def alike(one: SeenObject, other: SeenObject) -> bool:
            return bool(np.sum(one.mask & other.mask) > 0.9 * np.sum(one.mask | other.mask))

        while self._divisions:
            for pieces in self._divisions[0]:
                known = [(piece, [fit for other, fit in self._fitted if alike(piece, other)]) for piece in pieces]
                self._fresh = [piece for piece, fits in known if not fits]
                self._again = [fits[0] for _, fits in known if fits]
                if self._fresh:
                    return self._fresh
            self._divisions.pop(0)
        return []

    def judge(self, fits: Sequence[Fit]) -> None:
        """Keep a division, given the bodies of its fresh pieces; where it is no shorter, no finer one follows."""
        self._fitted += zip(self._fresh, fits, strict=True)
        fits = [fit for fit in (*fits, *self._again) if fit.status != Status.FAILED]
        if len(fits) > 1:
            weight = self._evidence.weigh(fits)
            left = weight.misfit + _PRICE * (len(fits) - 1)
            if left < self._least:
                self._least = left
                milliseconds = sum(fit.milliseconds for fit in fits)
                # Wider, as where a part ends and the next one begins is not seen.
                wide = [replace(fit, covariance=4 * fit.covariance) for fit in fits]
                self.parts = Parts.of(wide, weight.shares, self._noise, milliseconds)
                if weight.misfit <= _FINE + _PRICE:
                    del self._divisions[1:]
                return
        self._divisions.pop(0)


def _divide(obj: SeenObject, through: float) -> Iterator[np.ndarray]:
    """Yield label images (h, w) in the window of an object: its pieces from 1, 0 beside it."""
    depth = np.where(np.isfinite(obj.depth_crop), obj.depth_crop, np.float32(0))
    labels = (obj.mask_crop & (depth > 0)).astype(np.int32)
    extent = regions.extents(labels)[1]
    image = SampledImage(depth, labels, obj.camera_crop, 0.0, through)
    some = image.sample(1, extent, _SAMPLES)
    if some is None:
        return
    crossed, far = image.within(some)
    seen = set()
    for limit in (0.55, 0.35, 0.2):  # distances between clusters up to which they are one piece
        group = cluster(crossed, far, limit, max(4, _LEAST_SHARE * len(far)))
        if 0 < group.max() < MOST_PARTS and group.tobytes() not in seen:
            seen.add(group.tobytes())
            divided = np.zeros_like(labels)
            for k, piece in enumerate(image.pieces(extent, some, group, _SAMPLES)):
                divided[piece] = k + 1
            yield divided


def _divide_thin(obj: SeenObject) -> Iterator[np.ndarray]:
    """Yield a label image as :func:`_divide`: 1 where wide discs lie within the object's pixels, then what is thin."""
    mask = obj.mask_crop & np.isfinite(obj.depth_crop)
    inside = cv2.distanceTransform(np.pad(mask, 1).view(np.uint8), cv2.DIST_L2, 5)
    radius = 0.7 * float(inside.max())  # of wide discs, less than the widest one's
    beside = cv2.distanceTransform((inside <= radius).view(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    thin = mask & (beside > radius)
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(thin.view(np.uint8))
    area = statistics[1:, cv2.CC_STAT_AREA]
    is_large = area >= max(MIN_PIXELS, _LEAST_SHARE * np.count_nonzero(mask))
    largest = 1 + np.argsort(-area, kind="stable")[: min(MOST_PARTS - 1, np.count_nonzero(is_large))]
    number = np.zeros(count, np.int32)
    number[largest] = np.arange(len(largest)) + 1
    if len(largest):
        yield np.where(mask, number[labels] + 1, 0)


def _make_objects(obj: SeenObject, depth: np.ndarray, camera: Camera, pieces: np.ndarray) -> Iterator[SeenObject]:
    """Make objects of the pieces of an object, in its window; they stand on what it stands on."""
    for k in range(1, int(pieces.max()) + 1):
        mask = np.zeros_like(obj.mask)
        mask[obj.window] = pieces == k
        x, y, width, height = regions.box(mask)
        pixels = int(np.count_nonzero(mask))
        if pixels < MIN_PIXELS:
            continue
        window = slice(y, y + height), slice(x, x + width)
        crop = camera.cropped(x, y, width, height)
        yield SeenObject(obj.label, pixels, pixels, np.empty(0, int), mask, depth[window], crop, window, obj.plane)
