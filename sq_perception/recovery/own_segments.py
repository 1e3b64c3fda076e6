"""Segments of a depth image as a network sees them: which of them are one object, and which pixels are outliers.

For a segment a of :mod:`sq_perception.segmentation.segments` it predicts p_a(x), the probability that the reading of a
pixel x is of the object that most of a shows (:mod:`sq_perception.learning.networks`).

    parted    a has four compact pieces, and one more for each connected region, less than half of a, where p_a < 1/2.
              If the mean of p_a over a piece is below ``_SURE``, the network is asked about that piece as if it were a
              segment, and then about pieces that no object claims.  A piece shows another object if it claims itself,
              and if it and the objects found so far do not claim each other: if the means of p are below ``_APART``.
              A pixel is of the object that claims it most.  Parts that missing readings keep from touching stay
              one: lines of sight have joined them
    joined    a and b are one with log odds of k (l_ab + l_ba) + c, by the mean l_ab of the logit of p_a over b; the
              surest pairs first, until none is more likely one than two.  Not where both together are larger than
              ``max_size`` but no larger than the largest thing: in a heap of small things they are two of them
    outliers  pixels of a with p_a < 1/2: what a sensor widened an edge by, and bits of neighbours.  They stay in the
              label image, as they are no background either, but no fit takes them for the object's surface; of the
              others p_a is the membership
    nothing   a is dropped if it is no thing (:mod:`sq_perception.segmentation.objectness`), by the median logit of p_a
              over it and by its rise: a bump of the table, a wall, the room behind; not where there is no support
              plane, as all that is seen may be the object

Without a support plane it parts nothing.  The network is asked once about a segment, and again about one that was
parted or joined.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from sq_perception.fitting.options import MIN_PIXELS
from sq_perception.geometry.quantiles import quantile
from sq_perception.imaging import canonical_view, regions, segment_view
from sq_perception.imaging.camera import Camera
from sq_perception.imaging.segment_view import SegmentView
from sq_perception.learning.forward import CompactMasks
from sq_perception.segmentation.evidence import FrameEvidence
from sq_perception.segmentation.objectness import probability
from sq_perception.segmentation.options import LARGEST_THING, POINTS, largest_edge
from sq_perception.segmentation.segments import judge

_ONE = (0.5, -0.5)
"""k and c: of a logistic regression over pairs of segments of simulated scenes."""
_CLEAREST = 6.0
"""A logit tells no more than this, either way."""
_SURE = 0.85
"""A segment is parted only if a piece of it claims less."""
_APART, _ITSELF = 0.3, 0.5
"""Pieces that claim less of each other are of two objects; one that claims less of itself shows none."""
_LEAST_PIECE = 12
"""Cells of a region with p < 1/2, without its thin parts, that is a piece of its own."""


@dataclass(frozen=True, eq=False)
class _Seen:
    """A segment as the network saw it, its window of the image, and the logits of p in the view's cells."""

    window: tuple[slice, slice]
    view: SegmentView
    logits: np.ndarray


_Mapped = Callable[[Callable[[Sequence[int]], list[Any]], Sequence[int]], list[Any]]


