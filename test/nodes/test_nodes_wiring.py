"""The frame node between real publishers and subscribers, around a recoverer that does what the test says."""

import time
from dataclasses import fields
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs the extra 'ros'")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from frame_node_bench import CAMERA, FRAME_ID, Bench
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.msg import Log
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger

from sq_msgs_py.answers import from_response
from sq_msgs_py.depth_image import grey_to_message, labels_to_message
from sq_msgs_py.poses import plane_of
from sq_msgs_py.superquadrics import MessageError
from sq_perception.imaging import unit_cube
from sq_perception.imaging.camera import Camera
from sq_perception.nodes import frame_node, process
from sq_perception.nodes import input as input_module
from sq_perception.nodes.frame import latched_qos, stamp_of
from sq_perception.nodes.statistics import WITHOUT_MASK


def test_stamp_frame_and_numbers_arrive(bench):
    image = bench.depth()
    message, found = bench.answer(image)
    assert message.header == image.header
    np.testing.assert_allclose(found.translation, [[0.01, 0.02, 0.5]])
    np.testing.assert_allclose(found.size, 0.1)
    assert np.isnan(found.sigma_size).all()
    assert (found.id.tolist(), found.status.tolist()) == ([1], [0])
    depth, camera, labels, options = bench.recoverer.asked[-1]
    assert camera == CAMERA
    assert labels is None
    assert (depth == np.float32(0.5)).all()
    assert (options.method, options.sharpness, options.tau) == ("auto", 117.3, 4.82)


def ask_for_next(bench: Bench, service: str) -> Any:
    asked = bench.ask(Trigger, f"/recover_node/{service}")
    bench.until(lambda: bench.node._triggers)
    return asked


def mask_publisher(bench: Bench) -> Any:
    masks = bench.peer.create_publisher(Image, "mask/image", 5)
    bench.until(lambda: masks.get_subscription_count() and bench.node.count_publishers("/mask/image"))
    return masks


def with_fields(message: Image, **fields: Any) -> Image:
    for name, value in fields.items():
        setattr(message, name, value)
    return message


MOST = 2**32 - 1
BROKEN = [
    ("encoding: expected 16UC1 or 32FC1, got 'yuv422'", {"encoding": "yuv422"}),
    ("projection = orthographic", {"encoding": "mono8", "step": 64, "data": bytes(48 * 64)}),
    ("data", {"data": []}),
    ("data", {"height": 49}),
    ("step", {"height": MOST, "width": MOST, "step": MOST}),
    ("image size", {"height": 0, "width": 0, "step": 0, "data": []}),
]


def test_broken_images_are_refused_with_a_reason_and_the_node_goes_on(bench):
    for number, (words, wrong) in enumerate(BROKEN, start=1):
        counts = bench.send(with_fields(bench.depth(), **wrong))
        assert counts.refused == number, wrong
        assert words in counts.last_error, wrong
    assert not bench.recoverer.asked
    assert not bench.answers
    _, found = bench.answer(bench.depth())
    assert len(found) == 1
    assert bench.counts.answered == 1


def test_no_camera_info_or_a_useless_one_refuses_frames_with_a_reason_until_a_good_one_comes(make_bench):
    bench = make_bench()
    said = bench.send(bench.depth()).last_error
    assert all(words in said for words in ("/depth/camera_info", "none came", "1 publisher: /peer"))
    bench.put_info(CameraInfo())
    assert "is for 0 x 0" in bench.send(bench.depth()).last_error
    zero = CameraInfo(width=64, height=48)
    bench.put_info(zero)
    assert "not calibrated" in bench.send(bench.depth()).last_error
    zero.k = [float("nan")] * 9
    bench.put_info(zero)
    assert "finite" in bench.send(bench.depth()).last_error
    bench.send_info(Camera(32, 24, 30.0, 30.0, 15.5, 11.5))
    bench.send_info()
    assert (len(bench.answer(bench.depth())[1]), bench.counts.refused) == (1, 4)


def test_frames_may_change_their_size(bench):
    small = Camera(20, 10, 33.0, 33.0, 9.5, 4.5)
    bench.send_info(small)
    for camera in (CAMERA, small, CAMERA, small):
        bench.answer(bench.depth(camera))
        assert bench.recoverer.asked[-1][1] == camera
    other = Camera(21, 10, 33.0, 33.0, 9.5, 4.5)
    assert "expected one for 21 x 10 pixels, the last one is for 20 x 10" in bench.send(bench.depth(other)).last_error


