"""What nodes and their peers do with sq_msgs; run by test_sq_msgs.py, in an environment where it is built."""

from dataclasses import replace

import numpy as np
import pytest
from random_bodies import random_bodies
from rclpy.action import ActionClient
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2
from spun_nodes import SpunNodes
from std_msgs.msg import Header

from sq_msgs.action import Recover as RecoverImages
from sq_msgs.msg import GraspArray, Superquadric, SuperquadricArray
from sq_msgs.srv import PlanGrasps, Recover
from sq_msgs_py import superquadrics
from sq_msgs_py.answers import superquadric_array
from sq_perception.grasping import planner
from sq_perception.nodes.grasp_node import GraspNode
from sq_perception.tracking import association


@pytest.fixture(scope="module", autouse=True)
def compiled():
    """Kernels that have to be compiled first would take longer than a bench is patient."""
    association.warm_up()
    planner.warm_up()


def bodies(count: int = 2) -> superquadrics.SuperquadricArray:
    return random_bodies(count, np.random.default_rng(3))


def same(found: Superquadric, array: superquadrics.SuperquadricArray, k: int) -> None:
    place, turn, size = found.pose.pose.position, found.pose.pose.orientation, found.half_size
    np.testing.assert_array_equal([place.x, place.y, place.z], array.translation[k])
    np.testing.assert_array_equal([turn.x, turn.y, turn.z, turn.w], array.rotation[k])
    np.testing.assert_array_equal([size.x, size.y, size.z], array.size[k])
    np.testing.assert_array_equal(found.exponents, array.shape[k])
    np.testing.assert_array_equal(found.taper, array.taper[k])
    for name in ("id", "label", "status", "reason", "seen", "part", "fused", "score", "residual", "objectness"):
        np.testing.assert_array_equal(getattr(found, name), getattr(array, name)[k], name)


def test_a_message_holds_every_number_of_the_cloud_the_covariances_and_parts():
    array, header = bodies(), Header(frame_id="camera")
    covariances = np.random.default_rng(4).random((2, 6, 6))
    sent = superquadric_array(array, covariances, header, replace(array, part=np.array([1, 2])))
    message = deserialize_message(serialize_message(sent), SuperquadricArray)
    for k in range(2):
        same(message.superquadrics[k], array, k)
        np.testing.assert_array_equal(message.superquadrics[k].pose.covariance, covariances[k].ravel())
        np.testing.assert_array_equal(message.superquadrics[k].sigma_exponents, array.sigma_shape[k])
    for k, part in enumerate(message.parts):
        same(part, replace(array, part=np.array([1, 2])), k)
        assert np.isnan(part.pose.covariance).all()
    names = {name: value for name, value in vars(superquadrics).items() if name in ("CONVERGED", "WEAK", "FAILED")}
    names |= {one.name: int(one) for one in superquadrics.Reason}
    assert {name: getattr(Superquadric, name) for name in names} == names, "the constants are those of the cloud"


def test_recover_node_publishes_and_answers_in_it(make_bench):
    bench = make_bench()
    heard = bench.hear(SuperquadricArray, "recover_node/superquadric_array", 10)
    bench.until(lambda: bench.node._outputs.array.get_subscription_count())
    bench.send_info()
    cloud, array = bench.answer(bench.depth())
    bench.until(lambda: heard)
    assert heard[0].header == cloud.header
    same(heard[0].superquadrics[0], array, 0)
    assert heard[0].superquadrics[0].status == Superquadric.CONVERGED

    client = bench.peer.create_client(Recover, "recover_node/recover_array")
    assert client.wait_for_service(30.0)
    asked = client.call_async(Recover.Request())
    bench.until(lambda: bench.node._triggers)
    bench.send(bench.depth())
    bench.until(asked.done)
    assert asked.result().success, asked.result().message
    assert len(asked.result().bodies.superquadrics) == 1

    images, seen = ActionClient(bench.peer, RecoverImages, "recover_node/recover_images"), []
    assert images.wait_for_server(30.0)
    goal = images.send_goal_async(RecoverImages.Goal(images=2), lambda message: seen.append(message.feedback.bodies))
    bench.until(goal.done)
    ended = goal.result().get_result_async()
    for count in (1, 2):
        bench.until(lambda: bench.node._triggers)
        bench.send(bench.depth())
        bench.until(lambda count=count: len(seen) == count)
    bench.until(ended.done)
    assert ended.result().result.success
    assert repr(ended.result().result.bodies) == repr(seen[-1]), "the same, NaN of what is not known included"
    images.destroy()


