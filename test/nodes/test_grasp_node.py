"""grasp_node between a real publisher and subscribers: order, headers, parameters, and messages that are none."""

from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pytest
import soft_messages

pytest.importorskip("rclpy", reason="needs the extra 'ros'")

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseArray, PoseStamped
from rcl_interfaces.msg import Log
from rclpy.parameter import Parameter
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2
from spun_nodes import SpunNodes
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from visualization_msgs.msg import Marker, MarkerArray

from sq_msgs_py import answers
from sq_msgs_py import grasps as messages
from sq_msgs_py.poses import plane_message
from sq_msgs_py.superquadrics import SuperquadricArray, to_message
from sq_perception.grasping.planner import warm_up
from sq_perception.nodes import grasp_node
from sq_perception.nodes.frame import latched_qos
from sq_perception.nodes.grasp_node import GraspNode

BOX, CAN, WALL = 4, 7, 9
HEADER = Header(frame_id="base_link")


def bodies():
    return SuperquadricArray(
        size=np.array([[0.05, 0.02, 0.06], [0.033, 0.033, 0.06], [0.1, 0.1, 0.1]]),
        shape=np.array([[0.1, 0.1], [0.1, 1.0], [0.1, 0.1]]),
        translation=np.array([[0.4, 0.0, 0.06], [0.6, 0.0, 0.06], [0.0, 0.5, 0.1]]),
        rotation=np.tile([0.0, 0.0, 0.0, 1.0], (3, 1)), score=np.ones(3), residual=np.zeros(3),
        sigma_size=np.full((3, 3), 0.001), sigma_centre=np.full((3, 3), 0.001), sigma_turn=np.full((3, 3), 0.01),
        id=np.array([BOX, CAN, WALL]), status=np.zeros(3, dtype=int),
    )


class Bench(SpunNodes):
    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.said = self.hear(Log, "/rosout", QoSProfile(depth=50, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL))
        self.reports = self.hear(DiagnosticArray, "/diagnostics")
        self.node = GraspNode("grasp_node", context=self.context)
        self.heard = {}
        for kind, topic in ((PoseArray, "grasps"), (PointCloud2, "grasp_details"), (MarkerArray, "markers")):
            self.peer.create_subscription(
                kind, f"/grasp_node/{topic}", lambda message, topic=topic: self.heard.update({topic: message}), 10
            )
        self.cloud = self.peer.create_publisher(PointCloud2, "/superquadrics", 10)
        self.plane = self.peer.create_publisher(PoseStamped, "/support_plane", latched_qos())
        self.plane.publish(plane_message(np.array([0.0, 0.0, 1.0, 0.0]), HEADER))
        self.spin([self.node])
        self.until(lambda: self.node.is_active and self.cloud.get_subscription_count())
        self.until(lambda: self.node._plane is not None)
        self.until(lambda: all(one.get_subscription_count() for one in self.node._outputs))

    def answer(self, message):
        self.heard.clear()
        self.cloud.publish(message)
        self.until(lambda: len(self.heard) == 3)
        return self.heard

    def says(self, words):
        self.until(lambda: any(words in entry.msg for entry in tuple(self.said)))

    def report(self, condition):

        def found():
            each = ((one.status[0], {pair.key: pair.value for pair in one.status[0].values}) for one in [*self.reports])
            return next((report for report in each if condition(*report)), None)

        self.until(found)
        return found()

    def close(self):
        self.node.close()
        super().close()


@pytest.fixture(scope="module", autouse=True)
def compiled():
    """Kernels that have to be compiled first would take longer than the bench is patient."""
    warm_up()


@pytest.fixture
def bench():
    with Bench() as one:
        yield one


