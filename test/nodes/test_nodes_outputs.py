"""What a frame node publishes for other stacks and to be looked at, when, and in which frame."""

import sys
from collections.abc import Callable
from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs the extra 'ros'")

import soft_messages
from builtin_interfaces.msg import Time
from frame_node_bench import BOX, CAMERA, CAN, ball
from frame_node_bench import recovery as one
from sensor_msgs.msg import Image
from stand_in_tf2 import Tf2
from std_msgs.msg import Header
from std_srvs.srv import SetBool
from visualization_msgs.msg import Marker, MarkerArray

from sq_msgs_py import poses
from sq_perception import Camera, FrameRecovery, Recovery, Status, Superquadric
from sq_perception.geometry import rotation as quaternions
from sq_perception.imaging import unit_cube
from sq_perception.imaging.calibration import Calibration
from sq_perception.nodes import outputs as outputs_module
from sq_perception.nodes.frame import Frame
from sq_perception.nodes.outputs import OptionalOutputs, in_frame
from sq_perception.nodes.parameters import RecoverParameters
from sq_perception.nodes.tracking import CameraPoses, PoseError, Tracking
from sq_perception.recordings import publication
from sq_perception.recordings.publication import Identified

HEADER = Header(stamp=Time(sec=10, nanosec=500_000_000), frame_id="camera")
TF, DETECTIONS, SCENE = "/tf", "~/detections", "~/planning_scene"
ALL = RecoverParameters(publish_tf=True, publish_detections=True, publish_collision_objects=True)


def frame(header: Header = HEADER, camera: Camera = CAMERA) -> Frame:
    return Frame(header, "32FC1", np.full((camera.height, camera.width), np.nan, np.float32), Calibration(camera))


def recovery(*bodies: Recovery) -> FrameRecovery:
    return FrameRecovery(bodies, {"total": 1.0}, np.zeros((48, 64), np.int32), None, "")


def found(*ids: int, header: Header = HEADER) -> publication.Findings:
    """Boxes and cans with these ids, and a failed body."""
    bodies = [one((BOX, CAN)[number % 2], number) for number in ids]
    failed = one(BOX, 99, Status.FAILED)
    return publication.findings(Identified(recovery(*bodies, failed), (*ids, 2**31 + 99)), header, is_cube=False)


def shown(bodies: dict[int, Superquadric]) -> publication.Findings:
    identified = Identified(recovery(*(one(body, k) for k, body in bodies.items())), tuple(bodies))
    return publication.findings(identified, HEADER, is_cube=False)


class Publisher:
    """Notes what is published while ``listeners`` is above 0 or not."""

    def __init__(self, kind: type[Any], topic: str, queue: int, matched: Callable[[Any], None]) -> None:
        self.msg_type, self.topic, self.queue, self._matched = kind, topic, queue, matched
        self.topic_name, self._listeners = topic, 0
        self.listeners = 1
        self.sent: list[Any] = []

    @property
    def listeners(self) -> int:
        return self._listeners

    @listeners.setter
    def listeners(self, count: int) -> None:
        change, self._listeners = count - self._listeners, count
        self._matched(SimpleNamespace(current_count_change=change))

    def restart(self) -> None:
        self.listeners -= 1
        self.listeners += 1

    def get_subscription_count(self) -> int:
        return self.listeners

    def publish(self, message: Any) -> None:
        assert isinstance(message, self.msg_type)
        self.sent.append(message)


class Node:
    def __init__(self) -> None:
        self.publishers: dict[str, Publisher] = {}
        self.all: list[Publisher] = []
        self.warnings: list[str] = []
        self.said: list[str] = []
        self.time = 100.0

    def create_publisher(self, kind: type[Any], topic: str, queue: int, event_callbacks: Any) -> Publisher:
        assert topic not in self.publishers
        self.publishers[topic] = Publisher(kind, topic, queue, event_callbacks.matched)
        self.all.append(self.publishers[topic])
        return self.publishers[topic]

    def destroy_publisher(self, publisher: Publisher) -> None:
        assert self.publishers.pop(publisher.topic) is publisher

    def get_logger(self) -> Any:
        def warning(text: str, once: bool = False, **_: Any) -> None:
            if not (once and text in self.warnings):
                self.warnings.append(text)

        return SimpleNamespace(warning=warning, info=self.said.append)


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> Node:
    soft_messages.install(monkeypatch)
    made = Node()
    monkeypatch.setattr(outputs_module, "monotonic", lambda: made.time)
    return made


