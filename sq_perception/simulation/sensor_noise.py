"""Models of real depth sensors: noise, steps, edges and holes of a true depth image.

    model = sensor_noise.preset("kinect_v1")
    model.measured(depth, camera, rng)                # what it reports of a true depth image, NaN where nothing
    model.sigma(z, cosine), model.dropout(z, cosine)  # what it claims of a surface at depth z

z is depth in metres, +inf or NaN where nothing is seen; theta the angle between the surface's normal and the ray.
Lengths in pixels are those of the image at hand.  :mod:`sensor_model` has the interface and the ideal
sensor, :mod:`triangulation` the equations of stereo cameras; here are time of flight and the sensors by name.

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

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from sq_perception.imaging.camera import Camera
from sq_perception.imaging.inverse_depth import InverseDepth
from sq_perception.simulation.sensor_model import Ideal, SensorNoise, check, steepness
from sq_perception.simulation.triangulation import Stereo, StructuredLight


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


__all__ = ["IDEAL", "PRESETS", "Ideal", "SensorNoise", "Stereo", "StructuredLight", "TimeOfFlight", "preset"]

IDEAL = "ideal"
"""Name of the sensor with Gaussian noise and nothing else, whose noise the user chooses."""
KINECT_V1 = StructuredLight(
    focal=580.0, baseline=0.075, step=1 / 8, window=(9, 5), near=0.5, far=5.0, edge_wander=0.8, grazing=70.0, blind=88.0
)
"""Kinect for Xbox 360, Xtion and their kin, in the infrared camera's own view.

Noise and edges: Nguyen et al.  Steps and range: Khoshelham & Elberink (2.85 mm at 1 m, which is 1/8 pixel; 0.5 to 5 m).
Window: autocorrelation of plane residuals in the recorded mOSD frames.  Angles of loss are chosen, not measured.
"""

AZURE_KINECT = TimeOfFlight(near=0.5, far=3.86, footprint=2.0, mixed_loss=0.5)
"""Azure Kinect, narrow field of view, unbinned.

Range: Microsoft's specification.  Noise: that of the Kinect v2 (Fankhauser et al.), as Kurillo et al. found both
comparable up to 2.5 m; Microsoft's specification is at most 17 mm.  Footprint and loss at edges are chosen.
"""

REALSENSE_D435 = Stereo(
    focal=424.0,
    baseline=0.05,
    step=1 / 32,
    window=(11, 5),
    near=0.17,
    far=10.0,
    edge_wander=1.0,
    grazing=75.0,
    blind=88.0,
    subpixel=0.08,
    fattening=2,
)
"""RealSense D435 at 848 x 480.

Intel: field of view 90 degrees (f = 424), baseline 50 mm, disparities in steps of 1/32 pixel, nearest 0.17 m and
farthest 10 m; Grunnet-Jepsen (librealsense issue 3904): use a subpixel RMS of 0.08.  Window: autocorrelation of plane
residuals in recorded RealSense frames, scaled to f = 424.  Edges and angles of loss are chosen.
"""

ZED = Stereo(
    focal=700.0,
    baseline=0.12,
    step=0.0,
    window=(9, 9),
    near=0.3,
    far=20.0,
    edge_wander=1.0,
    grazing=75.0,
    blind=88.0,
    subpixel=0.25,
    fattening=3,
)
"""ZED at 1280 x 720, a passive stereo camera.

Stereolabs: baseline 120 mm, 0.3 to 20 m, depth as floating numbers.  Subpixel: 3 sigma of a quarter of a pixel are the
accuracy of 1 % at 1 m that is quoted for it.  The rest is chosen.  Holes where texture is missing are left out.
"""

PRESETS: Mapping[str, SensorNoise] = MappingProxyType(
    {"kinect_v1": KINECT_V1, "azure_kinect": AZURE_KINECT, "realsense_d435": REALSENSE_D435, "zed": ZED}
)


def preset(name: str) -> SensorNoise:
    """Return the sensor of this name.

    Raises
    ------
    ValueError
        If there is none.
    """
    if name not in PRESETS:
        raise ValueError(f"sensor: expected one of {', '.join(PRESETS)}, got {name!r}")
    return PRESETS[name]
