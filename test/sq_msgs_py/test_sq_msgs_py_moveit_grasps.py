"""moveit_msgs/Grasp of grasps, with classes built by hand: poses of the link, approaches, what may be touched."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from sq_msgs_py.grasps import GraspArray, moveit_grasps
from sq_perception.geometry import rotation as quaternions
from sq_perception.grasping.gripper import GRIPPERS

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