def test_masks_of_detections_are_used(make_bench):
    from yolo_msgs.msg import Detection, DetectionArray, Mask, Point2D

    def detection(score: float, *corners: tuple[float, float]) -> Detection:
        points = [Point2D(x=float(x), y=float(y)) for x, y in corners]
        return Detection(score=score, mask=Mask(width=64, height=48, data=points))

    bench = make_bench()
    detections = bench.peer.create_publisher(DetectionArray, "mask/detections", 5)
    bench.until(lambda: detections.get_subscription_count() and bench.node.count_publishers("/mask/detections"))
    bench.send_info()
    expected = np.zeros((48, 64), np.int32)
    expected[10:31, 5:26] = 2
    expected[20:41, 15:36] = 1
    image = bench.depth()
    first = detection(0.9, (15, 20), (35, 20), (35, 40), (15, 40))
    second = detection(0.4, (5, 10), (25, 10), (25, 30), (5, 30))
    detections.publish(DetectionArray(header=image.header, detections=[first, second]))
    bench.answer(image)
    np.testing.assert_array_equal(bench.recoverer.asked[-1][2], expected, "the surer one is on top")

    image = bench.depth()
    detections.publish(DetectionArray(header=image.header))
    bench.answer(image)
    assert not bench.recoverer.asked[-1][2].any(), "an image without detections has no objects"

    outside = detection(1.0, (-1e30, -5), (1e30, -5), (1e30, 1e30), (-1e30, 1e30))
    image = bench.depth()
    detections.publish(DetectionArray(header=image.header, detections=[outside]))
    bench.answer(image)
    assert (bench.recoverer.asked[-1][2] == 1).all(), "cut at the image's border"

    wide = Detection(mask=Mask(width=640, height=480, data=first.mask.data))
    for wrong, words in ((Detection(), "use a model for segmentation"), (wide, "align the depth image")):
        image = bench.depth()
        detections.publish(DetectionArray(header=image.header, detections=[first, wrong]))
        counts = bench.send(image)
        assert words in counts.last_error


def test_grasp_node_publishes_and_answers_in_it():
    bench = SpunNodes()
    node = GraspNode("grasp_node", context=bench.context)
    try:
        clouds = bench.peer.create_publisher(PointCloud2, "superquadrics", 10)
        heard = bench.hear(GraspArray, "grasp_node/grasp_array", 10)
        bench.spin([node])
        bench.until(lambda: node.is_active and clouds.get_subscription_count())
        upright = superquadrics.SuperquadricArray(
            **{
                **{name: getattr(bodies(1), name) for name in ("score", "residual", "status", "objectness")},
                "id": [7], "size": [[0.02, 0.02, 0.05]], "shape": [[0.2, 1.0]], "translation": [[0.0, 0.0, 0.5]],
                "rotation": [[0.7071068, 0.0, 0.0, 0.7071068]], "sigma_size": [[0.001, 0.001, 0.001]],
            }
        )
        clouds.publish(superquadrics.to_message(upright, Header(frame_id="camera")))
        bench.until(lambda: heard)
        assert heard[0].grasps, "a can that a hand can hold"
        best = heard[0].grasps[0]
        assert best.id == 7
        assert 0.03 < best.width < best.opening
        client = bench.peer.create_client(PlanGrasps, "grasp_node/plan_array")
        assert client.wait_for_service(30.0)
        asked = client.call_async(PlanGrasps.Request())
        bench.until(asked.done)
        assert asked.result().success, asked.result().message
        assert asked.result().grasps.grasps == heard[0].grasps
    finally:
        bench.until(node.close)
        bench.close()
