"""What recover_node and fitter_node have in common: depth images in, superquadrics out.

| name | type | |
| --- | --- | --- |
| `depth/image` | sensor_msgs/Image | in: 16UC1 mm, 32FC1 m; mono8 and mono16 for orthographic frames |
| `depth/camera_info` | sensor_msgs/CameraInfo | in: not needed for orthographic frames |
| `mask/image` | sensor_msgs/Image | in, optional: label image with the stamp of the depth image |
| `~/superquadrics` | sensor_msgs/PointCloud2 | out: one point per body, see sq_msgs_py.superquadrics |
| `~/markers` | visualization_msgs/MarkerArray | out, while somebody listens |
| `~/rendered_depth` | sensor_msgs/Image | out, while somebody listens; in the encoding of the input |
| `/diagnostics` | diagnostic_msgs/DiagnosticArray | out, once per second |
| `~/enable` | std_srvs/SetBool | drop all frames, or process them again |
| `~/trigger` | std_srvs/Trigger | process the next frame, also while disabled, and answer with a summary |

The executor's thread only stores messages; one worker thread takes the newest and does the work, so that services and
parameters answer at once.  Stamp and frame of the input are copied to every output.  Bodies are followed from frame to
frame (:mod:`sq_perception.nodes.identity`), and those that a frame shows are published.  Results of orthographic frames
are in the cube frame of :mod:`sq_perception.imaging.unit_cube`, those of others in the optical frame.
"""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable
from time import monotonic, perf_counter
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.task import Future
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import MarkerArray

from sq_msgs_py.superquadrics import to_message
from sq_perception.imaging import unit_cube
from sq_perception.imaging.camera import Camera
from sq_perception.nodes import report, results
from sq_perception.nodes.camera_poses import CameraPoses
from sq_perception.nodes.counters import Statistics, Throttle
from sq_perception.nodes.frame import Frame, decode
from sq_perception.nodes.identity import Identified, Identity
from sq_perception.nodes.inbox import Arrival, Inbox, Refused
from sq_perception.nodes.parameters import FrameParameters, LiveParameters
from sq_perception.nodes.stoppable_node import StoppableNode
from sq_perception.recovery import Recoverer, RecoveryOptions, render_recovery

WARM_UP_CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
_COMPANION_PATIENCE = 0.25
"""Seconds to wait for the camera_info or the mask of a frame that is already here."""
_WORKER_END = 10.0

Outcome = tuple[bool, str]
"""Whether a frame was answered, and the summary or the reason."""


