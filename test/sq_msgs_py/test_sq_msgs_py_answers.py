"""What ~/recover, ~/plan and MoveIt are answered: every number as it was; nothing hostile is taken for an answer."""

import json
from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pytest
from random_bodies import random_bodies

from sq_msgs_py.answers import from_response, grasps_from_response, text_of
from sq_msgs_py.grasps import GraspArray, moveit_grasps
from sq_msgs_py.superquadrics import MessageError
from sq_perception.geometry import rotation as quaternions
from sq_perception.grasping.gripper import GRIPPERS

HEADER = SimpleNamespace(frame_id="camera", stamp=SimpleNamespace(sec=7, nanosec=5))


def bodies(count):
    return random_bodies(count, np.random.default_rng(count))


def answered(text, success=True):
    return from_response(SimpleNamespace(success=success, message=text))


RNG = np.random.default_rng(1)
GRASPS = GraspArray(RNG.random((3, 3)), RNG.random((3, 4)), *RNG.random((3, 3)), np.array([7, 2**31, 7]))


@pytest.mark.parametrize("given", [bodies(0), bodies(1), bodies(5), GRASPS], ids=["0", "1", "5", "grasps"])
def test_every_column_comes_back_bit_by_bit_and_the_one_kind_is_not_taken_for_the_other(given):
    text = text_of(given, HEADER, "words")
    assert "NaN" not in text
    response = SimpleNamespace(success=True, message=text)
    reader, other, name = from_response, grasps_from_response, "~/plan"
    if given is GRASPS:
        reader, other, name = grasps_from_response, from_response, "~/recover"
    found = reader(response)
    assert (found.frame_id, found.stamp, found.summary) == ("camera", 7_000_000_005, "words")
    for column in fields(given):
        read = found.grasps if given is GRASPS else found.bodies
        before, after = getattr(given, column.name), getattr(read, column.name)
        assert before.dtype == after.dtype
        np.testing.assert_array_equal(before, after)
    with pytest.raises(MessageError, match=name):
        other(response)


def test_a_node_of_another_version_knows_more_or_less():
    document = json.loads(text_of(bodies(2), HEADER, ""))
    for row in document["superquadrics"]:
        del row["label"]
        row["colour"] = "red"
    assert answered(json.dumps(document)).bodies.label.tolist() == [0, 0]


def test_what_is_no_answer_is_refused():
    with pytest.raises(MessageError, match="no frame within 5 s"):
        answered("no frame within 5 s", success=False)
    good = json.loads(text_of(bodies(1), HEADER, ""))
    row = good["superquadrics"][0]
    changes = [{"size": [1.0, None, 1.0]}, {"size": [1.0]}, {"id": -1}, {"id": 10**40}, {"id": "a"}, {"score": {}}]
    hostile = [{**good, "superquadrics": [{**row, **change}]} for change in changes]
    hostile += [{**good, "superquadrics": [{}]}, {**good, "superquadrics": 3}, {**good, "stamp": None}, {}, [], 3]
    for text in ["2 bodies in 8 ms", "[" * 10**5, *map(json.dumps, hostile)]:
        with pytest.raises(MessageError, match="~/recover"):
            answered(text)


UP = (0.0, 0.6, 0.8)


def by_hand(name):
    """Stands for any message class: it has the fields that it is given."""
    return lambda **fields: SimpleNamespace(kind=name, **fields)


def grasps():
    rng = np.random.default_rng(0)
    turns = rng.standard_normal((3, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    return GraspArray(
        rng.uniform(-1, 1, (3, 3)), turns, [0.08, 0.06, 0.05], [0.07, 0.05, 0.04], [0.9, 0.8, 0.7], [4, 2, 4]
    )


@pytest.mark.parametrize("hand", GRIPPERS.values(), ids=lambda hand: hand.name)
def test_the_link_holds_the_tcp_where_it_was_planned(hand):
    found = moveit_grasps(grasps(), "header", hand.link, hand.link_from_tcp, UP, "thing_", types=by_hand)
    assert [one.allowed_touch_objects for one in found] == [["thing_4"], ["thing_2"], ["thing_4"]]
    assert [one.grasp_quality for one in found] == pytest.approx([0.9, 0.8, 0.7])
    for k, one in enumerate(found):
        pose = one.grasp_pose.pose
        place = np.array([pose.position.x, pose.position.y, pose.position.z])
        turn = np.array([pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w])
        link = quaternions.to_matrix(turn)
        shift, inner = hand.link_from_tcp
        np.testing.assert_allclose(place + link @ np.array(shift), grasps().position[k], atol=1e-6)
        tcp = quaternions.to_matrix(grasps().rotation[k].astype(float))
        np.testing.assert_allclose(link @ quaternions.to_matrix(np.array(inner)), tcp, atol=1e-5)
        way = one.pre_grasp_approach.direction
        assert way.header.frame_id == hand.link
        along = np.array([way.vector.x, way.vector.y, way.vector.z])
        np.testing.assert_allclose(link @ along, tcp[:, 2], atol=1e-5)
        retreat = one.post_grasp_retreat.direction
        assert retreat.header == "header"
        assert (retreat.vector.x, retreat.vector.y, retreat.vector.z) == UP


def test_fingers_open_by_half_each_and_close_on_the_width():
    hand = GRIPPERS["panda"]
    given = (grasps(), "header", hand.link, hand.link_from_tcp, UP, "thing_")
    first = moveit_grasps(*given, hand.joints, types=by_hand)[0]
    assert first.pre_grasp_posture.joint_names == ["panda_finger_joint1", "panda_finger_joint2"]
    assert first.pre_grasp_posture.points[0].positions == pytest.approx([0.04, 0.04])
    assert first.grasp_posture.points[0].positions == pytest.approx([0.035, 0.035])
    wide = replace(grasps(), width=[0.12, 0.05, 0.04])  # a side that is so unsure that it may be narrower
    first = moveit_grasps(wide, *given[1:], hand.joints, types=by_hand)[0]
    assert first.grasp_posture.points[0].positions == first.pre_grasp_posture.points[0].positions
    assert not hasattr(moveit_grasps(*given, types=by_hand)[0].grasp_posture, "points")
