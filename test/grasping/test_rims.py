"""An open vessel that is too wide for the gripper, seen from above, is taken by its rim; with a lid it is not."""

import numpy as np
import pytest

from sq_perception import Camera, Superquadric
from sq_perception.geometry import rotation as quaternions
from sq_perception.grasping.gripper import PANDA
from sq_perception.grasping.planner import grasps
from sq_perception.grasping.surroundings import Surroundings

CAMERA = Camera(320, 240, 400.0, 400.0, 159.5, 119.5)
TABLE = np.array([0.0, 0.0, -1.0, 0.6])
RADIUS, WALL, RIM = 0.06, 0.004, 0.52
VESSEL = Superquadric.stack([Superquadric([RADIUS, RADIUS, 0.04], [0.1, 1.0], [0.0, 0.0, 0.56], [0.0, 0.0, 0.0, 1.0])])
SURE = np.diag([1e-6] * 3 + [1e-4] * 2 + [1e-6] * 3 + [1e-4] * 3)[None]


def seen_from_above(floor, table=TABLE):
    """A depth image of a round vessel with its floor at z = ``floor``: rays that miss the floor end at its wall."""
    columns, rows = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    radius = RIM * np.hypot(columns - CAMERA.cx, rows - CAMERA.cy) / CAMERA.fx
    inner = RADIUS - WALL
    inside = np.minimum(floor, RIM * inner / np.maximum(radius, 1e-6))
    depth = np.where(radius < inner, inside, np.where(radius < RADIUS, RIM, 0.6))
    return Surroundings.of_image(depth, CAMERA, table)


def test_a_vessel_is_taken_by_its_rim():
    found = grasps(VESSEL, PANDA, SURE, seen_from_above(0.595)).grasps
    assert found
    for grasp in found:
        out = grasp.position[:2] / np.linalg.norm(grasp.position[:2])
        axes = quaternions.to_matrix(grasp.rotation)
        np.testing.assert_allclose(axes[:, 2], [0, 0, 1], atol=1e-9)
        assert axes[:2, 1] @ out == pytest.approx(1.0, abs=1e-2)
        assert np.linalg.norm(grasp.position[:2]) == pytest.approx(RADIUS - 0.5 * WALL, abs=3e-3)
        assert RIM + 0.01 < (grasp.position[2] + PANDA.tip) < 0.595
        assert grasp.opening > grasp.width + 0.01
        assert 0.5 < grasp.score < 0.95


@pytest.mark.parametrize(
    "around",
    [seen_from_above(RIM), seen_from_above(RIM + 0.008), Surroundings(TABLE), seen_from_above(0.595, table=None)],
    ids=["a lid", "full", "no image", "no plane"],
)
def test_without_a_cavity_that_was_seen_there_is_no_rim(around):
    found = grasps(VESSEL, PANDA, SURE, around)
    assert not found.grasps
    assert found.reasons[0]
