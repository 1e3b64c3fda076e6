"""Segments repaired by the bodies that were fitted to them.

Two segments are joined if one body tells the image in fewer nats than their two; a segment is split if the bodies of
its convex parts do (:mod:`sq_perception.recovery.scene_description`).  Fits are what costs time, so that few
candidates get one:

* joined: pairs between whose samples no line of sight is crossed (:mod:`sq_perception.segmentation.convex_parts`).
  Such segments touch in one convex surface, or are what an occluder left visible of one.  Those whose points lie on
  each other's body go first.
* split: segments of whose body much is left over, more than a second body would cost, and that have convex parts.
  Where there is a plane, the bodies of the parts stand on it, as far as can be seen: the neck of a bottle, which stands
  on another part, and the handle of a mug, which hovers, are no bodies of their own.

A frame in which every body explains its segment and no lines are free between two of them costs no fit.  Parts are
split again, to a bounded depth.  Frames as everywhere: optical, metres.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from sq_perception.fitting.fit import Fit, Status
from sq_perception.imaging.camera import Camera
from sq_perception.recovery import scene_description
from sq_perception.recovery.scene_description import Evidence
from sq_perception.segmentation import convex_parts
from sq_perception.segmentation.convex_parts import SightOptions

FitMask = Callable[[np.ndarray], Fit]
"""The fit of a mask, bool (height, width)."""

_SPLITTING = SightOptions(suspicious=0.04, apart=0.35)
_MOST_FITS = 6
_DEEPEST = 2
_LEAST_GAIN = 5.0
"""Nats by which a description must be shorter: less may be chance."""
_LEAST_LEFT = 0.12
"""Share of a segment's observations that its body leaves unexplained before a split is thought of."""
_DROP_STEPS = 24
_FOOT, _FOOT_NOISE = 0.015, 6.0
"""A body stands on the plane if it comes this near to it, metres, or so many noise levels."""


@dataclass(frozen=True, eq=False)
class Repair:
    """Segments and their bodies.

    Attributes
    ----------
    labels : int32 (height, width)
    fits
        By label; those of segments that were not touched are the ones given.
    joined, split
        Labels that were joined, as (kept, gone), and labels that were split, as (kept, new ...).
    """

    labels: np.ndarray
    fits: dict[int, Fit]
    joined: tuple[tuple[int, ...], ...] = ()
    split: tuple[tuple[int, ...], ...] = ()

    @property
    def changed(self) -> bool:
        return bool(self.joined or self.split)


def repaired(
    depth: np.ndarray,
    camera: Camera,
    labels: np.ndarray,
    plane: np.ndarray | None,
    fits: Mapping[int, Fit],
    fit_mask: FitMask,
    sigma: float,
    time_budget: float = np.inf,
) -> Repair:
    """Join and split segments as long as that makes the description of the image shorter.

    Parameters
    ----------
    depth : float (height, width)
        Metres, not finite where nothing was measured.
    camera
        A pinhole camera; for an orthographic one nothing is changed.
    labels : int32 (height, width)
        Segments, 0 for background.
    plane : (4,) or None
        Support plane, height above it = n.p + d.
    fits
        By label; other labels are left alone.
    fit_mask
        Fits a body to a mask.
    sigma
        Noise of the depth at one metre, metres.
    time_budget
        Seconds after which no further fit is begun.

    Raises
    ------
    ValueError
        If an image does not fit the camera.
    """
    camera.check_image(depth)
    camera.check_image(labels)
    if not camera.is_pinhole or not fits:
        return Repair(labels, dict(fits))
    work = _Work(depth, camera, labels, plane, dict(fits), fit_mask, sigma, time.perf_counter() + time_budget)
    work.join()
    for label in sorted(work.fits):
        work.split(label, _DEEPEST)
    return Repair(work.labels, work.fits, tuple(work.joined), tuple(work.parted))


