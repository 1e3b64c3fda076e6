"""A node that collects, image by image, what the demonstration shows: depth, truth and both results."""

from __future__ import annotations

import time
from collections import OrderedDict
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from sq_msgs_py.depth_image import GREY_ENCODINGS
from sq_msgs_py.superquadrics import SuperquadricArray, from_message
from sq_perception.imaging.calibration import Calibration
from sq_perception.nodes.frame import Frame, decode

RESULTS = ("recover_node", "fitter_node")
TRUTH = "synthetic_depth_node"
_REMEMBERED = 40


@dataclass(eq=False)
class Shot:
    """All that belongs to one stamp.

    Attributes
    ----------
    image, truth
        None while they have not come.
    results
        Superquadrics by the node that found them.
    latency
        From the image's stamp to the arrival of the result here, milliseconds, by node.
    """

    stamp: int
    image: Image | None = None
    truth: SuperquadricArray | None = None
    results: dict[str, SuperquadricArray] = field(default_factory=dict)
    latency: dict[str, float] = field(default_factory=dict)


class Watch(Node):
    """See the module."""

    def __init__(self, context: Any = None) -> None:
        super().__init__("demo", context=context)
        self._shots: OrderedDict[int, Shot] = OrderedDict()
        self._info: CameraInfo | None = None
        self._truth_comes = False
        self.images = 0
        """How many images came."""
        self.latest: Shot | None = None
        """The newest image with everything that belongs to it."""
        self.latencies: dict[str, list[float]] = {name: [] for name in RESULTS}
        fast = QoSProfile(depth=5, reliability=QoSReliabilityPolicy.BEST_EFFORT)
        self.create_subscription(CameraInfo, "depth/camera_info", self._on_info, fast)
        self.create_subscription(Image, "depth/image", self._on_image, fast)
        self.create_subscription(PointCloud2, f"{TRUTH}/truth", self._on_truth, fast)
        for name in RESULTS:
            self.create_subscription(PointCloud2, f"{name}/superquadrics", partial(self._on_result, name), 10)

    def frame(self, shot: Shot) -> Frame:
        """The decoded depth image of a complete shot.

        Raises
        ------
        ValueError
            If the image or its camera_info cannot be used.
        """
        assert shot.image is not None
        if shot.image.encoding in GREY_ENCODINGS:
            return decode(shot.image, None)
        return decode(shot.image, self._calibration)

    def _calibration(self) -> Calibration:
        if self._info is None:
            raise ValueError("no camera_info came with the depth image")
        return Calibration.of(self._info, self.resolve_topic_name("depth/image"))

    def _on_info(self, message: CameraInfo) -> None:
        self._info = message

    def _on_image(self, message: Image) -> None:
        self.images += 1
        shot = self._shot(message)
        shot.image = message
        self._check(shot)

    def _on_truth(self, message: PointCloud2) -> None:
        shot = self._shot(message)
        shot.truth = from_message(message)
        self._truth_comes = self._truth_comes or len(shot.truth) > 0
        self._check(shot)

    def _on_result(self, name: str, message: PointCloud2) -> None:
        shot = self._shot(message)
        shot.results[name] = from_message(message)
        shot.latency[name] = 1e-6 * (time.time_ns() - shot.stamp)
        self.latencies[name].append(shot.latency[name])
        self._check(shot)

    def _shot(self, message: Any) -> Shot:
        stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        shot = self._shots.setdefault(stamp, Shot(stamp))
        while len(self._shots) > _REMEMBERED:
            self._shots.popitem(last=False)
        return shot

    def _check(self, shot: Shot) -> None:
        """Make a shot the latest once nothing is missing any more."""
        if shot.image is None or set(shot.results) != set(RESULTS) or (self._truth_comes and shot.truth is None):
            return
        if self.latest is None or shot.stamp > self.latest.stamp:
            self.latest = shot
