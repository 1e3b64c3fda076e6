"""The node behind recover_node and fitter_node: depth images in, superquadrics out; its topics are in docs/nodes.md.

The stages of an image:

    input.Input -> frame.decode -> engine.Engine.recover -> tracking.Tracking.identify -> outputs.Outputs.answer

The executor's thread only stores messages; one worker thread processes the newest, so that services and parameters
respond at once.  Every output has the stamp of the input.  Results of orthographic frames are in the cube frame of
:mod:`sq_perception.imaging.unit_cube`, others in the optical frame or ``target_frame``.

A lifecycle node (:mod:`sq_perception.nodes.managed_node`): configuring loads the network and warms up, activating
subscribes, deactivating unsubscribes after the current frame, cleaning up frees the network's memory.
"""

from __future__ import annotations

import math
import threading
import traceback
from collections.abc import Mapping
from time import monotonic, perf_counter
from types import MappingProxyType
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.action import ActionServer, CancelResponse
from rclpy.callback_groups import CallbackGroup, ReentrantCallbackGroup
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from sq_msgs_py import answers
from sq_perception.geometry import kernel_cache
from sq_perception.imaging import unit_cube
from sq_perception.nodes import process
from sq_perception.nodes.engine import TURNS, Answer, Engine
from sq_perception.nodes.frame import Frame, stamp_of
from sq_perception.nodes.input import Arrival, Input
from sq_perception.nodes.managed_node import STEADY, ManagedNode, optional
from sq_perception.nodes.outputs import Outputs, in_frame, pose_in
from sq_perception.nodes.parameters import LiveParameters, RecoverParameters
from sq_perception.nodes.statistics import OLDEST, THROTTLE, Statistics
from sq_perception.nodes.tracking import CameraPoses, Tracking
from sq_perception.nodes.tracking import Pose as CameraPose
from sq_perception.recordings.publication import Findings, findings
from sq_perception.recovery.recovery import timed
from sq_perception.segmentation.options import Pose
from sq_perception.tracking import association

TRIGGER_TIMEOUT = 5.0
"""Seconds without a frame after which ~/trigger and ~/recover fail, beyond those that an image waits for its
camera_info: five periods of the slowest camera in use."""


class Outcome(NamedTuple):
    """Whether a frame was answered, the summary or the reason, and what was published."""

    is_answered: bool
    text: str
    findings: Findings | None = None