@pytest.fixture
def outputs(node: Node) -> OptionalOutputs:
    made = OptionalOutputs(node)
    made.follow(ALL)
    return made


def beside(body: Superquadric, x: float) -> Superquadric:
    return Superquadric(body.size, body.shape, body.translation + [x, 0, 0], body.rotation)


def objects(publisher: Publisher, which: int = -1) -> dict[str, bytes]:
    return {one.id: one.operation for one in publisher.sent[which].world.collision_objects}


def test_nothing_is_created_before_it_is_asked_for(node):
    outputs = OptionalOutputs(node)
    outputs.follow(RecoverParameters())
    outputs.publish(found(1), RecoverParameters())
    assert not node.all
    assert tuple(outputs.absent) == ()
    outputs.publish(found(1), replace(ALL, publish_tf=False))
    assert {(one.topic, one.queue) for one in node.all} == {(DETECTIONS, 10), (SCENE, 10)}
    outputs.publish(found(1), ALL)
    assert node.publishers[TF].queue == 100
    outputs.publish(found(1), replace(ALL, publish_detections=False))
    assert set(node.publishers) == {TF, SCENE}
    outputs.close()
    assert not node.publishers
    outputs.close()


def test_all_outputs_agree_on_names_poses_and_headers(node):
    parameters = replace(ALL, tf_prefix="thing")
    outputs = OptionalOutputs(node)
    outputs.follow(parameters)
    outputs.publish(found(3, 4), parameters)
    (tree,), (seen,), (scene,) = (node.publishers[topic].sent for topic in (TF, DETECTIONS, SCENE))
    for k, body in enumerate((CAN, BOX)):
        transform, detection, thing = tree.transforms[k], seen.detections[k], scene.world.collision_objects[k]
        assert transform.child_frame_id == detection.id == thing.id == f"thing{3 + k}"
        assert transform.header == detection.header == thing.header == HEADER
        shift, centre = transform.transform.translation, detection.bbox.center.position
        assert (shift.x, shift.y, shift.z) == (centre.x, centre.y, centre.z)
        np.testing.assert_allclose([shift.x, shift.y, shift.z], body.translation, atol=1e-7)
        assert transform.transform.rotation == detection.bbox.center.orientation == thing.pose.orientation
        assert np.asarray(detection.results[0].pose.covariance)[0] == pytest.approx(1e-6)
    assert [len(part) for part in (tree.transforms, seen.detections, scene.world.collision_objects)] == [2, 2, 2]


def test_only_what_is_heard_is_made(node, outputs):
    for publisher in node.all:
        publisher.listeners = 0
    made = found(1, 2)
    outputs.publish(made, replace(ALL, collision_shapes="mesh"))
    assert not any(publisher.sent for publisher in node.all)
    assert "meshes" not in vars(made), "a mesh costs 1.5 ms"
    node.publishers[TF].listeners = 2
    outputs.publish(made, ALL)
    assert [len(publisher.sent) for publisher in node.all] == [1, 0, 0]


def test_gone_objects_are_removed_and_hidden_ones_stay(node, outputs):
    scene = node.publishers[SCENE]
    add, remove = soft("moveit_msgs").CollisionObject.ADD, soft("moveit_msgs").CollisionObject.REMOVE
    outputs.publish(found(1, 2), ALL)
    assert objects(scene) == {"superquadric_1": add, "superquadric_2": add}
    outputs.publish(found(1), ALL, hidden=(2, 7))
    assert len(scene.sent) == 1, "nothing has changed"
    outputs.publish(found(1), ALL)
    assert objects(scene) == {"superquadric_2": remove}
    outputs.publish(found(1), ALL)
    assert len(scene.sent) == 2
    # Nobody hears that 1 is gone and that 5 came and went: what the planner may have is removed as soon as one listens.
    scene.listeners = 0
    outputs.publish(found(5), ALL)
    scene.listeners = 1
    outputs.publish(found(6), ALL)
    assert objects(scene) == {"superquadric_6": add, "superquadric_1": remove}
    outputs.publish(found(6), replace(ALL, tf_prefix="new"))
    assert objects(scene) == {"new6": add, "superquadric_6": remove}
    outputs.publish(found(6, header=Header(frame_id="map")), replace(ALL, tf_prefix="new"))
    assert objects(scene) == {"new6": add}, "planners know it in another frame"
    count = len(scene.sent)
    outputs.publish(found(), ALL)
    outputs.publish(found(), ALL)
    assert objects(scene) == {"new6": remove}
    assert len(scene.sent) == count + 1, "no empty scenes"


