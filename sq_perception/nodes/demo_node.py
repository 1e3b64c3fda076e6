"""The node of ``sq-perception demo``: collects images, their true bodies, and the results of two nodes."""

from __future__ import annotations

import signal
import time
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import Image, PointCloud2

from sq_msgs_py.superquadrics import from_message
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.nodes.frame import stamp_of
from sq_perception.recordings.publication import depth_of, superquadrics

IMAGE, TRUTH = "depth/image", "synthetic_depth_node/truth"


@dataclass(frozen=True, eq=False)
class Shot:
    """One image: depth (height, width), metres, true bodies (n,); per node its bodies (m,) and the milliseconds it
    took."""

    depth: np.ndarray
    truth: Superquadric
    found: Mapping[str, Superquadric]
    delay: Mapping[str, float]


class DemoNode(Node):
    """Node that ends the process ``seconds`` after the first image that all of ``nodes`` have answered.

    ``shots``: the images that all have answered.
    """

    def __init__(self, name: str, nodes: tuple[str, ...], seconds: float) -> None:
        super().__init__(name)
        patience = 600.0  # seconds: the first start compiles, for minutes on a slow machine
        self.start_failure = ""
        self.shots: list[Shot] = []
        self._nodes, self._seconds, self._due = nodes, seconds, time.monotonic() + patience
        self._waiting: OrderedDict[int, dict[str, tuple[Any, float]]] = OrderedDict()
        fast = QoSProfile(depth=5, reliability=QoSReliabilityPolicy.BEST_EFFORT)
        self.create_subscription(Image, IMAGE, partial(self._on_message, IMAGE), fast)
        self.create_subscription(PointCloud2, TRUTH, partial(self._on_message, TRUTH), fast)
        for node in nodes:
            self.create_subscription(PointCloud2, f"{node}/superquadrics", partial(self._on_message, node), 10)
        self.create_timer(0.1, self._look_at_clock)

    def close(self) -> bool:
        """Return at once: there is nothing to wait for."""
        return True

    def _look_at_clock(self) -> None:
        if time.monotonic() > self._due:
            if self.shots:
                signal.raise_signal(signal.SIGINT)
            else:
                self.start_failure = f"no image was answered by all of {', '.join(self._nodes)} in time"

    def _on_message(self, name: str, message: Any) -> None:
        stamp = stamp_of(message)
        parts = self._waiting.setdefault(stamp, {})
        parts[name] = message, 1e-6 * (time.time_ns() - stamp)
        while len(self._waiting) > 40:
            self._waiting.popitem(last=False)
        if parts.keys() != {IMAGE, TRUTH, *self._nodes}:
            return
        if not self.shots:
            self._due = time.monotonic() + self._seconds
        bodies = {each: superquadrics(from_message(parts[each][0]).recovered) for each in (TRUTH, *self._nodes)}
        delay = {each: parts[each][1] for each in self._nodes}
        self.shots.append(Shot(depth_of(parts[IMAGE][0], is_cube=False)[0].depth, bodies.pop(TRUTH), bodies, delay))
        del self._waiting[stamp]
