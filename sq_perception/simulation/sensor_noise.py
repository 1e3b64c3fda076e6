"""Models of real depth sensors: noise, steps, edges and holes of a true depth image.

    model = sensor_noise.preset("kinect_v1")
    model.measured(depth, camera, rng)                # what it reports of a true depth image, NaN where nothing
    model.sigma(z, cosine), model.dropout(z, cosine)  # what it claims of a surface at depth z

z is depth in metres, +inf or NaN where nothing is seen; theta the angle between the surface's normal and the ray.
Lengths in pixels are those of the image at hand.  The equations are in :mod:`sensor_model` (the interface and the ideal
sensor), :mod:`triangulation` and :mod:`time_of_flight`; here are the sensors.

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
from types import MappingProxyType

from sq_perception.simulation.sensor_model import Ideal, SensorNoise
from sq_perception.simulation.time_of_flight import TimeOfFlight
from sq_perception.simulation.triangulation import Stereo, StructuredLight

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
