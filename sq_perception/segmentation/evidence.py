"""What one frame shows: its objects, how surely a pixel is of which, and the support with the noise about it.

The segmentation makes it, and the stages behind it read it: views, fits and scores the membership of pixels, supports
the plane, repeated frames the noise, deviations of sizes the pairs of objects that may be one.  docs/segmentation.md
derives the probabilities and what they are worth.

Metres and pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sq_perception.imaging import regions
from sq_perception.segmentation.objectness import HeightEvidence
from sq_perception.segmentation.support_plane import LEAST_SIGMA, Plane

UNKNOWN_SIGMA = 1.5e-3
"""Noise of the depth at one metre, metres, where no support shows it: that of structured light (Khoshelham and Oude
Elberink, Sensors 2012)."""


@dataclass(frozen=True, eq=False)
class FrameEvidence:
    """Objects of one image, and what is known of them before their bodies are sought.

    Attributes
    ----------
    labels : int32 (height, width)
        0 for background; own labels run from 1, largest object first, labels given from outside keep their values.
    ids : tuple of int
        Labels in the image, the one with most pixels first.
    support : Plane or None
        The frame's support, with the noise about it; None where there is none.
    objectness
        The probability, by ``ids``, that each is a thing; empty: 1, as for labels given from outside.
    membership : float32 (height, width) or None
        The probability that the reading of a pixel is of the object whose label it has; None: 1.
    affinity : (n, n) or None
        The probability, by ``ids``, that two objects are one; None: 0.
    is_cut
        Whether there were more objects than ``max_objects``.
    larger, outside
        How many objects were left out as they are larger than ``max_size``, or outside of the workspace.
    heights : HeightEvidence or None
        What the segments are judged by, until they are.
    """

    labels: np.ndarray
    ids: tuple[int, ...] = ()
    support: Plane | None = None
    objectness: tuple[float, ...] = ()
    membership: np.ndarray | None = None
    affinity: np.ndarray | None = None
    is_cut: bool = False
    larger: int = 0
    outside: int = 0
    heights: HeightEvidence | None = None

    @property
    def plane(self) -> np.ndarray | None:
        """n and d (4,) of the support plane, height above it = n.p + d; None where there is none."""
        return None if self.support is None else self.support.equation

    @property
    def sigma(self) -> float:
        """Noise of the depth at one metre, metres."""
        return UNKNOWN_SIGMA if self.support is None else max(self.support.sigma, LEAST_SIGMA)

    @property
    def outliers(self) -> np.ndarray:
        """Pixels (height, width) that are more probably not of the object whose label they have."""
        if self.membership is None:
            return np.zeros(self.labels.shape, bool)
        return (self.labels > 0) & (self.membership < 0.5)

    def objectness_by_label(self) -> dict[int, float]:
        """The probability that each object is a thing, by its label."""
        return dict(zip(self.ids, self.objectness or (1.0,) * len(self.ids), strict=True))

    def affinities(self, label: int) -> dict[int, float]:
        """The probability that an object is one with each object of the frame, by their labels; empty: 0."""
        if self.affinity is None:
            return {}
        return dict(zip(self.ids, self.affinity[self.ids.index(label)].tolist(), strict=True))

    def keep(self, likely: dict[int, float]) -> FrameEvidence:
        """Keep the objects of some labels, with their probabilities to be things; renumbered from 1, largest first."""
        if tuple(likely) == self.ids == tuple(range(1, len(self.ids) + 1)):
            return replace(self, objectness=tuple(likely.values()))
        counts = regions.extents(self.labels)[:, 0]
        order = sorted(likely, key=lambda label: (-counts[label], label))
        number = np.zeros(len(counts), np.int32)
        number[order] = np.arange(len(order)) + 1
        place = [] if self.affinity is None else [self.ids.index(label) for label in order]
        return replace(
            self, labels=regions.renumber(self.labels, number), ids=tuple(range(1, len(order) + 1)),
            objectness=tuple(likely[label] for label in order),
            affinity=None if self.affinity is None else self.affinity[np.ix_(place, place)],
        )
