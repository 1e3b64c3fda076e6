"""Lifecycle, swaps and several nodes: what an integrator's manager, operator and launch file do to a frame node."""

from __future__ import annotations

import gc
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs the extra 'ros'")

import frame_node_bench
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from frame_node_bench import CAMERA, ball, counts_of, stand_ins
from lifecycle_msgs.msg import Transition, TransitionEvent
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from spun_nodes import PATIENCE, SpunNodes
from stand_in_tf2 import Tf2
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from sq_msgs_py.depth_image import depth_to_message, intrinsics_to_message, labels_to_message
from sq_msgs_py.superquadrics import from_message
from sq_perception.imaging.calibration import intrinsics
from sq_perception.nodes import managed_node
from sq_perception.nodes.frame_node import FrameNode
from sq_perception.recovery.recoverer import FrameRecovery


class Recoverer(frame_node_bench.Recoverer):
    """Answers one ball of the size that its model's name says, in centimetres."""

    def __init__(self, model: str) -> None:
        super().__init__()
        self.bodies = (ball(radius=0.01 * float(model or 1)),)
        self.at_work = self.most_at_work = 0
        self.duration = 0.0

    def recover(self, *given: Any) -> FrameRecovery:
        self.at_work += 1
        self.most_at_work = max(self.most_at_work, self.at_work)
        time.sleep(self.duration)
        self.at_work -= 1
        return super().recover(*given)


class Bench(SpunNodes):
    """Frame nodes whose recoverers the test makes, and a peer, spun by an executor of the test's choice."""

    def __init__(self, *arguments: str, namespaces: tuple[str, ...] = ("",), executor: Any = None) -> None:
        super().__init__("-p", "tracking:=false", *arguments)
        self.made: list[Recoverer] = []
        self.fault: Exception | None = None
        self.gate = threading.Event()
        self.gate.set()
        self.stand_ins = stand_ins(self._make, lambda model: Path(f"{id(self)} {model}"), self._check)
        self.stand_ins.start()
        self.events: list[str] = []
        self.reports: list[DiagnosticStatus] = []
        self.peer.create_subscription(
            TransitionEvent, "/recover_node/transition_event", lambda e: self.events.append(e.goal_state.label), 50
        )
        self.peer.create_subscription(DiagnosticArray, "/diagnostics", lambda m: self.reports.extend(m.status), 50)
        at = {space: f"/{space}" if space else "" for space in namespaces}
        self.answers = {one: self.hear(PointCloud2, f"{at[one]}/recover_node/superquadrics", 50) for one in at}
        self.images = {one: self.peer.create_publisher(Image, f"{at[one]}/depth/image", 5) for one in at}
        self.infos = {one: self.peer.create_publisher(CameraInfo, f"{at[one]}/depth/camera_info", 5) for one in at}
        self.nodes = [FrameNode("recover_node", namespace=space or None, context=self.context) for space in namespaces]
        self.node = self.nodes[0]
        self.spin(self.nodes, executor)
        self.stamps = 0

    def _check(self, model: str) -> None:
        if not model.isdigit():
            raise ValueError(f"{model} is no model")

    def _make(self, model: str | None, *_: Any, **__: Any) -> Recoverer:
        assert self.gate.wait(PATIENCE)
        if self.fault is not None:
            raise self.fault
        self.made.append(Recoverer(model or ""))
        return self.made[-1]

    def close(self) -> None:
        self.gate.set()
        for node in self.nodes:
            self.until(lambda node=node: node.close() or not node.is_configured)
        super().close()
        self.stand_ins.stop()

    def change(self, transition: int, label: str = "") -> bool:
        request = ChangeState.Request(transition=Transition(id=transition, label=label))
        return bool(self.call(ChangeState, "/recover_node/change_state", request).success)

    def bring_up(self) -> Bench:
        assert self.change(Transition.TRANSITION_CONFIGURE)
        assert self.change(Transition.TRANSITION_ACTIVATE)
        return self.active()

    def state(self) -> str:
        return str(self.call(GetState, "/recover_node/get_state").current_state.label)

    def active(self) -> Bench:
        for space, node in zip(self.answers, self.nodes, strict=True):
            self.until(lambda node=node: node.is_active)
            self.until(lambda space=space: self.images[space].get_subscription_count() >= 1)
            self.until(lambda space=space: self.infos[space].get_subscription_count() >= 1)
            self.until(lambda node=node: node._outputs.superquadrics.get_subscription_count() >= 1)
        return self

    def publish(self, space: str = "", value: float = 0.5) -> Header:
        self.stamps += 1
        header = Header(stamp=Time(sec=1000 + self.stamps), frame_id=f"{space}_camera")
        self.infos[space].publish(intrinsics_to_message(intrinsics(CAMERA), header))
        self.images[space].publish(depth_to_message(np.full((48, 64), value), header))
        return header

    def answer(self, space: str = "") -> float:
        """Publish frames until one is answered: the half size of the body, centimetres.

        More than one, as a subscription that has just been made may not be matched yet.
        """
        sent: list[Header] = []
        last = -1.0

        def answered() -> PointCloud2 | None:
            nonlocal last
            if time.monotonic() - last > 1.0:
                sent.append(self.publish(space))
                last = time.monotonic()
            return next((one for one in self.answers[space] if one.header in sent), None)

        self.until(answered)
        message = answered()
        assert message is not None
        return round(100 * float(from_message(message).size[0, 0]), 6)

    def report(self, condition: Callable[[DiagnosticStatus], bool]) -> None:
        self.until(lambda: any(condition(one) for one in self.reports[-3:]))

    def publish_refused(self, frames: int) -> None:
        for _ in range(frames):
            before = counts_of(self.node).refused
            self.publish()
            self.until(lambda before=before: counts_of(self.node).refused > before)


