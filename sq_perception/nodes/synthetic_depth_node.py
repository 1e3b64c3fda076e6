"""synthetic_depth_node: depth images with known truth, or recorded ones, as a camera would publish them.

| name | type | |
| --- | --- | --- |
| `depth/image` | sensor_msgs/Image | out: 32FC1 or 16UC1; mono8 or mono16 for orthographic frames |
| `depth/image/compressedDepth` | sensor_msgs/CompressedImage | out, for `image_transport: compressedDepth`: packed |
| `depth/camera_info` | sensor_msgs/CameraInfo | out: for pinhole frames |
| `mask/image` | sensor_msgs/Image | out: label images (16UC1), where recordings have them or they are asked for |
| `~/truth` | sensor_msgs/PointCloud2 | out: the bodies of generated scenes, in the message of the recovery |

All carry the same stamp and frame.  Publishers are reliable, which best effort subscribers hear too.  The image goes
last: whoever has it has the rest.

The k-th scene of a seed is always the same one.  A scene or recording stays for ``hold`` frames, in which only the
noise changes.  A camera_info_file with distortion gives generated scenes a raw camera: the scene is rendered and
measured as its rectified camera sees it, and distorted when it is published.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.qos import QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
from std_msgs.msg import Header

from sq_msgs_py.depth_image import (
    Intrinsics,
    RawIntrinsics,
    depth_to_message,
    grey_to_message,
    intrinsics_to_message,
    labels_to_message,
    raw_intrinsics_to_message,
)
from sq_msgs_py.superquadrics import to_message
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import unit_cube
from sq_perception.imaging.calibration import Calibration
from sq_perception.imaging.camera import Camera
from sq_perception.nodes.frame import image_topic, packed
from sq_perception.nodes.parameters import IDEAL, RAW, LiveParameters, ParameterError, SyntheticParameters
from sq_perception.recordings import camera_file, frame_file
from sq_perception.recordings.frame_file import FrameError
from sq_perception.recordings.publication import CAMERA_FRAME, CUBE_FRAME, truth_array
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
            self._calibration = camera_file.read_calibration(parameters.camera_info_file)
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


class SyntheticDepthNode(Node):
    """Publishes a frame per tick of its timer.

    Raises
    ------
    ParameterError, FrameError, ValueError
        If the parameters do not fit together or the first frame cannot be read or made.
    """

    def __init__(self, name: str, context: Any = None) -> None:
        super().__init__(name, context=context)
        self.start_failure = ""
        self._settings = LiveParameters(self, SyntheticParameters)
        self._source = FrameSource(self._settings.current)
        replay = self._settings.current.scene == "replay"
        self._image = self._output(Image, "depth/image")
        self._packed = None
        if self._settings.current.image_transport != RAW:
            topic = image_topic(self, "depth/image", self._settings.current.image_transport)
            self._packed = self._output(CompressedImage, topic)
        self._info = None if self._source.is_cube else self._output(CameraInfo, "depth/camera_info")
        self._mask = self._output(Image, "mask/image") if self._source.has_masks else None
        self._truth = None if replay else self._output(PointCloud2, "~/truth")
        self._rate = self._settings.current.rate
        self._ticks = self.create_timer(1 / self._rate, self._tick)
        self.get_logger().info(f"publishing {self._settings.current.scene} frames on {self._image.topic_name}")

    def close(self) -> bool:
        """There is nothing to wait for."""
        return True

    def _output(self, kind: type[Any], topic: str) -> Any:
        profile = QoSProfile(depth=2, history=QoSHistoryPolicy.KEEP_LAST, reliability=QoSReliabilityPolicy.RELIABLE)
        options = QoSOverridingOptions.with_default_policies()
        return self.create_publisher(kind, topic, profile, qos_overriding_options=options)

    def _tick(self) -> None:
        settings = self._settings.current
        if settings.rate != self._rate:
            self._rate = settings.rate
            self._ticks.timer_period_ns = int(1e9 / self._rate)
        try:
            frame = self._source.next(settings.noise, settings.sensor)
        except (FrameError, ValueError) as error:
            self.get_logger().warning(f"left out: {error}")
            return
        if frame is None:
            self.get_logger().info("that was the last frame (loop is false)")
            self._ticks.cancel()
            return
        self._publish(frame, settings)

    def _publish(self, frame: SourceFrame, settings: SyntheticParameters) -> None:
        frame_id = settings.frame_id or (CUBE_FRAME if frame.is_cube else CAMERA_FRAME)
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id=frame_id)
        if self._truth is not None and frame.truth is not None:
            self._truth.publish(to_message(truth_array(frame.truth), header))
        if self._info is not None and not frame.is_cube:
            self._info.publish(_camera_info(frame, header))
        depth, labels = frame.depth, frame.labels
        if frame.calibration is not None:
            depth = frame.calibration.as_sent(depth)
            labels = None if labels is None else frame.calibration.labels_as_sent(labels)
        if labels is not None:
            if self._mask is None:
                self._mask = self._output(Image, "mask/image")
            self._mask.publish(labels_to_message(labels, header))
        if self._packed is not None and not frame.is_cube and self._packed.get_subscription_count():
            self._packed.publish(packed(depth, header, _encoding(settings.encoding)))
        self._image.publish(_image(frame, depth, settings.encoding, header))


def _camera_info(frame: SourceFrame, header: Header) -> CameraInfo:
    if frame.calibration is None or frame.calibration.rectification is None:
        return intrinsics_to_message(_intrinsics(frame.camera), header)
    raw, lens = frame.calibration.rectification.raw, frame.calibration.rectification.distortion
    return raw_intrinsics_to_message(RawIntrinsics(_intrinsics(raw), lens.model, lens.coefficients), header)


def _intrinsics(camera: Camera) -> Intrinsics:
    return Intrinsics(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)


def _encoding(wanted: str) -> str:
    return "16UC1" if wanted == "16UC1" else "32FC1"


def _image(frame: SourceFrame, depth: np.ndarray, encoding: str, header: Header) -> Image:
    if frame.is_cube:
        kind = np.uint16 if encoding == "mono16" else np.uint8
        return grey_to_message(unit_cube.grey_from_depth(depth, kind), header)
    return depth_to_message(depth, header, _encoding(encoding))
