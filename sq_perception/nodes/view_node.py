"""The node behind ``sq-perception view``: listens to a camera and some frame nodes, and keeps what a page shows.

Images, camera_info and superquadrics are subscribed to while a browser shows the page, /diagnostics and
/parameter_events always; parameters go by services (:mod:`sq_perception.nodes.remote_node`).

The executor's thread stores messages and talks to services; one drawing thread decodes the newest and draws them, at a
limited rate and only while a browser shows the page.
"""

from __future__ import annotations

import threading
import traceback
from collections import OrderedDict, deque
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from time import monotonic
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import ParameterEvent
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from sq_msgs_py.depth_image import GREY_ENCODINGS
from sq_msgs_py.superquadrics import from_message
from sq_perception.geometry import rotation
from sq_perception.imaging import unit_cube
from sq_perception.nodes.frame import decode_by, listen_to_latched_info, newest, stamp_of
from sq_perception.nodes.remote_node import RemoteNode
from sq_perception.nodes.statistics import THROTTLE
from sq_perception.nodes.tracking import CameraPoses, PoseError
from sq_perception.recordings.bag_camera import camera_info_topic
from sq_perception.recordings.publication import drawn, size_of, superquadrics
from sq_perception.viewing import tables
from sq_perception.viewing.drawings import Bodies
from sq_perception.viewing.page import Page
from sq_perception.viewing.tables import NodeState

_IMAGES = 8
"""Depth images that are kept until the result of their stamp comes."""
_STATUS_PERIOD = 0.5
"""Seconds between two looks at states and ages where nothing new has come."""
_SERVICE_PERIOD = 0.1
_RATE_SECONDS = 3.0
_RESULT_PATIENCE = 1.0
_DRAWER_END = 5.0


class _Result(NamedTuple):
    """Superquadrics, and when they came, in seconds of the monotonic clock."""

    message: PointCloud2
    time: float


