"""Tracking in a frame node, between real publishers and subscribers: ids, resets, failed bodies, moving cameras."""

import sys
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs the extra 'ros'")

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from frame_node_bench import BOX, CAMERA, CAN, FRAME_ID, Bench, recovery
from spun_nodes import PATIENCE
from stand_in_tf2 import Tf2
from std_msgs.msg import Header
from std_srvs.srv import SetBool
from visualization_msgs.msg import Marker, MarkerArray

from sq_msgs_py.depth_image import depth_to_message
from sq_perception import Status, Superquadric
from sq_perception.geometry import rotation as quaternions


def grown(body: Superquadric, share: float) -> Superquadric:
    return Superquadric(body.size * (1 + share), body.shape, body.translation, body.rotation)


@pytest.fixture
def make_bench(make_bench: Callable[..., Bench]) -> Callable[..., Bench]:
    def make(*arguments: str) -> Bench:
        bench = make_bench(*arguments)
        bench.send_info()
        return bench

    return make


def image(sec: float, frame_id: str = FRAME_ID) -> Any:
    stamp = Time(sec=int(sec), nanosec=round(1e9 * (sec - int(sec))))
    return depth_to_message(np.full((CAMERA.height, CAMERA.width), np.nan), Header(stamp=stamp, frame_id=frame_id))


def diagnostics(bench: Bench) -> Callable[[], dict[str, str]]:
    reports = bench.hear(DiagnosticArray, "/diagnostics")

    def newest() -> dict[str, str]:
        before = len(reports)
        bench.until(lambda: len(reports) > before + 1)
        return {pair.key: pair.value for pair in reports[-1].status[0].values}

    return newest


def test_ids_and_forms_last_and_numbers_are_fused(make_bench):
    """Labels change places, the fit names the axes anew, a body fails: ids, axes and markers stay."""
    bench = make_bench()
    shown = bench.hear(MarkerArray, "recover_node/markers")
    bench.until(lambda: bench.node._outputs.markers.get_subscription_count())
    report = diagnostics(bench)

    bench.recoverer.bodies = (recovery(BOX, 1), recovery(CAN, 2))
    _, first = bench.answer(image(10.0))
    assert first.id.tolist() == [1, 2]
    for k in range(1, 8):
        other = grown(BOX, 0.03 * (-1) ** k).equivalent_forms()[k]
        bench.recoverer.bodies = (recovery(CAN, 1), recovery(BOX, 7, Status.FAILED), recovery(other, 2))
        _, found = bench.answer(image(10 + 0.1 * k))
        assert (found.id.tolist(), found.status.tolist()) == ([2, 2**31 + 7, 1], [0, 2, 0])
        assert quaternions.geodesic_angle(found.rotation[2].astype(float), first.rotation[0].astype(float)) < 0.01
        np.testing.assert_allclose(found.size[2], BOX.size, rtol=0.021)
    assert (found.sigma_size[2] < first.sigma_size[0]).all()
    assert (first.seen.tolist(), first.label.tolist()) == ([1, 1], [1, 2])
    assert (found.seen.tolist(), found.fused.tolist(), found.label.tolist()) == ([8, 0, 8], [1, 0, 1], [1, 7, 2])
    bench.until(lambda: len(shown) == 8)
    colours = {(marker.id, marker.color.r) for array in shown for marker in array.markers if "surface" in marker.ns}
    assert len(colours) == 2
    assert {marker.id for marker in shown[-1].markers[1:]} == {1, 2}

    bench.recoverer.bodies = (recovery(CAN, 1),)
    bench.answer(image(11.0))
    bench.until(lambda: len(shown) == 9)
    assert {(m.id, m.action) for m in shown[-1].markers[1:]} == {(2, Marker.ADD)}
    values = report()
    counts = [values[name] for name in ("track ids given", "track resets", "frames without camera pose")]
    assert counts == ["2", "0", "0"]


