"""Models of real depth sensors: noise, steps, edges and holes of a true depth image.

    model = sensor_noise.preset("kinect_v1")
    model.measure(depth, camera, rng)                # what it reports of a true depth image, NaN where nothing
    model.sigma(z, cosine), model.dropout(z, cosine)  # what it claims of a surface at depth z

z is depth in metres, +inf or NaN where nothing is seen; theta the angle between the surface's normal and the ray.
Lengths in pixels are those of the image at hand.

Structured light and stereo
---------------------------
Disparity is f b w, with the sensor's focal length f in pixels, its baseline b and w = 1 / z.

- Noise of standard deviation sigma(z, theta) in depth is sigma / z^2 in w.  One reading looks at a window of the image,
  so that the noise is a moving average over that window.
- Steps of ``step`` pixels of disparity are z^2 step / (f b) in depth (Khoshelham & Elberink 2012).  sigma is what a
  user measures and contains them: the noise before rounding has the variance sigma^2 - (width of the step)^2 / 12.
- The second eye does not see everything: shadows, fx b (w1 - w2) wide, on the side of an object away from that eye.
- Edges wander: a pixel near one shows the surface that a pixel at a normally distributed distance sees.  Surfaces are
  continued along their plane, so that nothing but edges moves.

As z is not linear in w, depths are too large by sigma^2 / z on average.

Time of flight
--------------
A pixel that measures the time of flight of modulated light mixes what falls into it: with the shares s of the surfaces
and the returned light ~ 1 / z^2,

    z = sum(s z / z^2) / sum(s / z^2),

between foreground and background: flying pixels.  Readings end where too little light returns.

References
----------
Khoshelham & Elberink, Accuracy and resolution of Kinect depth data for indoor mapping applications, Sensors 12 (2012).
Nguyen, Izadi & Lovell, Modeling Kinect sensor noise for improved 3D reconstruction and tracking, 3DIMPVT 2012.
Fankhauser et al., Kinect v2 for mobile robot navigation: evaluation and modeling, ICAR 2015.
Kurillo et al., Evaluating the accuracy of the Azure Kinect and Kinect v2, Sensors 22 (2022).
Grunnet-Jepsen et al., Tuning depth cameras for best performance; Subpixel linearity improvement (Intel RealSense).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from sq_perception.imaging.camera import Camera
from sq_perception.imaging.inverse_depth import InverseDepth, beside

_FARTHEST_MOVE = 4  # pixels, more than which no edge wanders


@dataclass(frozen=True)
class SensorNoise(ABC):
    """A depth sensor; see the module."""

    def measure(self, depth: np.ndarray, camera: Camera, rng: np.random.Generator) -> np.ndarray:
        """Measure a true depth image (height, width), metres, +inf or NaN for nothing: float32, NaN for no reading.
        Raises ValueError or TypeError for other numbers, sizes, depths or cameras; only :class:`Ideal` takes
        orthographic ones."""
        if not isinstance(rng, np.random.Generator):
            raise TypeError(f"rng: expected a numpy.random.Generator, got {type(rng).__name__}")
        depth = np.asarray(depth)
        if depth.ndim != 2 or not np.issubdtype(depth.dtype, np.floating):
            raise ValueError(f"depth: expected a floating image (height, width), got {depth.dtype} {depth.shape}")
        camera.check_image(depth)
        return self._measure(depth, camera, rng)

    def sigma(self, z: Any, cosine: Any = 1.0) -> np.ndarray:
        """Return the standard deviation, metres, of a reading at depth z with this cosine of incidence; broadcasts.
        Raises ValueError if a depth is not positive or a cosine not in (0, 1]."""
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


@dataclass(frozen=True)
class Triangulation(SensorNoise):
    """Common base of structured light and stereo."""

    focal: float  # pixels, focal length by which disparities are measured
    baseline: float
    """Metres, x of the projector or second imager; positive is to the right of the camera, seen by the camera."""
    step: float  # pixels, step that disparities are rounded to; 0 does not round
    window: tuple[int, int]  # (columns, rows), odd numbers of pixels that one reading looks at
    near: float
    far: float  # metres; readings nearer or farther are missing
    edge_wander: float  # pixels, standard deviation of the place of an edge, in both directions, at normal incidence
    grazing: float
    blind: float  # degrees of incidence up to which (grazing) no reading is lost, and from which on (blind) all are

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
        scene, lost = self._match(scene, lost)
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

    def _match(self, scene: InverseDepth, lost: np.ndarray) -> tuple[InverseDepth, np.ndarray]:
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
    60 degrees only.
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
    """

    subpixel: float = 0.1  # pixels, standard deviation of disparity
    fattening: int = 0  # pixels, 0 to 16

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, subpixel=(0.0, np.inf), fattening=(0, 16))

    def _sigma(self, z: np.ndarray, cosine: np.ndarray) -> np.ndarray:
        return np.square(z) * (self.subpixel / (self.focal * abs(self.baseline)))

    def _match(self, scene: InverseDepth, lost: np.ndarray) -> tuple[InverseDepth, np.ndarray]:
        column = np.arange(scene.w.shape[1], dtype=np.float32) - scene.w * np.float32(scene.camera.fx * self.baseline)
        outside = (column < 0) | (column > scene.w.shape[1] - 1)
        if self.fattening:
            scene, covered = scene.dilate(self.fattening)
            lost = lost & ~covered
        return scene, lost | outside


