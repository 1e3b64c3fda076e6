"""Sensors that measure the time of flight of modulated light.

A pixel mixes what falls into it: with the shares s of the surfaces and the returned light ~ 1 / z^2,

    z = sum(s z / z^2) / sum(s / z^2),

between foreground and background: flying pixels.  Readings end where too little light returns.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sq_perception.imaging.camera import Camera
from sq_perception.imaging.inverse_depth import InverseDepth
from sq_perception.simulation.sensor_model import SensorNoise, check, steepness


@dataclass(frozen=True)
class TimeOfFlight(SensorNoise):
    """Continuous-wave time of flight, as in the second and third Kinect: noise after Fankhauser et al. (2015),

        sigma = 0.0015 - 0.0005 z + 0.0003 z^2 + 0.0001 z^1.5 theta^2 / (pi/2 - theta)^2    metres.

    The light that returns goes with cosine / z^2.  Half of the readings are missing where it is that of a surface seen
    face-on at ``far``, all below 3/4 and none above 5/4 of that.  Multipath is left out.

    Attributes
    ----------
    near, far : metres
        Readings outside are missing.
    footprint : pixels
        Width that a pixel collects light from, 0 to 2: the edge between neighbours lies anywhere between their
        centres, and what of a footprint reaches over it belongs to the other surface.
    mixed_loss
        Share of mixed pixels that the sensor recognises and leaves out.
    """

    near: float
    far: float
    footprint: float
    mixed_loss: float

    def __post_init__(self) -> None:
        check(self, near=(1e-3, np.inf), far=(self.near, np.inf), footprint=(0.0, 2.0), mixed_loss=(0.0, 1.0))

    def dropout(self, z: Any, cosine: Any = 1.0) -> np.ndarray:
        return np.clip((1.25 - cosine * np.square(self.far / np.asarray(z))) / 0.5, 0.0, 1.0)

    def _sigma(self, z: np.ndarray, cosine: np.ndarray) -> np.ndarray:
        face_on = 0.0015 - 0.0005 * z + 0.0003 * np.square(z)
        return face_on + 0.0001 * z * np.sqrt(z) * np.square(steepness(cosine))

    def _measure(self, depth: np.ndarray, camera: Camera, rng: np.random.Generator) -> np.ndarray:
        scene = InverseDepth.of(depth, camera)
        cosine, lost = scene.cosine(), scene.w == 0
        z = 1 / np.where(lost, np.float32(1 / self.near), scene.w)
        sigma = self._sigma(z, np.maximum(cosine, np.float32(1e-3)))
        lost |= rng.random(z.shape, dtype=np.float32) < self.dropout(z, cosine)
        self._mix(z, lost, scene, rng)
        z = z + sigma * rng.standard_normal(z.shape, dtype=np.float32)
        lost |= (z < self.near) | (z > self.far)
        return np.where(lost, np.float32(np.nan), z).astype(np.float32)

    def _mix(self, z: np.ndarray, lost: np.ndarray, scene: InverseDepth, rng: np.random.Generator) -> None:
        """Mix pixels beside jumps with their neighbours, in place."""
        if self.footprint == 0:
            return
        w, width = scene.w.ravel(), scene.w.shape[1]
        share, first, second = np.zeros((3, w.size), np.float32)
        for jump, step in zip(scene.jumps(), (1, width), strict=True):
            v, u = np.nonzero(jump)
            index = v * width + u
            edge = rng.random(index.size, dtype=np.float32)
            for pixel, other, distance in ((index, index + step, edge), (index + step, index, 1 - edge)):
                reach = np.maximum(self.footprint / 2 - distance, 0) / self.footprint
                # Within one kind of pair every pixel occurs once, so that plain indexing adds up.
                share[pixel] += reach
                first[pixel] += reach * w[other]
                second[pixel] += reach * np.square(w[other])
        mixed = np.nonzero((second > 0) & (w > 0))[0]
        own = np.maximum(1 - share[mixed], 0)
        light = own * np.square(w[mixed]) + second[mixed]
        z.ravel()[mixed] = (own * w[mixed] + first[mixed]) / light
        lost.ravel()[mixed] |= rng.random(mixed.size) < self.mixed_loss