def test_a_camera_info_that_comes_after_its_image_or_changes_is_waited_for(make_bench):
    """As with a region of interest that moves: a driver publishes it after its image, and another one's shifts it."""
    bench = make_bench("-p", "patience:=10.0")
    for left in range(4):
        image, camera = bench.depth(), Camera(64, 48, 60.0, 60.0, 31.5 - 4 * left, 23.5)
        info = bench.info(camera)
        info.header.stamp = image.header.stamp
        before = bench.counts.received
        bench.images.publish(image)
        bench.until(lambda before=before: bench.counts.received > before)
        time.sleep(0.02)  # in which an image that waits for nothing is taken
        bench.put_info(info)
        bench.until(lambda: bench.counts.in_work == 0)
        if left != 1:  # the first change that there was could not be expected
            assert bench.recoverer.asked[-1][1] == camera
    assert (bench.counts.answered, bench.counts.refused) == (4, 0)


def test_a_camera_info_that_changed_without_the_stamps_of_images_is_not_waited_for(make_bench):
    bench = make_bench("-p", "patience:=10.0")
    for left in (0, 4):
        bench.send_info(camera := Camera(64, 48, 60.0, 60.0, 31.5 - left, 23.5))
    began = time.monotonic()
    bench.answer(bench.depth())
    assert bench.recoverer.asked[-1][1] == camera
    assert time.monotonic() - began < 5.0


def test_the_newest_frame_wins_and_every_frame_is_accounted_for(bench):
    bench.recoverer.gate.clear()
    bench.images.publish(bench.depth())
    bench.until(lambda: len(bench.recoverer.asked) == 1)
    for number in range(2, 8):
        bench.images.publish(bench.depth(value=0.1 * number))
        bench.until(lambda number=number: bench.counts.received == number)
    assert bench.counts.in_work == 2
    bench.recoverer.gate.set()
    bench.until(lambda: bench.counts.in_work == 0)
    counts = bench.counts
    assert (counts.received, counts.answered, counts.dropped, counts.refused) == (7, 2, 5, 0)
    assert bench.recoverer.asked[-1][0][0, 0] == np.float32(0.7)


def test_a_defect_costs_one_frame_and_not_the_node_and_no_bodies_are_an_answer(bench):
    bench.recoverer.error = ZeroDivisionError("made up")
    counts = bench.send(bench.depth())
    assert (counts.refused, counts.last_error[21:]) == (1, "ZeroDivisionError: made up")
    bench.recoverer.error = ValueError("no good")
    assert bench.send(bench.depth()).last_error.endswith(" no good")
    bench.recoverer.error, bench.recoverer.bodies = None, ()
    message, found = bench.answer(bench.depth(value=float("nan")))
    assert len(found) == 0
    assert message.width == 0


def test_parameters_take_effect_with_the_next_frame(bench):
    bench.answer(bench.depth())
    bench.set(bench.node, s=3, tau=2.5, depth_min=0.2, depth_max=3, max_objects=4, time_budget=0.5)
    assert not bench.node.set_parameters([Parameter("s", value=-1.0)])[0].successful
    bench.answer(bench.depth())
    before, after = (asked[3] for asked in bench.recoverer.asked)
    assert (before.sharpness, before.depth_range) == (117.3, (0.0, np.inf))
    assert (after.sharpness, after.tau) == (3.0, 2.5)
    assert (after.depth_range, after.max_objects, after.time_budget) == ((0.2, 3.0), 4, 0.5)
    assert before.time_budget == np.inf


def test_enable_and_trigger(bench):
    answer = bench.call(SetBool, "/recover_node/enable", SetBool.Request(data=False))
    assert answer.success
    counts = bench.send(bench.depth())
    assert (counts.answered, counts.dropped) == (0, 1)

    first, second = bench.ask(Trigger, "/recover_node/trigger"), bench.ask(Trigger, "/recover_node/trigger")
    bench.until(lambda: len(bench.node._triggers) == 2)
    bench.send(bench.depth())
    bench.until(lambda: first.done() and second.done())
    assert first.result().success
    assert first.result().message.startswith("1 body in 1 ms; 1 converged 200 x 200 x 200 mm")
    assert bench.send(bench.depth()).dropped == 2

    assert bench.call(SetBool, "/recover_node/enable", SetBool.Request(data=True)).success
    assert len(bench.answer(bench.depth())[1]) == 1


