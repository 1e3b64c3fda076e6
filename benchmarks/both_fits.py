"""The surface fit and the classic fit of the same object, and what each of them costs in milliseconds.

The classic fit gets the object's measured points, of which it takes 1000, evenly in the order of the image.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from sq_perception.fitting import solina_bajcsy, surface_fit
from sq_perception.fitting.fit import Fit, Status
from sq_perception.imaging.camera import Camera


@dataclass(frozen=True)
class Both:
    """Both fits of one object, their milliseconds, and all measured points (n, 3) of the object, metres."""

    fit: Fit
    classic: Fit
    milliseconds: float
    classic_milliseconds: float
    points: np.ndarray

    @property
    def verdict(self) -> str:
        """What the surface fit reports of itself."""
        if self.fit.status == Status.CONVERGED:
            return self.fit.message
        return f"{self.fit.status.name.lower()}: {self.fit.message}"


def both(depth: np.ndarray, mask: np.ndarray, camera: Camera, options: surface_fit.FitOptions) -> Both:
    """Fit one object of an image with both methods."""
    began = time.perf_counter()
    fit = surface_fit.fit(depth, mask, camera, options=options)
    milliseconds = 1e3 * (time.perf_counter() - began)
    points = measured_points(depth, mask, camera)
    began = time.perf_counter()
    classic = solina_bajcsy.fit(points)
    return Both(fit, classic, milliseconds, 1e3 * (time.perf_counter() - began), points)


def measured_points(depth: np.ndarray, mask: np.ndarray, camera: Camera) -> np.ndarray:
    """What was measured within a mask: points (n, 3) of the optical frame, in the order of the image."""
    rows, columns = np.nonzero(mask & np.isfinite(depth))
    return camera.unproject(columns, rows, depth[rows, columns])
