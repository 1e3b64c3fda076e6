"""Segments split where the bodies of their convex parts describe the image more briefly.

A segment of whose body much is left over, more than a second body would cost
(:mod:`sq_perception.recovery.scene_description`), and that has convex parts
(:mod:`sq_perception.segmentation.convex_parts`), is fitted again part by part.  Where there is a plane, the bodies of
the parts stand on it, as far as can be seen: the neck of a bottle, which stands on another part, and the handle of a
mug, which hovers, are no bodies of their own.

Fits are what costs time: a frame in which every body explains its segment costs none.  Parts are split again, to a
bounded depth.  Frames as everywhere: optical, metres.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
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
AreOne = Callable[[np.ndarray, Sequence[np.ndarray]], bool]
"""Whether two of some parts, bool (height, width), are one object for all that labels (height, width) show."""

_PARTS = SightOptions(suspicious=0.04, apart=0.35)
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
class Split:
    """Segments and their bodies.

    Attributes
    ----------
    labels : int32 (height, width)
    fits
        By label; those of segments that were not touched are the ones given.
    parted
        Labels that were split, as (kept, new ...).
    """

    labels: np.ndarray
    fits: dict[int, Fit]
    parted: tuple[tuple[int, ...], ...] = ()


def split(
    depth: np.ndarray,
    camera: Camera,
    labels: np.ndarray,
    plane: np.ndarray | None,
    fits: Mapping[int, Fit],
    fit_mask: FitMask,
    sigma: float,
    time_budget: float = np.inf,
    are_one: AreOne | None = None,
) -> Split:
    """Split segments as long as that makes the description of the image shorter.

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
    are_one
        What refuses a split whose parts belong together.

    Raises
    ------
    ValueError
        If an image does not fit the camera.
    """
    camera.check_image(depth)
    camera.check_image(labels)
    fits, parted = dict(fits), []
    if not camera.is_pinhole:
        return Split(labels, fits)
    deadline, fits_left = time.perf_counter() + time_budget, _MOST_FITS
    with np.errstate(invalid="ignore"):
        known = np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)
    image = _Image(depth, known, camera, plane, sigma)
    waiting = [(label, _DEEPEST) for label in sorted(fits, reverse=True)]
    while waiting and time.perf_counter() < deadline:
        label, deepest = waiting.pop()
        mask = labels == label
        if deepest == 0 or fits_left == 0 or _explains(fits[label]):
            continue
        parts = convex_parts.parts(mask, known, camera, sigma, _PARTS)
        if len(parts) < 2 or (are_one is not None and are_one(labels, parts)) or not image.may_pay(mask, fits[label]):
            continue
        found: list[Fit] = []
        for part in parts[:fits_left]:
            if time.perf_counter() >= deadline:
                break
            fits_left -= 1
            found.append(fit_mask(part))
        if len(found) < len(parts) or any(fit.status == Status.FAILED for fit in found):
            continue
        if image.hangs(found) or not image.is_shorter(mask, found, [fits[label]]):
            continue
        numbers = (label, *range(int(labels.max()) + 1, int(labels.max()) + len(parts)))
        labels = labels.copy()
        for number, part, fit in zip(numbers, parts, found, strict=True):
            labels[part] = number
            fits[number] = fit
        parted.append(numbers)
        waiting.extend((number, deepest - 1) for number in reversed(numbers))
    return Split(labels, fits, tuple(parted))


@dataclass(frozen=True, eq=False)
class _Image:
    """What bodies are held against; ``known`` is the depth with 0 where nothing was measured."""

    depth: np.ndarray
    known: np.ndarray
    camera: Camera
    plane: np.ndarray | None
    sigma: float

    def may_pay(self, mask: np.ndarray, fit: Fit) -> bool:
        """Whether the body of a mask leaves so much over that a second one might pay."""
        evidence = Evidence.of(self.depth, mask, self.camera, self.sigma)
        return _left(evidence, [fit]) > scene_description.price(evidence) + _LEAST_GAIN

    def is_shorter(self, mask: np.ndarray, new: Sequence[Fit], old: Sequence[Fit]) -> bool:
        """Whether new bodies of a mask describe the image more briefly than old ones."""
        evidence = Evidence.of(self.depth, mask, self.camera, self.sigma)
        lengths = [_left(evidence, fits) + len(fits) * scene_description.price(evidence) for fits in (new, old)]
        return lengths[0] + _LEAST_GAIN < lengths[1]

    def hangs(self, fits: Sequence[Fit]) -> bool:
        """Whether a body that does not reach the plane, let down onto it, meets another one or was seen to hover."""
        if self.plane is None:
            return False
        normal, drop = self.plane[:3], np.linspace(0, 1, _DROP_STEPS)[:, None]
        for fit in fits:
            body = fit.superquadric
            height, reach = float(body.translation @ normal + self.plane[3]), float(body.support(normal[None])[0])
            level = max(_FOOT, _FOOT_NOISE * self.sigma * float(body.translation[2]) ** 2)
            if height - reach < level:
                continue
            down = body.translation - (reach + drop * (height - reach)) * normal
            if any((other.superquadric.gauge(down) < 1).any() for other in fits if other is not fit):
                return True
            # Near the plane the line of sight grazes what is measured.
            columns, rows = np.rint(self.camera.project(down[: _DROP_STEPS // 2])).astype(int).T
            inside = (columns >= 0) & (rows >= 0) & (columns < self.camera.width) & (rows < self.camera.height)
            seen = self.known[rows[inside], columns[inside]]
            if (seen > down[: _DROP_STEPS // 2][inside, 2] + level).any():
                return True
        return False


def _explains(fit: Fit) -> bool:
    """Whether a body leaves so little of its segment over that no split is thought of."""
    return fit.status != Status.FAILED and fit.inlier_share > 1 - _LEAST_LEFT and not fit.as_hull


def _left(evidence: Evidence, fits: Sequence[Fit]) -> float:
    """Nats left over by the bodies; what failed explains nothing."""
    return scene_description.unexplained(evidence, [fit.superquadric for fit in fits if fit.status != Status.FAILED])
