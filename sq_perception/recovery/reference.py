"""The readings and segments that the bodies of a frame were recovered from: what the next frame is compared with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from sq_perception.imaging.camera import Camera
from sq_perception.recovery.options import RecoveryOptions
from sq_perception.segmentation.segments import Segmentation

_WIDTH = 320
"""Columns that are compared: noise of neighbouring pixels is alike in all sensors of sensor_noise.preset."""
BAND = 2
"""Compared pixels around an object that belong to it: free space and outline."""


@dataclass(frozen=True, eq=False)
class Reference:
    """What a frame's bodies were recovered from.

    Attributes
    ----------
    depth : float32 (rows, columns)
        Every ``stride``-th pixel of the image; 0 where nothing was measured.
    segments
        The objects, of all pixels, found ``age`` frames ago, or ``given``.
    """

    depth: np.ndarray
    stride: int
    camera: Camera
    options: RecoveryOptions
    segments: Segmentation
    age: int
    given: bool

    @classmethod
    def of(
        cls,
        depth: np.ndarray,
        camera: Camera,
        options: RecoveryOptions,
        segments: Segmentation,
        *,
        age: int,
        given: bool,
    ) -> Reference:
        """Of an image (height, width) that is NaN where nothing was measured."""
        stride = max(1, round(camera.width / _WIDTH))
        return cls(sampled(depth, stride), stride, camera, options, segments, age, given)

    def keeping(self, other: Reference, labels: np.ndarray, kept: Sequence[int]) -> Reference:
        """These readings, but those of another reference around the labels that were recovered from it."""
        taken = np.zeros(self.depth.shape, bool)
        for label in kept:
            taken |= around(labels[:: self.stride, :: self.stride] == label) > 0
        return replace(self, depth=np.where(taken, other.depth, self.depth))


def sampled(depth: np.ndarray, stride: int) -> np.ndarray:
    """Every so many-th pixel, float32, of an image that is NaN where nothing was measured; 0 there."""
    seen = np.asarray(depth[::stride, ::stride], dtype=np.float32)
    return np.where(np.isnan(seen), np.float32(0), seen)


def around(mask: np.ndarray) -> np.ndarray:
    """An object with its surroundings, uint8."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * BAND + 1, 2 * BAND + 1), np.uint8))
