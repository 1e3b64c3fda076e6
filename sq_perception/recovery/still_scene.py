"""Objects that did not change since the frame before: readings in them and around them differ by no more than noise.

Where readings differ by noise alone, another fit would differ by its covariance.  So the body of the frame before
stands, without another segmentation, prediction or fit; its error is that of the frame it was recovered from, and
counts once (:attr:`~sq_perception.recovery.recovery.Recovery.repeats`, :mod:`sq_perception.tracking.fusion`).

    scene = StillScene(recoverer)
    for depth in video:
        found = scene.recover(depth, camera)

Equation
--------
q = (d - r) / (s z^2) compares a pixel's depth d with its depth r when its body was recovered; s is the noise of the
difference at one metre, measured on the frame itself, where most pixels are taken to show what they did.  An object
repeats if most of its pixels are still measured and the eight sums of q over its surroundings, weighted by

    1, x, y, x^2, x y, y^2 (the place in the image), dr/dx, dr/dy (what a shift by a pixel makes of r, edges included)

are those of noise: with g = V q, T = g^T (v V V^T)^-1 g is chi-squared with eight degrees of freedom; v makes up for
noise that neighbouring pixels share.  What turned, slid, or has another shape moves these sums.  The segments of a
frame repeat if its objects do and nowhere, over a patch as small as an object, does q change, or reading appear that
does not go on with one beside it.

Because readings are compared with those at the recovery, slow motion adds up until it is noticed.  Because the test may
miss what lies below the noise, and a fit may have been wrong, one body at a time is recovered anew when its turn comes,
sooner where the view does not determine all of it; old segments are then found anew, too.

The camera has not moved: where it has, nothing repeats.  Optical frame, metres; pinhole cameras.

Reference: M. Yamamoto et al., Direct estimation of range flow on deformable shape from a video rate range camera,
IEEE PAMI 15(1), 1993, for the change of a range image under motion.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from sq_perception.fitting.fit import CUT_SHORT, Status
from sq_perception.geometry.kernels import inline_kernel, kernel
from sq_perception.geometry.quantiles import select
from sq_perception.imaging.camera import Camera
from sq_perception.imaging.regions import extents
from sq_perception.imaging.regions import window as window_of
from sq_perception.recovery.options import RecoveryOptions
from sq_perception.recovery.readings import Readings
from sq_perception.recovery.recoverer import Found, Recoverer
from sq_perception.recovery.recovery import FrameRecovery, Recovery
from sq_perception.segmentation.evidence import FrameEvidence

_BAND = 2  # compared pixels around an object that belong to it: free space and outline
_CLIP, _FAR = 3.0, 6.0  # noise levels: more is an edge that wandered, in an object's sums and in a patch
_BESIDE = 3
"""Compared pixels up to which a new reading may go on with an old one; without, one frame in
twenty of a still scene has a patch that looks new."""
_BLOCK = 8  # compared pixels across which noise may be shared
_QUARTILE = 1.15  # three quarters of normal noise lie below this many standard deviations
_ANEW = 30
"""Repetitions after which the turn of a body comes, of a weak one after a third of them, and age of segments that are
then found anew: a second at 30 Hz."""


@dataclass(frozen=True, eq=False)
class Reference:
    """A frame's recovery, and what it was made from: what the next frame is compared with.

    ``depth``: float32 (rows, columns), every ``stride``-th pixel of the image, 0 where nothing was measured: for each
    body, as it was when that was recovered.  ``segmentation``: the objects, found ``age`` frames ago, or ``given``.
    """

    recovery: FrameRecovery
    depth: np.ndarray
    stride: int
    camera: Camera
    options: RecoveryOptions
    segmentation: FrameEvidence
    age: int
    given: bool


@dataclass(frozen=True, eq=False)
class Repeated:
    """What a frame repeats of the one before: ``bodies`` by their label there, and the ``segmentation`` if it holds."""

    bodies: Mapping[int, Recovery]
    segmentation: FrameEvidence | None


NOTHING = Repeated({}, None)


class StillScene:
    """Recovers the frames of one camera, and takes from the frame before, ``last``, what did not change.  Several
    scenes may share the ``recoverer``."""

    def __init__(self, recoverer: Recoverer, last: Reference | None = None) -> None:
        self.recoverer = recoverer
        self.last = last

    def recover(
        self, depth: np.ndarray, camera: Camera, labels: np.ndarray | None = None,
        options: RecoveryOptions | None = None,
    ) -> FrameRecovery:
        """Recover every object of the next frame; parameters and errors as those of :meth:`Recoverer.recover`."""
        self.last = follow(self.recoverer, self.recoverer.read(depth, camera, labels, options), self.last)
        return self.last.recovery


def follow(recoverer: Recoverer, readings: Readings, last: Reference | None) -> Reference:
    """Recover a frame, given the reference that the frame before left; returns what it leaves to the next."""
    kept = NOTHING if last is None else repeat(last, readings)
    seen, stride = sample(readings.depth, readings.camera)
    if last is not None and kept.segmentation is not None and len(kept.bodies) == len(last.recovery.bodies):
        bodies = tuple(replace(body, repeats=body.repeats + 1) for body in last.recovery.bodies)
        spent = 1e3 * (time.perf_counter() - readings.began)
        milliseconds = {**dict.fromkeys(last.recovery.milliseconds, 0.0), "segmentation": spent, "total": spent}
        return replace(
            last, recovery=replace(last.recovery, bodies=bodies, milliseconds=milliseconds), age=last.age + 1
        )
    found = recoverer.find_objects(readings, kept.segmentation)
    same = {} if last is None else match(kept, last.recovery.labels, found)
    recovery = recoverer.recover_objects(readings, found, same)
    age = 0 if last is None or kept.segmentation is None else last.age + 1
    new = Reference(
        recovery, seen, stride, readings.camera, readings.options, found.segmentation, age, readings.labels is not None
    )
    return new if last is None or not same else mix(new, last, list(same))


def warm_up() -> None:
    """Compile, or load from disk, every kernel by an image that is all one object and repeats itself."""
    readings = np.ones((2 * _BLOCK, 2 * _BLOCK), np.float32)
    shown = np.ones(readings.shape, np.int32)
    extents(shown)
    _compare(readings, readings, shown, 1e-3)
    _moments(_around(shown == 1), 1e-3, np.zeros_like(readings), readings, readings, readings)


def repeat(last: Reference, readings: Readings) -> Repeated:
    """The bodies and segments of the frame before that hold for an image.  Segments repeat only where given masks do,
    or where none were given to either."""
    previous, camera, labels = last.recovery, readings.camera, readings.labels
    if last.camera != camera or last.options != readings.options or not camera.is_pinhole:
        return NOTHING
    if previous.labels.max(initial=0) > previous.labels.size:  # given ones, and tables by label would be huge
        return NOTHING
    old, new = last.depth, sample(readings.depth, camera)[0]
    shown = np.ascontiguousarray(previous.labels[:: last.stride, :: last.stride], dtype=np.int32)
    compared = _compare(old, new, shown, last.segmentation.sigma)
    if compared is None:
        return NOTHING
    change, patches, level, share = compared
    # An edge that wanders fills half of a patch of 7 x 7.
    still = float(np.abs(cv2.blur(patches, (7, 7))).max()) < 3.5
    smooth = cv2.blur(old, (3, 3))

    due, boxes = _due(previous.bodies), extents(shown)
    kept, repeating = {}, 0
    for body in previous.bodies:
        if body.label >= len(boxes):
            continue
        window = window_of(boxes[body.label], _BAND)
        own = shown[window] == body.label
        had = own & (old[window] > 0)
        # What is taken away where nothing is behind it, or comes too near, is not measured any more.
        if np.count_nonzero(had & (new[window] > 0)) <= 0.5 * np.count_nonzero(had):
            continue
        seen = (np.ascontiguousarray(image[window]) for image in (change, old, new, smooth))
        sums, square = _moments(_around(own), level, *seen)
        square = share * square + 1e-6 * share * np.trace(square) * np.eye(len(square))
        # T is above 30 once in 5000 by chance, once in 50 at the edges of simulated sensors.
        if square.any() and sums @ np.linalg.solve(square, sums) < 30:
            repeating += 1
            if body is not due and CUT_SHORT not in body.message:
                kept[body.label] = body
    count = len(previous.bodies)
    is_same = not last.given if labels is None else np.array_equal(labels, previous.labels)
    is_fresh = len(kept) == count or last.age < _ANEW
    repeats = is_same and still and 0 < count == repeating and is_fresh
    return Repeated(kept, last.segmentation if repeats else None)


def _compare(
    old: np.ndarray, new: np.ndarray, shown: np.ndarray, sigma: float
) -> tuple[np.ndarray, np.ndarray, float, float] | None:
    """What changed between two images (rows, columns) of labels ``shown``, in levels of their noise; None where the
    camera has moved.  Returns q, clipped, what patches are taken of, the noise level s, and v."""
    # A fourth behind the farthest object and beyond, where tables graze and walls are far, readings come and go.
    reach = 1.25 * float(old[shown > 0].max(initial=0))
    change, near = _changed(old, new, reach)
    spread = select(near, 3 * near.size // 4) / _QUARTILE if near.size else np.inf
    if spread > 5 * sigma:  # still scenes have up to 3.5
        return None
    level = max(spread, 0.5 * sigma)
    patches, sums = _in_noise_levels(change, old, new, level, reach)
    share = max((select(sums, 3 * sums.size // 4) / _QUARTILE / _BLOCK) ** 2, 1.0) if sums.size else 1.0
    return None if share > 25 else (change, patches, level, share)  # still scenes have up to 17


def match(kept: Repeated, labels: np.ndarray, found: Found) -> dict[int, Recovery]:
    """The repeated bodies of a new frame's objects, by their new labels.  ``labels`` are those of the frame before; a
    body whose object is segmented otherwise now is left out."""
    same: dict[int, Recovery] = {}
    for obj in found.objects if kept.bodies else ():
        is_own = (found.segmentation.labels[obj.window] == obj.label) & np.isfinite(obj.depth_crop)
        inside = labels[obj.window][is_own]
        counts = np.bincount(np.maximum(inside, 0))
        counts[0] = 0
        label = int(counts.argmax())
        body = kept.bodies.get(label)
        # Noise at the edge of a small object leaves an intersection over union of 0.8.
        if body is not None and counts[label] > 0.8 * (body.pixels + obj.pixels - counts[label]):
            same[obj.label] = replace(body, label=obj.label, pixels=obj.pixels, repeats=body.repeats + 1)
    return same


def sample(depth: np.ndarray, camera: Camera) -> tuple[np.ndarray, int]:
    """The readings of an image (height, width) that are compared, float32, and their stride in pixels.  The image is
    NaN where nothing was measured, the readings are 0 there."""
    stride = max(1, round(camera.width / 320))  # with so many columns neighbouring noise is alike in all sensors
    seen = np.asarray(depth[::stride, ::stride], dtype=np.float32)
    return np.where(np.isnan(seen), np.float32(0), seen), stride


def mix(new: Reference, old: Reference, kept: Sequence[int]) -> Reference:
    """The new reference, with the old readings around the labels that were recovered from these."""
    labels, taken = new.recovery.labels[:: new.stride, :: new.stride], np.zeros(new.depth.shape, bool)
    for label in kept:
        taken |= _around(labels == label) > 0
    return replace(new, depth=np.where(taken, old.depth, new.depth))


def _around(mask: np.ndarray) -> np.ndarray:
    """An object with its surroundings, uint8."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * _BAND + 1, 2 * _BAND + 1), np.uint8))


