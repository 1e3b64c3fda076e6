"""synthetic_depth_node: depth images with known truth, or recorded ones, as a camera would publish them.

Publishes depth/image (32FC1 or 16UC1, for orthographic frames mono8 or mono16), depth/camera_info of pinhole frames,
mask/image where recordings have labels or they are asked for, and in ~/truth the bodies of generated scenes, in the
message of the recovery.  All have the same stamp and frame, and the image comes last: whoever has it has the rest.
Publishers are reliable, so best effort subscribers receive them too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from rclpy.node import Node
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import Header

from sq_msgs_py.depth_image import DEPTH_ENCODINGS, GREY_ENCODINGS, intrinsics_to_message, labels_to_message
from sq_msgs_py.superquadrics import to_message
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import unit_cube
from sq_perception.imaging.calibration import intrinsics
from sq_perception.imaging.camera import Camera, Projection
from sq_perception.nodes.parameters import LiveParameters, ParameterError, Parameters, setting
from sq_perception.nodes.statistics import THROTTLE
from sq_perception.recordings import bag_file, camera_file, frame_file, inputs
from sq_perception.recordings.frame_file import RecordedFrame
from sq_perception.recordings.publication import CAMERA_FRAME, CUBE_FRAME, depth_message, truth_array
from sq_perception.simulation.scenes import TABLE_CAMERA, table_scene, thesis_scene
from sq_perception.simulation.sensor_noise import IDEAL, PRESETS, Ideal, preset


@dataclass(frozen=True)
class SyntheticParameters(Parameters):
    """Parameters of synthetic_depth_node."""

    scene: Literal["thesis", "table", "replay"] = setting(
        "table",
        "thesis: orthographic grey images of one random body; table: a pinhole camera over bodies on a table; replay: "
        "recorded frames from path.",
        choices=("thesis", "table", "replay"), live=False,
    )
    rate: float = setting(10.0, "Frames per second.", unit="Hz", within=(0.1, 200.0))
    seed: int = setting(
        0, "Seed of scenes and noise: equal seeds give equal images.", within=(0, 2**31 - 1), live=False
    )
    noise: float = setting(
        0.0,
        "Standard deviation of the ideal sensor's depth noise: metres, for orthographic frames grey levels of 255.",
        unit="m or grey levels", within=(0.0, 50.0),
    )
    sensor: str = setting(
        IDEAL,
        "Simulated sensor: ideal adds only noise; the others have their own noise, steps, edges and holes "
        "(docs/sensors.md).",
        choices=(IDEAL, *PRESETS),
    )
    hold: int = setting(30, "Frames per scene or recording; the noise changes.", within=(1, 10**6), live=False)
    scenes: int = setting(0, "Number of scenes before it stops or repeats; 0: endless.", within=(0, 10**6), live=False)
    loop: bool = setting(True, "Start again after the last scene or recording; false: stop publishing.", live=False)
    objects: int = setting(3, "Bodies on the table.", within=(1, 10), live=False)
    encoding: str = setting(
        "auto", "auto: mono8 for orthographic frames, 32FC1 for others.",
        choices=("auto", *GREY_ENCODINGS, *DEPTH_ENCODINGS), live=False,
    )
    masks: str = setting(
        "auto",
        "Label images on mask/image: auto publishes those of recordings, always also those of generated scenes.",
        choices=("auto", "always", "never"), live=False,
    )
    frame_id: str = setting(
        "", "Frame of the images; empty: camera_depth_optical_frame, or unit_cube for orthographic frames.", live=False
    )
    path: str = setting("", "A recorded frame or a folder of them, for scene = replay.", live=False)
    camera_info_file: str = setting(
        "", "camera_info YAML of recorded PNG depth images; also the camera of table scenes, without distortion.",
        live=False,
    )
    projection: Projection = setting(
        "pinhole", "Camera model of recorded images, since 8 bit orthographic images look like depth images.",
        choices=get_args(Projection), live=False,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.scene != "replay":
            self.check(self.scene == "thesis", f"scene = {self.scene}")
        elif not self.path:
            raise ParameterError("path: expected a recorded frame or a folder of them for scene = replay, got nothing")
        if self.sensor != IDEAL and self.noise != 0:
            raise ParameterError(f"noise: expected 0 for sensor = {self.sensor}, which has its own, got {self.noise:g}")

    def check(self, is_cube: bool, what: str) -> None:
        """Raise ParameterError if ``what`` has images of the unit cube and these parameters do not, or the reverse."""
        if self.encoding != "auto" and is_cube != (self.encoding in GREY_ENCODINGS):
            expected = " or ".join(GREY_ENCODINGS if is_cube else DEPTH_ENCODINGS)
            raise ParameterError(f"encoding: expected {expected} for {what}, got {self.encoding}")
        if is_cube and self.sensor != IDEAL:
            raise ParameterError(f"sensor: expected {IDEAL} for {what}, got {self.sensor}")


@dataclass(frozen=True, eq=False)
class SourceFrame(RecordedFrame):
    """One image; ``truth`` (n,) are its bodies in the frame that results are published in, if they are known."""

    truth: Superquadric | None = None


Maker = Callable[[int], SourceFrame]  # makes the k-th image without noise, the same one for each call


class FrameSource:
    """Frames in their order: each of ``count`` images (0: endless) for ``hold`` frames, in a ``loop`` or once.

    Raises ValueError if the first image cannot be read or made.
    """

    def __init__(self, make: Maker, count: int, *, seed: int, hold: int, loop: bool) -> None:
        self._make, self._count, self._hold, self._loop = make, count, hold, loop
        self._noise = np.random.default_rng([seed, 2])
        self._position, self._left = 0, hold
        self.clean = make(0)  # the current image without noise

    def next(self, noise: float, sensor: str = IDEAL) -> SourceFrame | None:
        """Return the next image as the sensor measures it; None after the last one.  ``noise`` of the ideal sensor in
        metres, or grey levels of 255.  Raises ValueError for an unreadable recording, or one that the sensor cannot
        have taken."""
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
        return replace(self.clean, depth=model.measure(self.clean.depth, self.clean.camera, self._noise))


def generate(
    scene: Literal["thesis", "table"], seed: int, *, objects: int, camera: Camera = TABLE_CAMERA,
    with_labels: bool = False,
) -> Maker:
    """Return a maker of random scenes: a thesis' image, or ``objects`` on a table before a ``camera``."""

    def make(position: int) -> SourceFrame:
        rng = np.random.default_rng([seed, 1, position])
        is_thesis = scene == "thesis"
        made = thesis_scene(rng) if is_thesis else table_scene(rng, objects, camera)
        depth, labels = made.render()
        truth = unit_cube.cube_from_optical(made.bodies) if is_thesis else made.bodies
        return SourceFrame(
            depth, made.camera, labels if with_labels else None, f"{scene} scene {position}", truth=truth
        )

    return make