def test_grasps_come_best_first_with_the_header_of_the_bodies(bench):
    message = to_message(bodies(), HEADER)
    heard = bench.answer(message)
    details = messages.from_message(heard["grasp_details"])
    assert {one.header.frame_id for one in (heard["grasps"], heard["grasp_details"])} == {"base_link"}
    assert set(details.id) == {BOX, CAN}
    assert (np.diff(details.score) <= 0).all()
    assert len(heard["grasps"].poses) == len(details)
    first = heard["grasps"].poses[0].position
    np.testing.assert_allclose([first.x, first.y, first.z], details.position[0], atol=1e-6)
    assert (details.position[:, 2] > 0.0095).all(), "the tips are above the plane z = 0"
    assert {marker.id for marker in heard["markers"].markers[1:]} == {BOX, CAN}
    # However far away the origin of a map is: the numbers of the default region are no limit.
    there = replace(bodies(), translation=bodies().translation + [250.0, -400.0, 0.0])
    assert set(messages.from_message(bench.answer(to_message(there, HEADER))["grasp_details"]).id) == {BOX, CAN}


def test_the_node_says_what_it_listens_to_and_diagnostics_what_it_did(bench):
    """A cloud of something else is refused, and the next one answered."""
    bench.says("ready, listening to /superquadrics")
    bench.answer(to_message(bodies(), HEADER))
    status, values = bench.report(lambda status, values: values["answered"] == "1")
    assert (status.level, status.name) == (DiagnosticStatus.OK, "grasp_node: clouds")
    assert "grasps of 3 bodies" in values["last answer"]
    assert float(values["plan: median [ms]"]) > 0
    assert float(values["age of the bodies [s]"]) >= 0
    bench.cloud.publish(PointCloud2(width=3, height=1))
    status, values = bench.report(lambda status, values: values["refused"] == "1")
    assert values["last error"]
    assert (values["received"], values["in work"]) == ("2", "0")
    assert len(bench.answer(to_message(bodies(), Header()))["grasps"].poses) > 0
    assert len(bench.answer(to_message(SuperquadricArray.empty(), Header()))["grasps"].poses) == 0


def test_silence_is_reported_with_who_publishes():
    with Bench("-p", "no_cloud_warning:=0.1") as bench:
        bench.says("no superquadrics on /superquadrics for")
        bench.says("1 publisher: /peer")
        bench.report(lambda status, _: status.message == "no superquadrics arrive")
        bench.peer.destroy_publisher(bench.cloud)
        bench.until(lambda: bench.node._clouds.publishers == "nobody publishes it")
        bench.says("nobody publishes it")


def test_old_bodies_are_not_planned_for():
    """By the node's clock, here a simulated one: from the image's stamp, or the cloud's arrival where it has none."""
    with Bench("-p", "use_sim_time:=true", "-p", "max_age:=10.0") as bench:
        clock = bench.peer.create_publisher(Clock, "/clock", 10)
        bench.until(clock.get_subscription_count)

        def at(seconds):
            clock.publish(Clock(clock=Time(sec=seconds)))
            bench.until(lambda: bench.node.get_clock().now().nanoseconds == seconds * 10**9)

        def planned():
            return bench.call(Trigger, "/grasp_node/plan")

        at(1000)
        bench.answer(to_message(bodies(), Header(stamp=Time(sec=997), frame_id="base_link")))
        at(1007)
        assert '; 10.0 s old"' in planned().message
        at(1008)
        answer = planned()
        assert not answer.success
        assert answer.message == "the last superquadrics are 11.0 s old, and max_age is 10 s"
        bench.answer(to_message(bodies(), Header(frame_id="base_link")))
        at(1018)
        assert planned().success
        at(1019)
        assert not planned().success
        bench.set(bench.node, max_age=0)
        assert planned().success


def test_bodies_of_the_unit_cube_are_refused(bench):
    """As by sq-perception grasp: they are no metres."""
    bench.cloud.publish(to_message(bodies(), Header(frame_id="unit_cube")))
    bench.until(lambda: bench.node._last is not None)
    answer = bench.call(Trigger, "/grasp_node/plan")
    assert not answer.success
    assert "no metres to grasp in" in answer.message
    assert not bench.heard


