"""The interface of depth sensor models; :mod:`sq_perception.simulation.sensor_noise` has the sensors."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np

from sq_perception.imaging.camera import Camera


@dataclass(frozen=True)
class SensorNoise(ABC):
    """A depth sensor; see the module."""

    def measured(self, depth: np.ndarray, camera: Camera, rng: np.random.Generator) -> np.ndarray:
        """Measure a true depth image: float32 (height, width) metres, NaN for no reading.

        Parameters
        ----------
        depth : floating (height, width)
            True depth in metres, +inf or NaN where nothing is seen.
        camera : Camera
            Of the image; a pinhole for all sensors but :class:`Ideal`.
        rng : numpy.random.Generator
            The same state gives the same image.

        Raises
        ------
        ValueError, TypeError
            If the image is not of floating numbers or not of the camera's size, shows depths that are not positive to
            a pinhole camera, or the camera or the generator are of another kind.
        """
        if not isinstance(rng, np.random.Generator):
            raise TypeError(f"rng: expected a numpy.random.Generator, got {type(rng).__name__}")
        depth = np.asarray(depth)
        if depth.ndim != 2 or not np.issubdtype(depth.dtype, np.floating):
            raise ValueError(f"depth: expected a floating image (height, width), got {depth.dtype} {depth.shape}")
        camera.check_image(depth)
        return self._measure(depth, camera, rng)

    def sigma(self, z: Any, cosine: Any = 1.0) -> np.ndarray:
        """Return the standard deviation, metres, of a reading at depth z with this cosine of incidence; broadcasts.

        Raises
        ------
        ValueError
            If a depth is not positive or a cosine not in (0, 1].
        """
        z, cosine = np.asarray(z, dtype=float), np.asarray(cosine, dtype=float)
        if not (np.isfinite(z) & (z > 0)).all():
            raise ValueError("z: expected positive metres")
        if not ((cosine > 0) & (cosine <= 1)).all():
            raise ValueError("cosine: expected more than 0 and at most 1")
        return self._sigma(z, cosine) + np.zeros(np.broadcast_shapes(z.shape, cosine.shape))

    def dropout(self, z: Any, cosine: Any = 1.0) -> np.ndarray:
        """Return the share of missing readings of a surface; arguments as of :meth:`sigma`."""
        return np.zeros(np.broadcast_shapes(np.shape(z), np.shape(cosine)))

    @abstractmethod
    def _measure(self, depth: np.ndarray, camera: Camera, rng: np.random.Generator) -> np.ndarray: ...

    @abstractmethod
    def _sigma(self, z: np.ndarray, cosine: np.ndarray) -> np.ndarray: ...


@dataclass(frozen=True)
class Ideal(SensorNoise):
    """Sensor with independent Gaussian noise of ``deviation`` metres, for any camera and depth."""

    deviation: float = 0.0

    def __post_init__(self) -> None:
        check(self, deviation=(0.0, np.inf))

    def _measure(self, depth: np.ndarray, camera: Camera, rng: np.random.Generator) -> np.ndarray:
        seen = np.where(np.isfinite(depth), depth, np.nan).astype(np.float32)
        if self.deviation == 0:
            return seen
        return seen + np.float32(self.deviation) * rng.standard_normal(depth.shape, dtype=np.float32)

    def _sigma(self, z: np.ndarray, cosine: np.ndarray) -> np.ndarray:
        return np.full_like(z, self.deviation)


def check(model: SensorNoise, **limits: tuple[float, float]) -> None:
    """Raise ValueError unless each named attribute is a finite number within its limits."""
    for name, (low, high) in limits.items():
        value = getattr(model, name)
        if not (np.isfinite(value) and low <= value <= high):
            raise ValueError(f"{name}: expected {low:g} to {high:g}, got {value}")


def steepness(cosine: np.ndarray) -> np.ndarray:
    """Return theta / (pi/2 - theta) of the angle of incidence theta with this cosine."""
    theta = np.arccos(np.minimum(cosine, 1))
    return theta / (np.pi / 2 - theta)