def _due(bodies: Sequence[Recovery]) -> Recovery | None:
    """The body whose turn it is to be recovered anew, if any."""

    def overdue(body: Recovery) -> int:
        return body.repeats - (_ANEW // 3 if body.status == Status.WEAK else _ANEW)

    longest = max(bodies, key=overdue, default=None)
    return longest if longest is not None and overdue(longest) >= 0 else None


@kernel
def _changed(old: np.ndarray, new: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """(d - r) / z^2 where both images have a reading, 0 elsewhere, and its sizes (n,) within reach."""
    change, near, count = np.zeros(old.shape, np.float32), np.empty(old.size, np.float32), 0
    for v in range(old.shape[0]):
        for u in range(old.shape[1]):
            r, d = old[v, u], new[v, u]
            if r > 0 and d > 0:
                z = max(min(r, d), np.float32(1e-6))
                change[v, u] = (d - r) / (z * z)
                if r < reach:
                    near[count] = abs(change[v, u])
                    count += 1
    return change, near[:count]


@kernel
def _in_noise_levels(
    change: np.ndarray, old: np.ndarray, new: np.ndarray, level: float, reach: float
) -> tuple[np.ndarray, np.ndarray]:
    """What patches are taken of (rows, columns), and sizes (n,) of the sums of q over blocks of readings.  ``change``
    becomes q, clipped, in place."""
    patches = np.empty(change.shape, np.float32)
    for v in range(change.shape[0]):
        for u in range(change.shape[1]):
            q = change[v, u] / level
            is_new = old[v, u] == 0 and 0 < new[v, u] < reach and not _goes_on(old, new[v, u], v, u, level)
            patches[v, u] = _FAR if is_new else min(max(q, -_FAR), _FAR)
            change[v, u] = min(max(q, -_CLIP), _CLIP)
    rows, columns = change.shape[0] // _BLOCK, change.shape[1] // _BLOCK
    sums, count = np.empty(rows * columns, np.float32), 0
    for i in range(rows):
        for j in range(columns):
            total, full = 0.0, True
            for v in range(i * _BLOCK, (i + 1) * _BLOCK):
                for u in range(j * _BLOCK, (j + 1) * _BLOCK):
                    full = full and 0 < old[v, u] < reach and new[v, u] > 0
                    total += change[v, u]
            if full:
                sums[count] = abs(total)
                count += 1
    return patches, sums[:count]


@inline_kernel
def _goes_on(old: np.ndarray, reading: float, v: int, u: int, level: float) -> bool:
    """Whether a reading where none was is like one that was beside it: at the edges of holes they come and go."""
    for i in range(max(v - _BESIDE, 0), min(v + _BESIDE + 1, old.shape[0])):
        for j in range(max(u - _BESIDE, 0), min(u + _BESIDE + 1, old.shape[1])):
            if old[i, j] > 0 and abs(old[i, j] - reading) < _FAR * level * reading * reading:
                return True
    return False


@kernel
def _moments(
    near: np.ndarray, level: float, change: np.ndarray, old: np.ndarray, new: np.ndarray, smooth: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """V q (8,) and V V^T (8, 8) of the pixels in or near one object; zeros where none has both readings."""
    rows, columns = near.shape
    sums, square, w = np.zeros(8), np.zeros((8, 8)), np.ones(8)
    for v in range(rows):
        for u in range(columns):
            if not (old[v, u] > 0 and new[v, u] > 0 and near[v, u]):
                continue
            z = np.float64(min(old[v, u], new[v, u]))
            scale = level * max(z, 1e-6) ** 2
            x, y = 2.0 * u / max(columns - 1, 1) - 1.0, 2.0 * v / max(rows - 1, 1) - 1.0
            before, after = max(u - 1, 0), min(u + 1, columns - 1)
            across = (np.float64(smooth[v, after]) - smooth[v, before]) / max(after - before, 1)
            before, after = max(v - 1, 0), min(v + 1, rows - 1)
            down = (np.float64(smooth[after, u]) - smooth[before, u]) / max(after - before, 1)
            w[1], w[2], w[3], w[4], w[5] = x, y, x * x, x * y, y * y
            w[6], w[7] = min(max(across / scale, -1.0), 1.0), min(max(down / scale, -1.0), 1.0)
            for i in range(8):
                sums[i] += w[i] * change[v, u]
                for j in range(i + 1):
                    square[i, j] += w[i] * w[j]
    for i in range(8):
        square[i, i:] = square[i:, i]
    return sums, square
