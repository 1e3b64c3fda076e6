"""Sensors that measure disparity: structured light and stereo.

Disparity is f b w, with the sensor's focal length f in pixels, its baseline b and w = 1 / z.

- Noise of standard deviation sigma(z, theta) in depth is sigma / z^2 in w.  One reading looks at a window of the image,
  so that the noise is a moving average over that window.
- Steps of ``step`` pixels of disparity are z^2 step / (f b) in depth (Khoshelham & Elberink 2012).  sigma is what a
  user measures and contains them: the noise before rounding has the variance sigma^2 - (width of the step)^2 / 12.
- The second eye does not see everything: shadows, fx b (w1 - w2) wide, on the side of an object away from that eye.
- Edges wander: a pixel near one shows the surface that a pixel at a normally distributed distance sees.  Surfaces are
  continued along their plane, so that nothing but edges moves.

As z is not linear in w, depths are too large by sigma^2 / z on average.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from sq_perception.imaging.camera import Camera
from sq_perception.imaging.inverse_depth import InverseDepth, beside
from sq_perception.simulation.sensor_model import SensorNoise, check, steepness

_FARTHEST_MOVE = 4
"""Pixels, more than which no edge wanders."""


@dataclass(frozen=True)
class Triangulation(SensorNoise):
    """Common base of structured light and stereo.

    Attributes
    ----------
    focal : pixels
        Focal length by which disparities are measured.
    baseline : metres
        x of the projector or second imager; positive is to the right of the camera, seen by the camera.
    step : pixels
        Step that disparities are rounded to; 0 does not round.
    window : (columns, rows)
        Odd numbers of pixels that one reading looks at.
    near, far : metres
        Readings outside are missing.
    edge_wander : pixels
        Standard deviation of the place of an edge, in both directions, at normal incidence.
    grazing, blind : degrees
        Incidence up to which no reading is lost, and from which on all are; linear between.
    """

    focal: float
    baseline: float
    step: float
    window: tuple[int, int]
    near: float
    far: float
    edge_wander: float
    grazing: float
    blind: float

    def __post_init__(self) -> None:
        check(self, focal=(1e-3, np.inf), baseline=(-np.inf, np.inf), step=(0.0, np.inf), near=(1e-3, np.inf))
        check(self, far=(self.near, np.inf), edge_wander=(0.0, float(_FARTHEST_MOVE)))
        check(self, grazing=(0.0, 90.0), blind=(self.grazing, 90.0))
        if self.baseline == 0:
            raise ValueError("baseline: expected metres to one side, got 0")
        if len(self.window) != 2 or any(int(n) != n or n < 1 or n % 2 == 0 for n in self.window):
            raise ValueError(f"window: expected two odd numbers of pixels, got {self.window}")

    @property
    def quantum(self) -> float:
        """The step of the readings in 1 / z, per metre."""
        return self.step / (self.focal * abs(self.baseline))

    def dropout(self, z: Any, cosine: Any = 1.0) -> np.ndarray:
        angle = np.degrees(np.arccos(np.clip(cosine, 0.0, 1.0)))
        share = (angle - self.grazing) / max(self.blind - self.grazing, 1e-6)
        return np.clip(share, 0.0, 1.0) + np.zeros(np.shape(z))

    def _measure(self, depth: np.ndarray, camera: Camera, rng: np.random.Generator) -> np.ndarray:
        scene = InverseDepth.of(depth, camera)
        cosine, lost = scene.cosine(), scene.hidden_from(self.baseline)
        scene, lost = self._matched(scene, lost)
        w, cosine, lost = self._wander(scene, cosine, lost, rng)
        lost |= w == 0
        z = 1 / np.where(lost, np.float32(1 / self.near), w)
        variance = np.square(self._sigma(z, np.maximum(cosine, np.float32(1e-3))) / np.square(z))
        variance -= np.float32(self.quantum**2 / 12)
        w = w + _average(rng, w.shape, self.window) * np.sqrt(np.maximum(variance, 0))
        if self.quantum:
            w = np.rint(w / np.float32(self.quantum)) * np.float32(self.quantum)
        lost |= (w < 1 / self.far) | (w > 1 / self.near)
        self._thin_out(lost, cosine, rng)
        with np.errstate(divide="ignore"):
            return np.where(lost, np.float32(np.nan), 1 / w).astype(np.float32)

    def _matched(self, scene: InverseDepth, lost: np.ndarray) -> tuple[InverseDepth, np.ndarray]:
        """Return what matching makes of the scene and of the pixels lost so far."""
        return scene, lost

    def _wander(
        self, scene: InverseDepth, cosine: np.ndarray, lost: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return inverse depth, cosine and lost pixels with displaced edges."""
        if self.edge_wander == 0:
            return scene.w, cosine, lost
        brush = np.ones((2 * _FARTHEST_MOVE + 1, 2 * _FARTHEST_MOVE + 1), np.uint8)
        v, u = np.nonzero(cv2.dilate(beside(scene.jumps()).view(np.uint8), brush))
        far = self._edge_deviation(cosine[v, u]) * rng.standard_normal((2, v.size), dtype=np.float32)
        down, right = np.clip(np.rint(far), -_FARTHEST_MOVE, _FARTHEST_MOVE).astype(np.intp)
        down = np.clip(v + down, 0, cosine.shape[0] - 1) - v
        right = np.clip(u + right, 0, cosine.shape[1] - 1) - u
        w, moved_cosine, moved_lost = scene.w.copy(), cosine.copy(), lost.copy()
        w[v, u] = scene.shift(v, u, down, right)
        moved_cosine[v, u] = cosine[v + down, u + right]
        moved_lost[v, u] = lost[v + down, u + right]
        return w, moved_cosine, moved_lost

    def _edge_deviation(self, cosine: np.ndarray) -> np.ndarray | float:
        return self.edge_wander

    def _thin_out(self, lost: np.ndarray, cosine: np.ndarray, rng: np.random.Generator) -> None:
        """Drop readings of grazing surfaces, in window-sized patches."""
        from scipy.special import ndtri  # here: a node that recovers does without

        v, u = np.nonzero(~lost & (cosine < np.cos(np.radians(self.grazing))))
        if v.size:
            share = self.dropout(self.near, cosine[v, u])
            lost[v, u] = _average(rng, lost.shape, self.window)[v, u] < ndtri(share)


