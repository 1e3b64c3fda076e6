"""What a frame repeats of the one before it: objects whose pixels, and those around them, read the same but for noise.

A body is what a fit makes of readings.  Where these are the same but for noise, a fit to them would answer the same but
for what noise makes of it, which is its covariance: the body stands, and neither segmentation nor network nor fit is
asked again.  It is not refined either: its error is that of the frame it was recovered from, and counts once
(:attr:`~sq_perception.recovery.recovery.Recovery.repeats`, :mod:`sq_perception.tracking.fusion`).

Equation
--------
q = (d - r) / (s z^2) compares a pixel's depth d with its depth r when its body was recovered; s is the noise of the
difference at one metre, measured on the frame itself, where most pixels are taken to show what they did.  An object
repeats if the eight sums of q over its surroundings, weighted by

    1, x, y, x^2, x y, y^2 (the place in the image), dr/dx, dr/dy (what a shift by a pixel makes of r, edges included)

are those of noise: with g = V q, T = g^T (v V V^T)^-1 g is chi-squared with eight degrees of freedom; v makes up for
noise that neighbouring pixels share.  What turned, slid, or has another shape moves these sums.  A frame repeats as a
whole if its objects do and nowhere does q change, or reading appear, over a patch as small as an object.

Because readings are compared with those at the recovery, slow motion adds up until it is noticed.  And because the test
may miss what lies below the noise, and a valley of the fit's cost may have been a wrong one, one body at a time is
recovered anew when its turn comes, sooner where the view does not tell it whole.

The camera has not moved: where it has, nothing repeats.  Optical frame, metres; pinhole cameras.

Reference: M. Yamamoto et al., Direct estimation of range flow on deformable shape from a video rate range camera,
IEEE PAMI 15(1), 1993, for the change of a range image under motion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from sq_perception.fitting.fit import CUT_SHORT, Status
from sq_perception.imaging.camera import Camera
from sq_perception.recovery.options import RecoveryOptions

if TYPE_CHECKING:
    from sq_perception.recovery.recovery import FrameRecovery, Recovery
    from sq_perception.recovery.seen_object import SeenObject

_WIDTH = 320
"""Columns that are compared: noise of neighbouring pixels is alike in all sensors of sensor_noise.preset."""
_BAND = 2
"""Compared pixels around an object that belong to it: free space and outline."""
_CLIP, _FAR = 3.0, 6.0
"""Noise levels: more is an edge that wandered, in an object's sums and in a patch."""
_CHANGED = 30.0
"""T of an object that does not repeat: 1 in 5000 by chance; 1 in 50 at the edges of simulated sensors."""
_PATCH, _NEW = 7, 3.5
"""Compared pixels across, and mean of q in noise levels, of a patch that shows something new.  An edge that wanders
fills half of it."""
_BLOCK = 8
"""Compared pixels across which noise may be shared."""
_QUARTILE = 1.15
"""Three quarters of normal noise lie below this many standard deviations."""
_REACH = 1.25
"""Of the farthest object's depth: beyond, where tables graze and walls are far, readings come and go."""
_NOISIER, _SHARED = 5.0, 25.0
"""Of a reading's noise, and v: more is none, and the camera has moved.  Still scenes had up to 3.5 and 17."""
_ANEW = {Status.CONVERGED: 30, Status.WEAK: 10, Status.FAILED: 30}
"""Repetitions after which a body's turn comes: a second at 30 Hz.  Chosen."""
_ALIKE = 0.8
"""Intersection over union of two segments that are one: what noise leaves of a small object's edge."""


@dataclass(frozen=True, eq=False)
class Reference:
    """The readings that a frame's bodies were recovered from.

    Attributes
    ----------
    depth : float32 (rows, columns)
        Every ``stride``-th pixel of the image; 0 where nothing was measured.
    sigma
        Noise of the depth at one metre, metres.
    """

    depth: np.ndarray
    stride: int
    sigma: float
    camera: Camera
    options: RecoveryOptions

    @classmethod
    def of(cls, depth: np.ndarray, camera: Camera, sigma: float, options: RecoveryOptions) -> Reference:
        """Of an image (height, width) that is NaN where nothing was measured."""
        stride = max(1, round(camera.width / _WIDTH))
        return cls(np.nan_to_num(depth[::stride, ::stride]), stride, sigma, camera, options)

    def keeping(self, other: Reference, labels: np.ndarray, kept: Sequence[int]) -> Reference:
        """These readings, but those of another reference around the labels that were recovered from it."""
        around = np.zeros(self.depth.shape, bool)
        for label in kept:
            around |= _around(labels[:: self.stride, :: self.stride] == label) > 0
        return replace(self, depth=np.where(around, other.depth, self.depth))


@dataclass(frozen=True, eq=False)
class Repeated:
    """What a frame repeats.

    Attributes
    ----------
    bodies
        By their label in the frame before.
    whole
        Whether there is nothing else to see.
    """

    bodies: Mapping[int, Recovery]
    whole: bool