def test_planners_are_told_of_changes_alone_and_a_new_planner_of_everything(node, outputs):
    """A still scene, in which numbers quiver by tenths of a millimetre: one message, not one a frame."""
    scene = node.publishers[SCENE]

    def show(*bodies: Superquadric, **changes: Any) -> int:
        """How many objects are told of."""
        count = len(scene.sent)
        outputs.publish(shown(dict(enumerate(bodies, 1))), replace(ALL, **changes))
        return len(objects(scene)) if len(scene.sent) > count else 0

    quivers = Superquadric(BOX.size + 2e-4, BOX.shape, BOX.translation + 2e-4, -BOX.rotation)
    assert [show(BOX, CAN), show(quivers, CAN), show(BOX, CAN)] == [2, 0, 0]
    for moved in (
        Superquadric(BOX.size, BOX.shape, BOX.translation + [0, 0, 0.003], BOX.rotation),
        Superquadric(BOX.size + [0.003, 0, 0], BOX.shape, BOX.translation, BOX.rotation),
        Superquadric(BOX.size + 0.0018, BOX.shape, BOX.translation, BOX.rotation),  # whose corners move by more
        Superquadric(BOX.size, [0.9, 0.6], BOX.translation, BOX.rotation),
        Superquadric(BOX.size, BOX.shape, BOX.translation, [0.1, 0.2, 0.4, 0.9]),
    ):
        assert [show(moved, CAN), show(moved, CAN), show(BOX, CAN)] == [1, 0, 1]
    assert sum(show(beside(BOX, 0.0005 * k), CAN) for k in range(21)) == 4, "steps of half a millimetre add up to 10 mm"
    show(BOX, CAN)
    scene.listeners = 2
    assert [show(BOX, CAN), show(BOX, CAN)] == [2, 0]
    assert show(BOX, CAN, collision_shapes="mesh") == 2
    scene.listeners = 0
    show(BOX, CAN, collision_shapes="mesh")
    scene.listeners = 1
    assert show(BOX, CAN, collision_shapes="mesh") == 2, "a planner that has started again knows nothing"
    scene.restart()
    assert show(BOX, CAN, collision_shapes="mesh") == 2, "between two frames, too"
    assert show(BOX, CAN, collision_shapes="mesh") == 0


def test_a_new_planner_is_told_of_what_an_arm_hides(node, outputs):
    """MoveIt is started again while the arm is before body 2; with a camera that moves nobody knows where that is."""
    scene = node.publishers[SCENE]
    outputs.publish(found(1, 2), ALL)
    (_, before) = scene.sent[-1].world.collision_objects
    scene.restart()
    outputs.publish(found(1), ALL, hidden=(2, 7))
    (_, again) = scene.sent[-1].world.collision_objects
    assert again == before, "as it was last seen"
    outputs.publish(found(1), ALL, hidden=(2, 7))
    assert len(scene.sent) == 2
    node.time += 6
    outputs.publish(found(1), ALL, hidden=(2, 7))
    assert list(objects(scene)) == ["superquadric_1"], "the planner is the same: what is attached must not come back"
    outputs.publish(found(1, 2), ALL)
    assert list(objects(scene)) == ["superquadric_2"], "shown again"

    scene.restart()
    outputs.publish(found(1), replace(ALL, fixed_frame="map"), hidden=(2,))
    assert list(objects(scene)) == ["superquadric_1"]
    scene.restart()
    outputs.publish(found(1), replace(ALL, fixed_frame="map", target_frame="base_link"), hidden=(2,))
    assert list(objects(scene)) == ["superquadric_1", "superquadric_2"]
    scene.restart()
    outputs.publish(found(1, header=Header(frame_id="other")), ALL, hidden=(2,))
    assert list(objects(scene)) == ["superquadric_1"], "planners that know it know it in its own frame"