@dataclass(frozen=True)
class StructuredLight(Triangulation):
    """One camera and a projector, as in the first Kinect: noise after Nguyen, Izadi & Lovell (2012), metres,

        sigma = 0.0012 + 0.0019 (z - 0.4)^2 + 0.0001 / sqrt(z) theta^2 / (pi/2 - theta)^2,

    and edges that wander by edge_wander + 0.035 theta / (pi/2 - theta) pixels.  They use the last term of sigma beyond
    60 degrees only, where it is 0.4 mm at 1 m; here it holds everywhere, so that nothing jumps.
    """

    def _sigma(self, z: np.ndarray, cosine: np.ndarray) -> np.ndarray:
        return 0.0012 + 0.0019 * np.square(z - 0.4) + 0.0001 / np.sqrt(z) * np.square(steepness(cosine))

    def _edge_deviation(self, cosine: np.ndarray) -> np.ndarray:
        return self.edge_wander + 0.035 * steepness(np.maximum(cosine, np.float32(1e-3)))


@dataclass(frozen=True)
class Stereo(Triangulation):
    """Sensor of two imagers, with or without a projector: sigma = z^2 subpixel / (f b).

    The match of a window takes the nearer of two surfaces in it: foregrounds are fattened, by ``fattening`` pixels all
    around, over what the second imager does not see as well.  Columns that lie outside the second image are missing: a
    band of fx b / z pixels at the border away from it.

    Attributes
    ----------
    subpixel : pixels
        Standard deviation of disparity.
    fattening : pixels
        0 to 16.
    """

    subpixel: float = 0.1
    fattening: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, subpixel=(0.0, np.inf), fattening=(0, 16))

    def _sigma(self, z: np.ndarray, cosine: np.ndarray) -> np.ndarray:
        return np.square(z) * (self.subpixel / (self.focal * abs(self.baseline)))

    def _matched(self, scene: InverseDepth, lost: np.ndarray) -> tuple[InverseDepth, np.ndarray]:
        column = np.arange(scene.w.shape[1], dtype=np.float32) - scene.w * np.float32(scene.camera.fx * self.baseline)
        outside = (column < 0) | (column > scene.w.shape[1] - 1)
        if self.fattening:
            scene, covered = scene.dilate(self.fattening)
            lost = lost & ~covered
        return scene, lost | outside


def _average(rng: np.random.Generator, shape: tuple[int, ...], window: tuple[int, int]) -> np.ndarray:
    """Average normal numbers (height, width) over a window (columns, rows), with variance 1."""
    columns, rows = window
    height, width = shape[0] + rows - 1, shape[1] + columns - 1
    white = rng.standard_normal((height, width), dtype=np.float32)
    mean = cv2.boxFilter(white, -1, (columns, rows), normalize=False, borderType=cv2.BORDER_CONSTANT)
    top, left = rows // 2, columns // 2
    return mean[top : top + shape[0], left : left + shape[1]] / np.float32(np.sqrt(columns * rows))