def test_one_body_may_be_asked_for_and_the_reason_of_none_is_told(bench):
    bench.answer(to_message(bodies(), HEADER))
    bench.set(bench.node, only_id=WALL)
    answer = bench.call(Trigger, "/grasp_node/plan")
    assert not answer.success
    assert f"{WALL}: wider than the opening" in answer.message
    bench.until(lambda: not bench.heard["grasps"].poses)
    assert [marker.action for marker in bench.heard["markers"].markers] == [Marker.DELETEALL]


def test_a_region_may_be_asked_for_and_the_answer_has_its_grasps(bench):
    bench.answer(to_message(bodies(), HEADER))
    bench.heard.clear()
    (refused,) = bench.node.set_parameters([Parameter("region", value=[0.5, -0.1, 0.0, 0.4, 0.1, 0.2])])
    assert "region: expected least x, y, z and greater" in refused.reason
    bench.set(bench.node, region=[0.5, -0.1, 0.0, 0.7, 0.1, 0.2])
    answer = answers.grasps_from_response(bench.call(Trigger, "/grasp_node/plan"))
    assert (answer.frame_id, set(answer.grasps.id)) == ("base_link", {CAN})
    bench.until(lambda: "grasp_details" in bench.heard)
    told = messages.from_message(bench.heard["grasp_details"])
    for column in fields(told):
        np.testing.assert_array_equal(getattr(answer.grasps, column.name), getattr(told, column.name))
    bench.set(bench.node, only_id=BOX)
    answer = bench.call(Trigger, "/grasp_node/plan")
    assert not answer.success
    assert answer.message.startswith("0 grasps of 3 bodies; only_id and region leave none; ")


def test_what_is_too_wide_is_taken_by_a_part(bench):
    """A head as long as the wall, with a handle that points up; parts share its id."""
    both = np.array([2, 2])
    parts = replace(
        bodies().where(both), size=np.array([[0.1, 0.1, 0.05], [0.015, 0.015, 0.05]]),
        translation=np.array([[0.0, 0.5, 0.05], [0.0, 0.5, 0.15]]), part=np.array([1, 2]),
    )
    assert WALL not in messages.from_message(bench.answer(to_message(bodies(), HEADER))["grasp_details"]).id
    found = messages.from_message(bench.answer(to_message(bodies().followed_by(parts), HEADER))["grasp_details"])
    assert set(found.id) == {BOX, CAN, WALL}
    assert (found.position[found.id == WALL, 2] > 0.1).all()


def test_a_cloud_that_is_planned_while_the_node_is_deactivated_is_dropped(bench, monkeypatch):
    """Deactivated between the plan and its publication: no refusal, no grasps, and the next activation answers."""
    planned, said = grasp_node.plan, []

    def deactivated(*given):
        assert bench.node._change("deactivate")
        return planned(*given)

    with monkeypatch.context() as patched:
        patched.setattr(grasp_node, "plan", deactivated)
        patched.setattr(bench.node.get_logger(), "warning", lambda text, **_: said.append(text))
        assert bench.node._answer(to_message(bodies(), HEADER)) == (None, "the node is inactive")
    assert not said
    assert bench.node._change("activate")
    bench.until(lambda: all(one.get_subscription_count() for one in bench.node._outputs))
    bench.until(bench.cloud.get_subscription_count)
    assert len(bench.answer(to_message(bodies(), HEADER))["grasps"].poses) > 0


def test_a_pause_leaves_no_subscription_and_no_publisher_behind(bench):
    def there():
        names = [f"/grasp_node/{name}" for name in ("grasps", "grasp_details", "markers")]
        counts = [len(bench.peer.get_publishers_info_by_topic(name)) for name in names]
        return [*counts, bench.plane.get_subscription_count(), bench.cloud.get_subscription_count()]

    for _ in range(3):
        bench.until(lambda: there() == [1] * 5)
        assert bench.node._change("deactivate")
        bench.until(lambda: there() == [0] * 5)
        assert bench.node._change("activate")


