"""Superquadrics as other stacks take them: frames, detections, collision objects, and arrays in other frames."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("shape_msgs", reason="message packages missing: install the extra 'ros' or source ROS 2")

import soft_messages
from builtin_interfaces.msg import Time
from std_msgs.msg import Header

from sq_msgs_py import poses
from sq_msgs_py.collision_objects import Scene, collision_objects, planning_scene, removals
from sq_msgs_py.poses import detections, transforms
from sq_msgs_py.superquadrics import CONVERGED, FAILED, WEAK, SuperquadricArray
from sq_perception import Superquadric, mesh
from sq_perception.geometry import rotation as quaternions

HEADER = Header(stamp=Time(sec=7, nanosec=8), frame_id="optical")
QUARTER_ABOUT_Z = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])


@pytest.fixture(autouse=True)
def packages(monkeypatch: pytest.MonkeyPatch) -> None:
    soft_messages.install(monkeypatch)


def three() -> SuperquadricArray:
    """A box, a body that failed, and a can."""
    return SuperquadricArray(
        size=np.array([[0.05, 0.04, 0.03], [1.0, 1.0, 1.0], [0.03, 0.03, 0.06]]),
        shape=np.array([[0.1, 0.1], [1.0, 1.0], [0.1, 1.0]]),
        translation=np.array([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0], [-0.5, 0.25, 0.75]]),
        rotation=np.array([[0.0, 0.0, 0.6, 0.8], [0.0, 0.0, 0.0, 1.0], [0.0, 2.0, 0.0, 0.0]]),
        score=np.array([0.75, 0.0, np.nan]), residual=np.array([0.001, np.nan, 0.002]),
        sigma_size=np.full((3, 3), 0.001), id=np.array([4, 2**31 + 9, 6]), status=np.array([CONVERGED, FAILED, WEAK]),
    )


def numbers(pose: Any) -> tuple[list[float], list[float]]:
    p, q = pose.position, pose.orientation
    return [p.x, p.y, p.z], [q.x, q.y, q.z, q.w]


def test_moving_an_array_is_moving_its_bodies():
    """Two routes: columns by numpy, with a quaternion of any length, and bodies by the geometry; the rest stays."""
    rng = np.random.default_rng(3)
    turn, shift = quaternions.random(1, rng)[0], rng.normal(size=3)
    array = replace(three(), rotation=quaternions.random(3, rng))
    there = poses.move(array, 3 * turn, shift)
    for column in ("size", "shape", "score", "residual", "sigma_size", "id", "status"):
        np.testing.assert_array_equal(getattr(there, column), getattr(array, column))
    for k in range(3):
        one = Superquadric(*(getattr(array, c)[k].astype(float) for c in ("size", "shape", "translation", "rotation")))
        expected = one.transformed(turn, shift)
        np.testing.assert_allclose(there.translation[k], expected.translation, atol=1e-6)
        assert quaternions.geodesic_angle(there.rotation[k].astype(float), expected.rotation) < 1e-5
    back = quaternions.conjugate(turn)
    again = poses.move(there, back, -quaternions.to_matrix(back) @ shift)
    np.testing.assert_allclose(again.translation, array.translation, atol=1e-6)
    np.testing.assert_allclose(np.abs(np.sum(again.rotation * array.rotation, axis=1)), 1, atol=1e-6)


def test_covariances_turn_with_the_frame_an_empty_array_moves_and_a_header_keeps_its_stamp():
    rng = np.random.default_rng(4)
    turn = quaternions.random(1, rng)[0]
    factor = rng.normal(size=(2, 6, 6))
    known = factor @ np.swapaxes(factor, 1, 2)
    found = poses.turn_covariances(known, 2 * turn)
    change = np.zeros((6, 6))
    change[:3, :3] = change[3:, 3:] = quaternions.to_matrix(turn)
    np.testing.assert_allclose(found, [change @ one @ change.T for one in known], atol=1e-12)
    assert np.isnan(poses.turn_covariances(np.full((1, 6, 6), np.nan), turn)).all()
    assert len(poses.move(SuperquadricArray.empty(), QUARTER_ABOUT_Z, np.zeros(3))) == 0
    header = poses.header_in(HEADER, "map")
    assert (header.frame_id, header.stamp) == ("map", HEADER.stamp)
    assert HEADER.frame_id == "optical"


@pytest.mark.parametrize(
    ("rotation", "translation"),
    [(np.zeros(4), np.zeros(3)), ([0, 0, 0, np.nan], np.zeros(3)), (np.ones(3), np.zeros(3)),
     (QUARTER_ABOUT_Z, [0, np.inf, 0]), (QUARTER_ABOUT_Z, np.zeros(2))],
)  # fmt: skip
def test_what_is_no_motion_is_refused(rotation, translation):
    with pytest.raises(ValueError, match=r"rotation|motion"):
        poses.move(three(), np.array(rotation), np.array(translation))


def test_frames_of_bodies_that_did_not_fail():
    first, second = transforms(three(), HEADER)
    assert (first.child_frame_id, second.child_frame_id) == ("superquadric_4", "superquadric_6")
    assert first.header == second.header == HEADER
    shift, turn = first.transform.translation, first.transform.rotation
    assert [shift.x, shift.y, shift.z] == [1.0, 2.0, 3.0]
    assert [turn.x, turn.y, turn.z, turn.w] == pytest.approx([0, 0, 0.6, 0.8])
    turn = second.transform.rotation
    assert [turn.x, turn.y, turn.z, turn.w] == [0.0, 1.0, 0.0, 0.0], "of length 1, as tf2 asks for"
    assert transforms(three(), HEADER, prefix="left/")[0].child_frame_id == "left/4"
    assert transforms(SuperquadricArray.empty(), HEADER) == []
    assert len(SuperquadricArray.empty().recovered) == 0
    with pytest.raises(ValueError, match="frame_id"):
        transforms(three(), Header())


def test_detections_say_full_sizes_scores_names_and_the_covariances_that_are_known():
    message = detections(three(), HEADER, prefix="body")
    assert message.header == HEADER
    box, can = message.detections
    assert (box.id, can.id) == ("body4", "body6")
    assert box.header == HEADER
    assert (box.bbox.size.x, box.bbox.size.y, box.bbox.size.z) == pytest.approx((0.10, 0.08, 0.06))
    assert numbers(box.bbox.center) == numbers(box.results[0].pose.pose)
    assert numbers(box.bbox.center)[0] == [1.0, 2.0, 3.0]
    (result,) = box.results
    assert (result.hypothesis.class_id, result.hypothesis.score) == ("superquadric", 0.75)
    assert can.results[0].hypothesis.score == 0.0, "unknown"
    assert not np.any(result.pose.covariance)
    assert detections(SuperquadricArray.empty(), HEADER).detections == []
    known = np.full((3, 6, 6), np.nan)
    known[0] = np.arange(36).reshape(6, 6)
    box, can = detections(three(), HEADER, covariances=known).detections
    assert list(box.results[0].pose.covariance) == list(range(36))
    assert not np.any(can.results[0].pose.covariance)
    with pytest.raises(ValueError, match=r"covariances: expected shape \(3, 6, 6\)"):
        detections(three(), HEADER, covariances=known[:2])


def test_collision_objects_of_primitives():
    box, can = collision_objects(three(), HEADER)
    assert (box.id, can.id) == ("superquadric_4", "superquadric_6")
    assert (box.operation, box.header) == (type(box).ADD, HEADER)
    assert (numbers(box.pose)[0], numbers(box.pose)[1]) == ([1.0, 2.0, 3.0], pytest.approx([0, 0, 0.6, 0.8]))
    assert [list(one.dimensions) for one in box.primitives] == [pytest.approx([0.10, 0.08, 0.06])]
    assert [list(one.dimensions) for one in can.primitives] == [pytest.approx([0.12, 0.03])]
    assert numbers(can.primitive_poses[0]) == ([0, 0, 0], [0, 0, 0, 1])
    assert not len(box.meshes)
    assert not len(box.mesh_poses)


def test_collision_objects_of_meshes_stand_where_the_bodies_are():
    """A mesh in the body's frame, through the object's pose, is the body's mesh in the header's frame."""
    array = three()
    shown = array.recovered
    centred = [Superquadric(shown.size[k], shown.shape[k], np.zeros(3), [0, 0, 0, 1]) for k in range(2)]
    surfaces = [mesh(one, 16) for one in centred]
    objects = collision_objects(array, HEADER, meshes=[(one.vertices, one.faces) for one in surfaces], prefix="")
    assert [one.id for one in objects] == ["4", "6"]
    for k, one in enumerate(objects):
        assert not len(one.primitives)
        assert numbers(one.mesh_poses[0]) == ([0, 0, 0], [0, 0, 0, 1])
        centre, turn = (np.array(part) for part in numbers(one.pose))
        points = np.array([[p.x, p.y, p.z] for p in one.meshes[0].vertices]) @ quaternions.to_matrix(turn).T + centre
        body = Superquadric(*(getattr(shown, c)[k] for c in ("size", "shape", "translation", "rotation")))
        gauge = body.gauge(points)
        assert gauge.min() == pytest.approx(gauge.max(), abs=1e-4), "the body's form"
        assert 1 < gauge.min() < 1.03, "and a little larger"
        assert len(one.meshes[0].triangles) == len(surfaces[k].faces)
    with pytest.raises(ValueError, match="meshes: expected one for each of 2 bodies, got 1"):
        collision_objects(array, HEADER, meshes=[([], [])])


def test_scenes_are_differences_and_removals_never_mean_everything():
    objects = [*collision_objects(three(), HEADER), *removals({"superquadric_9", "superquadric_2"}, HEADER)]
    scene = planning_scene(objects)
    assert scene.is_diff
    assert scene.robot_state.is_diff, "otherwise MoveIt takes the empty robot state for the robot's"
    assert [one.id for one in scene.world.collision_objects] == [f"superquadric_{k}" for k in (4, 6, 2, 9)]
    gone = scene.world.collision_objects[-1]
    assert (gone.operation, gone.header) == (type(gone).REMOVE, HEADER)
    assert not len(gone.primitives)
    with pytest.raises(ValueError, match="MoveIt would remove all objects"):
        removals([""], HEADER)


def test_a_round_body_at_rest_is_sent_once():
    """Its rotation about its own axis is arbitrary, as are all rotations of a ball, and axes of equal length swap."""
    rng, scene = np.random.default_rng(11), Scene()
    can = three().where(np.array([False, False, True]))
    ball = replace(can, size=np.full((1, 3), 0.04), shape=np.ones((1, 2)), id=np.array([7]))
    box = replace(can, size=np.array([[0.05, 0.03, 0.03]]), shape=np.full((1, 2), 0.2), id=np.array([8]))
    assert len(scene.changes(can, HEADER)) == 1
    for _ in range(20):
        angle = rng.uniform(0, np.pi)
        turned = poses.product(can.rotation, np.array([0.0, 0.0, np.sin(angle), np.cos(angle)]))
        quivering = replace(can, rotation=turned, translation=can.translation + rng.normal(0, 1e-4, 3))
        assert scene.changes(quivering, HEADER) == []
    tilted = poses.product(can.rotation, np.array([np.sin(0.02), 0.0, 0.0, np.cos(0.02)]))
    assert len(scene.changes(replace(can, rotation=tilted), HEADER)) == 1, "its rims have moved by 2.7 mm"
    scene = Scene()
    assert len(scene.changes(ball, HEADER)) == 1
    for rotation in quaternions.random(20, rng):
        assert scene.changes(replace(ball, rotation=rotation[None]), HEADER) == []
    scene = Scene()
    assert len(scene.changes(box, HEADER)) == 1
    swapped = replace(box, size=box.size[:, [1, 0, 2]], rotation=poses.product(box.rotation, QUARTER_ABOUT_Z))
    assert scene.changes(swapped, HEADER) == [], "a quarter turn of a box whose edges swap is the same box"


@pytest.mark.parametrize("normal", [[0, 0, 1], [1, 0, 0], [-1, 0, 0], [0, -1, 0], [0.1, -0.8, -0.59]])
def test_a_plane_is_a_pose_on_it_with_z_along_its_normal(normal: list[float]) -> None:
    """And moves with its frame: heights of points stay what they are."""
    plane = np.append(np.array(normal) / np.linalg.norm(normal), 0.7)
    message = poses.plane_message(3 * plane, HEADER)
    assert message.header == HEADER
    np.testing.assert_allclose(poses.plane_of(message), plane, atol=1e-12)
    centre = message.pose.position
    np.testing.assert_allclose([centre.x, centre.y, centre.z], -0.7 * plane[:3], atol=1e-12)
    turn, shift = np.array([0.1, 0.5, -0.3, 0.8]), np.array([1.0, 2.0, 3.0])
    points = np.array([[0.3, 0.1, 0.9], [-0.2, 0.4, 1.5]])
    there = points @ poses.matrices(poses.unit_quaternions(turn)).T + shift
    moved = poses.move_plane(plane, turn, shift)
    np.testing.assert_allclose(there @ moved[:3] + moved[3], points @ plane[:3] + plane[3], atol=1e-12)