@pytest.fixture
def make_bench() -> Iterator[Callable[..., Bench]]:
    with ExitStack() as benches:
        yield lambda *arguments, **options: benches.enter_context(Bench(*arguments, **options))


class TestLifecycle:
    def test_it_brings_itself_up_and_may_be_led_through_every_state(self, make_bench):
        bench = make_bench().active()
        assert bench.answer() == 1.0
        bench.until(lambda: bench.peer.count_publishers("/recover_node/transition_event") == 1)
        assert bench.change(Transition.TRANSITION_DEACTIVATE)
        assert bench.state() == "inactive"
        bench.until(lambda: bench.events[-2:] == ["deactivating", "inactive"])
        bench.until(lambda: bench.images[""].get_subscription_count() == 0)
        refused = bench.call(Trigger, "/recover_node/trigger")
        assert (refused.success, refused.message) == (False, "the node is inactive, not active")
        assert bench.change(Transition.TRANSITION_ACTIVATE)
        assert bench.active().answer() == 1.0

        watched = weakref.ref(bench.made[-1])
        assert bench.change(0, "deactivate")
        assert bench.change(0, "cleanup")
        assert bench.state() == "unconfigured"
        bench.made.clear()
        gc.collect()
        assert watched() is None, "the network is still in memory after the cleanup"
        assert bench.bring_up().answer() == 1.0
        assert len(bench.made) == 1
        assert bench.change(Transition.TRANSITION_ACTIVE_SHUTDOWN)
        assert bench.state() == "finalized"

    def test_without_autostart_it_waits_and_every_parameter_may_be_set(self, make_bench):
        bench = make_bench("-p", "autostart:=false")
        assert bench.state() == "unconfigured"
        assert not bench.made
        for projection in ("orthographic", "pinhole"):
            bench.set(bench.node, projection=projection)
        bench.report(lambda one: one.level == DiagnosticStatus.OK and one.message == "unconfigured")
        assert bench.change(Transition.TRANSITION_CONFIGURE)
        assert bench.state() == "inactive"
        refused = bench.node.set_parameters([Parameter("projection", value="orthographic")])[0]
        assert not refused.successful
        assert "it is inactive: ros2 lifecycle set /recover_node deactivate, then cleanup" in refused.reason
        assert bench.change(Transition.TRANSITION_ACTIVATE)
        assert bench.active().answer() == 1.0

    def test_a_transition_that_is_not_allowed_is_refused_and_the_node_goes_on(self, make_bench):
        bench = make_bench().active()
        numbers = (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE, Transition.TRANSITION_CLEANUP, 99)
        for transition, label in (*((number, "") for number in numbers), (0, ""), (0, "nonsense"), (0, "destroy")):
            assert not bench.change(transition, label)
            assert bench.state() == "active"
        assert bench.answer() == 1.0

    def test_a_configuration_that_fails_goes_through_the_error_state_and_says_why(self, make_bench):
        bench = make_bench("-p", "autostart:=false")
        bench.until(lambda: bench.peer.count_publishers("/recover_node/transition_event") == 1)
        bench.fault = ValueError("weights.safetensors: no such model file")
        assert bench.state() == "unconfigured"
        assert not bench.change(Transition.TRANSITION_CONFIGURE)
        assert bench.state() == "unconfigured"
        bench.until(lambda: "unconfigured" in bench.events)
        assert bench.events == ["configuring", "errorprocessing", "unconfigured"]
        reason = "cannot configure: weights.safetensors: no such model file"
        bench.report(lambda one: one.level == DiagnosticStatus.ERROR and one.message == f"unconfigured: {reason}")
        bench.node.start()
        bench.until(lambda: bench.node.start_failure)
        assert bench.node.start_failure == reason, "as the process is told"
        bench.fault = None
        assert bench.bring_up().answer() == 1.0
        bench.report(lambda one: one.level == DiagnosticStatus.OK)

    def test_a_device_that_fails_frame_after_frame_is_started_anew(self, make_bench, monkeypatch):
        monkeypatch.setattr(managed_node, "_PAUSE", 0.1)
        bench = make_bench().active()
        assert bench.answer() == 1.0
        bench.made[0].error = ValueError("a hard frame")
        bench.publish_refused(12)
        bench.made[0].error = None
        assert bench.answer() == 1.0
        assert len(bench.made) == 1, "bad frames are no reason"
        bench.made[0].error = ZeroDivisionError("device lost")
        bench.publish_refused(10)
        bench.until(lambda: len(bench.made) == 2)  # another one, though the first is still there to be shared
        assert bench.active().answer() == 1.0
        assert bench.node.fault == ""

    def test_a_device_that_does_not_come_back_ends_the_process(self, make_bench, monkeypatch):
        monkeypatch.setattr(managed_node, "_PAUSE", 0.1)
        bench = make_bench().active()
        bench.answer()
        bench.made[0].error = ZeroDivisionError("device lost")
        bench.fault = RuntimeError("no device")
        bench.publish_refused(10)
        bench.until(lambda: bench.node.start_failure)
        assert bench.node.start_failure == "cannot configure: no device"

    def test_planners_keep_their_obstacles_when_the_camera_fails_but_not_when_it_is_switched_off(
        self, make_bench, monkeypatch
    ):
        monkeypatch.setattr(managed_node, "_PAUSE", 0.1)
        monkeypatch.setattr(managed_node, "_END", 60.0)  # on a busy machine
        bench = make_bench().active()
        withdrawn = []
        monkeypatch.setattr(bench.node._outputs.optional, "withdraw", lambda: withdrawn.append(bench.node.state))
        bench.node._fail("device lost")
        bench.until(lambda: len(bench.made) == 1 and bench.node.state == "unconfigured")
        bench.active()
        assert withdrawn == []
        assert bench.change(Transition.TRANSITION_DEACTIVATE)
        assert withdrawn == ["deactivating"]
        assert bench.change(Transition.TRANSITION_ACTIVATE)
        bench.active()
        assert bench.node.close()
        assert bench.node.state == "finalized"
        assert withdrawn == ["deactivating"]