class ViewNode(Node):
    """See the module.

    Parameters
    ----------
    page
        Shows the nodes named ``nodes``, fully qualified; closed with the node.
    depth, camera_info
        Topics, resolved and remapped as those of a node are.  Without a camera_info that is named or remapped, the one
        in the name space of the images.
    rate
        How often the page is drawn, Hz, at most.
    """

    def __init__(
        self,
        name: str,
        page: Page,
        depth: str,
        camera_info: str | None,
        nodes: Sequence[str],
        rate: float = 10.0,
        context: Any = None,
    ) -> None:
        super().__init__(name, context=context)
        self.start_failure = ""
        self._page, self._period = page, 1.0 / rate
        self._topics = self._resolved(depth, camera_info)
        self._lock = threading.Lock()
        self._images: OrderedDict[int, Image] = OrderedDict()
        self._arrivals: deque[float] = deque(maxlen=1000)
        self._info: CameraInfo | None = None
        self._results: dict[str, _Result] = {}
        self._diagnosed: dict[str, dict[str, str]] = {}
        self._poses = CameraPoses(self)
        self._inputs: list[Subscription] = []
        self._latched: Subscription | None = None
        self._drawn: Image | None = None
        self._shown: dict[str, _Result] = {}
        """The result of each node that was drawn last."""
        self._status_due = 0.0
        self._remote = {name: RemoteNode(self, name) for name in nodes}
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self.create_subscription(ParameterEvent, "/parameter_events", self._on_parameter_event, 1000)
        # Steady: a simulator that is paused stops the node's own clock.
        self.create_timer(_SERVICE_PERIOD, self._on_tick, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._closed = threading.Event()
        self._news = threading.Event()
        self._drawer = threading.Thread(target=self._draw_on, name="drawer", daemon=True)
        self._drawer.start()

    def _resolved(self, depth: str, camera_info: str | None) -> tuple[str, str]:
        """The topics that are listened to."""
        images = str(self.resolve_topic_name(depth))
        name = camera_info or camera_info_topic(depth)
        info = str(self.resolve_topic_name(name))
        if camera_info is None and info == self.resolve_topic_name(name, only_expand=True):
            info = camera_info_topic(images)
        return images, info

    def close(self) -> bool:
        """Stop drawing and serving."""
        self._closed.set()
        self._news.set()
        self._drawer.join(_DRAWER_END)
        self._page.close()
        return not self._drawer.is_alive()

    # Callbacks, in the executor's thread

    def _on_tick(self) -> None:
        """Listen while somebody watches; pass wishes of the page on, and answers back."""
        watched = self._page.watched
        if watched and not self._inputs:
            self._listen()
        elif not watched and self._inputs:
            for subscription in (*self._inputs, self._latched):
                if subscription is not None:
                    self.destroy_subscription(subscription)
            self._inputs, self._latched = [], None
        if self._inputs and self._latched is None:
            self._latched = listen_to_latched_info(self, self._topics[1], self._on_info)
        executor = self.executor
        assert executor is not None, "it calls this"
        for change in self._page.changes():
            executor.create_task(self._remote[change.node].change, change.name, change.value)
        for remote in self._remote.values():
            remote.tick()

    def _listen(self) -> None:
        depth, camera_info = self._topics
        self._inputs = [
            self.create_subscription(CameraInfo, camera_info, self._on_info, newest()),
            self.create_subscription(Image, depth, self._on_image, newest()),
        ]
        for name in self._remote:
            topic = f"{name}/superquadrics"
            self._inputs.append(self.create_subscription(PointCloud2, topic, partial(self._on_result, name), newest()))

    def _on_info(self, message: CameraInfo) -> None:
        self._info = message

    def _on_image(self, message: Image) -> None:
        self._poses.follow(stamp_of(message))
        with self._lock:
            self._arrivals.append(monotonic())
            self._images[stamp_of(message)] = message
            self._images.move_to_end(stamp_of(message))  # where a short bag begins again the stamp is there already
            while len(self._images) > _IMAGES:
                self._images.popitem(last=False)
        # The image waits for its result, where results come at all.
        if not any(monotonic() - result.time < _RESULT_PATIENCE for result in self._results.values()):
            self._news.set()

    def _on_result(self, name: str, message: PointCloud2) -> None:
        self._results[name] = _Result(message, monotonic())
        self._news.set()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            for name in self._remote:
                if status.hardware_id == name:
                    self._diagnosed[name] = {pair.key: pair.value for pair in status.values}

    def _on_parameter_event(self, event: ParameterEvent) -> None:
        if event.node in self._remote:
            self._remote[event.node].reload()

    # The drawing thread

    def _draw_on(self) -> None:
        due = 0.0
        while not self._closed.is_set():
            self._news.wait(_STATUS_PERIOD)
            self._news.clear()
            if self._closed.wait(max(0.0, due - monotonic())):
                return
            due = monotonic() + self._period
            try:
                self._draw()
            except Exception:
                # A defect of ours or of a message: it costs this picture, and the page goes on.
                if not self._closed.is_set():
                    self.get_logger().error(traceback.format_exc(), throttle_duration_sec=THROTTLE)

    def _draw(self) -> None:
        for remote in self._remote.values():
            remote.show(self._page)
        if not self._page.watched:
            self._status_due = 0.0  # controls may have changed when somebody looks again
            return
        now = monotonic()
        status_due = now >= self._status_due
        results = dict(self._results)
        with self._lock:
            images = list(self._images.values())
            rate = sum(1 for time in self._arrivals if now - time <= _RATE_SECONDS) / _RATE_SECONDS
        header = self._draw_depth(images, rate, results)
        for name in self._remote:
            if status_due or results.get(name) is not self._shown.get(name):
                self._draw_node(name, results.get(name), header)
        self._shown = results
        if status_due:
            self._status_due = monotonic() + _STATUS_PERIOD

    def _draw_depth(self, images: list[Image], rate: float, results: dict[str, _Result]) -> Any:
        """Draw the image that belongs to the newest results, else the newest; the header of what is drawn."""
        topic = self._topics[0]
        if not images:
            self._page.show_source(tables.source_status(topic, None, 0.0, "", "no depth image has come yet"))
            return None
        stamps = {
            stamp_of(result.message) for result in results.values() if monotonic() - result.time < tables.SILENT_SECONDS
        }
        image = next((candidate for candidate in reversed(images) if stamp_of(candidate) in stamps), images[-1])
        remark = "" if rate > 0 else "no depth images come any more"
        if image is not self._drawn:
            try:
                frame = decode_by(self._info, image, topic)
                self._page.show_depth(frame.depth, frame.camera)
                self._drawn = image
            except ValueError as error:
                remark = str(error)
        self._page.show_source(tables.source_status(topic, size_of(image), rate, image.header.frame_id, remark))
        return image.header

    def _draw_node(self, name: str, result: _Result | None, header: Any) -> None:
        is_there = self._remote[name].is_there
        state = NodeState(name, diagnostics=self._diagnosed.get(name, {}) if is_there else {}, is_there=is_there)
        bodies = None
        if result is not None:
            bodies, remark = self._converted(result.message, header)
            state = replace(state, age=monotonic() - result.time, remark=remark)
        self._page.show_bodies(bodies, state)

    def _converted(self, message: PointCloud2, header: Any) -> tuple[Bodies | None, str]:
        """The bodies in the frame of the depth image, and why they cannot be drawn."""
        try:
            array = from_message(message)
            bodies = superquadrics(array.recovered)
            if self._drawn is not None and self._drawn.encoding in GREY_ENCODINGS:
                bodies = unit_cube.optical_from_cube(bodies)
            elif header is not None and message.header.frame_id != header.frame_id:
                turn, shift = self._poses.at(header, message.header.frame_id)
                back = rotation.conjugate(turn)
                bodies = bodies.transformed(back, -(rotation.to_matrix(back) @ shift))
            return drawn(array, bodies), ""
        except PoseError as error:
            return None, f"bodies are in {message.header.frame_id}, the image in {header.frame_id}: {error}"
        except ValueError as error:
            return None, str(error)