def test_a_bag_that_begins_again_resets_once(make_bench, capfd):
    bench = make_bench()
    report = diagnostics(bench)
    bench.recoverer.bodies = (recovery(BOX, 1),)
    assert [bench.answer(image(sec))[1].id.tolist() for sec in (10.0, 10.1, 3.0, 3.1)] == [[1], [1], [2], [2]]
    values = report()
    assert (values["tracks"], values["track ids given"], values["track resets"]) == ("1", "2", "1")
    assert capfd.readouterr().err.count("stamps jumped back to 3.000 s") == 1


def test_another_optical_frame_is_another_world_and_no_stamp_is_now(make_bench):
    bench = make_bench()
    bench.recoverer.bodies = (recovery(BOX, 1),)
    assert bench.answer(image(10.0))[1].id.tolist() == [1]
    assert bench.answer(image(10.1, "another_camera"))[1].id.tolist() == [2]
    unstamped = [bench.answer(image(0.0, "another_camera"))[1].id.tolist() for _ in range(3)]
    assert unstamped[0] == unstamped[1] == unstamped[2]


def test_another_method_ends_the_tracks(make_bench, capfd):
    """Numbers of a network, with no or other deviations, are not fused with those of a fit."""
    bench = make_bench()
    for k, share in enumerate((0.0, 0.02)):
        bench.recoverer.bodies = (recovery(grown(BOX, share), 1),)
        assert bench.answer(image(10 + 0.1 * k))[1].id.tolist() == [1]
    bench.set(bench.node, method="network")
    bench.recoverer.bodies = (recovery(grown(BOX, 0.05), 1),)
    _, found = bench.answer(image(10.2))
    assert found.id.tolist() == [2]
    np.testing.assert_allclose(found.size[0], 1.05 * BOX.size, rtol=1e-6)
    bench.set(bench.node, method="symmetry")
    assert bench.answer(image(10.3))[1].id.tolist() == [3]
    bench.set(bench.node, s=50.0, threads=2)
    assert bench.answer(image(10.4))[1].id.tolist() == [3]
    assert capfd.readouterr().err.count("bodies come from another method or model") == 2


def test_without_tracking_ids_are_labels_and_each_frame_stands_for_itself(make_bench):
    bench = make_bench()
    bench.recoverer.bodies = (recovery(BOX, 5), recovery(CAN, 9, Status.FAILED))
    assert bench.answer(image(10.0))[1].id.tolist() == [1, 2**31 + 9]
    bench.set(bench.node, tracking=False)
    bench.recoverer.bodies = (recovery(grown(BOX, 0.05), 5), recovery(CAN, 9, Status.FAILED))
    _, found = bench.answer(image(10.1))
    assert found.id.tolist() == [5, 9]
    np.testing.assert_allclose(found.size[0], 1.05 * BOX.size, rtol=1e-6)
    bench.set(bench.node, tracking=True)
    assert bench.answer(image(10.2))[1].id.tolist() == [2, 2**31 + 9]


def test_a_tracker_that_cannot_go_on_costs_one_frame(make_bench):
    bench = make_bench()
    bench.recoverer.bodies = (recovery(BOX, 1),)
    bench.answer(image(10.0))
    broken = recovery(BOX, 1)
    object.__setattr__(broken.fit, "covariance", np.eye(3))
    bench.recoverer.bodies = (broken,)
    assert "tracking: covariance" in bench.send(image(10.1)).last_error
    bench.recoverer.bodies = (recovery(BOX, 1),)
    assert bench.answer(image(10.2))[1].id.tolist() == [2]


STANDS = np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3)


def at_stamps(poses: dict[float, Any]) -> Callable[..., Any]:

    def look_up(target: str, source: str, stamp: int, timeout: Any) -> Any:
        for seconds, pose in poses.items():
            if abs(1e9 * seconds - stamp) < 1e3:
                return pose
        raise RuntimeError("would require extrapolation into the future")

    return look_up