class TestSwap:
    def test_the_next_frame_has_the_model_that_was_set_last(self, make_bench):
        bench = make_bench().active()
        bench.set(bench.node, s=3)
        assert bench.answer() == 1.0
        assert len(bench.made) == 1, "what does not concern the recoverer swaps nothing"
        for model in ("2", "4", "3"):
            bench.set(bench.node, model=model)
        assert bench.answer() == 3.0
        assert bench.node._engine.description == "method auto, 3 on cpu"
        assert len(bench.made) == 2
        assert bench.made[-1].warm is not None

    def test_a_model_that_cannot_work_is_refused_or_leaves_the_old_one(self, make_bench):
        bench = make_bench().active()
        refused = bench.node.set_parameters([Parameter("model", value="bad")])[0]
        assert (refused.successful, refused.reason) == (False, "model: bad is no model")
        bench.fault = MemoryError("no room for weights")
        bench.set(bench.node, model="4")
        assert bench.answer() == 1.0
        reason = "cannot change to method auto, 4 on cpu: no room for weights"
        bench.report(lambda one: one.level == DiagnosticStatus.WARN and one.message == reason)
        bench.fault = None
        bench.set(bench.node, model="4")
        assert bench.answer() == 4.0
        assert bench.node._engine.fault == ""

    def test_services_answer_while_a_model_loads_and_another_one_that_is_set_then_follows_it(self, make_bench):
        bench = make_bench("-p", "autostart:=false")
        bench.gate.clear()
        bench.node.start()
        bench.until(lambda: bench.node.state == "configuring")
        assert bench.state() == "configuring"
        bench.set(bench.node, model="6")
        assert not bench.made
        bench.gate.set()
        assert bench.active().answer() == 6.0