def test_a_planner_that_was_busy_knows_in_the_end_what_is_there(node, outputs):
    """It plans while one body goes and another one moves, and gets the last ten messages of that time."""
    known: dict[str, Any] = {}

    def heard(bodies: dict[int, Superquadric]) -> None:
        outputs.publish(shown(bodies), ALL)

    def take() -> None:
        scene = node.publishers[SCENE]
        for message in scene.sent[-10:]:
            for thing in message.world.collision_objects:
                known.pop(thing.id, None)
                if thing.operation == soft("moveit_msgs").CollisionObject.ADD:
                    known[thing.id] = thing.pose.position.x
        scene.sent.clear()

    heard({1: BOX, 2: CAN, 3: BOX})
    take()
    for k in range(1, 20):
        heard({2: beside(CAN, 0.01 * k), 3: beside(BOX, 0.1)})
    take()
    assert set(known) == {"superquadric_1", "superquadric_2", "superquadric_3"}, "the removal was lost"
    node.time += 6
    for _ in range(3):
        heard({2: beside(CAN, 0.2), 3: beside(BOX, 0.1)})
    assert len(node.publishers[SCENE].sent) == 1
    take()
    assert known == {"superquadric_2": pytest.approx(0.05), "superquadric_3": pytest.approx(0.11)}
    told = []
    for _ in range(2):
        node.time += 6
        heard({2: beside(CAN, 0.2), 3: beside(BOX, 0.1)})
        told.append(len(objects(node.publishers[SCENE])))
    assert told == [3, 2], "removed by two repetitions, as a planner may miss the first, and no more"


def test_switching_off_removes_and_ending_does_not(node, outputs):
    scene = node.publishers[SCENE]
    outputs.publish(found(1, 2), ALL)
    off = replace(ALL, publish_collision_objects=False)
    outputs.publish(found(1, 2), off)
    assert set(objects(scene).values()) == {soft("moveit_msgs").CollisionObject.REMOVE}
    assert len(objects(scene)) == 2
    assert SCENE in node.publishers, "the message is still on its way"
    outputs.publish(found(1, 2), off)
    assert SCENE not in node.publishers
    assert len(scene.sent) == 2
    outputs.publish(found(1), ALL)
    scene = node.publishers[SCENE]
    outputs.close()
    assert len(scene.sent) == 1
    outputs = OptionalOutputs(node)
    outputs.follow(ALL)
    outputs.publish(found(1), ALL)
    outputs.withdraw()
    outputs.withdraw()
    assert len(node.publishers[SCENE].sent) == 2


@pytest.mark.parametrize(("package", "topic"), [("tf2_msgs", TF), ("vision_msgs", DETECTIONS), ("moveit_msgs", SCENE)])
def test_absent_packages_are_named_once_and_the_others_go_on(node, monkeypatch, package, topic):
    soft_messages.remove(monkeypatch, package)
    outputs = OptionalOutputs(node)
    outputs.follow(ALL)
    for _ in range(3):
        outputs.publish(found(1), ALL)
    assert tuple(outputs.absent.values()) == (package,)
    (warning,) = node.warnings
    assert f"expected {package}, which cannot be used" in warning
    assert f"ros-$ROS_DISTRO-{package.replace('_', '-')}" in warning
    assert set(node.publishers) == {TF, DETECTIONS, SCENE} - {topic}
    assert all(len(publisher.sent) == (1 if publisher.topic == SCENE else 3) for publisher in node.all)
    outputs.publish(found(1), RecoverParameters())
    assert tuple(outputs.absent) == (), "nobody asks for it any more"


def test_images_without_frame_have_no_transforms_and_no_objects(node, outputs):
    for _ in range(2):
        outputs.publish(found(1, header=Header()), ALL)
    assert [len(node.publishers[topic].sent) for topic in (TF, DETECTIONS, SCENE)] == [0, 2, 0]


def soft(package: str) -> Any:
    return sys.modules[f"{package}.msg"]


FRAMES = {
    "map": (quaternions.from_rotation_vector(np.array([0.3, -1.1, 0.7])), np.array([1.0, -2.0, 0.5])),
    "base": (np.array([0, 0, 0, 1.0]), np.zeros(3)),
}
"""Poses of the camera at 10.5 s."""


