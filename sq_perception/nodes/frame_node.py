"""What recover_node and fitter_node have in common: depth images in, superquadrics out.

| name | type | |
| --- | --- | --- |
| `depth/image` | sensor_msgs/Image | in: 16UC1 mm, 32FC1 m; mono8 and mono16 for orthographic frames |
| `depth/image/compressedDepth` | sensor_msgs/CompressedImage | in, instead, for `image_transport: compressedDepth` |
| `depth/camera_info` | sensor_msgs/CameraInfo | in: not needed for orthographic frames |
| `mask/image` | sensor_msgs/Image | in, optional: label image with the stamp of the depth image |
| `~/superquadrics` | sensor_msgs/PointCloud2 | out: one point per body, see sq_msgs_py.superquadrics |
| `~/markers` | visualization_msgs/MarkerArray | out, while somebody listens |
| `~/rendered_depth` | sensor_msgs/Image | out, while somebody listens; in the encoding of the input |
| `/diagnostics` | diagnostic_msgs/DiagnosticArray | out, once per second, in every state |
| `~/enable` | std_srvs/SetBool | drop all frames, or process them again |
| `~/trigger` | std_srvs/Trigger | process the next frame, also while disabled, and answer with a summary |

A lifecycle node (:mod:`sq_perception.nodes.managed_node`): configuring loads the network and warms up, activating
subscribes, deactivating ends the subscriptions after the frame at hand, cleaning up frees the network's memory.

The executor's thread only stores messages; one worker thread takes the newest and does the work, so that services and
parameters answer at once.  Stamp and frame of the input are copied to every output.  Bodies are followed from frame to
frame (:mod:`sq_perception.nodes.identity`), and those that a frame shows are published.  Results of orthographic frames
are in the cube frame of :mod:`sq_perception.imaging.unit_cube`, those of others in the optical frame, or in
``target_frame``.  What else is published, for tf2, planners and vision pipelines: :mod:`sq_perception.nodes.outputs`.
"""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable
from dataclasses import dataclass, fields
from time import monotonic, perf_counter
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_srvs.srv import SetBool, Trigger

from sq_perception.imaging import unit_cube
from sq_perception.imaging.calibration import Calibration
from sq_perception.imaging.camera import Camera
from sq_perception.nodes import garbage, report, transport
from sq_perception.nodes.counters import Statistics, Throttle
from sq_perception.nodes.engine import TURNS, Engine, Workshop
from sq_perception.nodes.frame import Frame, decode
from sq_perception.nodes.frame_publisher import FramePublisher
from sq_perception.nodes.inbox import Arrival, Inbox, NoCameraInfo, Refused
from sq_perception.nodes.managed_node import ManagedNode
from sq_perception.nodes.parameters import FrameParameters, LiveParameters
from sq_perception.nodes.triggers import Outcome, Triggers
from sq_perception.recovery.recoverer import FrameRecovery

WARM_UP_CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
_WORKER_END = 3.0
"""Seconds that a deactivation waits for the frame at hand."""
_OLDEST = 3600.0
"""Seconds; the age of an older frame, or one from the future, says nothing about latency: a bag, or another clock."""
_DEFECTS = 10
"""Frames in a row that end in a defect of ours or of the device, after which the node starts anew."""


@dataclass(frozen=True)
class _Input:
    """A subscription, and what is said about it, also after it has been destroyed."""

    subscription: Subscription
    topic: str
    profile: QoSProfile


