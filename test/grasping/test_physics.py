"""The physics that picking is measured by: a good grasp holds, one beside the thing does not."""

import numpy as np
import pytest

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.grasping.gripper import PANDA
from sq_perception.grasping.planner import grasps
from sq_perception.grasping.surroundings import Surroundings

pytest.importorskip("mujoco", reason="needs the extra 'picking'")
HALF = np.array([0.02, 0.03, 0.05])
DOWN = quaternions.from_matrix(np.diag([1.0, -1.0, -1.0]))
TABLE = Surroundings(plane=np.array([0.0, 0.0, 1.0, 0.0]))


@pytest.fixture(scope="module")
def picking():
    import picking
    from common import picking_world

    return picking_world, picking


@pytest.fixture(scope="module")
def world_of(picking):
    def made(friction=0.5, half=HALF):
        body = Superquadric(half, [0.1, 0.1], np.zeros(3), [0.0, 0.0, 0.0, 1.0])
        world = picking[0].World([picking[0].Thing(Superquadric.stack([body]), friction)], PANDA)
        world.put(0, np.array([0.0, 0.0, half[2]]), np.array([0.0, 0.0, 0.0, 1.0]))
        world.settle(0.3)
        return world

    return made


def test_a_thing_rests_where_it_was_put_a_good_grasp_holds_and_the_same_beside_does_not(world_of):
    position, _ = world_of().pose(0)
    np.testing.assert_allclose(position, [0, 0, HALF[2]], atol=1e-3)
    at = np.array([0.0, 0.0, 0.075])
    assert world_of().pick(at, DOWN, 0.075).how == "held"
    assert world_of().pick(at + [0.03, 0.0, 0.0], DOWN, 0.075).how == "missed"
    assert world_of().pick(at + [0.0, 0.03, 0.0], DOWN, 0.075).how == "collision"


def test_what_the_planner_plans_holds(world_of):
    world = world_of()
    position, rotation = world.pose(0)
    body = Superquadric.stack([Superquadric(HALF, [0.1, 0.1], position, rotation)])
    best = grasps(body, PANDA, np.zeros((1, 11, 11)), TABLE).grasps[0]
    assert world.pick(best.position, best.rotation, best.opening).held == 0
    assert world.left == []


def test_friction_is_what_holds(world_of):
    """0.12 kg between fingers of some 60 N: 2 mu F is 0.2 N for mu = 0.002, which does not carry 1.2 N."""
    at = np.array([0.0, 0.0, 0.075])
    assert world_of(friction=0.002).pick(at, DOWN, 0.075).held < 0
    assert world_of(friction=1.0).pick(at, DOWN, 0.075).held == 0


def test_a_vessel_has_walls_that_are_taken_at_the_rim(world_of, picking):
    """A cup of 9 cm, wider than the gripper opens: one finger goes into it."""
    world_module, _ = picking
    cup = Superquadric.stack([Superquadric([0.045, 0.045, 0.04], [0.1, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])])
    hollow = Superquadric([[0.042, 0.042, 0.074]], [[0.1, 1.0]], [[0.0, 0.0, 0.04]], [[0.0, 0.0, 0.0, 1.0]])
    thing = world_module.Thing(cup, 0.6, "cup", hollow)
    inside = np.concatenate(thing.solids())
    inside = inside[inside[:, 2] > 0.0]
    assert np.hypot(*inside[:, :2].T).min() > 0.04
    assert np.ptp(inside[:, :2], axis=0) == pytest.approx([0.09, 0.09], abs=2e-3)
    world = world_module.World([thing], PANDA)
    world.put(0, np.array([0.0, 0.0, 0.04]), np.array([0.0, 0.0, 0.0, 1.0]))
    world.settle(0.3)
    assert world.pick(np.array([0.0, 0.0435, 0.07]), DOWN, 0.05).held == 0


def test_failures_are_told_apart(picking):
    failure = picking[1].failure
    assert failure({"held": 2, "how": "held", "touched": "", "aim": 2}) == ""
    assert failure({"held": -1, "how": "collision", "touched": "2", "aim": 2}) == "wrong size"
    assert failure({"held": -1, "how": "collision", "touched": "1", "aim": 2}) == "collision"
    assert failure({"held": -1, "how": "collision", "touched": "table", "aim": 2}) == "collision"
    assert failure({"held": -1, "how": "missed", "touched": "", "aim": 2}) == "missed"


def test_a_gain_is_that_of_the_same_scenes(picking):
    def line(who, seed, taken):
        picks = [{"held": 0}] * taken + [{"held": -1}] * (5 - taken)
        return {"kind": "pile", "contestant": who, "seed": seed, "taken": taken, "picks": picks}

    lines = [line("ours", seed, 4) for seed in range(6)] + [line("box", seed, 3) for seed in range(2, 9)]
    found = picking[1].gain(lines, "pile", "ours", "box")
    assert found["scenes"] == [4]
    np.testing.assert_allclose(found["gsr"], 20.0)
    np.testing.assert_allclose(found["dr"], 20.0)
    assert picking[1].gain(lines, "packed", "ours", "box") == {}
    upright = [{**one, "kind": "packed", "taken": 5, "picks": [{"held": 0}] * 5} for one in lines]
    assert picking[1].gain(lines + upright, "both", "ours", "box")["gsr"][0] == pytest.approx(10.0)