class FrameNode(ManagedNode):
    """Node for depth images; ``kind`` is its parameter dataclass, ``defaults`` override some of its defaults.  Raises
    ParameterError; a model that is missing or wrong is a fault of the configuration."""

    _action: ActionServer | None = None

    def __init__(
        self, name: str, kind: type[RecoverParameters] = RecoverParameters, *, namespace: str | None = None,
        context: Any = None, defaults: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        super().__init__(name, Statistics(), namespace=namespace, context=context)
        self._engine = Engine(self)
        self._settings: LiveParameters[RecoverParameters] = LiveParameters(
            self, kind, locked=self._why_locked, check=self._engine.check, changed=self._engine.follow,
            defaults=defaults,
        )
        self._poses = CameraPoses(self)
        self._tracking = Tracking(self, self._poses)
        self._outputs = Outputs(self)
        self._input: Input | None = None
        self._worker: threading.Thread | None = None
        self._enabled = True
        self._publishing = threading.Lock()
        """Held while publishing, or while deciding that nothing is published any more."""
        self._defects = 0
        self._triggers: dict[Future, float] = {}
        """Outcomes that callers of ~/trigger and ~/recover wait for, and the start of the wait."""
        self.create_service(SetBool, "~/enable", self._on_enable)
        # Their answers wait for a frame; in the default group nothing else would run meanwhile.
        apart = ReentrantCallbackGroup()
        self.create_service(Trigger, "~/trigger", self._on_trigger, callback_group=apart)
        self.create_service(Trigger, "~/recover", self._on_recover, callback_group=apart)
        optional(
            self, self.create_service, "sq_msgs/srv/Recover", "~/recover_array", self._on_recover_array,
            callback_group=apart,
        )
        self._action = optional(self, self._serve_images, "sq_msgs/action/Recover", apart)
        self.start(self._settings.current.autostart)

    # The lifecycle

    def _configure(self) -> None:
        parameters = self._settings.current
        started = perf_counter()
        self.get_logger().info("warming up: loading compiled code, or compiling it on the first start")
        kernel_cache.compile_beside()
        self._engine.build(parameters)
        association.warm_up()
        self.get_logger().info(f"warm after {perf_counter() - started:.1f} s")
        latest = self._settings.current
        self._outputs.open(latest)
        if latest.fixed_frame or latest.target_frame or latest.camera_frame:
            self._poses.listen()
        process.keep_objects()

    def _activate(self) -> None:
        self._defects = 0
        self._input = source = Input(self, self._settings, self._is_wanted, self._statistics)
        self._worker = threading.Thread(target=self._work, args=(source,), name="worker", daemon=True)
        self._worker.start()
        self.get_logger().info(f"ready, listening to {source.topic}")

    def _deactivate(self) -> None:
        self._stop()
        with self._publishing:
            self._outputs.optional.withdraw()
            self._outputs.hide()

    def _cleanup(self) -> None:
        self._stop()
        with self._publishing:
            self._outputs.close()
        self._poses.close()
        self._engine.release()
        process.release_objects()  # nothing of a network may hang on in a cycle of references

    def _stop(self) -> None:
        """End subscriptions and worker.  Planners keep their obstacles when a camera fails."""
        with self._publishing:
            source, self._input = self._input, None
        if source is not None:
            source.close()
        self._resolve(Outcome(False, "the node has been deactivated"))
        if self._worker is not None:
            self._worker.join(3.0)
            if self._worker.is_alive():
                self.get_logger().warning("the current frame takes long; it is the last one and is not published")

    def close(self) -> bool:
        """Close as :meth:`ManagedNode.close`; also False while a frame is in progress."""
        return super().close() and (self._worker is None or not self._worker.is_alive())

    def destroy_node(self) -> None:
        """Destroy the node as rclpy does, and its action."""
        action, self._action = self._action, None
        if action is not None:
            action.destroy()
        super().destroy_node()

    def _why_locked(self) -> str:
        """Return why parameters that are read at configuration cannot change now; empty if they can."""
        if not self.is_configured:
            return ""
        name = self.get_fully_qualified_name()
        return (
            f"is read when the node is configured (autostart: started), and it is {self.state}: ros2 lifecycle set "
            f"{name} deactivate, then cleanup; set it; configure, activate"
        )

    # The worker

    def _work(self, source: Input) -> None:
        while source.wait():
            arrival: Arrival | None = None
            outcome: Outcome | None = None
            try:
                with TURNS:
                    # Taken when the turn has come: while others were computing, a newer one may have arrived.
                    arrival = source.take()
                    found = self._recover(source, arrival) if arrival is not None and self._is_wanted() else None
                with self._publishing:
                    # Deactivated or disabled meanwhile: nothing is published.
                    if arrival and found and self._input is source and self._is_wanted():
                        outcome = self._publish(arrival, *found)
                        self._defects = 0
            except ValueError as error:
                outcome = Outcome(False, str(error))
            except Exception as error:
                if not self.context.ok() or self._input is not source:
                    self._statistics.count("dropped", int(arrival is not None))
                    return
                outcome = Outcome(False, f"{type(error).__name__}: {error}")
                self.get_logger().error(traceback.format_exc(), throttle_duration_sec=THROTTLE)
                self._defects += 1
                if self._defects == 10:
                    self._engine.discard()
                    self._fail(f"10 frames in a row failed, the last one by {outcome.text}")
            if arrival is not None:
                self._conclude(arrival, outcome)

    def _conclude(self, arrival: Arrival, outcome: Outcome | None) -> None:
        """Count a frame by its outcome, None if it was dropped, and answer whoever waits for one."""
        was_wanted = self._is_wanted()
        if outcome is None:
            self._statistics.count("dropped")
        else:
            if not outcome.is_answered:
                self._statistics.refuse(outcome.text)
                self.get_logger().warning(f"refused a frame: {outcome.text}", throttle_duration_sec=THROTTLE)
            self._resolve(outcome, arrival.time)
        if not was_wanted:
            with self._publishing:
                self._outputs.hide()

    def _is_wanted(self) -> bool:
        """Return whether frames are processed or one was requested."""
        return self._enabled or any(not trigger.done() for trigger in tuple(self._triggers))

    def _recover(self, source: Input, arrival: Arrival) -> tuple[Frame, Answer, dict[str, float]]:
        """Return the frame of an image, its bodies, and the duration of each stage in milliseconds."""
        parameters = self._settings.current
        stages = {"wait": 1e3 * (monotonic() - arrival.time)}
        self._poses.follow(stamp_of(arrival.message))
        view: tuple[str, CameraPose] | None = None
        if parameters.camera_frame:
            view = parameters.camera_frame, self._find_pose(arrival.message.header, parameters, "camera_frame")
        with timed(stages, "decode"):
            frame = source.frame(arrival, parameters, view)
        pose: Pose | None = unit_cube.POSE if frame.is_cube else None
        if pose is None and parameters.target_frame and parameters.box is not None:  # the workspace, in that frame
            turn, shift = self._find_pose(frame.header, parameters, "target_frame")
            pose = tuple(turn.tolist()), tuple(shift.tolist())
        answer = self._engine.recover(frame, parameters, pose)
        stages |= {f"recovery: {name}": took for name, took in answer[0].milliseconds.items()}
        return frame, answer, stages

    def _find_pose(self, header: Any, parameters: RecoverParameters, name: str) -> CameraPose:
        """Return the pose of a header's frame in that of a parameter; wait for it while other cameras compute."""
        frame = getattr(parameters, name)
        try:
            return pose_in(self._poses, header, frame, 0.0, name)
        except ValueError:
            with TURNS.pause():
                return pose_in(self._poses, header, frame, parameters.tf_tolerance, name)

    def _publish(self, arrival: Arrival, frame: Frame, answer: Answer, stages: dict[str, float]) -> Outcome | None:
        """Name and publish the bodies; None if they are no longer wanted."""
        parameters = self._settings.current
        with timed(stages, "tracking"):
            found = self._tracking.identify(*answer, frame, arrival.time, parameters)
        with timed(stages, "publish"):
            here = findings(found, frame.header, frame.is_cube)
            shown = in_frame(here, self._poses, parameters.target_frame, parameters.tf_tolerance)
            # Both may have waited for transforms.  Disabled meanwhile: least of all a grasped body is published.
            if not self._is_wanted():
                return None
            self._outputs.answer(shown)
        age = 1e-9 * (self.get_clock().now().nanoseconds - stamp_of(frame))
        if abs(age) < OLDEST:
            stages["stamp to result"] = 1e3 * age
        self._outputs.accompany(found, shown, frame, parameters, stages)
        summary = found.summary(frame.is_cube)
        self._statistics.answer(stages, summary)
        if found.recovery.doubt:
            self._statistics.doubt(found.recovery.doubt)
            self.get_logger().warning(found.recovery.message, throttle_duration_sec=THROTTLE)
        elif found.recovery.bodies and found.recovery.message:
            self.get_logger().info(found.recovery.message, throttle_duration_sec=THROTTLE)
        return Outcome(True, summary, shown)

    def _resolve(self, outcome: Outcome, arrived: float = math.inf) -> None:
        """Answer requests that were waiting when the frame arrived, at ``arrived`` of the monotonic clock."""
        for caller, since in tuple(self._triggers.items()):
            if since <= arrived and not caller.done():
                caller.set_result(outcome)
                if self.executor is not None:
                    self.executor.wake()  # a future that is awaited does not do that itself

    # Services and diagnostics, in the executor's thread

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._enabled = bool(request.data)
        if not self._is_wanted() and self._publishing.acquire(blocking=False):  # otherwise the worker does it
            try:
                self._outputs.hide()
            finally:
                self._publishing.release()
        response.success = True
        response.message = "enabled" if self._enabled else "disabled: frames are dropped, ~/trigger still works"
        return response

    async def _on_trigger(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message, _ = await self._next_outcome()
        return response

    async def _on_recover(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message, found = await self._next_outcome()
        if found is not None:
            response.message = answers.text_of(found.array, found.header, response.message)
        return response

    async def _on_recover_array(self, request: Any, response: Any) -> Any:
        response.success, response.message, found = await self._next_outcome()
        if found is not None:
            response.bodies = answers.superquadric_array(found.array, found.covariances, found.header, found.parts)
        return response

    def _serve_images(self, kind: Any, group: CallbackGroup) -> ActionServer:
        async def recover_images(goal: Any) -> Any:
            """Recover as many images as the goal asks for; the first failure ends it."""
            result = kind.Result()
            for _ in range(max(int(goal.request.images), 1)):
                if goal.is_cancel_requested:
                    goal.canceled()
                    return result
                result = await self._on_recover_array(None, kind.Result())
                if not result.success:
                    goal.abort()
                    return result
                goal.publish_feedback(kind.Feedback(bodies=result.bodies))
            goal.succeed()
            return result

        accept = {"cancel_callback": lambda _: CancelResponse.ACCEPT}
        return ActionServer(self, kind, "~/recover_images", recover_images, callback_group=group, **accept)

    async def _next_outcome(self) -> Outcome:
        """Return the outcome of the next frame, or why there is none."""
        source = self._input
        if source is None:
            return Outcome(False, f"the node is {self.state}, not active")
        caller = Future(executor=self.executor)
        self._triggers[caller] = monotonic()
        # In a group of its own: rclpy's remember for good what was destroyed.
        alone = ReentrantCallbackGroup()
        waited = TRIGGER_TIMEOUT + self._settings.current.patience
        late = self.create_timer(waited, caller.cancel, callback_group=alone, clock=STEADY)
        outcome: Outcome | None = await caller
        self.destroy_timer(late)
        del self._triggers[caller]
        if outcome is None and source.silence < waited:
            return Outcome(False, f"of the images on {source.topic} none was recovered within {waited:g} s")
        return outcome or Outcome(False, f"no frame on {source.topic} within {waited:g} s: {source.heard}")

    def _on_second(self) -> None:
        source, parameters = self._input, self._settings.current
        silent = False
        if source is not None:
            source.follow_publishers()
            silent = 0 < parameters.no_frame_warning < source.silence
            if silent:
                text = f"no depth image on {source.topic} for {source.silence:.0f} s: {source.heard}"
                self.get_logger().warning(text, throttle_duration_sec=THROTTLE)
        more = {"enabled": str(self._enabled).lower(), "engine": self._engine.description}
        if absent := self._outputs.optional.absent:
            more["missing packages"] = " ".join(absent.values())
        if self.is_active and parameters.tracking:
            tally = self._tracking.tally
            more |= {"tracks": str(tally.tracks), "track ids given": str(tally.births)}
            more |= {"track resets": str(tally.resets), "frames without camera pose": str(tally.without_pose)}
        standing = self.standing(self._engine.fault)
        if standing is None and not self._enabled:
            standing = DiagnosticStatus.OK, "disabled"
        elif standing is None and silent:
            standing = DiagnosticStatus.WARN, "no depth images arrive"
        self.report(standing, more)