@dataclass(frozen=True, eq=False)
class SegmentNetwork:
    """The network of masks before one image of a pinhole camera.

    Attributes
    ----------
    network
        The network of masks.
    depth : float (height, width)
        Metres, not finite or 0 where nothing was measured; every segment has a reading.
    plane : (4,) or None
        Support plane.
    mapped
        Applies a function of some labels to all of them; it may do so in several threads.
    max_size
        Largest edge of an object, metres.
    """

    network: CompactMasks
    depth: np.ndarray
    camera: Camera
    plane: np.ndarray | None
    mapped: _Mapped
    max_size: float = LARGEST_THING

    def improve(self, found: FrameEvidence) -> FrameEvidence:
        """Part and join segments, find their outliers, and drop those of nothing; labels from 1, the largest first."""
        if not found.ids:
            return found
        labels = found.labels.copy()
        seen = self._seen(labels, found.ids)
        parts = [] if self.plane is None else self._part(labels, seen)
        if parts:
            seen |= self._seen(labels, parts)
        while len(seen) > 1 and (joined := self._join(labels, seen)):
            seen |= self._seen(labels, joined)
        membership, medians = np.ones(labels.shape, np.float32), {}
        for label, answer in seen.items():
            inside = labels[answer.window] == label
            logits = answer.view.at_pixels(answer.logits, answer.window)[inside]
            medians[label] = quantile(logits, 0.5)
            if medians[label] >= 0 and np.count_nonzero(logits >= 0) >= MIN_PIXELS:  # most of it is the object
                membership[answer.window][inside] = probability(logits)
        affinity = probability(np.maximum(_odds_of_one(labels, seen), -_CLEAREST))
        affinity = np.triu(affinity, 1) + np.triu(affinity, 1).T
        return judge(replace(found, labels=labels, ids=tuple(seen), membership=membership, affinity=affinity), medians)

    def _part(self, labels: np.ndarray, seen: Mapping[int, _Seen]) -> list[int]:
        """Part segments that are several objects, in ``labels``; returns the labels of all the parts."""
        doubts = {label: doubt for label, answer in seen.items() if (doubt := _doubt(answer)) is not None}
        objects = self.mapped(lambda some: [self._objects(seen[k].view, *doubts[k]) for k in some], list(doubts))
        return [part for k, each in zip(doubts, objects, strict=True) for part in _cut(labels, k, seen[k], each)]

    def _join(self, labels: np.ndarray, seen: dict[int, _Seen]) -> list[int]:
        """Join pairs that are each other's object, each segment with one other; the labels that remain of them."""
        odds, order = _odds_of_one(labels, seen), list(seen)
        remain: list[int] = []
        taken: set[int] = set()
        for pair in np.argsort(-odds, axis=None):
            i, j = divmod(int(pair), len(order))
            if odds[i, j] <= 0:
                break
            if not taken & {i, j} and self._may_be_one((labels == order[i]) | (labels == order[j])):
                taken |= {i, j}
                labels[labels == order[j]] = order[i]
                del seen[order[j]]
                remain.append(order[i])
        return remain

    def _may_be_one(self, mask: np.ndarray) -> bool:
        """Whether what a mask (height, width) shows may be one object, or one piece of furniture, which is left out
        whole: no object is between ``max_size`` and the largest thing."""
        rows, columns = np.nonzero(mask)
        points = regions.some_points(rows, columns, self.depth, self.camera, POINTS)
        edge = largest_edge(points, None if self.plane is None else self.plane[:3])
        return edge <= self.max_size or edge > LARGEST_THING

    def _objects(self, view: SegmentView, pieces: np.ndarray, sure: np.ndarray) -> list[np.ndarray]:
        """The logits (p, p), in the cells of a segment's view, of each object that its pieces (p, p) show.

        The network is asked about the least sure piece first, then about pieces that no object claims.
        """
        objects: dict[int, np.ndarray] = {}
        claimed = np.zeros(len(sure))
        while claimed.min() < _APART:
            piece = int(np.lexsort((sure, claimed))[0])
            logits = self._logits([view.of_part(pieces == piece)])[0]
            claims = _means(logits, pieces)
            if claims[piece] >= _ITSELF and (claims[list(objects)] < _APART).all():
                objects[piece] = logits
                claimed = np.maximum(claimed, claims)
            claimed[piece] = 1.0
        return list(objects.values())

    def _seen(self, labels: np.ndarray, chosen: Sequence[int]) -> dict[int, _Seen]:
        extents = regions.extents(labels)
        windows = {label: regions.window(extents[label]) for label in chosen}

        def of_some(some: Sequence[int]) -> list[_Seen]:
            views = [
                segment_view.from_segment(self.depth, labels, label, windows[label], self.camera, self.plane)
                for label in some
            ]
            logits = self._logits([view.image for view in views])
            return [_Seen(windows[label], view, each) for label, view, each in zip(some, views, logits, strict=True)]

        return dict(zip(chosen, self.mapped(of_some, chosen), strict=True))

    def _logits(self, images: Sequence[np.ndarray]) -> np.ndarray:
        """The network's logits (n, p, p) for images (p, p, CHANNELS), shown to it as an upright camera sees them.

        Turned by whole quarters, as a view of a segment follows the image's rows and columns.
        """
        up = np.eye(3) if self.plane is None else canonical_view.upright(self.plane[:3])
        quarters = round(2 / np.pi * np.arctan2(up[0, 1], up[0, 0]))
        answers = self.network.logits(np.ascontiguousarray(np.rot90(np.stack(images), quarters, axes=(1, 2))))
        return np.ascontiguousarray(np.rot90(answers, -quarters, axes=(1, 2)))