NOTHING = Repeated({}, False)


def repeated(previous: FrameRecovery, depth: np.ndarray, camera: Camera, options: RecoveryOptions) -> Repeated:
    """What an image repeats of the frame before it.

    Parameters
    ----------
    depth : float (height, width)
        Metres, NaN where nothing was measured.
    """
    before = previous.reference
    if before is None or before.camera != camera or before.options != options or not camera.is_pinhole:
        return NOTHING
    old, new = before.depth, Reference.of(depth, camera, before.sigma, options).depth
    labels = previous.labels[:: before.stride, :: before.stride]
    reach = _REACH * float(old[labels > 0].max(initial=0))
    both = (old > 0) & (new > 0)
    nearer = np.maximum(np.minimum(old, new), 1e-6)
    change = np.where(both, (new - old) / (nearer * nearer), 0)
    near = np.abs(change[both & (old < reach)])
    spread = float(np.quantile(near, 0.75)) / _QUARTILE if near.size else np.inf
    if spread > _NOISIER * before.sigma:
        return NOTHING
    level = max(spread, 0.5 * before.sigma)
    change /= level

    patches = np.clip(change, -_FAR, _FAR)
    patches[(old == 0) & (new > 0) & (new < reach)] = _FAR
    still = float(np.abs(cv2.blur(patches, (_PATCH, _PATCH))).max()) < _NEW
    change = np.clip(change, -_CLIP, _CLIP)
    share = _shared(change, both & (old < reach))
    if share > _SHARED:
        return NOTHING
    smooth = cv2.blur(old, (3, 3))

    due = _due(previous.bodies)
    kept = {}
    for one in previous.bodies:
        if one is due or CUT_SHORT in one.message:
            continue
        mask = _around(labels == one.label)
        left, top, width, height = cv2.boundingRect(mask)
        window = slice(top, top + height), slice(left, left + width)
        inside = both[window] & (mask[window] > 0)
        scale = level * nearer[window] ** 2
        if _statistic(change[window], inside, smooth[window], scale, share) < _CHANGED:
            kept[one.label] = one
    return Repeated(kept, still and 0 < len(kept) == len(previous.bodies))


def matched(kept: Repeated, labels: np.ndarray, objects: Sequence[SeenObject]) -> dict[int, Recovery]:
    """The repeated bodies of a new frame's objects, by their new labels.

    ``labels`` are those of the frame before; a body whose object is segmented otherwise now is left out.
    """
    same: dict[int, Recovery] = {}
    for one in objects if kept.bodies else ():
        inside = labels[one.window][one.mask_crop]
        counts = np.bincount(np.maximum(inside, 0))
        counts[0] = 0
        label = int(counts.argmax())
        body = kept.bodies.get(label)
        if body is not None and counts[label] > _ALIKE * (body.pixels + one.pixels - counts[label]):
            same[one.label] = replace(body, label=one.label, pixels=one.pixels, repeats=body.repeats + 1)
    return same


def _due(bodies: Sequence[Recovery]) -> Recovery | None:
    """The body whose turn it is to be recovered anew, if any."""
    waiting = [one for one in bodies if one.repeats >= _ANEW[one.status]]
    return max(waiting, key=lambda one: one.repeats - _ANEW[one.status], default=None)


def _around(mask: np.ndarray) -> np.ndarray:
    """An object with its surroundings, uint8."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * _BAND + 1, 2 * _BAND + 1), np.uint8))


def _shared(change: np.ndarray, both: np.ndarray) -> float:
    """v: the variance of a sum over a block, a pixel of it; 1 for independent ones of unit variance."""
    rows, columns = (size // _BLOCK * _BLOCK for size in change.shape)
    parts = (rows // _BLOCK, _BLOCK, columns // _BLOCK, _BLOCK)
    full = both[:rows, :columns].reshape(parts).all(axis=(1, 3))
    sums = np.abs(change[:rows, :columns].reshape(parts).sum(axis=(1, 3))[full])
    if sums.size == 0:
        return 1.0
    return max((float(np.quantile(sums, 0.75)) / _QUARTILE / _BLOCK) ** 2, 1.0)


def _statistic(change: np.ndarray, inside: np.ndarray, depth: np.ndarray, scale: np.ndarray, share: float) -> float:
    """T of one object."""
    rows, columns = np.nonzero(inside)
    if rows.size == 0:
        return np.inf
    height, width = inside.shape
    x, y = 2 * columns / max(width - 1, 1) - 1, 2 * rows / max(height - 1, 1) - 1
    shifts = [
        np.clip(slope / scale, -1, 1)[inside] for slope in (np.gradient(depth, axis=1), np.gradient(depth, axis=0))
    ]
    weights = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y, *shifts])
    sums = weights @ change[inside]
    spread = share * (weights @ weights.T)
    spread += 1e-6 * np.trace(spread) * np.eye(len(spread))
    return float(sums @ np.linalg.solve(spread, sums))
