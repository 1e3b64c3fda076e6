"""The node behind synthetic_depth_node, which lists its topics."""

from __future__ import annotations

from typing import Any

import numpy as np
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
from sq_perception.imaging import unit_cube
from sq_perception.imaging.camera import Camera
from sq_perception.nodes import transport
from sq_perception.nodes.frame_source import FrameSource, SourceFrame
from sq_perception.nodes.parameters import LiveParameters, SyntheticParameters
from sq_perception.nodes.stoppable_node import StoppableNode
from sq_perception.recordings.frame_file import FrameError
from sq_perception.recordings.publication import CAMERA_FRAME, CUBE_FRAME, truth_array


class SyntheticDepthNode(StoppableNode):
    """Publishes a frame per tick of its timer.

    Raises
    ------
    ParameterError, FrameError, ValueError
        If the parameters do not fit together or the first frame cannot be read or made.
    """

    def __init__(self, name: str, context: Any = None) -> None:
        super().__init__(name, context=context)
        self._settings = LiveParameters(self, SyntheticParameters)
        self._source = FrameSource(self._settings.current)
        replay = self._settings.current.scene == "replay"
        self._image = self._output(Image, "depth/image")
        self._packed = None
        if self._settings.current.image_transport != transport.RAW:
            topic = transport.topic(self, "depth/image", self._settings.current.image_transport)
            self._packed = self._output(CompressedImage, topic)
        self._info = None if self._source.is_cube else self._output(CameraInfo, "depth/camera_info")
        self._mask = self._output(Image, "mask/image") if self._source.has_masks else None
        self._truth = None if replay else self._output(PointCloud2, "~/truth")
        self._rate = self._settings.current.rate
        self._ticks = self.create_timer(1 / self._rate, self._tick)
        self.get_logger().info(f"publishing {self._settings.current.scene} frames on {self._image.topic_name}")

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
            self._packed.publish(transport.packed(depth, header, _encoding(settings.encoding)))
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