class _Work:
    """One repair on its way."""

    def __init__(
        self,
        depth: np.ndarray,
        camera: Camera,
        labels: np.ndarray,
        plane: np.ndarray | None,
        fits: dict[int, Fit],
        fit_mask: FitMask,
        sigma: float,
        deadline: float,
    ) -> None:
        self.depth, self.camera, self.labels, self.plane = depth, camera, labels, plane
        with np.errstate(invalid="ignore"):
            self.known = np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)
        self.fits, self.sigma, self.deadline = fits, sigma, deadline
        self._fit_mask, self._fits_left = fit_mask, _MOST_FITS
        self.joined: list[tuple[int, ...]] = []
        self.parted: list[tuple[int, ...]] = []

    def fit(self, masks: list[np.ndarray]) -> list[Fit] | None:
        """Fits of all these masks, or None if there is no time for them or one of them fails."""
        found = []
        for mask in masks:
            if not self._may_fit():
                return None
            self._fits_left -= 1
            found.append(self._fit_mask(mask))
            if found[-1].status == Status.FAILED:
                return None
        return found

    # Joining

    def join(self) -> None:
        """Join pairs until none makes the description shorter, or there is no fit left to try one."""
        refused: set[tuple[int, int]] = set()
        agreement: dict[tuple[int, int], float] = {}
        pairs = self._free_pairs()
        while self._may_fit():
            left = [pair for pair in pairs if pair not in refused]
            if not left:
                return
            for pair in left:
                if pair not in agreement:
                    agreement[pair] = self._agreement(*pair)
            a, b = max(left, key=agreement.__getitem__)
            if not self._joined(a, b):
                refused.add((a, b))
                continue
            agreement = {pair: share for pair, share in agreement.items() if not {a, b} & set(pair)}
            pairs = self._free_pairs()

    def _may_fit(self) -> bool:
        return self._fits_left > 0 and time.perf_counter() < self.deadline

    def _free_pairs(self) -> list[tuple[int, int]]:
        labels = (
            self.labels
            if len(self.fits) == self.labels.max()
            else np.where(np.isin(self.labels, list(self.fits)), self.labels, 0)
        )
        return convex_parts.free_pairs(labels, self.known, self.camera, self.sigma)

    def _agreement(self, a: int, b: int) -> float:
        """Share of the samples of either segment that lie on the other's body, the larger of both."""
        return max(self._on(a, b), self._on(b, a))

    def _on(self, label: int, other: int) -> float:
        rows, columns = np.nonzero((self.labels == label) & (self.known > 0))
        step = max(1, rows.size // 100)
        rows, columns = rows[::step], columns[::step]
        if rows.size == 0:
            return 0.0
        points = self.camera.unproject(columns, rows, self.known[rows, columns])
        fit = self.fits[other]
        level = np.hypot(self.sigma * points[:, 2] ** 2, scene_description.MODEL_ERROR)
        return float(np.mean(np.abs(fit.superquadric.sampson_distance(points)) < 2 * level))

    def _joined(self, a: int, b: int) -> bool:
        both = (self.labels == a) | (self.labels == b)
        found = self.fit([both])
        if found is None or not self._shorter(both, [found[0]], [self.fits[a], self.fits[b]], 0.0):
            return False
        self.labels = np.where(self.labels == b, a, self.labels).astype(self.labels.dtype)
        self.fits[a] = found[0]
        del self.fits[b]
        self.joined.append((a, b))
        return True

    # Splitting

    def split(self, label: int, deepest: int) -> None:
        """Split a segment into its convex parts, and these again, while that makes the description shorter."""
        if deepest == 0 or not self._may_fit():
            return
        mask = self.labels == label
        if not self._badly_told(label, mask):
            return
        parts = convex_parts.parts(mask, self.known, self.camera, self.sigma, _SPLITTING)
        if len(parts) < 2:
            return
        found = self.fit(parts)
        if found is None or self._hangs(found) or not self._shorter(mask, found, [self.fits[label]], _LEAST_GAIN):
            return
        self.labels = self.labels.copy()
        numbers = [label]
        for part, fit in zip(parts, found, strict=True):
            number = label if part is parts[0] else int(self.labels.max()) + 1
            self.labels[part] = number
            self.fits[number] = fit
            if number != label:
                numbers.append(number)
        self.parted.append(tuple(numbers))
        for number in numbers:
            self.split(number, deepest - 1)

    def _badly_told(self, label: int, mask: np.ndarray) -> bool:
        """Whether the body leaves so much over that a second one might pay."""
        fit = self.fits[label]
        if fit.status != Status.FAILED and fit.inlier_share > 1 - _LEAST_LEFT and not fit.as_hull:
            return False
        evidence = Evidence.of(self.depth, mask, self.camera, self.sigma)
        return self._left(evidence, [fit]) > scene_description.price(evidence) + _LEAST_GAIN

    def _hangs(self, fits: list[Fit]) -> bool:
        """Whether a body that does not reach the plane, let down onto it, meets another one or was seen to hover."""
        if self.plane is None:
            return False
        normal, drop = self.plane[:3], np.linspace(0, 1, _DROP_STEPS)[:, None]
        for one in fits:
            body = one.superquadric
            height, reach = float(body.translation @ normal + self.plane[3]), float(body.support(normal[None])[0])
            level = max(_FOOT, _FOOT_NOISE * self.sigma * float(body.translation[2]) ** 2)
            if height - reach < level:
                continue
            down = body.translation - (reach + drop * (height - reach)) * normal
            if any((other.superquadric.gauge(down) < 1).any() for other in fits if other is not one):
                return True
            # Near the plane the line of sight grazes what is measured.
            columns, rows = np.rint(self.camera.project(down[: _DROP_STEPS // 2])).astype(int).T
            inside = (columns >= 0) & (rows >= 0) & (columns < self.camera.width) & (rows < self.camera.height)
            seen = self.known[rows[inside], columns[inside]]
            if (seen > down[: _DROP_STEPS // 2][inside, 2] + level).any():
                return True
        return False

    # Descriptions

    def _shorter(self, mask: np.ndarray, new: list[Fit], old: list[Fit], gain: float) -> bool:
        evidence = Evidence.of(self.depth, mask, self.camera, self.sigma)
        lengths = [self._left(evidence, fits) + len(fits) * scene_description.price(evidence) for fits in (new, old)]
        return lengths[0] + gain < lengths[1]

    @staticmethod
    def _left(evidence: Evidence, fits: list[Fit]) -> float:
        """Nats left over by the bodies; what failed explains nothing."""
        return scene_description.unexplained(
            evidence, [fit.superquadric for fit in fits if fit.status != Status.FAILED]
        )