def read(paths: Sequence[Path], camera_info: Path | str | None, projection: Projection, *, with_labels: bool) -> Maker:
    """Return a maker of recorded frames."""

    def make(position: int) -> SourceFrame:
        frame = frame_file.read(paths[position], camera_info, projection)
        return SourceFrame(frame.depth, frame.camera, frame.labels if with_labels else None, frame.name)

    return make


def recordings(path: Path) -> list[Path]:
    """Return a recorded frame, or those of a folder in their order; ValueError if there is none."""
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise ValueError(f"path: expected a recorded frame or a folder of them, {path} does not exist")
    found = [frame for frame in inputs.in_folder(path) if not bag_file.is_bag(frame)]
    if not found:
        raise ValueError(f"path: expected recorded frames ({', '.join(frame_file.SUFFIXES)}) in {path}, there are none")
    return found


def frame_source(parameters: SyntheticParameters) -> FrameSource:
    """Return the images that the parameters ask for; ValueError if the first one cannot be had or published so."""
    info = parameters.camera_info_file
    if parameters.scene == "replay":
        if info:
            camera_file.read_calibration(info, "ignore", size=inputs.ANY_SIZE)  # what is wrong with it is said at once
        paths = recordings(Path(parameters.path))
        with_labels = parameters.masks != "never"
        count, make = len(paths), read(paths, info or None, parameters.projection, with_labels=with_labels)
    else:
        count = parameters.scenes
        make = generate(
            parameters.scene, parameters.seed, objects=parameters.objects,
            camera=camera_file.read_calibration(info, "ignore").camera if info else TABLE_CAMERA,
            with_labels=parameters.masks == "always",
        )
    source = FrameSource(make, count, seed=parameters.seed, hold=parameters.hold, loop=parameters.loop)
    parameters.check(source.clean.is_cube, source.clean.name)
    return source