def test_a_camera_that_moves_is_looked_up(make_bench, monkeypatch, capfd):
    """Bodies at rest in the fixed frame: fused where the pose is known, ids alone where it is not."""
    poses: dict[float, Any] = {}
    tf2 = Tf2(monkeypatch, at_stamps(poses))
    bench = make_bench("-p", "fixed_frame:=map")
    report = diagnostics(bench)
    for k in range(6):
        turn, shift = quaternions.from_rotation_vector(np.array([0.0, 0.03 * k, 0.0])), np.array([0.02 * k, 0.0, 0.0])
        if k != 4:
            poses[10 + 0.1 * k] = turn, shift
        back = quaternions.conjugate(turn)
        seen = grown(BOX, 0.03 * (-1) ** k).transformed(back, -quaternions.to_matrix(back) @ shift)
        bench.recoverer.bodies = (recovery(seen, 1),)
        _, found = bench.answer(image(10 + 0.1 * k))
        assert found.id.tolist() == [1]
        np.testing.assert_allclose(found.translation[0], seen.translation, atol=2e-3)
        error = np.abs(found.size[0] / BOX.size - 1).max()
        assert error == pytest.approx(0.03, abs=1e-4) if k in (0, 4) else error < 0.029
    assert tf2.asked[0] == ("map", FRAME_ID)
    values = report()
    assert (values["frames without camera pose"], values["track ids given"]) == ("1", "1")
    assert capfd.readouterr().err.count("no camera pose in fixed_frame, nothing is fused: would require") == 1
    bench.answer(image(5.0))
    assert tf2.cleared == 1


@pytest.mark.parametrize("tracking", ["true", "false"])
@pytest.mark.parametrize("box", [(), ("-p", "workspace:=[-1.0, -1.0, 0.0, 1.0, 1.0, 2.0]")])
def test_a_bag_that_begins_again_is_seen_in_the_target_frame_again(make_bench, monkeypatch, box, tracking):
    """tf2 takes no transforms of the beginning while it remembers the end."""
    poses = {60.0: STANDS}
    Tf2(monkeypatch, at_stamps(poses)).clear = lambda: poses.update({3.1: STANDS})
    bench = make_bench("-p", "target_frame:=base", "-p", "tf_tolerance:=0.0", "-p", f"tracking:={tracking}", *box)
    counts = [bench.send(image(sec)) for sec in (60.0, 3.0, 3.1)]
    assert [(one.answered, one.refused) for one in counts] == [(1, 0), (1, 1), (2, 1)], counts[-1].last_error


@pytest.mark.parametrize("name", ["fixed_frame", "target_frame"])
def test_what_is_disabled_while_a_transform_is_waited_for_publishes_nothing(make_bench, monkeypatch, name):
    """Else a body that the gripper holds by now would come into the planning scene again."""
    tf2, waits, comes = Tf2(monkeypatch, lambda *_: STANDS), threading.Event(), threading.Event()

    def look_up(*_: Any) -> Any:
        waits.set()
        assert comes.wait(PATIENCE)
        return STANDS

    bench = make_bench("-p", f"{name}:=base")
    actions: list[int] = []
    bench.peer.create_subscription(
        MarkerArray, "recover_node/markers", lambda array: actions.extend(one.action for one in array.markers), 10
    )
    bench.until(lambda: bench.node._outputs.markers.get_subscription_count() == 1)
    bench.answer(image(10.0))
    bench.until(lambda: actions == [Marker.DELETEALL, Marker.ADD, Marker.ADD])
    tf2.look_up = look_up
    bench.images.publish(image(11.0))
    bench.until(waits.is_set)
    assert bench.call(SetBool, "/recover_node/enable", SetBool.Request(data=False)).success
    comes.set()
    bench.until(lambda: bench.counts.in_work == 0)
    assert (bench.counts.answered, bench.counts.dropped, len(bench.answers)) == (1, 1, 1)
    bench.until(lambda: actions == [Marker.DELETEALL, Marker.ADD, Marker.ADD, Marker.DELETEALL])


def test_without_tf2_ids_remain(make_bench, monkeypatch, capfd):
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    bench = make_bench("-p", "fixed_frame:=map")
    for k, share in enumerate((0.0, 0.05)):
        bench.recoverer.bodies = (recovery(grown(BOX, share), 4),)
        _, found = bench.answer(image(10 + k))
        assert found.id.tolist() == [1]
        np.testing.assert_allclose(found.size[0], (1 + share) * BOX.size, rtol=1e-6)
    assert bench.node._tracking.tally.without_pose == 2
    assert "tf2_ros cannot be imported" in capfd.readouterr().err