def test_who_asks_once_gets_the_bodies_of_the_next_image(bench):
    """The same columns as the topic's, bit by bit, also while disabled; and why there are none."""
    assert bench.call(SetBool, "/recover_node/enable", SetBool.Request(data=False)).success
    asked = ask_for_next(bench, "recover")
    message, bodies = bench.answer(bench.depth())
    bench.until(asked.done)
    answer = from_response(asked.result())
    assert len(bodies) == 1
    for column in fields(bodies):
        np.testing.assert_array_equal(getattr(answer.bodies, column.name), getattr(bodies, column.name))
    assert (answer.frame_id, answer.stamp) == (message.header.frame_id, stamp_of(message))
    assert answer.summary.startswith("1 body in 1 ms")

    refused = bench.ask(Trigger, "/recover_node/trigger"), bench.ask(Trigger, "/recover_node/recover")
    bench.until(lambda: len(bench.node._triggers) == 2)
    bench.send(with_fields(bench.depth(), data=[]))
    bench.until(lambda: all(future.done() for future in refused))
    for future in refused:
        with pytest.raises(MessageError, match="data"):
            from_response(future.result())


def test_a_trigger_without_a_frame_answers_in_time_and_nothing_else_waits(make_bench, monkeypatch):
    monkeypatch.setattr(frame_node, "TRIGGER_TIMEOUT", 0.5)
    bench = make_bench("-p", "patience:=0.7")
    bench.send_info()
    future = ask_for_next(bench, "trigger")
    assert bench.call(SetBool, "/recover_node/enable", SetBool.Request(data=True)).success
    bench.until(future.done)
    assert not future.result().success
    assert "no frame on /depth/image within 1.2 s" in future.result().message
    assert "/peer" in future.result().message
    assert len(bench.answer(bench.depth())[1]) == 1


def test_after_disable_nothing_is_published_any_more(bench):
    bench.answer(bench.depth())
    bench.recoverer.gate.clear()
    bench.images.publish(bench.depth())
    bench.until(lambda: len(bench.recoverer.asked) == 2)
    bench.images.publish(bench.depth())
    bench.until(lambda: bench.counts.received == 3)
    assert bench.call(SetBool, "/recover_node/enable", SetBool.Request(data=False)).success
    bench.recoverer.gate.set()
    bench.until(lambda: bench.counts.in_work == 0)
    assert (bench.counts.answered, bench.counts.dropped, len(bench.answers)) == (1, 2, 1)


def test_a_clock_that_stands_still_stops_neither_triggers_nor_reports_of_silence(make_bench, monkeypatch):
    monkeypatch.setattr(frame_node, "TRIGGER_TIMEOUT", 0.5)
    bench = make_bench("-p", "use_sim_time:=true", "-p", "no_frame_warning:=0.5")
    reports = bench.hear(DiagnosticArray, "/diagnostics")
    answer = bench.call(Trigger, "/recover_node/trigger")
    assert (answer.success, answer.message.split(":")[0]) == (False, "no frame on /depth/image within 0.75 s")
    bench.until(lambda: reports and reports[-1].status[0].message == "no depth images arrive")


def test_triggers_leave_nothing_behind(bench):
    bench.answer(bench.depth())
    client = bench.peer.create_client(Trigger, "/recover_node/trigger")
    bench.until(client.service_is_ready)

    def entities() -> int:
        return len(bench.node.default_callback_group.entities) + len(list(bench.node.timers))

    before = entities()
    for _ in range(20):
        future = client.call_async(Trigger.Request())
        bench.until(lambda: len(bench.node._triggers) == 1)
        bench.send(bench.depth())
        bench.until(future.done)
        assert future.result().success
    assert entities() == before