def test_what_was_there_before_a_pause_is_neither_shown_nor_planned_for_after_it(bench):
    bench.answer(to_message(bodies(), HEADER))
    assert bench.call(Trigger, "/grasp_node/plan").success
    bench.heard.clear()
    assert bench.node._change("deactivate")
    bench.until(lambda: "markers" in bench.heard)
    assert [marker.action for marker in bench.heard["markers"].markers] == [Marker.DELETEALL]
    assert bench.node._change("activate")
    answer = bench.call(Trigger, "/grasp_node/plan")
    assert (answer.success, answer.message) == (False, "no superquadrics have come yet")


def asked_for(bench, target):
    """What MoveIt's service answers: its handler, as classes of a service exist only where they are built."""
    from moveit_msgs.msg import MoveItErrorCodes

    response = SimpleNamespace(grasps=[], error_code=MoveItErrorCodes())
    return bench.node._on_plan_grasps(SimpleNamespace(target=SimpleNamespace(id=target)), response)


def test_moveit_asks_for_the_grasps_of_one_object(bench, monkeypatch):
    soft_messages.install(monkeypatch)
    early = asked_for(bench, "")
    assert early.error_code.val == early.error_code.FAILURE
    assert early.error_code.message == "no superquadrics have come yet"

    details = messages.from_message(bench.answer(to_message(bodies(), HEADER))["grasp_details"])
    every = asked_for(bench, "")
    assert (every.error_code.val, every.error_code.source) == (every.error_code.SUCCESS, "/grasp_node")
    np.testing.assert_allclose([one.grasp_quality for one in every.grasps], details.score, atol=1e-6)
    can = asked_for(bench, f"superquadric_{CAN}")
    assert len(can.grasps) == (details.id == CAN).sum()
    assert {tuple(one.allowed_touch_objects) for one in can.grasps} == {(f"superquadric_{CAN}",)}
    first = can.grasps[0]
    assert first.grasp_pose.header.frame_id == first.post_grasp_retreat.direction.header.frame_id == "base_link"
    lift = first.post_grasp_retreat.direction.vector
    np.testing.assert_allclose([lift.x, lift.y, lift.z], [0.0, 0.0, 1.0], atol=1e-12)
    assert first.grasp_posture.joint_names == ["panda_finger_joint1", "panda_finger_joint2"]

    wall = asked_for(bench, f"superquadric_{WALL}")
    assert not wall.grasps
    assert wall.error_code.val == wall.error_code.PLANNING_FAILED
    assert f"{WALL}: wider than the opening" in wall.error_code.message
    other = asked_for(bench, "table")
    assert other.error_code.val == other.error_code.INVALID_OBJECT_NAME
    assert "expected an id among superquadric_4, superquadric_7" in other.error_code.message


def test_without_a_table_the_retreat_goes_back_as_it_came(bench, monkeypatch):
    soft_messages.install(monkeypatch)
    bench.answer(to_message(bodies(), Header(frame_id="elsewhere")))
    for one in asked_for(bench, f"superquadric_{BOX}").grasps:
        came, goes = one.pre_grasp_approach.direction, one.post_grasp_retreat.direction
        assert came.header.frame_id == goes.header.frame_id == "panda_hand"
        assert (came.vector.x, came.vector.y, came.vector.z) == (-goes.vector.x, -goes.vector.y, -goes.vector.z)


def test_moveit_is_answered_over_the_wire(bench):
    services = pytest.importorskip("moveit_msgs.srv", reason="moveit_msgs is not installed: it is not on PyPI")
    bench.answer(to_message(bodies(), HEADER))
    request = services.GraspPlanning.Request()
    request.target.id = f"superquadric_{BOX}"
    answer = bench.call(services.GraspPlanning, "/grasp_node/plan_grasps", request)
    assert answer.error_code.val == answer.error_code.SUCCESS
    assert {tuple(one.allowed_touch_objects) for one in answer.grasps} == {(f"superquadric_{BOX}",)}