@pytest.fixture
def tf2(monkeypatch: pytest.MonkeyPatch) -> Tf2:
    def look_up(target: str, source: str, stamp: int, timeout: Any) -> Any:
        if target not in FRAMES or stamp != 10_500_000_000:
            raise LookupError(f"{target} does not exist")
        return FRAMES[target]

    return Tf2(monkeypatch, look_up)


def test_findings_in_another_frame_are_the_bodies_seen_from_there(node, tf2):
    here = found(1, 2)
    there = in_frame(here, CameraPoses(node), "map")
    turn, shift = FRAMES["map"]
    assert (there.header.frame_id, there.header.stamp) == ("map", HEADER.stamp)
    assert here.header.frame_id == "camera"
    expected = poses.move(here.array, turn, shift)
    for column in fields(expected):
        np.testing.assert_array_equal(getattr(there.array, column.name), getattr(expected, column.name))
    assert in_frame(here, CameraPoses(node), "") is here


def test_markers_lie_on_the_bodies(node):
    """Meshes in the body's frame and back again are those of the body in the frame of the image."""
    drawn = found(1, 2).markers().markers[1:]
    kinds = [(marker.id, marker.ns.split("/")[1], marker.action) for marker in drawn]
    assert kinds == [(1, "surface", 0), (1, "outline", 0), (2, "surface", 0), (2, "outline", 0)]
    for marker, body in zip(drawn, (CAN, CAN, BOX, BOX), strict=True):
        points = np.array([[p.x, p.y, p.z] for p in marker.points])
        np.testing.assert_allclose(body.gauge(points), 1, atol=1e-4)


def test_covariances_of_poses_are_about_the_axes_of_their_frame(node, tf2):
    """A body's own rotation vector w is R w about the axes of the frame that R leads to."""
    here = found(2)
    assert np.diag(here.covariances[0])[:3] == pytest.approx([1e-6, 4e-6, 9e-6])
    own = np.diag(np.square([0.02, 0.03, 0.04]))
    turn = quaternions.to_matrix(BOX.rotation)
    np.testing.assert_allclose(here.covariances[0][3:, 3:], turn @ own @ turn.T, atol=1e-9)
    there = in_frame(here, CameraPoses(node), "map").covariances[0]
    matrix = quaternions.to_matrix(FRAMES["map"][0])
    np.testing.assert_allclose(there[:3, :3], matrix @ np.diag([1e-6, 4e-6, 9e-6]) @ matrix.T, atol=1e-12)
    np.testing.assert_allclose(there[3:, 3:], matrix @ turn @ own @ turn.T @ matrix.T, atol=1e-9)


def test_findings_of_a_cube_are_in_its_frame():
    camera = unit_cube.camera(64, 48)
    body = Superquadric([0.2, 0.15, 0.1], [0.3, 0.6], [0.5, 0.5, 0.5], [0.1, 0.2, 0.3, 0.9])
    made = publication.findings(Identified(recovery(one(body, 1)), (1,)), HEADER, not camera.is_pinhole)
    expected = unit_cube.cube_from_optical(body)
    np.testing.assert_allclose(made.array.translation[0], expected.translation, atol=1e-7)
    flip = np.diag([1.0, -1, -1])
    own = np.diag(np.square([0.02, 0.03, 0.04]))
    turn = flip @ quaternions.to_matrix(body.rotation)
    np.testing.assert_allclose(made.covariances[0][3:, 3:], turn @ own @ turn.T, atol=1e-9)


def test_a_missing_transform_refuses_the_frame(node, tf2, monkeypatch):
    camera_poses = CameraPoses(node)
    with pytest.raises(ValueError, match="target_frame: expected a transform from 'camera' to 'moon': moon does not"):
        in_frame(found(1), camera_poses, "moon")
    late = Header(stamp=Time(sec=11), frame_id="camera")
    with pytest.raises(ValueError, match="target_frame"):
        in_frame(found(1, header=late), camera_poses, "map")
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    with pytest.raises(ValueError, match="tf2_ros cannot be imported"):
        in_frame(found(1), CameraPoses(node), "map")
    assert in_frame(found(1), CameraPoses(node), "camera").header.frame_id == "camera", "needs no tf2"