class FrameNode(ManagedNode):
    """See the module.

    Parameters
    ----------
    name, namespace
        Of the node.
    kind
        The dataclass of its parameters.
    workshop
        What makes the recoverer that does the work, and tells it what the parameters say.
    context
        rclpy's default if not given.

    Raises
    ------
    ParameterError
        For a parameter that cannot be used.  A model that is missing or wrong is a fault of the configuration, as it is
        read there.
    """

    def __init__(
        self,
        name: str,
        kind: type[Any],
        workshop: Workshop[Any],
        *,
        namespace: str | None = None,
        context: Any = None,
    ) -> None:
        super().__init__(name, namespace=namespace, context=context)
        self._engine: Engine[Any] = Engine(workshop, self._inform, self._complain)
        self._settings: LiveParameters[Any] = LiveParameters(
            self, kind, locked=self._why_locked, judge=workshop.judge, changed=self._on_changed
        )
        self._statistics = Statistics()
        self._throttle = Throttle()
        self._enabled = True
        self._triggers = Triggers(self)
        self._publisher = FramePublisher(self, self._warn, self._inform)
        self._note = ""
        self._defects = 0
        self._inbox: Inbox | None = None
        self._worker: threading.Thread | None = None
        self._image_input: _Input | None = None
        self._info_input: _Input | None = None
        self._mask_input: _Input | None = None
        self._last_image = monotonic()
        self._last_counts = self._statistics.snapshot()
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_service(SetBool, "~/enable", self._on_enable)
        # Its answer waits for a frame; in the default group nothing else would run meanwhile.
        self.create_service(Trigger, "~/trigger", self._on_trigger, callback_group=ReentrantCallbackGroup())
        # On a steady clock: simulated time may stand still, and the node still has to say so.
        self.create_timer(1.0, self._on_second, clock=Clock(clock_type=ClockType.STEADY_TIME))
        if self._settings.current.autostart:
            self.start()

    # The lifecycle

    def _configure(self) -> None:
        parameters = self._settings.current
        started = perf_counter()
        self.get_logger().info("warming up: loading compiled code, or compiling it on the first start")
        self._engine.build(parameters, self._warm_up_camera)
        latest = self._settings.current
        meanwhile = {one.name for one in fields(latest) if getattr(latest, one.name) != getattr(parameters, one.name)}
        self._engine.follow(latest, frozenset(meanwhile), self._warm_up_camera)
        self.get_logger().info(f"warm after {perf_counter() - started:.1f} s")
        self._publisher.open(latest)
        garbage.keep()

    def _activate(self) -> None:
        pinhole = self._settings.current.projection == "pinhole"
        self._defects = 0
        self._last_image = monotonic()
        packing = self._settings.current.image_transport
        image_topic = transport.topic(self, "depth/image", packing)
        self._inbox = inbox = Inbox(
            (lambda info: self._calibrated(info, image_topic)) if pinhole else None,
            needs_mask=lambda: self._expects_mask(self._settings.current.use_masks),
            patience=lambda: self._settings.current.patience,
            dropped=lambda number: self._statistics.count("dropped", number),
        )
        self._worker = threading.Thread(target=self._work, args=(inbox,), name="worker", daemon=True)
        self._worker.start()
        # Subscriptions are served in this order: what an image needs is there before the image.
        self._info_input = self._listen(CameraInfo, "depth/camera_info", inbox.put_info) if pinhole else None
        self._mask_input = self._listen(Image, "mask/image", inbox.put_mask)
        self._image_input = self._listen(transport.message_type(packing), image_topic, self._on_image)
        self.get_logger().info(f"ready, listening to {self._image_input.topic}")

    def _deactivate(self) -> None:
        self._stop()
        self._publisher.withdraw()

    def _cleanup(self) -> None:
        self._stop()
        self._publisher.close()
        self._engine.release()
        garbage.release()  # nothing of a network may hang on in a cycle of references

    def _stop(self) -> None:
        """End subscriptions and worker.  What planners were told of stays: a camera that fails takes no obstacles."""
        inputs = (self._image_input, self._mask_input, self._info_input)
        self._image_input = self._mask_input = self._info_input = None
        for one in inputs:
            if one is not None:
                self.destroy_subscription(one.subscription)
        inbox, self._inbox = self._inbox, None
        if inbox is not None:
            self._statistics.count("dropped", inbox.close())
        self._triggers.answer((False, "the node has been deactivated"))
        if self._worker is not None:
            self._worker.join(_WORKER_END)
            if self._worker.is_alive():
                self.get_logger().warning("the frame at hand takes long; it is the last one, and is not published")

    def close(self) -> bool:
        """As :meth:`ManagedNode.close`; False also while a frame or a swap of the model is still at work."""
        is_still = super().close()
        return is_still and not self._engine.is_making and (self._worker is None or not self._worker.is_alive())

    def _comes_back(self) -> bool:
        return bool(self._settings.current.autostart)

    @property
    def _warm_up_camera(self) -> Camera:
        return unit_cube.camera() if self._settings.current.projection == "orthographic" else WARM_UP_CAMERA

    def _why_locked(self) -> str:
        """Why parameters that are read at the configuration cannot change now; empty if they can."""
        if not self.is_configured:
            return ""
        name = self.get_fully_qualified_name()
        return (
            f"is read when the node is configured, and it is {self.state}: ros2 lifecycle set {name} deactivate, then "
            "cleanup; set it; configure, activate"
        )

    def _on_changed(self, parameters: Any, names: frozenset[str]) -> None:
        self._engine.follow(parameters, names, self._warm_up_camera)

    def _listen(self, kind: type[Any], topic: str, callback: Callable[[Any], None]) -> _Input:
        profile = QoSProfile(depth=1, history=QoSHistoryPolicy.KEEP_LAST, reliability=QoSReliabilityPolicy.BEST_EFFORT)
        made = self.create_subscription(
            kind,
            topic,
            callback,
            profile,
            event_callbacks=SubscriptionEventCallbacks(message_lost=self._on_lost),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
        return _Input(made, made.topic_name, made.qos_profile)

    # Callbacks, in the executor's thread: quick, and nothing in them can fail on a message's content

    def _on_image(self, message: Image | CompressedImage) -> None:
        inbox = self._inbox
        if inbox is None:
            return
        self._last_image = monotonic()
        self._statistics.count("received")
        if self._is_wanted:
            inbox.put_image(message)
        else:
            self._statistics.count("dropped")

    def _calibrated(self, info: CameraInfo, image_topic: str) -> Calibration:
        calibration = Calibration.of(info, image_topic, self._settings.current.distortion)
        if calibration.note != self._note and self._throttle.passes("distortion") is not None:
            self._note = calibration.note
            self._inform(f"{image_topic}: {calibration.note or 'no distortion'}")
        return calibration

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
        image_input = self._image_input
        if image_input is None:
            response.success, response.message = False, f"the node is {self.state}, not active"
            return response
        timeout = self._settings.current.trigger_timeout

        def why_none() -> str:
            return f"no frame on {image_input.topic} within {timeout:g} s: {self._heard(image_input)}"

        return await self._triggers.outcome(response, timeout, why_none)

    def _on_second(self) -> None:
        image_input, parameters = self._image_input, self._settings.current
        silence = monotonic() - self._last_image
        silent = image_input is not None and 0 < parameters.no_frame_warning < silence
        if silent and image_input is not None:
            topic, publishers = image_input.topic, self._heard(image_input)
            self._warn("silence", f"no depth image on {topic} for {silence:.0f} s: {publishers}")
        now = self._statistics.snapshot()
        message = DiagnosticArray()
        message.header.stamp = self.get_clock().now().to_msg()
        condition = report.Condition(
            state=self.state,
            fault=self.fault or self._engine.fault,
            silent=silent,
            enabled=self._enabled,
            engine=self._engine.words,
            absent=self._publisher.absent,
            tally=self._publisher.tally if self.is_active and parameters.tracking else None,
        )
        message.status.append(report.status(self.get_fully_qualified_name(), now, self._last_counts, condition))
        self._last_counts = now
        self._diagnostics.publish(message)

    # The worker

    def _work(self, inbox: Inbox) -> None:
        while inbox.wait():
            arrival: Arrival | None = None
            outcome: Outcome
            try:
                with TURNS.turn():
                    # Taken when the turn has come: while others were computing, a newer one may have arrived.
                    arrival = inbox.take()
                    if arrival is None:
                        continue
                    if not self._is_wanted:
                        self._statistics.count("dropped")
                        continue
                    frame, recovery, stages = self._recovered(inbox, arrival)
                if self._inbox is not inbox or not self._is_wanted:
                    # Deactivated or disabled meanwhile: nothing is published any more, least of all a grasped body.
                    self._statistics.count("dropped")
                    continue
                outcome = True, self._published(frame, recovery, arrival, stages)
                self._defects = 0
            except ValueError as error:
                outcome = False, str(error)
            except Exception as error:
                if not self.context.ok() or self._inbox is not inbox:
                    return
                # A defect of ours: it costs this frame and leaves its trace in the log, and the node goes on.
                outcome = False, f"{type(error).__name__}: {error}"
                if self._throttle.passes("defect") is not None:
                    self.get_logger().error(traceback.format_exc())
                self._defects += 1
                if self._defects == _DEFECTS:
                    self._engine.discard()
                    self._fail(f"{_DEFECTS} frames in a row failed, the last one by {outcome[1]}")
            if arrival is None:
                continue
            if not outcome[0]:
                self._statistics.refuse(outcome[1])
                self._warn(outcome[1].split(":")[0], f"refused a frame: {outcome[1]}")
            self._triggers.answer(outcome, arrival.time)

    @property
    def _is_wanted(self) -> bool:
        """Whether frames are processed, or one is asked for."""
        return self._enabled or len(self._triggers) > 0

    def _recovered(self, inbox: Inbox, arrival: Arrival) -> tuple[Frame, FrameRecovery, dict[str, float]]:
        """The frame of a message, its bodies, and how long that took by stage, milliseconds."""
        parameters = self._settings.current
        stages = {"wait": 1e3 * (monotonic() - arrival.time)}
        clock = perf_counter()
        frame = self._decoded(inbox, arrival, parameters)
        stages["decode"] = 1e3 * (perf_counter() - clock)
        recoverer, options = self._engine.at_work(parameters)
        recovery = recoverer.recover(frame.depth, frame.camera, frame.labels, options)
        return frame, recovery, stages | {f"recovery: {name}": took for name, took in recovery.milliseconds.items()}

    def _published(self, frame: Frame, recovery: FrameRecovery, arrival: Arrival, stages: dict[str, float]) -> str:
        """Publish the results; the summary."""
        parameters = self._settings.current
        found, findings, took = self._publisher.answer(frame, recovery, arrival.time, parameters)
        age = 1e-9 * (self.get_clock().now().nanoseconds - _nanoseconds(frame.header.stamp))
        if abs(age) < _OLDEST:
            took["stamp to result"] = 1e3 * age
        self._statistics.answer(stages | took)
        self._statistics.note(self._publisher.accompany(frame, found, findings, parameters))
        return report.summary(found.recovery, found.ids)

    def _decoded(self, inbox: Inbox, arrival: Arrival, parameters: FrameParameters) -> Frame:
        message = arrival.message
        if parameters.projection == "orthographic":
            frame = decode(message, None)
        else:
            try:
                frame = decode(message, lambda: inbox.calibration_of(message))
            except NoCameraInfo as error:
                info_input = self._info_input
                if info_input is None:
                    raise
                raise Refused(f"{error}, on {info_input.topic}: {self._heard(info_input)}") from error
        if parameters.use_masks == "always" and arrival.mask is None:
            mask_input = self._mask_input
            where = f" on {mask_input.topic}" if mask_input is not None else ""
            raise Refused(f"mask: expected one with the stamp of the image (use_masks is always), none came{where}")
        return frame.with_mask(arrival.mask if parameters.use_masks != "never" else None)

    def _expects_mask(self, use: str) -> bool:
        mask_input = self._mask_input
        if mask_input is None:
            return False
        return use == "always" or (use == "auto" and bool(self.count_publishers(mask_input.topic)))

    # Words

    def _inform(self, text: str) -> None:
        self.get_logger().info(text)

    def _complain(self, text: str) -> None:
        self.get_logger().error(text)

    def _warn(self, kind: str, text: str) -> None:
        remark = self._throttle.passes(kind)
        if remark is not None:
            self.get_logger().warning(text + remark)

    def _heard(self, listened: _Input) -> str:
        return report.publishers(self.get_publishers_info_by_topic(listened.topic), listened.profile)


def _nanoseconds(stamp: Any) -> int:
    """Of a header; rclpy's Time refuses stamps before 1970, which a message can hold."""
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)