def test_masks_of_the_same_stamp_are_used(bench):
    masks = mask_publisher(bench)
    bench.node._input._on_mask(labels_to_message(np.ones((48, 64), np.int32), Header()))
    image = bench.depth()
    image.header = Header(frame_id=FRAME_ID)
    bench.answer(image)
    assert bench.recoverer.asked[-1][2] is None, "no stamp belongs to no image"

    image = bench.depth()
    labels = np.zeros((48, 64), np.int32)
    labels[3:9, 4:8] = 7
    masks.publish(labels_to_message(labels, image.header))
    bench.answer(image)
    np.testing.assert_array_equal(bench.recoverer.asked[-1][2], labels)

    masks.publish(labels_to_message(labels, bench.header()))
    bench.answer(bench.depth())
    assert bench.recoverer.asked[-1][2] is None
    assert bench.node._statistics._counts[WITHOUT_MASK] == 2

    image = bench.depth()
    masks.publish(labels_to_message(labels[:10], image.header))
    assert "mask: expected the size of the depth image, 64 x 48, got 64 x 10" in bench.send(image).last_error

    bench.set(bench.node, use_masks="always")
    assert "use_masks is always" in bench.send(bench.depth()).last_error

    bench.set(bench.node, use_masks="never")
    image = bench.depth()
    masks.publish(labels_to_message(labels, image.header))
    bench.answer(image)
    assert bench.recoverer.asked[-1][2] is None


def test_a_mask_that_comes_while_the_node_is_busy_is_used(make_bench):
    """The image's patience is at an end, and its turn has not come."""
    bench = make_bench("-p", "patience:=0.0")
    bench.send_info()
    masks = mask_publisher(bench)
    bench.set(bench.node, use_masks="never")
    bench.recoverer.gate.clear()
    bench.images.publish(bench.depth())
    bench.until(lambda: len(bench.recoverer.asked) == 1)
    bench.set(bench.node, use_masks="always")
    image = bench.depth()
    bench.images.publish(image)
    bench.until(lambda: bench.node._input._ready is not None)
    masks.publish(labels_to_message(np.full((48, 64), 3, np.int32), image.header))
    bench.until(lambda: bench.node._input._masks)
    bench.recoverer.gate.set()
    bench.until(lambda: bench.counts.in_work == 0)
    assert (bench.counts.answered, bench.counts.refused) == (2, 0), bench.counts.last_error
    assert (bench.recoverer.asked[-1][2] == 3).all()
    assert not bench.node._input._masks


def test_images_whose_masks_never_come_are_answered_before_too_many_wait(make_bench):
    """A mask network that hangs, and more images within the patience than are kept: the oldest go on without masks."""
    bench = make_bench("-p", "patience:=10.0")
    bench.send_info()
    mask_publisher(bench)
    images = [bench.depth() for _ in range(input_module._WAITING + 3)]
    for image in images[:-3]:
        bench.node._input._on_image(image)
    assert not bench.recoverer.asked
    for count, image in enumerate(images[-3:], start=1):
        bench.node._input._on_image(image)
        bench.until(lambda count=count: len(bench.answers) == count)
    assert [answer.header for answer in bench.answers] == [image.header for image in images[:3]]
    assert all(asked[2] is None for asked in bench.recoverer.asked)
    assert bench.counts.dropped == 0


def test_orthographic_frames_need_no_camera_info_and_answer_in_the_cube_frame(make_bench):
    bench = make_bench("-p", "projection:=orthographic")
    assert bench.recoverer.warm == unit_cube.camera()
    rendered = bench.hear(Image, "recover_node/rendered_depth")
    bench.until(lambda: bench.node._outputs.rendered_depth.get_subscription_count())
    for dtype in (np.uint8, np.uint16):
        grey = np.zeros((32, 32), dtype)
        grey[8:20, 8:20] = 0.75 * np.iinfo(dtype).max
        image = grey_to_message(grey, bench.header())
        before = len(rendered)
        message, found = bench.answer(image)
        assert message.header == image.header
        np.testing.assert_allclose(found.translation, [[0.01, 1 - 0.02, 1 - 0.5]], rtol=1e-6)
        depth, camera, _, _ = bench.recoverer.asked[-1]
        assert camera == unit_cube.camera(32)
        assert np.nanmax(depth) == pytest.approx(0.25, abs=4e-3)
        assert np.isnan(depth[0]).all()
        bench.until(lambda before=before: len(rendered) > before)
        assert rendered[-1].encoding == image.encoding
    assert "projection = pinhole" in bench.send(bench.depth()).last_error
    one = grey_to_message(np.ones((1, 1), np.uint8), bench.header())
    assert "2 x 2 pixels" in bench.send(one).last_error


