"""The node behind synthetic_depth_node, which lists its topics."""

from __future__ import annotations

from typing import Any

import numpy as np
from rclpy.qos import QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import Header

from sq_msgs_py.depth_image import (
    Intrinsics,
    depth_to_message,
    grey_to_message,
    intrinsics_to_message,
    labels_to_message,
)
from sq_msgs_py.superquadrics import to_message
from sq_perception.imaging import unit_cube
from sq_perception.nodes.frame_source import FrameSource, SourceFrame
from sq_perception.nodes.parameters import LiveParameters, SyntheticParameters
from sq_perception.nodes.results import truth_array
from sq_perception.nodes.stoppable_node import StoppableNode
from sq_perception.recorded_frame import FrameError

CAMERA_FRAME = "camera_depth_optical_frame"
CUBE_FRAME = "unit_cube"


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
            camera = frame.camera
            known = Intrinsics(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
            self._info.publish(intrinsics_to_message(known, header))
        if frame.labels is not None:
            if self._mask is None:
                self._mask = self._output(Image, "mask/image")
            self._mask.publish(labels_to_message(frame.labels, header))
        self._image.publish(_image(frame, settings.encoding, header))


def _image(frame: SourceFrame, encoding: str, header: Header) -> Image:
    if frame.is_cube:
        kind = np.uint16 if encoding == "mono16" else np.uint8
        return grey_to_message(unit_cube.grey_from_depth(frame.depth, kind), header)
    return depth_to_message(frame.depth, header, "16UC1" if encoding == "16UC1" else "32FC1")
