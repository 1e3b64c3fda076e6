"""One object of a frame on its way to a body: its pixels, what it stands on, which of its pixels measured it, and what
networks predict of it: for many views at once, before other work goes on or only if that asks for it.

Masks are sorted by size before they come here.  Crops are windows of the image with a camera of their own; metres,
optical frame.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import cv2
import numpy as np

from sq_perception.fitting.options import ON_SUPPORT
from sq_perception.fitting.priors import HullPrior
from sq_perception.geometry.quantiles import quantile
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import canonical_view, depth_steps, raycast, regions
from sq_perception.imaging.camera import Camera
from sq_perception.imaging.canonical_view import CanonicalView
from sq_perception.imaging.depth_steps import coherent, shown_step
from sq_perception.learning.inference import HullPredictions, Predictor, ThingPredictor
from sq_perception.learning.network_config import RegressorConfig, ThingConfig
from sq_perception.segmentation.evidence import FrameEvidence

_POINTS = 2000  # enough for quantiles of heights to settle
_MOST_ROWS = 4  # pixels by which a given mask is completed at most

Answers: TypeAlias = Superquadric | HullPredictions


@dataclass(frozen=True, eq=False)
class Prediction:
    """What a network predicts of one object, from ``view``; perhaps it is computed when it is asked for.

    ``answers`` gives the network's answers for several objects, each in the frame of its view, the one at ``number``
    for this one.
    """

    view: CanonicalView
    answers: Callable[[], Answers]
    number: int

    def body(self) -> Superquadric:
        """The predicted body in the optical frame."""
        answers = self.answers()
        bodies = answers.bodies if isinstance(answers, HullPredictions) else answers
        return self.view.from_canonical(bodies[self.number]).canonical_form()

    def hull(self) -> HullPrior | None:
        """The predicted hull in the optical frame, if the network predicts hulls."""
        answers = self.answers()
        return answers.hull(self.number, self.view) if isinstance(answers, HullPredictions) else None


@dataclass(frozen=True, eq=False)
class SeenObject:
    """One object, and what is known of it before its body is sought.

    ``label``: its value in the label image.  ``pixels``, ``masked``: number of measured pixels of its label, and of all
    of them.  ``unread`` (n,): those that were not measured, as indices into the image: a mask from colour tells that
    the object is there.  ``mask``: bool (height, width), what measured it: those pixels without outliers, or with what
    goes on from them (:func:`complete`); ``mask_crop``, ``depth_crop`` and ``camera_crop`` are its ``window`` of mask,
    depth and camera.  ``plane`` (4,): what it stands on.  ``shown``: what a network is shown of it.  ``view``: what its
    score is measured on.  ``prediction``: what the network says.  ``fills``: whether it runs out of the image on
    opposite sides: a surface, and no thing.
    """

    label: int
    pixels: int
    masked: int
    unread: np.ndarray
    mask: np.ndarray
    depth_crop: np.ndarray
    camera_crop: Camera
    window: tuple[slice, slice]
    plane: np.ndarray | None = None
    shown: CanonicalView | None = None
    view: CanonicalView | None = None
    prediction: Prediction | None = None
    fills: bool = False

    @property
    def mask_crop(self) -> np.ndarray:
        return self.mask[self.window]

    @cached_property
    def points(self) -> np.ndarray:
        """At most some thousand measured points (n, 3), evenly taken."""
        rows, columns = np.nonzero(self.mask_crop)
        return regions.some_points(rows, columns, self.depth_crop, self.camera_crop, _POINTS)

    def heights(self, plane: np.ndarray) -> np.ndarray:
        """Heights above a plane (4,), metres, of the pixels of ``mask_crop``; NaN elsewhere."""
        depth, mask = np.ascontiguousarray(self.depth_crop), np.ascontiguousarray(self.mask_crop)
        return raycast.heights(depth, mask, self.camera_crop.lens, plane)

    @cached_property
    def step(self) -> float:
        """Metres between neighbours from which on one is not of the object."""
        footprint = quantile(self.depth_crop[self.mask_crop], 0.5) / np.sqrt(self.camera_crop.fx * self.camera_crop.fy)
        return float(shown_step(footprint))

    @cached_property
    def connected(self) -> np.ndarray:
        """``mask_crop`` without what a depth step separates from most of it, such as the wall behind in a mask that is
        too large."""
        depth, mask = np.ascontiguousarray(self.depth_crop), np.ascontiguousarray(self.mask_crop)
        return coherent(depth, mask, self.step)

    def levels(self, plane: np.ndarray) -> tuple[float, float]:
        """Heights above a plane that a fiftieth and half of its pixels stay below, metres; of some thousand pixels."""
        heights = self.heights(plane)[self.connected]
        heights = heights[:: max(1, heights.size // _POINTS)]
        return quantile(heights, 0.02), quantile(heights, 0.5)

    def of_readings(self, depth: np.ndarray, gaps: np.ndarray, labels: np.ndarray) -> SeenObject:
        """The object in an image (height, width) that has no readings in its ``gaps``, bool (height, width)."""
        left = np.isfinite(depth[self.window]) & (labels[self.window] == self.label)
        pixels = int(np.count_nonzero(left))
        return replace(self, mask=self.mask & ~gaps, depth_crop=depth[self.window], pixels=pixels)


def objects(depth: np.ndarray, found: FrameEvidence, camera: Camera) -> list[SeenObject]:
    """The objects of a segmentation that have a measured pixel, in its order; outliers are none of their surface."""
    measured, outliers, seen = np.isfinite(depth), found.outliers, []
    for label in found.ids:
        named = found.labels == label
        mask = named & measured
        left, top, width, height = regions.box(mask)
        if width == 0:
            continue
        window = slice(top, top + height), slice(left, left + width)
        camera_crop = camera.cropped(left, top, width, height)
        pixels = int(np.count_nonzero(mask[window]))
        unread = np.flatnonzero(named ^ mask) if np.count_nonzero(named) > pixels else np.zeros(0, np.int64)
        masked, fills = pixels + len(unread), regions.fills((left, top, width, height), measured)
        inner = mask & ~outliers
        seen.append(SeenObject(label, pixels, masked, unread, inner, depth[window], camera_crop, window, fills=fills))
    return seen


def complete(obj: SeenObject, depth: np.ndarray, camera: Camera, labels: np.ndarray) -> SeenObject:
    """Return the object with a mask that was given some pixels too small completed; any other object as it is.

    Such a mask goes on nearly all around without a depth step, while beside a right one there is the support, what is
    far behind, or another object.  Uncompleted, the missing pixels would pass for free space beside the object, and the
    mask's border for its outline.  ``labels`` (height, width) are those of all objects.
    """
    if obj.plane is None or not camera.is_pinhole:
        return obj
    around, near, names, view = surroundings(obj, depth, labels, camera, _MOST_ROWS)
    unnamed = np.isfinite(near) & (names == 0)
    free = unnamed & (raycast.heights(near, unnamed, view.lens, obj.plane) > 0.01)  # metres
    mask, rows = names == obj.label, 0
    while rows < _MOST_ROWS:
        rim = (cv2.dilate(mask.view(np.uint8), depth_steps.CROSS) > 0) & ~mask
        grown = depth_steps.grow(mask.astype(np.int32), free & rim, near, 1, depth_steps.STEP) > 0
        # Of the second row around household things 4 % go on typically, 70 % where masks are two pixels too small.
        if np.count_nonzero(grown & rim) <= 0.6 * np.count_nonzero(rim):
            break
        mask, rows = grown, rows + 1
    if rows < 2:  # a sensor widens an edge by one
        return obj
    whole = np.zeros_like(obj.mask)
    whole[around] = mask & np.isfinite(near)
    x, y, width, height = regions.box(whole)
    window = slice(y, y + height), slice(x, x + width)
    crop = camera.cropped(x, y, width, height)
    return replace(obj, mask=whole, depth_crop=depth[window], camera_crop=crop, window=window)


def surroundings(
    obj: SeenObject, depth: np.ndarray, labels: np.ndarray, camera: Camera, reach: int
) -> tuple[tuple[slice, slice], np.ndarray, np.ndarray, Camera]:
    """The window of the image up to ``reach`` pixels around an object, with its depth, its labels and its camera."""
    down, across = obj.window
    top, left = max(down.start - reach, 0), max(across.start - reach, 0)
    around = slice(top, down.stop + reach), slice(left, across.stop + reach)
    near = np.ascontiguousarray(depth[around])
    return around, near, labels[around], camera.cropped(left, top, near.shape[1], near.shape[0])


def add_views(
    obj: SeenObject, depth: np.ndarray, camera: Camera, config: RegressorConfig | ThingConfig | None
) -> SeenObject:
    """Return the object with ``shown``, the view for a network of this configuration, and ``view``, for its score."""
    inner = core(obj, depth, camera)
    shown = None
    if config is not None:
        whole = inner.copy()
        whole.flat[obj.unread] = True
        shown = config.view_of(depth, whole, camera, obj.plane)
    if shown is not None and not (isinstance(config, RegressorConfig) and config.framing == "full"):
        return replace(obj, shown=shown, view=shown)
    view = canonical_view.from_mask(obj.depth_crop, inner[obj.window], obj.camera_crop, pixels=64)
    return replace(obj, shown=shown, view=view)


def core(obj: SeenObject, depth: np.ndarray, camera: Camera) -> np.ndarray:
    """The mask (height, width) without pixels that measured the table or the background.

    A view is framed by all pixels of a mask, but sensors widen what is near, and masks from colour may be too large
    anywhere.  A thing that is thin above the table keeps all its pixels.
    """
    if not camera.is_pinhole:
        return obj.mask
    inner = obj.mask_crop
    if obj.plane is not None:
        above = obj.heights(obj.plane) > ON_SUPPORT
        inner = above if 2 * np.count_nonzero(above) > obj.pixels else inner
    whole = np.zeros_like(obj.mask)
    whole[obj.window] = inner
    # With a margin, as a part that goes on beyond the mask is something else.
    around, near, inside, _ = surroundings(obj, depth, whole, camera, 1)
    whole[around] &= coherent(near, np.ascontiguousarray(inside), obj.step)
    return whole


# What networks predict


def predict_hulls(
    views: Sequence[CanonicalView], planes: Sequence[np.ndarray | None], network: ThingPredictor, mirror: bool
) -> list[Prediction]:
    """Predictions of hulls from views, and from their mirror images, and the support planes (4,), optical frame."""
    shown = np.stack([view.with_steps for view in views])
    known = zip(views, planes, strict=True)
    below = np.stack([np.zeros(4) if plane is None else view.plane_to_canonical(plane) for view, plane in known])
    extents = np.array([view.extent for view in views])
    found = network.predict(shown, below, extents, mirror)
    return [Prediction(view, lambda: found, k) for k, view in enumerate(views)]


def predict_bodies(views: Sequence[CanonicalView], network: Predictor, when_asked: bool) -> list[Prediction]:
    """Predictions of bodies from views: computed now, or all of them when the first one is asked for."""
    shown = np.stack([view.marked for view in views])
    lock, found = threading.Lock(), list[Superquadric]()

    def answers() -> Superquadric:
        with lock:  # of several threads that ask, one computes
            if not found:
                found.append(network.predict(shown))
            return found[0]

    if not when_asked:
        answers()
    return [Prediction(view, answers, k) for k, view in enumerate(views)]