class FrameNode(StoppableNode):
    """See the module.

    Parameters
    ----------
    name
        Of the node.
    kind
        The dataclass of its parameters.
    make_recoverer, options
        What does the work, and how it is told what the parameters say.
    context
        rclpy's default if not given.

    Raises
    ------
    ParameterError
        For a parameter that cannot be used.
    CheckpointError
        For a model file that is missing or wrong.
    """

    def __init__(
        self,
        name: str,
        kind: type[Any],
        make_recoverer: Callable[[Any], Recoverer],
        options: Callable[[Any], RecoveryOptions],
        context: Any = None,
    ) -> None:
        super().__init__(name, context=context)
        self._settings: LiveParameters[Any] = LiveParameters(self, kind)
        self._recoverer = make_recoverer(self._settings.current)
        self._options = options
        self._statistics = Statistics()
        self._throttle = Throttle()
        self._inbox = Inbox()
        self._enabled = True
        self._triggers: list[tuple[float, Future]] = []
        self._triggers_lock = threading.Lock()
        self._shown_ids: list[int] = []
        fixed_frame = self._settings.current.fixed_frame
        poses = CameraPoses(self, fixed_frame) if fixed_frame else None
        self._identity = Identity(poses, self._warn, self.get_logger().info)
        self._last_image = monotonic()
        self._last_level_counts = self._statistics.snapshot()
        self._warm_up()
        self._connect()
        self._worker = threading.Thread(target=self._work, name="worker", daemon=True)
        self._worker.start()
        self.get_logger().info(f"ready, listening to {self._image_input.topic_name}")

    def close(self) -> None:
        """Stop the worker; the frame at hand is finished first."""
        self._inbox.close()
        self._worker.join(_WORKER_END)

    # Wiring

    def _warm_up(self) -> None:
        started = perf_counter()
        self.get_logger().info("warming up: loading compiled code, or compiling it on the first start")
        orthographic = self._settings.current.projection == "orthographic"
        camera = unit_cube.camera() if orthographic else WARM_UP_CAMERA
        self._recoverer.warm_up(camera)
        self.get_logger().info(f"warm after {perf_counter() - started:.1f} s")

    def _connect(self) -> None:
        pinhole = self._settings.current.projection == "pinhole"
        # Subscriptions are served in this order: what an image needs is there before the image.
        self._info_input = self._listen(CameraInfo, "depth/camera_info", self._inbox.put_info) if pinhole else None
        self._mask_input = self._listen(Image, "mask/image", self._inbox.put_mask)
        self._image_input = self._listen(Image, "depth/image", self._on_image)
        self._superquadrics = self.create_publisher(PointCloud2, "~/superquadrics", 10)
        self._markers = self.create_publisher(MarkerArray, "~/markers", 1)
        self._rendered = self.create_publisher(Image, "~/rendered_depth", 1)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_service(SetBool, "~/enable", self._on_enable)
        # Its answer waits for a frame; in the default group nothing else would run meanwhile.
        self.create_service(Trigger, "~/trigger", self._on_trigger, callback_group=ReentrantCallbackGroup())
        self.create_timer(1.0, self._on_second)

    def _listen(self, kind: type[Any], topic: str, callback: Callable[[Any], None]) -> Subscription:
        profile = QoSProfile(depth=1, history=QoSHistoryPolicy.KEEP_LAST, reliability=QoSReliabilityPolicy.BEST_EFFORT)
        return self.create_subscription(
            kind,
            topic,
            callback,
            profile,
            event_callbacks=SubscriptionEventCallbacks(message_lost=self._on_lost),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    # Callbacks, in the executor's thread: quick, and nothing in them can fail on a message's content

    def _on_image(self, message: Image) -> None:
        self._last_image = monotonic()
        self._statistics.count("received")
        if (not self._enabled and not self._triggers) or self._inbox.put_image(message):
            self._statistics.count("dropped")

    def _on_lost(self, event: Any) -> None:
        self._statistics.count("lost", event.total_count_change)
        self._warn(
            "lost",
            f"{event.total_count} messages lost before they arrived: best effort images need more shared memory than "
            "Fast DDS reserves by default. Remedy: start the PUBLISHER (the camera driver) with "
            "FASTRTPS_DEFAULT_PROFILES_FILE set to the profile that ships in this package's config folder",
        )

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._enabled = bool(request.data)
        response.success = True
        response.message = "enabled" if self._enabled else "disabled: frames are dropped, ~/trigger still works"
        return response

    async def _on_trigger(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        timeout = self._settings.current.trigger_timeout
        outcome: Future = Future(executor=self.executor)
        entry = monotonic(), outcome
        with self._triggers_lock:
            self._triggers.append(entry)
        timer = self.create_timer(timeout, lambda: self._expire(entry, timeout))
        response.success, response.message = await outcome
        self.destroy_timer(timer)
        return response

    def _expire(self, entry: tuple[float, Future], timeout: float) -> None:
        with self._triggers_lock:
            if entry not in self._triggers:
                return
            self._triggers.remove(entry)
        topic = self._image_input.topic_name
        entry[1].set_result((False, f"no frame on {topic} within {timeout:g} s: {self._heard(self._image_input)}"))

    def _on_second(self) -> None:
        silence = monotonic() - self._last_image
        limit = self._settings.current.no_frame_warning
        silent = 0 < limit < silence
        if silent:
            topic, publishers = self._image_input.topic_name, self._heard(self._image_input)
            self._warn("silence", f"no depth image on {topic} for {silence:.0f} s: {publishers}")
        now = self._statistics.snapshot()
        message = DiagnosticArray()
        message.header.stamp = self.get_clock().now().to_msg()
        tally = self._identity.tally if self._settings.current.tracking else None
        name = self.get_fully_qualified_name()
        message.status.append(report.status(name, now, self._last_level_counts, silent, self._enabled, tally))
        self._last_level_counts = now
        self._diagnostics.publish(message)

    # The worker

    def _work(self) -> None:
        while (arrival := self._inbox.take()) is not None:
            outcome: Outcome
            try:
                outcome = True, self._process(arrival)
            except ValueError as error:
                outcome = False, str(error)
            except Exception as error:
                if not self.context.ok():
                    return
                # A defect of ours: it costs this frame and leaves its trace in the log, and the node goes on.
                outcome = False, f"{type(error).__name__}: {error}"
                if self._throttle.passes("defect") is not None:
                    self.get_logger().error(traceback.format_exc())
            if not outcome[0]:
                self._statistics.refuse(outcome[1])
                self._warn(outcome[1].split(":")[0], f"refused a frame of {self._image_input.topic_name}: {outcome[1]}")
            self._answer_triggers(arrival, outcome)

    def _process(self, arrival: Arrival) -> str:
        """Recover one frame and publish the results; its summary."""
        parameters = self._settings.current
        clock = perf_counter()
        stages = {"wait": 1e3 * (monotonic() - arrival.time)}
        frame = self._decoded(arrival.message, parameters)
        stages["decode"] = 1e3 * (perf_counter() - clock)

        recovery = self._recoverer.recover(frame.depth, frame.camera, frame.labels, self._options(parameters))
        stages |= {f"recovery: {stage}": duration for stage, duration in recovery.milliseconds.items()}

        clock = perf_counter()
        if parameters.tracking:
            found = self._identity.tracked(recovery, frame, arrival.time)
            stages["tracking"] = 1e3 * (perf_counter() - clock)
        else:
            found = self._identity.untracked(recovery)

        clock = perf_counter()
        array = results.superquadric_array(found.recovery, found.ids, frame.is_cube)
        self._superquadrics.publish(to_message(array, frame.header))
        stages["publish"] = 1e3 * (perf_counter() - clock)
        age = self.get_clock().now() - Time.from_msg(frame.header.stamp, clock_type=self.get_clock().clock_type)
        stages["stamp to result"] = age.nanoseconds * 1e-6
        clock = perf_counter()
        self._publish_pictures(frame, found, parameters)
        stages["pictures"] = 1e3 * (perf_counter() - clock)
        self._statistics.answer(stages)
        return report.summary(found.recovery, found.ids)

    def _decoded(self, message: Image, parameters: FrameParameters) -> Frame:
        if parameters.projection == "orthographic":
            frame = decode(message, None)
        else:
            try:
                frame = decode(message, lambda: self._inbox.camera_of(message, _COMPANION_PATIENCE))
            except Refused as error:
                assert self._info_input is not None
                topic = self._info_input.topic_name
                raise Refused(f"{error}, on {topic}: {self._heard(self._info_input)}") from error
        return frame.with_mask(self._mask(message, parameters.use_masks))

    def _mask(self, message: Image, use: str) -> Image | None:
        topic = self._mask_input.topic_name
        if use == "never" or (use == "auto" and not self.count_publishers(topic)):
            return None
        mask = self._inbox.mask_of(message, _COMPANION_PATIENCE)
        if mask is None and use == "always":
            raise Refused(f"mask: expected one with the stamp of the image (use_masks is always), none came on {topic}")
        return mask

    def _publish_pictures(self, frame: Frame, found: Identified, parameters: FrameParameters) -> None:
        if self._markers.get_subscription_count():
            markers = results.marker_array(found.recovery, found.ids, frame, parameters, self._shown_ids)
            self._shown_ids = results.shown_ids(found.recovery, found.ids)
            self._markers.publish(markers)
        if self._rendered.get_subscription_count():
            depth, _ = render_recovery(found.recovery, frame.camera)
            self._rendered.publish(frame.encode(depth))

    def _answer_triggers(self, arrival: Arrival, outcome: Outcome) -> None:
        """Answer the triggers that were waiting when this frame arrived."""
        with self._triggers_lock:
            waiting = [entry for entry in self._triggers if entry[0] <= arrival.time]
            self._triggers = [entry for entry in self._triggers if entry not in waiting]
        for _, future in waiting:
            future.set_result(outcome)
        if waiting and self.executor is not None:
            self.executor.wake()

    # Words

    def _warn(self, kind: str, text: str) -> None:
        remark = self._throttle.passes(kind)
        if remark is not None:
            self.get_logger().warning(text + remark)

    def _heard(self, subscription: Subscription) -> str:
        offered = self.get_publishers_info_by_topic(subscription.topic_name)
        return report.publishers(offered, subscription.qos_profile)
