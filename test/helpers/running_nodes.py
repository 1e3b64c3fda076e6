"""Nodes as processes of their own and a peer beside them: what tests and benchmarks of running nodes share.

Nothing here knows the inside of a node: topics, services, diagnostics and /proc are all that is looked at.  Times are
seconds of the monotonic clock, ages milliseconds from the stamp of an image to the arrival of its result in the peer.
"""

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from spun_nodes import SpunNodes
from started_nodes import Child
from std_msgs.msg import Header

from sq_msgs_py.depth_image import depth_to_message, intrinsics_to_message
from sq_perception import Camera, Superquadric
from sq_perception.imaging.calibration import intrinsics
from sq_perception.nodes import process
from sq_perception.nodes.frame import stamp_of
from sq_perception.simulation.scenes import Scene

PATIENCE = 90.0
"""Seconds; a loaded machine compiles on the first start."""
CAMERA = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
BODIES = Superquadric(
    np.array([[0.06, 0.05, 0.08], [0.04, 0.05, 0.06]]), np.array([[0.4, 0.6], [0.2, 0.9]]),
    np.array([[0.08, 0.01, 0.6], [-0.1, -0.02, 0.65]]), np.array([[0.4, 0.3, 0.1, 0.85], [0.1, 0.5, 0.2, 0.8]]),
)
"""Two bodies in the optical frame, one to the right and one to the left."""


def environment(**more: str) -> dict[str, str]:
    """What the processes of nodes get: this one's environment, the shipped Fast DDS profile, and ``more``."""
    return {**os.environ, **process.additions(), "RCUTILS_COLORIZED_OUTPUT": "0", **more}


def arguments(*parameters: str, remap: Sequence[str] = ()) -> list[str]:
    """The command line of parameters ("name:=value") and remappings ("from:=to")."""
    parts = [word for parameter in parameters for word in ("-p", parameter)]
    return ["--ros-args", *parts, *(word for one in remap for word in ("-r", one))]


def until(condition: Callable[[], Any], alive: Sequence[Child] = (), patience: float = PATIENCE) -> Any:
    """The first true value of ``condition``; fails where a process of ``alive`` ends, or nothing comes in time."""
    deadline = time.monotonic() + patience
    while not (result := condition()):
        for child in alive:
            assert child.exit_code is None, f"{child.name} ended:\n" + "\n".join(child.last_lines())
        if time.monotonic() > deadline:
            raise AssertionError("\n".join([f"waited {patience:g} s in vain", *(child.output() for child in alive)]))
        time.sleep(0.002)
    return result


@dataclass(frozen=True)
class Answer:
    """One result: when it arrived, how old its image was then, and the message."""

    time: float
    age: float
    message: PointCloud2

    @property
    def stamp(self) -> int:
        return stamp_of(self.message)


@dataclass(frozen=True)
class Diagnosis:
    """One report of a node: when it arrived, its level and message, and its values by key."""

    time: float
    level: int
    message: str
    values: dict[str, str] = field(default_factory=dict)

    def count(self, key: str) -> int:
        return int(self.values[key])

    @property
    def is_balanced(self) -> bool:
        """Whether every received frame has exactly one verdict or is in work."""
        parts = ("answered", "dropped", "refused", "in work")
        return self.count("received") == sum(self.count(key) for key in parts)


@dataclass(frozen=True)
class Call:
    response: Any
    milliseconds: float


