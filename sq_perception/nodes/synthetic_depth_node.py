"""synthetic_depth_node: depth images with known truth, or recorded ones, as a camera would publish them.

| name | type | |
| --- | --- | --- |
| `depth/image` | sensor_msgs/Image | out: 32FC1 or 16UC1; mono8 or mono16 for orthographic frames |
| `depth/camera_info` | sensor_msgs/CameraInfo | out: for pinhole frames |
| `mask/image` | sensor_msgs/Image | out: label images (16UC1), where recordings have them or they are asked for |
| `~/truth` | sensor_msgs/PointCloud2 | out: the bodies of generated scenes, in the message of the recovery |

All have the same stamp and frame.  Publishers are reliable, so best effort subscribers receive them too.  The image is
published last: whoever has it has the rest.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import Header

from sq_msgs_py.depth_image import GREY_ENCODINGS, intrinsics_to_message, labels_to_message
from sq_msgs_py.superquadrics import to_message
from sq_perception.imaging.calibration import intrinsics
from sq_perception.nodes.live_parameters import LiveParameters
from sq_perception.nodes.parameters import SyntheticParameters
from sq_perception.nodes.statistics import THROTTLE
from sq_perception.recordings import camera_file, inputs
from sq_perception.recordings.frame_source import FrameSource, SourceFrame, generate, read, recordings
from sq_perception.recordings.publication import CAMERA_FRAME, CUBE_FRAME, depth_message, truth_array
from sq_perception.simulation.scenes import TABLE_CAMERA


def frame_source(parameters: SyntheticParameters) -> FrameSource:
    """Return the images that the parameters ask for.

    Raises
    ------
    ValueError
        If there is nothing to replay, or the first image cannot be read, made, or published as they want it.
    """
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
            parameters.scene,
            parameters.seed,
            objects=parameters.objects,
            camera=camera_file.read_calibration(info, "ignore").camera if info else TABLE_CAMERA,
            with_labels=parameters.masks == "always",
        )
    source = FrameSource(make, count, seed=parameters.seed, hold=parameters.hold, loop=parameters.loop)
    parameters.check(source.clean.is_cube, source.clean.name)
    return source


class SyntheticDepthNode(Node):
    """Node that publishes one frame per tick of its timer.

    Raises
    ------
    ValueError
        If the parameters do not fit together or the first frame cannot be read or made.
    """

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