def test_diagnostics_count_and_warn(bench):
    reports = bench.hear(DiagnosticArray, "/diagnostics")

    def latest() -> tuple[DiagnosticStatus, dict[str, str]]:
        status = reports[-1].status[0]
        return status, {pair.key: pair.value for pair in status.values}

    bench.answer(bench.depth())
    bench.until(lambda: reports and latest()[1]["answered"] == "1")
    assert "stamp to result: median [ms]" not in latest()[1], "the stamp of an old recording says nothing about latency"
    image = bench.depth()
    image.header.stamp = bench.node.get_clock().now().to_msg()
    bench.answer(image)
    bench.send(with_fields(bench.depth(), encoding="yuv422"))

    bench.until(lambda: reports and latest()[1]["received"] == "3")
    status, values = latest()
    assert status.hardware_id == "/recover_node"
    assert (values["answered"], values["dropped"], values["refused"], values["lost"]) == ("2", "0", "1", "0")
    assert "yuv422" in values["last error"]
    assert float(values["stamp to result: median [ms]"]) > 0
    assert {"wait: p95 [ms]", "recovery: total: median [ms]", "publish: median [ms]"} <= set(values)
    assert any(report.status[0].level == DiagnosticStatus.WARN for report in reports)


@pytest.mark.parametrize("asked", [True, False])
def test_lost_messages_are_counted_and_the_remedy_fits_the_subscription(make_bench, capfd, asked):
    """A publisher's depth where it is reliable, as somebody asked for; buffers where it is not."""
    reliable = ("-p", "qos_overrides./depth/image.subscription.reliability:=reliable")
    bench = make_bench(*(reliable if asked else ()))
    source = bench.node._input
    if not asked:
        deaf = QoSProfile(depth=1, reliability=QoSReliabilityPolicy.BEST_EFFORT)
        bench.peer.create_publisher(Image, "depth/image", deaf)
        bench.until(lambda: source._image._qos.reliability == QoSReliabilityPolicy.BEST_EFFORT)
    for listener, total, new in ((source._image, 3, 3), (source._image, 5, 2), (source._info, 1, 1)):
        listener._on_message_lost(SimpleNamespace(total_count=total, total_count_change=new))
    assert bench.counts.lost == {"/depth/image": 5, "/depth/camera_info": 1}
    said = capfd.readouterr().err
    assert "3 messages of /depth/image lost" in said
    assert said.count(f"FASTRTPS_DEFAULT_PROFILES_FILE={process.profile_path()}") == (0 if asked else 1)
    assert ("Raise the depth of the PUBLISHER" in said) == asked


def test_a_subscription_is_as_reliable_as_its_publishers(make_bench):
    """Reliable while all of them are: a large best effort message is often lost; deaf to none of them."""
    bench = make_bench()
    heard = bench.node._input._image
    reliable, best_effort = QoSReliabilityPolicy.RELIABLE, QoSReliabilityPolicy.BEST_EFFORT
    bench.send_info()

    def offered() -> set[QoSReliabilityPolicy]:
        """By the node, as others see it."""
        found = bench.peer.get_subscriptions_info_by_topic("/depth/image")
        return {one.qos_profile.reliability for one in found}

    bench.until(lambda: offered() == {reliable})
    assert len(bench.answer(bench.depth())[1]) == 1
    other = bench.peer.create_publisher(Image, "depth/image", QoSProfile(depth=1, reliability=best_effort))
    bench.until(lambda: offered() == {best_effort})
    bench.until(other.get_subscription_count)
    assert "INCOMPATIBLE" not in heard.publishers
    bench.images, kept = other, bench.images
    assert len(bench.answer(bench.depth())[1]) == 1
    bench.peer.destroy_publisher(other)
    bench.images = kept
    bench.until(lambda: offered() == {reliable})
    bench.until(kept.get_subscription_count)
    assert len(bench.answer(bench.depth())[1]) == 1


@pytest.mark.parametrize("asked", ["best_effort", "reliable"])
def test_a_reliability_that_was_asked_for_stays(make_bench, asked):
    bench = make_bench("-p", f"qos_overrides./depth/image.subscription.reliability:={asked}")
    mixed = asked == "reliable"
    if mixed:
        bench.peer.create_publisher(Image, "depth/image", QoSProfile(depth=1, reliability=QoSReliabilityPolicy(2)))
    bench.until(lambda: bench.node.count_publishers("/depth/image") == 1 + mixed)
    bench.node._input.follow_publishers()
    (seen,) = bench.peer.get_subscriptions_info_by_topic("/depth/image")
    assert seen.qos_profile.reliability.name.lower() == asked