class SyntheticDepthNode(Node):
    """Node that publishes one frame per tick of its timer; ValueError as :func:`frame_source`."""

    def __init__(self, name: str, context: Any = None) -> None:
        super().__init__(name, context=context)
        self.start_failure = ""
        self._settings = LiveParameters(self, SyntheticParameters, check=self._check, changed=self._keep_time)
        self._source = frame_source(self._settings.current)
        self._image = self._output(Image, "depth/image")
        self._info = self._output(CameraInfo, "depth/camera_info")
        self._truth = self._output(PointCloud2, "~/truth")
        # Where somebody publishes masks, images wait for them.
        self._mask = self._output(Image, "mask/image") if self._source.clean.labels is not None else None
        self._ticks = self.create_timer(1 / self._settings.current.rate, self._tick)
        self.get_logger().info(f"publishing {self._settings.current.scene} frames on {self._image.topic_name}")

    def close(self) -> bool:
        """Return at once: there is nothing to wait for."""
        return True

    def _check(self, parameters: SyntheticParameters, _: frozenset[str]) -> None:
        parameters.check(self._source.clean.is_cube, self._source.clean.name)

    def _keep_time(self, parameters: SyntheticParameters, _: frozenset[str]) -> None:
        self._ticks.timer_period_ns = int(1e9 / parameters.rate)

    def _output(self, kind: type[Any], topic: str) -> Any:
        options = QoSOverridingOptions.with_default_policies()
        return self.create_publisher(kind, topic, 2, qos_overriding_options=options)

    def _tick(self) -> None:
        settings = self._settings.current
        try:
            frame = self._source.next(settings.noise, settings.sensor)
            if frame is not None:
                self._publish(frame, settings)
        except ValueError as error:
            self.get_logger().warning(f"left out: {error}", throttle_duration_sec=THROTTLE)
            return
        if frame is None:
            self.get_logger().info("that was the last frame (loop is false)")
            self._ticks.cancel()

    def _publish(self, frame: SourceFrame, settings: SyntheticParameters) -> None:
        frame_id = settings.frame_id or (CUBE_FRAME if frame.is_cube else CAMERA_FRAME)
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id=frame_id)
        fitting = GREY_ENCODINGS if frame.is_cube else ("32FC1", "16UC1")
        encoding = settings.encoding if settings.encoding in fitting else fitting[0]
        if frame.truth is not None:
            self._truth.publish(to_message(truth_array(frame.truth), header))
        if not frame.is_cube:
            self._info.publish(intrinsics_to_message(intrinsics(frame.camera), header))
        if frame.labels is not None:
            if self._mask is None:
                self._mask = self._output(Image, "mask/image")
            wide = frame.labels.max(initial=0) > np.iinfo(np.uint16).max
            self._mask.publish(labels_to_message(frame.labels, header, "32SC1" if wide else "16UC1"))
        self._image.publish(depth_message(frame.depth, header, encoding))
