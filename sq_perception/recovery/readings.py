"""One image to recover from: its readings and masks, checked, with small holes filled."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from sq_perception.imaging import depth_units, hole_filling
from sq_perception.imaging.camera import GREATEST_DEPTH, LEAST_DEPTH, Camera
from sq_perception.recovery.options import RecoveryOptions


@dataclass(frozen=True, eq=False)
class Readings:
    """One image to recover from.

    ``depth``: float32 (height, width), metres, NaN where nothing was measured; small holes are filled.  ``filled``:
    bool (height, width) or None, the filled pixels: segments and views take them, fits do not.  ``labels``: integer
    (height, width) or None, masks from outside.  ``began``: when work on it began, by :func:`time.perf_counter`.
    """

    depth: np.ndarray
    filled: np.ndarray | None
    camera: Camera
    labels: np.ndarray | None
    options: RecoveryOptions
    began: float

    def within_range(self, labels: np.ndarray) -> np.ndarray:
        """Return the depth without readings of objects that are out of range: left in, they would pass for free space
        beside the objects."""
        near, far = self.options.depth_range
        if near <= 0 and np.isinf(far):
            return self.depth
        out = (labels > 0) & ((self.depth < near) | (self.depth > far))
        return np.where(out, np.float32(np.nan), self.depth)

    def doubt(self) -> str:
        """Return what makes all bodies of the image doubtful, in words; empty otherwise."""
        return depth_units.doubt(self.depth, self.camera)


def read(depth: np.ndarray, camera: Camera, labels: np.ndarray | None, options: RecoveryOptions) -> Readings:
    """Check an image and fill its small holes; parameters and errors as those of ``Recoverer.recover``.  Arrays come
    out row by row, as kernels are compiled for arrays of a kind."""
    began = time.perf_counter()
    depth = camera.readings(depth)
    farthest = min(GREATEST_DEPTH, float(np.finfo(depth.dtype).max))  # which half precision does not reach
    within = (depth >= (LEAST_DEPTH if camera.is_pinhole else 0)) & (depth <= farthest)
    depth = np.ascontiguousarray(np.where(within, depth, np.nan), dtype=np.float32)
    if labels is not None:
        labels = np.asarray(np.ma.filled(labels, 0), order="C")
        if labels.shape != depth.shape:
            raise ValueError(f"labels: expected the shape of the depth, {depth.shape}, got {labels.shape}")
    depth, labels, filled = hole_filling.fill(depth, labels)
    return Readings(depth, filled, camera, labels, options, began)
