"""What the demonstration sees of its nodes: a camera's images, their truth, and the results of two methods."""

from __future__ import annotations

import time
from collections import OrderedDict
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from sq_msgs_py.superquadrics import from_message
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.nodes.frame import Frame, decode_by, stamp_of
from sq_perception.recordings.publication import superquadrics

CAMERA = "synthetic_depth_node"
_REMEMBERED = 40
"""Images that wait for what belongs to them."""


class Found(NamedTuple):
    """Bodies (n,) without failed ones, their residuals (n,), and milliseconds from their stamp to their arrival."""

    bodies: Superquadric
    residual: np.ndarray
    latency: float


@dataclass(eq=False)
class Shot:
    """All that belongs to one stamp: the image, once it has come, and bodies by the node that they are of."""

    stamp: int
    image: Image | None = None
    results: dict[str, Found] = field(default_factory=dict)

    @property
    def truth(self) -> Superquadric | None:
        """The bodies that the camera shows."""
        return self.results[CAMERA].bodies if CAMERA in self.results else None


class Watch:
    """Collects, image by image, depth, truth and the results of ``nodes``; lives as long as a ``with`` block."""

    def __init__(self, nodes: tuple[str, ...], has_truth: bool) -> None:
        self._wanted = {*nodes, CAMERA} if has_truth else set(nodes)
        """Whose bodies belong to an image."""
        self._shots: OrderedDict[int, Shot] = OrderedDict()
        self._info: CameraInfo | None = None
        self.images = 0
        """How many images came."""
        self.latest: Shot | None = None
        """The newest image with everything that belongs to it."""
        self.latencies: dict[str, list[float]] = {name: [] for name in nodes}

    def __enter__(self) -> Watch:
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        self._node = node = Node("demo")
        self._image_topic = node.resolve_topic_name("depth/image")
        fast = QoSProfile(depth=5, reliability=QoSReliabilityPolicy.BEST_EFFORT)
        node.create_subscription(CameraInfo, "depth/camera_info", self._on_info, fast)
        node.create_subscription(Image, "depth/image", self._on_image, fast)
        node.create_subscription(PointCloud2, f"{CAMERA}/truth", partial(self._on_bodies, CAMERA), fast)
        for name in self.latencies:
            node.create_subscription(PointCloud2, f"{name}/superquadrics", partial(self._on_bodies, name), 10)
        return self

    def __exit__(self, *_: object) -> None:
        rclpy.try_shutdown()

    def listen(self, seconds: float) -> None:
        """Take what comes, for some seconds at most."""
        rclpy.spin_once(self._node, timeout_sec=seconds)

    def frame(self, shot: Shot) -> Frame:
        """The decoded depth image of a complete shot.

        Raises
        ------
        ValueError
            If the image or its camera_info cannot be used.
        """
        assert shot.image is not None
        return decode_by(self._info, shot.image, self._image_topic)

    def _on_info(self, message: CameraInfo) -> None:
        self._info = message

    def _on_image(self, message: Image) -> None:
        self.images += 1
        shot = self._shot(message)
        shot.image = message
        self._check(shot)

    def _on_bodies(self, name: str, message: PointCloud2) -> None:
        shot, kept = self._shot(message), from_message(message).recovered
        shot.results[name] = found = Found(superquadrics(kept), kept.residual, 1e-6 * (time.time_ns() - shot.stamp))
        if name in self.latencies:
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
        is_newer = self.latest is None or shot.stamp > self.latest.stamp
        if is_newer and shot.image is not None and self._wanted <= set(shot.results):
            self.latest = shot