@dataclass(frozen=True)
class TimeOfFlight(SensorNoise):
    """Continuous-wave time of flight, as in the second and third Kinect: noise after Fankhauser et al. (2015),

        sigma = 0.0015 - 0.0005 z + 0.0003 z^2 + 0.0001 z^1.5 theta^2 / (pi/2 - theta)^2    metres.

    The light that returns goes with cosine / z^2.  Half of the readings are missing where it is that of a surface seen
    face-on at ``far``, all below 3/4 and none above 5/4 of that.  Multipath is left out.
    """

    near: float
    far: float  # metres; readings nearer or farther are missing
    footprint: float
    """Pixels, width that a pixel collects light from, 0 to 2: the edge between neighbours lies anywhere between their
    centres, and what of a footprint reaches over it belongs to the other surface."""
    mixed_loss: float  # share of mixed pixels that the sensor recognises and leaves out

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


def _average(rng: np.random.Generator, shape: tuple[int, ...], window: tuple[int, int]) -> np.ndarray:
    """Average normal numbers (height, width) over a window (columns, rows), with variance 1."""
    columns, rows = window
    height, width = shape[0] + rows - 1, shape[1] + columns - 1
    white = rng.standard_normal((height, width), dtype=np.float32)
    mean = cv2.boxFilter(white, -1, (columns, rows), normalize=False, borderType=cv2.BORDER_CONSTANT)
    top, left = rows // 2, columns // 2
    return mean[top : top + shape[0], left : left + shape[1]] / np.float32(np.sqrt(columns * rows))


IDEAL = "ideal"  # name of the sensor with Gaussian noise and nothing else, whose noise the user chooses
PRESETS: Mapping[str, SensorNoise] = {
    # Kinect for Xbox 360, Xtion and their kin, in the infrared camera's own view.  Noise and edges: Nguyen et al.
    # Steps and range: Khoshelham & Elberink (2.85 mm at 1 m, which is 1/8 pixel; 0.5 to 5 m).  Window: autocorrelation
    # of plane residuals in the recorded mOSD frames.  Angles of loss are chosen, not measured.
    "kinect_v1": StructuredLight(
        focal=580.0, baseline=0.075, step=1 / 8, window=(9, 5), near=0.5, far=5.0, edge_wander=0.8, grazing=70.0,
        blind=88.0,
    ),
    # Narrow field of view, unbinned.  Range: Microsoft's specification.  Noise: that of the Kinect v2 (Fankhauser et
    # al.), as Kurillo et al. found both comparable up to 2.5 m; Microsoft's specification is at most 17 mm.  Footprint
    # and loss at edges are chosen.
    "azure_kinect": TimeOfFlight(near=0.5, far=3.86, footprint=2.0, mixed_loss=0.5),
    # At 848 x 480.  Intel: field of view 90 degrees (f = 424), baseline 50 mm, disparities in steps of 1/32 pixel,
    # nearest 0.17 m and farthest 10 m; Grunnet-Jepsen (librealsense issue 3904): use a subpixel RMS of 0.08.  Window:
    # autocorrelation of plane residuals in recorded frames, scaled to f = 424.  Edges and angles of loss are chosen.
    "realsense_d435": Stereo(
        focal=424.0, baseline=0.05, step=1 / 32, window=(11, 5), near=0.17, far=10.0, edge_wander=1.0, grazing=75.0,
        blind=88.0, subpixel=0.08, fattening=2,
    ),
    # A passive stereo camera at 1280 x 720.  Stereolabs: baseline 120 mm, 0.3 to 20 m, depth as floating numbers.
    # Subpixel: 3 sigma of a quarter of a pixel are the accuracy of 1 % at 1 m that is quoted for it.  The rest is
    # chosen.  Holes where texture is missing are left out.
    "zed": Stereo(
        focal=700.0, baseline=0.12, step=0.0, window=(9, 9), near=0.3, far=20.0, edge_wander=1.0, grazing=75.0,
        blind=88.0, subpixel=0.25, fattening=3,
    ),
}  # fmt: skip


def preset(name: str) -> SensorNoise:
    """Return the sensor of this name; a ValueError if there is none."""
    if name not in PRESETS:
        raise ValueError(f"sensor: expected one of {', '.join(PRESETS)}, got {name!r}")
    return PRESETS[name]