def _doubt(answer: _Seen) -> tuple[np.ndarray, np.ndarray] | None:
    """The pieces (p, p) of a segment's view, and the mean of p over each, if one may be of something else than most."""
    cells = (answer.view.image[..., segment_view.SEGMENT] > 0) & (answer.view.image[..., segment_view.MEASURED] > 0)
    rows, columns = np.nonzero(cells)
    if not len(rows):
        return None
    pieces = segment_view.compact_pieces(cells, 4, (rows.mean(), columns.mean()))
    unlikely = (cells & (answer.logits < 0)).view(np.uint8)
    # An object is wide; the rims that a sensor adds are outliers, and not worth a question.
    wide = cv2.morphologyEx(unlikely, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, region, sizes, _ = cv2.connectedComponentsWithStats(wide, connectivity=8)
    for k in range(1, count):
        if _LEAST_PIECE <= sizes[k, cv2.CC_STAT_AREA] < len(rows) / 2:  # p is of what most of the segment shows
            pieces[region == k] = 3 + k
    pieces[cells] = np.unique(pieces[cells], return_inverse=True)[1]  # none is empty
    sure = _means(answer.logits, pieces)
    return (pieces, sure) if sure.min() < _SURE else None


def _means(logits: np.ndarray, pieces: np.ndarray) -> np.ndarray:
    """The mean of p over each of some pieces, numbers (p, p)."""
    where = pieces >= 0
    number = pieces[where]
    return np.bincount(number, probability(logits[where])) / np.maximum(np.bincount(number), 1)


def _cut(labels: np.ndarray, label: int, answer: _Seen, objects: Sequence[np.ndarray]) -> list[int]:
    """Give pixels of a segment to the object that claims them most; the labels of the parts, none if it stays whole."""
    if len(objects) < 2:
        return []
    rows, columns = np.nonzero(labels[answer.window] == label)
    logits = np.stack([answer.view.at_pixels(each, answer.window)[rows, columns] for each in objects])
    is_large = np.bincount(logits.argmax(axis=0), minlength=len(objects)) >= MIN_PIXELS
    more = np.count_nonzero(is_large) - 1
    if more < 1:
        return []
    owners = logits[is_large].argmax(axis=0)
    cells = np.full(labels[answer.window].shape, -1, np.int32)
    cells[rows, columns] = owners
    if not _touch(cells):
        return []
    names = np.array([label, *(int(labels.max()) + 1 + np.arange(more))])
    labels[answer.window][rows, columns] = names[owners]
    return [int(name) for name in names]


def _touch(parts: np.ndarray) -> bool:
    """Whether any two parts, numbers from 0 in a window, are two pixels apart or less."""
    near = np.ones((5, 5), np.uint8)
    owned = [(parts == k).view(np.uint8) for k in range(parts.max() + 1)]
    return any((cv2.dilate(a, near) & b).any() for k, a in enumerate(owned) for b in owned[:k])


def _odds_of_one(labels: np.ndarray, seen: Mapping[int, _Seen]) -> np.ndarray:
    """The log odds that two segments are one, for pairs (n, n) above the diagonal; -inf out of each other's view."""
    claims = np.full((len(seen), len(seen)), -np.inf)
    for i, answer in enumerate(seen.values()):
        if answer.view.image[..., segment_view.OTHERS].any():
            claims[i] = _claims(labels, answer)[list(seen)]
    slope, offset = _ONE
    claims = slope * (claims + claims.T) + offset
    claims[np.tril_indices(len(seen))] = -np.inf
    return claims


def _claims(labels: np.ndarray, answer: _Seen) -> np.ndarray:
    """The mean of the logit of p over each label in a view; -inf over 0, and over those out of the view."""
    height, width = labels.shape
    grid = np.ix_(np.clip(answer.view.rows, 0, height - 1), np.clip(answer.view.columns, 0, width - 1))
    there = np.where(answer.view.image[..., segment_view.IMAGE] > 0, labels[grid], 0).ravel()
    counts = np.bincount(there, minlength=int(labels.max()) + 1)
    sums = np.bincount(there, np.clip(answer.logits, -_CLEAREST, _CLEAREST).ravel(), len(counts))
    counts[0] = 0
    return np.where(counts > 0, sums / np.maximum(counts, 1), -np.inf)