def test_a_camera_info_that_was_published_once_before_is_received(make_bench):
    bench = make_bench()
    bench.peer.destroy_publisher(bench.infos)
    bench.peer.create_publisher(CameraInfo, "depth/camera_info", latched_qos()).publish(bench.info())
    bench.until(lambda: len(bench.node._input._infos) == 1)
    assert len(bench.answer(bench.depth())[1]) == 1


def test_what_is_left_out_of_a_frame_is_said_and_that_its_images_name_no_frame_once(bench):
    log = bench.hear(Log, "/rosout", 50)
    for _ in range(3):
        image = bench.depth()
        image.header.frame_id = ""
        assert bench.answer(image)[0].header.frame_id == ""
    bench.until(lambda: [entry for entry in log if "the images have no frame_id" in entry.msg])
    bench.recoverer.message = "there are more objects than max_objects = 1: smaller ones are left out"
    assert len(bench.answer(bench.depth())[1]) == 1
    bench.until(lambda: "more objects than max_objects = 1" in log[-1].msg)
    assert sum("no frame_id" in entry.msg for entry in log) == 1


def test_the_support_plane_and_a_latched_cloud_reach_those_who_come_late(make_bench):
    """A frame without plane, as behind an arm, takes nothing back."""
    bench = make_bench("-p", "qos_overrides./recover_node/superquadrics.publisher.durability:=transient_local")
    bench.send_info()
    bench.recoverer.plane = np.array([0.0, -0.8, -0.6, 0.5])
    header = bench.answer(bench.depth())[0].header
    bench.recoverer.plane = None
    bench.answer(bench.depth())
    heard = bench.hear(PoseStamped, "recover_node/support_plane", latched_qos())
    late = bench.hear(PointCloud2, "recover_node/superquadrics", latched_qos())
    bench.until(lambda: heard and late)
    assert heard[0].header == header
    np.testing.assert_allclose(plane_of(heard[0]), [0.0, -0.8, -0.6, 0.5], atol=1e-12)


def test_the_support_plane_of_a_frame_is_there_before_its_bodies(bench):
    """Who plans on the bodies of a camera that has moved must not do so on the plane of the frame before."""
    pairs: list[tuple[Any, Any]] = []
    bench.recoverer.plane = np.array([0.0, -0.8, -0.6, 0.5])
    planes = bench.hear(PoseStamped, "recover_node/support_plane", latched_qos())

    def plan(message: PointCloud2) -> None:
        pairs.append((message.header, planes[-1].header if planes else None))

    bench.peer.create_subscription(PointCloud2, "recover_node/superquadrics", plan, 10)
    outputs = bench.node._outputs
    bench.until(lambda: outputs.support_plane.get_subscription_count() == 1)
    bench.until(lambda: outputs.superquadrics.get_subscription_count() == 2)
    for count in range(1, 9):
        bench.answer(bench.depth())
        bench.until(lambda count=count: len(pairs) == count)
    assert all(of_cloud == of_plane for of_cloud, of_plane in pairs), pairs


@pytest.mark.parametrize(("target", "pose"), [("", None), (FRAME_ID, ((0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0)))])
def test_the_workspace_is_a_box_of_the_target_frame(make_bench, target, pose):
    box = [-0.5, -0.5, 0.0, 0.5, 0.5, 1.5]
    bench = make_bench("-p", f"workspace:={box}", "-p", f"target_frame:='{target}'")
    bench.send_info()
    bench.answer(bench.depth())
    options = bench.recoverer.asked[-1][3]
    assert (options.workspace, options.workspace_pose) == (tuple(box), pose)
    bench.set(bench.node, target_frame="moon")
    assert "target_frame: expected a transform from" in bench.send(bench.depth()).last_error
    assert len(bench.recoverer.asked) == 1, "nothing is computed for a frame that cannot be published"


def test_the_workspace_of_orthographic_frames_is_a_box_of_the_cube_frame(make_bench):
    """As the bodies are: what lies in the box above y = 0.5 is in the upper half of the image."""
    box = [0.0, 0.5, 0.0, 1.0, 1.0, 1.0]
    bench = make_bench("-p", "projection:=orthographic", "-p", f"workspace:={box}")
    bench.answer(grey_to_message(np.full((32, 32), 99, np.uint8), bench.header()))
    depth, camera, _, options = bench.recoverer.asked[-1]
    points = camera.points(depth)
    assert options.is_within(points[4:12].reshape(-1, 3))
    assert not options.is_within(points[20:28].reshape(-1, 3))
