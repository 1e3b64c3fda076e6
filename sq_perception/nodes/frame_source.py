"""What synthetic_depth_node publishes: generated scenes or recorded frames, one after the other, with fresh noise.

The k-th scene of a seed is always the same one.  A scene or recording stays for ``hold`` frames, in which only the
noise changes.  A camera_info_file with distortion gives generated scenes a raw camera: the scene is rendered and
measured as its rectified camera sees it, and distorted when it is published.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import unit_cube
from sq_perception.imaging.calibration import Calibration
from sq_perception.imaging.camera import Camera
from sq_perception.nodes.parameters import IDEAL, ParameterError, SyntheticParameters
from sq_perception.recordings import frame_file
from sq_perception.simulation.scenes import table_scene, thesis_scene
from sq_perception.simulation.sensor_noise import Ideal, preset

SUFFIXES = (".npz", ".png", ".bmp")
_SCENES, _NOISE = 1, 2
"""Streams of random numbers under one seed."""


@dataclass(frozen=True, eq=False)
class SourceFrame:
    """One image.

    Attributes
    ----------
    depth : float32 (height, width)
        Metres in the optical frame, NaN where nothing is seen.
    camera : Camera
    labels : int32 (height, width) or None
    truth : Superquadric or None
        The bodies (n,) in the frame that results are published in: cube frame if ``is_cube``, else optical frame.
    is_cube : bool
    name : str
    calibration : Calibration or None
        Of the camera that publishes the image, where that distorts.
    """

    depth: np.ndarray
    camera: Camera
    labels: np.ndarray | None
    truth: Superquadric | None
    is_cube: bool
    name: str
    calibration: Calibration | None = None


class FrameSource:
    """Frames in their order.

    Raises
    ------
    ParameterError
        If there is nothing to replay, or the first frame cannot be published as the parameters want it.
    FrameError, ValueError
        If the first frame cannot be read or made.
    """

    def __init__(self, parameters: SyntheticParameters) -> None:
        self._parameters = parameters
        self._files = _recordings(Path(parameters.path)) if parameters.scene == "replay" else []
        self._calibration = None
        if parameters.camera_info_file:
            self._calibration = frame_file.read_calibration(parameters.camera_info_file)
        self._noise = np.random.default_rng([parameters.seed, _NOISE])
        self._count = len(self._files) or parameters.scenes
        self._position, self._left = 0, parameters.hold
        self._clean = self._make(0)
        if parameters.encoding != "auto" and self.is_cube != (parameters.encoding in ("mono8", "mono16")):
            expected = "mono8 or mono16" if self.is_cube else "16UC1 or 32FC1"
            raise ParameterError(f"encoding: expected {expected} for {self._clean.name}, got {parameters.encoding}")
        if self.is_cube and parameters.sensor != IDEAL:
            raise ParameterError(f"sensor: expected {IDEAL} for {self._clean.name}, got {parameters.sensor}")

    @property
    def is_cube(self) -> bool:
        """Whether the current image shows the unit cube."""
        return self._clean.is_cube

    @property
    def has_masks(self) -> bool:
        """Whether the current image comes with masks."""
        return self._clean.labels is not None

    def next(self, noise: float, sensor: str = IDEAL) -> SourceFrame | None:
        """The next image as the sensor measures it; None after the last one.

        ``noise`` is that of the ideal sensor, metres, or grey levels of 255 for the unit cube.

        Raises
        ------
        FrameError
            If a recording cannot be read; the one after it is next.
        ValueError
            If the sensor is unknown or cannot have taken the image, as it is orthographic.
        """
        if self._left == 0:
            self._position += 1
            if self._count and self._position >= self._count:
                if not self._parameters.loop:
                    self._position = self._count
                    return None
                self._position = 0
            self._clean = self._make(self._position)
            self._left = self._parameters.hold
        self._left -= 1
        model = Ideal(noise / 255 if self.is_cube else noise) if sensor == IDEAL else preset(sensor)
        return replace(self._clean, depth=model.measured(self._clean.depth, self._clean.camera, self._noise))

    def _make(self, position: int) -> SourceFrame:
        if self._files:
            return self._recorded(self._files[position])
        rng = np.random.default_rng([self._parameters.seed, _SCENES, position])
        name = f"{self._parameters.scene} scene {position}"
        if self._parameters.scene == "thesis":
            scene = thesis_scene(rng, self._parameters.pixels)
            truth, is_cube = unit_cube.cube_from_optical(scene.bodies), True
        else:
            options = {} if self._calibration is None else {"camera": self._calibration.camera}
            scene = table_scene(rng, self._parameters.objects, **options)
            truth, is_cube = scene.bodies, False
        depth, labels = scene.render()
        wanted = labels if self._parameters.masks == "always" else None
        distorting = None
        if not is_cube and self._calibration is not None and self._calibration.rectification is not None:
            distorting = self._calibration
        return SourceFrame(depth, scene.camera, wanted, truth, is_cube, name, distorting)

    def _recorded(self, path: Path) -> SourceFrame:
        frame = frame_file.read(path, self._parameters.camera_info_file or None, self._parameters.projection)
        labels = None if self._parameters.masks == "never" else frame.labels
        return SourceFrame(frame.depth, frame.camera, labels, None, frame.is_cube, frame.name)


def _recordings(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise ParameterError(f"path: expected a recorded frame or a folder of them, {path} does not exist")
    found = sorted(one for one in path.iterdir() if one.suffix.lower() in SUFFIXES and one.is_file())
    if not found:
        raise ParameterError(f"path: expected recorded frames ({', '.join(SUFFIXES)}) in {path}, there are none")
    return found
