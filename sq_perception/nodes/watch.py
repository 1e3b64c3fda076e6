"""What the demonstration sees of its nodes: a camera's images, their truth, and the results of two methods."""

from __future__ import annotations

import time
from collections import OrderedDict
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from sq_msgs_py.depth_image import GREY_ENCODINGS
from sq_msgs_py.superquadrics import from_message
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.calibration import Calibration
from sq_perception.nodes.frame import Frame, decode, stamp_of
from sq_perception.recordings.publication import superquadrics

CAMERA = "synthetic_depth_node"
_REMEMBERED = 40
"""Images that wait for what belongs to them."""


@dataclass(frozen=True, eq=False)
class Found:
    """The bodies (n,) of one result, without failed ones, their residuals (n,), and when they came here.

    Attributes
    ----------
    latency
        From the image's stamp to the arrival, milliseconds.
    """

    bodies: Superquadric
    residual: np.ndarray
    latency: float


@dataclass(eq=False)
class Shot:
    """All that belongs to one stamp; image and truth are None while they have not come."""

    stamp: int
    image: Image | None = None
    truth: Superquadric | None = None
    results: dict[str, Found] = field(default_factory=dict)
    """By the node that found them."""


class Watch:
    """Collects, image by image, depth, truth and the results of ``nodes``; lives as long as a ``with`` block."""

    def __init__(self, nodes: tuple[str, ...]) -> None:
        self._names = nodes
        self._shots: OrderedDict[int, Shot] = OrderedDict()
        self._info: CameraInfo | None = None
        self._truth_comes = False
        self.images = 0
        """How many images came."""
        self.latest: Shot | None = None
        """The newest image with everything that belongs to it."""
        self.latencies: dict[str, list[float]] = {name: [] for name in nodes}

    def __enter__(self) -> Watch:
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        node = Node("demo")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        self._image_topic = node.resolve_topic_name("depth/image")
        fast = QoSProfile(depth=5, reliability=QoSReliabilityPolicy.BEST_EFFORT)
        node.create_subscription(CameraInfo, "depth/camera_info", self._on_info, fast)
        node.create_subscription(Image, "depth/image", self._on_image, fast)
        node.create_subscription(PointCloud2, f"{CAMERA}/truth", self._on_truth, fast)
        for name in self._names:
            node.create_subscription(PointCloud2, f"{name}/superquadrics", partial(self._on_result, name), 10)
        return self

    def __exit__(self, *_: object) -> None:
        rclpy.try_shutdown()

    def listen(self, seconds: float) -> None:
        """Take what comes, for some seconds at most."""
        self._executor.spin_once(timeout_sec=seconds)

    def frame(self, shot: Shot) -> Frame:
        """The decoded depth image of a complete shot.

        Raises
        ------
        ValueError
            If the image or its camera_info cannot be used.
        """
        assert shot.image is not None
        return decode(shot.image, None if shot.image.encoding in GREY_ENCODINGS else self._calibration)

    def _calibration(self) -> Calibration:
        if self._info is None:
            raise ValueError("no camera_info came with the depth image")
        return Calibration.of(self._info, self._image_topic)

    def _on_info(self, message: CameraInfo) -> None:
        self._info = message

    def _on_image(self, message: Image) -> None:
        self.images += 1
        shot = self._shot(message)
        shot.image = message
        self._check(shot)

    def _on_truth(self, message: PointCloud2) -> None:
        shot = self._shot(message)
        shot.truth = _found(message, 0.0).bodies
        self._truth_comes = self._truth_comes or len(shot.truth) > 0
        self._check(shot)

    def _on_result(self, name: str, message: PointCloud2) -> None:
        shot = self._shot(message)
        shot.results[name] = found = _found(message, 1e-6 * (time.time_ns() - shot.stamp))
        self.latencies[name].append(found.latency)
        self._check(shot)

    def _shot(self, message: Any) -> Shot:
        stamp = stamp_of(message)
        shot = self._shots.setdefault(stamp, Shot(stamp))
        while len(self._shots) > _REMEMBERED:
            self._shots.popitem(last=False)
        return shot

    def _check(self, shot: Shot) -> None:
        """Make a shot the latest once nothing is missing any more."""
        is_complete = shot.image is not None and set(shot.results) == set(self._names)
        if not is_complete or (self._truth_comes and shot.truth is None):
            return
        if self.latest is None or shot.stamp > self.latest.stamp:
            self.latest = shot


def _found(message: PointCloud2, latency: float) -> Found:
    kept = from_message(message).recovered
    return Found(superquadrics(kept), kept.residual, latency)