def test_all_frames_share_one_listener_and_none_is_there_before(node, tf2):
    camera_poses = CameraPoses(node)
    assert tf2.listeners == 0
    np.testing.assert_array_equal(camera_poses.at(HEADER, "camera")[1], np.zeros(3))
    assert tf2.listeners == 0
    for frame_id in ("map", "base", "map"):
        turn, shift = camera_poses.at(HEADER, frame_id)
        np.testing.assert_allclose(turn, FRAMES[frame_id][0])
        np.testing.assert_allclose(shift, FRAMES[frame_id][1])
    assert tf2.listeners == 1
    camera_poses.close()
    camera_poses.close()
    assert tf2.closed == 1
    np.testing.assert_allclose(camera_poses.at(HEADER, "map")[1], [1.0, -2.0, 0.5])
    assert tf2.listeners == 2
    tf2.look_up = lambda *_: (np.full(4, np.nan), np.zeros(3))
    with pytest.raises(PoseError, match="no rigid motion"):
        camera_poses.at(HEADER, "map")


def test_another_fixed_frame_is_another_world(node, tf2):
    tracking = Tracking(node, CameraPoses(node))

    def identified(fixed: str) -> tuple[int, ...]:
        parameters = RecoverParameters(fixed_frame=fixed)
        return tracking.identify(recovery(one(BOX, 1)), None, frame(), 0.0, parameters).ids

    assert [identified(fixed) for fixed in ("", "", "map", "map", "base", "")] == [(1,), (1,), (2,), (2,), (3,), (4,)]
    assert [text.split(":")[0] for text in node.said] == [
        f"fixed_frame is {name} from now on" for name in ("map", "base", "none")
    ]
    assert tracking.tally.without_pose == 0
    identified("moon")
    assert tracking.tally.without_pose == 1


def test_tracks_that_a_frame_does_not_show_are_hidden(node):
    tracking = Tracking(node, CameraPoses(node))

    def identified(parameters: RecoverParameters, *bodies: Recovery) -> Identified:
        return tracking.identify(recovery(*bodies), None, frame(), 10.0, parameters)

    first = identified(RecoverParameters(), one(BOX, 1), one(CAN, 2))
    assert (first.ids, first.hidden) == ((1, 2), ())
    second = identified(RecoverParameters(), one(CAN, 1))
    assert (second.ids, second.hidden) == ((2,), (1,))
    assert identified(RecoverParameters(tracking=False), one(CAN, 1)).hidden == ()


def test_pictures_are_made_while_somebody_listens(bench):
    bench.set(bench.node, tracking=False)
    bench.recoverer.bodies = (ball(1), ball(5), ball(6, Status.FAILED))
    assert len(bench.answer(bench.depth())[1]) == 3
    shown = bench.hear(MarkerArray, "recover_node/markers")
    rendered = bench.hear(Image, "recover_node/rendered_depth")
    outputs = bench.node._outputs
    bench.until(lambda: outputs.markers.get_subscription_count() and outputs.rendered_depth.get_subscription_count())
    assert not shown
    image = bench.depth()
    bench.answer(image)
    bench.until(lambda: shown and rendered)
    assert sorted({marker.id for marker in shown[0].markers[1:]}) == [1, 5]
    assert all(marker.header == image.header for marker in shown[0].markers)
    depth = publication.depth_of(rendered[0], False)[0].depth
    assert rendered[0].header == image.header
    assert np.nanmin(depth) == pytest.approx(0.4, abs=2e-3)
    assert np.isnan(depth).any()


@pytest.mark.parametrize("end", ["disabled", "deactivated", "ended"])
def test_markers_go_with_the_one_who_would_move_them(bench, end):
    shown = bench.hear(MarkerArray, "recover_node/markers")
    bench.until(lambda: bench.node._outputs.markers.get_subscription_count())
    bench.recoverer.bodies = (ball(1), ball(5))
    bench.answer(bench.depth())
    bench.until(lambda: len(shown) == 1)
    if end == "disabled":
        assert bench.call(SetBool, "/recover_node/enable", SetBool.Request(data=False)).success
    elif end == "deactivated":
        bench.node._tasks.put(lambda: bench.node._change("deactivate"))
    else:
        bench.until(bench.node.close)
    bench.until(lambda: len(shown) == 2)
    assert [marker.action for marker in shown[1].markers] == [Marker.DELETEALL]