class TestSeveralCameras:
    @pytest.mark.parametrize("executor", [SingleThreadedExecutor, MultiThreadedExecutor, EventsExecutor])
    def test_two_cameras_in_one_process_share_a_recoverer_and_do_not_mix(self, make_bench, executor):
        bench = make_bench(namespaces=("front", "wrist"), executor=lambda context: executor(context=context)).active()
        assert len(bench.made) == 1
        bench.made[0].duration = 0.02
        for _ in range(5):
            for space in ("front", "wrist"):
                assert bench.answer(space) == 1.0
        for space in ("front", "wrist"):
            assert {one.header.frame_id for one in bench.answers[space]} == {f"{space}_camera"}
        bench.set(bench.nodes[1], model="7")
        assert (bench.answer("front"), bench.answer("wrist")) == (1.0, 7.0), "a swap leaves the other alone"

    def test_one_frame_at_a_time_and_nobody_starves(self, make_bench):
        bench = make_bench(namespaces=("front", "wrist")).active()
        for space in ("front", "wrist"):
            bench.answer(space)
        recoverer = bench.made[0]
        recoverer.duration = 0.02
        counted = {space: len(bench.answers[space]) for space in bench.answers}
        answered = dict.fromkeys(counted, 0)
        deadline = time.monotonic() + PATIENCE
        while sum(answered.values()) < 40:
            assert time.monotonic() < deadline, answered
            for space in ("front", "wrist"):
                bench.publish(space)
            time.sleep(0.004)
            answered = {space: len(bench.answers[space]) - counted[space] for space in bench.answers}
        assert recoverer.most_at_work == 1
        assert min(answered.values()) >= 12, answered

    def test_a_camera_that_waits_for_its_transform_lets_the_other_compute(self, make_bench, monkeypatch):
        waits, over = threading.Event(), threading.Event()
        given_up: list[bool] = []

        def look_up(target: str, source: str, stamp: int, patience: Any) -> Any:
            if patience.nanoseconds:
                waits.set()
                given_up.append(not over.wait(PATIENCE / 3))
            raise LookupError("it does not come")

        Tf2(monkeypatch, look_up)
        bench = make_bench(namespaces=("front", "wrist")).active()
        bench.answer("wrist")
        bench.set(bench.nodes[1], target_frame="base", workspace=[-1.0, -1.0, 0.0, 1.0, 1.0, 2.0])
        bench.publish("wrist")
        bench.until(waits.is_set)
        assert bench.answer("front") == 1.0
        assert not given_up, "it was answered meanwhile"
        over.set()
        bench.until(lambda: "it does not come" in counts_of(bench.nodes[1]).last_error)

    def test_an_override_of_one_camera_leaves_the_other_alone(self, make_bench):
        """rclpy writes overrides into the profile that it is given."""
        override = "qos_overrides./front/recover_node/support_plane.publisher.durability:=volatile"
        bench = make_bench("-p", override, "-p", "autostart:=false", namespaces=("front", "wrist"))
        for node in bench.nodes:
            node.start()
            bench.until(lambda node=node: node.is_active)
        bench.active()
        kept = {}
        for space in ("front", "wrist"):
            (found,) = bench.peer.get_publishers_info_by_topic(f"/{space}/recover_node/support_plane")
            kept[space] = found.qos_profile.durability.name
        assert kept == {"front": "VOLATILE", "wrist": "TRANSIENT_LOCAL"}


def test_masks_that_come_later_than_newer_images_are_waited_for(make_bench):
    bench = make_bench("-p", "use_masks:=always", "-p", "patience:=5.0").active()
    masks = bench.peer.create_publisher(Image, "mask/image", 5)
    bench.until(masks.get_subscription_count)
    headers = []
    for number in range(4):
        headers.append(bench.publish())
        bench.until(lambda number=number: counts_of(bench.node).received == number + 1)
    masks.publish(labels_to_message(np.ones((48, 64), np.int32), headers[1]))
    bench.until(lambda: [one.header for one in bench.answers[""]] == [headers[1]])
    masks.publish(labels_to_message(np.ones((48, 64), np.int32), headers[3]))
    bench.until(lambda: [one.header for one in bench.answers[""]] == [headers[1], headers[3]])
    counts = counts_of(bench.node)
    assert (counts.dropped, counts.refused) == (2, 0)
