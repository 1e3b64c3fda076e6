"""Images in the order in which a camera would take them: generated scenes with known truth, or recorded frames.

A maker gives the k-th image without noise, the same one for each call; :class:`FrameSource` holds it for some frames,
in which only the noise changes, and goes on to the next.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import unit_cube
from sq_perception.imaging.camera import Camera, Projection
from sq_perception.recordings import bag_file, frame_file, inputs
from sq_perception.recordings.frame_file import RecordedFrame
from sq_perception.simulation.scenes import TABLE_CAMERA, table_scene, thesis_scene
from sq_perception.simulation.sensor_noise import IDEAL, Ideal, preset

_SCENES, _NOISE = 1, 2
"""Streams of random numbers under one seed."""


@dataclass(frozen=True, eq=False)
class SourceFrame(RecordedFrame):
    """One image.

    Attributes
    ----------
    truth : Superquadric or None
        The bodies (n,) in the frame that results are published in: cube frame if ``is_cube``, else optical frame.
    """

    truth: Superquadric | None = None


Maker = Callable[[int], SourceFrame]


class FrameSource:
    """Frames in their order: each of ``count`` images (0: endless) for ``hold`` frames, in a ``loop`` or once.

    Raises
    ------
    ValueError
        If the first image cannot be read or made.
    """

    def __init__(self, make: Maker, count: int, *, seed: int, hold: int, loop: bool) -> None:
        self._make, self._count, self._hold, self._loop = make, count, hold, loop
        self._noise = np.random.default_rng([seed, _NOISE])
        self._position, self._left = 0, hold
        self.clean = make(0)
        """The current image without noise."""

    def next(self, noise: float, sensor: str = IDEAL) -> SourceFrame | None:
        """The next image as the sensor measures it; None after the last one.

        ``noise`` is that of the ideal sensor, metres, or grey levels of 255 for the unit cube.

        Raises
        ------
        ValueError
            If a recording cannot be read (the one after it is next), or the sensor is unknown or cannot have taken the
            image, as it is orthographic.
        """
        if self._left == 0:
            self._position += 1
            if self._count and self._position >= self._count:
                if not self._loop:
                    self._position = self._count
                    return None
                self._position = 0
            self.clean = self._make(self._position)
            self._left = self._hold
        self._left -= 1
        model = Ideal(noise / 255 if self.clean.is_cube else noise) if sensor == IDEAL else preset(sensor)
        return replace(self.clean, depth=model.measured(self.clean.depth, self.clean.camera, self._noise))


def generate(
    scene: Literal["thesis", "table"],
    seed: int,
    *,
    objects: int,
    camera: Camera = TABLE_CAMERA,
    with_labels: bool = False,
) -> Maker:
    """Random scenes: a thesis' image, or ``objects`` on a table before a ``camera``."""

    def make(position: int) -> SourceFrame:
        rng = np.random.default_rng([seed, _SCENES, position])
        if scene == "thesis":
            made = thesis_scene(rng)
            truth = unit_cube.cube_from_optical(made.bodies)
        else:
            made = table_scene(rng, objects, camera)
            truth = made.bodies
        depth, labels = made.render()
        shown = labels if with_labels else None
        name = f"{scene} scene {position}"
        return SourceFrame(depth, made.camera, shown, name, truth=truth)

    return make


def read(
    paths: Sequence[Path], camera_info: Path | str | None, projection: Projection, *, with_labels: bool
) -> Maker:
    """Recorded frames one after the other."""

    def make(position: int) -> SourceFrame:
        path = paths[position]
        frame = frame_file.read(path, camera_info, projection)
        labels = frame.labels if with_labels else None
        return SourceFrame(frame.depth, frame.camera, labels, frame.name)

    return make


def recordings(path: Path) -> list[Path]:
    """A recorded frame, or those of a folder in the order of :mod:`~sq_perception.recordings.inputs`.

    Raises
    ------
    ValueError
        If there is none.
    """
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise ValueError(f"path: expected a recorded frame or a folder of them, {path} does not exist")
    found = [frame for frame in inputs.in_folder(path) if not bag_file.is_bag(frame)]
    if not found:
        raise ValueError(f"path: expected recorded frames ({', '.join(frame_file.SUFFIXES)}) in {path}, there are none")
    return found
