"""The surface fit and the classic fit of the same object, and what each of them costs in milliseconds.

The classic fit gets 1000 of the object's measured points, evenly in the order of the image, as its users would give it.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from sq_perception.fitting import solina_bajcsy, surface_fit
from sq_perception.fitting.fit import Fit, Status
from sq_perception.imaging.camera import Camera

CLASSIC_POINTS = 1000


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
    middle = time.perf_counter()
    rows, columns = np.nonzero(mask & np.isfinite(depth))
    points = camera.unproject(columns, rows, depth[rows, columns])
    chosen = np.linspace(0, len(points) - 1, min(len(points), CLASSIC_POINTS)).astype(int)
    classic = solina_bajcsy.fit(points[chosen])
    ended = time.perf_counter()
    return Both(fit, classic, 1e3 * (middle - began), 1e3 * (ended - middle), points)
