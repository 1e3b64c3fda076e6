"""The physics that picking is measured by: a good grasp holds, one beside the thing does not."""

from __future__ import annotations

import sys

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
def world_of(repository):
    sys.path.insert(0, str(repository / "benchmarks"))
    try:
        from picking_world import Thing, World
    finally:
        sys.path.pop(0)

    def made(friction=0.5, half=HALF):
        body = Superquadric(half, [0.1, 0.1], np.zeros(3), [0.0, 0.0, 0.0, 1.0])
        world = World([Thing(Superquadric.stack([body]), friction)], PANDA)
        world.put(0, np.array([0.0, 0.0, half[2]]), np.array([0.0, 0.0, 0.0, 1.0]))
        world.settle(0.3)
        return world

    return made


def test_a_thing_rests_where_it_was_put(world_of):
    position, _ = world_of().pose(0)
    np.testing.assert_allclose(position, [0, 0, HALF[2]], atol=1e-3)


def test_a_good_grasp_holds_and_the_same_beside_does_not(world_of):
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