class Peer(SpunNodes):
    """A node in this process, spun in the background, that publishes, listens and calls."""

    def __init__(self) -> None:
        os.environ.update(process.additions())
        super().__init__()
        self.node = self.peer
        self._publishers: dict[str, Any] = {}
        self._clients: dict[str, Any] = {}
        self._answers: dict[str, list[Answer]] = {}
        self._diagnoses: dict[str, list[Diagnosis]] = {}
        self.spin([])
        self.listen(DiagnosticArray, "/diagnostics", self._on_diagnostics)

    # Listening

    def listen(self, kind: type[Any], topic: str, callback: Callable[[Any], None], depth: int = 50) -> None:
        """Subscribe; the callback runs in the background thread."""
        self.node.create_subscription(kind, topic, callback, depth)
        self.executor.wake()

    def answers(self, node: str) -> list[Answer]:
        """The results of a node ("/recover_node"), growing from the first call on."""
        if node not in self._answers:
            found = self._answers[node] = []

            def heard(message: PointCloud2) -> None:
                age = 1e-6 * (self.node.get_clock().now().nanoseconds - stamp_of(message))
                found.append(Answer(time.monotonic(), age, message))

            self.listen(PointCloud2, f"{node}/superquadrics", heard)
        return self._answers[node]

    def diagnoses(self, node: str) -> list[Diagnosis]:
        return self._diagnoses.setdefault(node, [])

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            if "received" in values:
                self.diagnoses(_owner(status)).append(
                    Diagnosis(time.monotonic(), int.from_bytes(status.level, "big"), status.message, values)
                )

    # Speaking

    def publisher(self, kind: type[Any], topic: str, depth: int = 5) -> Any:
        full = _absolute(topic)
        if full not in self._publishers:
            self._publishers[full] = self.node.create_publisher(kind, full, depth)
        return self._publishers[full]

    def silence(self, topic: str) -> None:
        self.node.destroy_publisher(self._publishers.pop(_absolute(topic)))

    def header(self, frame_id: str = "a_camera") -> Header:
        return Header(stamp=self.node.get_clock().now().to_msg(), frame_id=frame_id)

    def start_call(self, kind: type[Any], name: str, request: Any, alive: Sequence[Child] = ()) -> Future:
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, name)
            self.executor.wake()
        until(self._clients[name].service_is_ready, alive)
        return self._clients[name].call_async(request)

    def call(self, kind: type[Any], name: str, request: Any, alive: Sequence[Child] = ()) -> Call:
        done: list[float] = []
        began = time.perf_counter()
        future = self.start_call(kind, name, request, alive)
        future.add_done_callback(lambda _: done.append(time.perf_counter()))
        until(lambda: done, alive)
        return Call(future.result(), 1e3 * (done[0] - began))

    def set(self, node: str, alive: Sequence[Child] = (), **values: Any) -> list[Any]:
        """Set parameters one by one; the results (successful, reason)."""
        changes = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        request = SetParameters.Request(parameters=changes)
        return list(self.call(SetParameters, f"{node}/set_parameters", request, alive).response.results)

    def get(self, node: str, *names: str, alive: Sequence[Child] = ()) -> list[Any]:
        request = GetParameters.Request(names=list(names))
        found = self.call(GetParameters, f"{node}/get_parameters", request, alive).response.values
        return [parameter_value_to_python(one) for one in found]

    # Frames

    def frame(
        self, bodies: Superquadric = BODIES, camera: Camera = CAMERA, frame_id: str = "a_camera"
    ) -> tuple[Image, CameraInfo]:
        header = self.header(frame_id)
        return depth_to_message(_rendered(bodies, camera), header), intrinsics_to_message(intrinsics(camera), header)

    def ask(
        self, node: str, image: Image, info: CameraInfo, alive: Sequence[Child] = (), space: str = "/",
        every: float = 1.0,
    ) -> Answer:
        """Publish a frame in a namespace, again ``every`` so often as best effort may lose it, until it is answered."""
        heard = self.answers(node)
        images = self.publisher(Image, f"{space}depth/image")
        infos = self.publisher(CameraInfo, f"{space}depth/camera_info")
        until(lambda: images.get_subscription_count() and infos.get_subscription_count(), alive)
        until(lambda: self.node.count_publishers(f"{node}/superquadrics"), alive)
        sent: list[float] = []
        seen = len(heard)

        def answered() -> Answer | None:
            if not sent or time.monotonic() - sent[-1] > every:
                infos.publish(info)
                images.publish(image)
                sent.append(time.monotonic())
            return next((one for one in heard[seen:] if one.message.header == image.header), None)

        return until(answered, alive)


_IMAGES: dict[tuple[int, Camera], np.ndarray] = {}


def _rendered(bodies: Superquadric, camera: Camera) -> np.ndarray:
    key = id(bodies), camera
    if key not in _IMAGES:
        _IMAGES[key] = Scene(bodies, camera, None).render()[0]
    return _IMAGES[key]


def _owner(status: DiagnosticStatus) -> str:
    return "/" + status.name.split(":")[0].strip().lstrip("/")


def _absolute(topic: str) -> str:
    return "/" + topic.lstrip("/")
