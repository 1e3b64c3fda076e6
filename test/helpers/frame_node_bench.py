"""A frame node between real publishers and subscribers, around a recoverer that does what the test says."""

import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
from builtin_interfaces.msg import Time
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from spun_nodes import PATIENCE, SpunNodes
from std_msgs.msg import Header

from sq_msgs_py.depth_image import depth_to_message, intrinsics_to_message
from sq_msgs_py.superquadrics import SuperquadricArray, from_message
from sq_perception import Camera, Fit, FrameRecovery, Recovery, Status, Superquadric
from sq_perception.imaging.calibration import intrinsics
from sq_perception.nodes import engine
from sq_perception.nodes.frame_node import FrameNode

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
FRAME_ID = "some_camera_optical_frame"

BOX = Superquadric([0.05, 0.04, 0.03], [0.3, 0.6], [0.01, 0.02, 0.6], [0.1, 0.2, 0.3, 0.9])
CAN = Superquadric([0.03, 0.03, 0.06], [0.2, 0.9], [-0.15, 0.02, 0.7], [0.5, 0.0, 0.1, 0.8])
DEVIATIONS = np.diag(np.square([0.002] * 3 + [0.03] * 2 + [0.001, 0.002, 0.003] + [0.02, 0.03, 0.04]))


def recovery(body: Superquadric, label: int, status: Status = Status.CONVERGED) -> Recovery:
    return Recovery(Fit(body, 0.001, status, "", covariance=DEVIATIONS), 0.9, label, 100)


def ball(label: int = 1, status: Status = Status.CONVERGED, radius: float = 0.1) -> Recovery:
    body = Superquadric(np.full(3, radius), np.ones(2), np.array([0.01, 0.02, 0.5]), np.array([0, 0, 0, 1.0]))
    return Recovery(Fit(body, 0.001, status, ""), 0.9, label, 100)


def counts_of(node: FrameNode) -> Any:
    """What a node has counted: received, answered, dropped, refused, in_work, lost by topic; and its last error."""
    one = node._statistics
    with one._lock:
        counts = {what: one._counts[what] for what in ("received", "answered", "dropped", "refused")}
        in_work = 2 * counts["received"] - sum(counts.values())
        return SimpleNamespace(**counts, in_work=in_work, lost=dict(one._lost), last_error=one._last_error)


class Recoverer:
    """Notes what it is asked, and answers ``bodies``, or raises, once ``gate`` is open."""

    def __init__(self) -> None:
        self.asked: list[tuple[np.ndarray, Camera, np.ndarray | None, Any]] = []
        self.bodies: tuple[Recovery, ...] = (ball(),)
        self.plane: np.ndarray | None = None
        self.message = self.doubt = ""
        self.error: Exception | None = None
        self.gate = threading.Event()
        self.gate.set()

    def warm_up(self, camera: Camera) -> None:
        self.warm = camera

    def recover(self, depth: np.ndarray, camera: Camera, labels: np.ndarray | None, options: Any) -> FrameRecovery:
        self.asked.append((depth, camera, labels, options))
        assert self.gate.wait(PATIENCE)
        if self.error is not None:
            raise self.error
        labels = np.zeros(depth.shape, np.int32)
        return FrameRecovery(self.bodies, {"total": 1.0}, labels, self.plane, self.message, doubt=self.doubt)


def stand_ins(
    make: Callable[..., Recoverer], resolve: Callable[[Any], Path], check: Callable[[Any], None] = lambda _: None
) -> Any:
    """A patch by which nodes make these recoverers, which repeat no frame, of weights that nobody reads."""
    scenes = lambda recoverer, last: SimpleNamespace(recover=recoverer.recover, last=None)  # noqa: E731
    weights = SimpleNamespace(resolve=resolve, check=check)
    return patch.multiple(engine, checkpoint=weights, Recoverer=make, StillScene=scenes)


class Bench(SpunNodes):
    """A frame node and a peer that publishes to it and listens, spun in the background."""

    def __init__(self, *arguments: str) -> None:
        super().__init__(*arguments)
        self.recoverer = Recoverer()
        self.stand_ins = stand_ins(lambda *_, **__: self.recoverer, lambda _: Path(f"weights of {id(self)}"))
        self.stand_ins.start()
        self.node = FrameNode("recover_node", context=self.context)
        self.images = self.peer.create_publisher(Image, "depth/image", 5)
        self.infos = self.peer.create_publisher(CameraInfo, "depth/camera_info", 5)
        self.answers = self.hear(PointCloud2, "recover_node/superquadrics", 10)
        self.spin([self.node])
        self.until(lambda: self.node.is_active)
        if self.node._settings.current.image_transport == "raw":
            self.until(self.images.get_subscription_count)
        self.until(lambda: self.node._outputs.superquadrics.get_subscription_count() == 1)
        self.stamps = 0

    def close(self) -> None:
        self.recoverer.gate.set()
        self.until(self.node.close)  # a starved machine collects garbage for longer than a node waits for it
        super().close()
        self.stand_ins.stop()

    @property
    def counts(self) -> Any:
        return counts_of(self.node)

    def header(self) -> Header:
        self.stamps += 1
        return Header(stamp=Time(sec=1000 + self.stamps, nanosec=7), frame_id=FRAME_ID)

    def depth(self, camera: Camera = CAMERA, value: float = 0.5) -> Image:
        return depth_to_message(np.full((camera.height, camera.width), value), self.header())

    def send_info(self, camera: Camera = CAMERA) -> None:
        """Publish a camera_info and wait until the node has it."""
        self.put_info(self.info(camera))

    def info(self, camera: Camera = CAMERA) -> CameraInfo:
        return intrinsics_to_message(intrinsics(camera), self.header())

    def put_info(self, message: CameraInfo) -> None:
        self.until(self.infos.get_subscription_count)
        before = sum(1 for _ in self.node._input._infos)
        assert before < self.node._input._infos.maxlen
        self.infos.publish(message)
        self.until(lambda: len(self.node._input._infos) > before)

    def send(self, message: Any, publisher: Any = None) -> Any:
        """Publish an image and wait for its verdict: the counts after it."""
        before = self.counts
        (publisher or self.images).publish(message)
        self.until(lambda: self.counts.received > before.received and self.counts.in_work == 0)
        return self.counts

    def answer(self, message: Any, publisher: Any = None) -> tuple[PointCloud2, SuperquadricArray]:
        """Publish a good image; the published result."""
        before = len(self.answers)
        self.send(message, publisher)
        self.until(lambda: len(self.answers) > before)
        return self.answers[-1], from_message(self.answers[-1])
