"""What benchmarks of things build on: IoU and hulls, against the package's own."""

import household_things
import numpy as np
import pytest
from common import hull_columns
from scipy.spatial import ConvexHull

from sq_perception.geometry import Superquadric, metrics, rotation
from sq_perception.geometry.mesh import mesh
from sq_perception.geometry.union import DIRECTIONS
from sq_perception.simulation.things_on_table import TABLE_CAMERA, things_on_table

BODY = Superquadric([0.06, 0.04, 0.03], [0.3, 0.7], [0.05, -0.03, 0.7], [0.3, -0.2, 0.5, 0.8])


def test_iou_with_a_hull_is_the_iou_of_the_bodies(rng: np.random.Generator) -> None:
    columns = hull_columns.Columns.of(mesh(BODY, 128).vertices)
    assert columns.volume == pytest.approx(float(BODY.volume()), rel=2e-3)
    assert columns.iou(BODY) > 0.995
    for _ in range(5):
        turn, shift = rotation.from_rotation_vector(rng.normal(0, 0.2, 3)), rng.normal(0, 0.01, 3)
        moved = BODY.transformed(turn, BODY.translation - rotation.to_matrix(turn) @ BODY.translation + shift)
        assert columns.iou(moved) == pytest.approx(float(metrics.volume_iou(moved, BODY, 128)), abs=3e-3)


def test_hull_points_span_the_hull() -> None:
    scene = things_on_table(np.random.default_rng(3), 4)
    assert scene.camera == TABLE_CAMERA
    for placed in scene.placed:
        points = household_things.hull_points(placed.thing.parts)
        reach = placed.thing.support(DIRECTIONS)
        spanned = (points[ConvexHull(points).vertices] @ DIRECTIONS.T).max(axis=0)
        assert (spanned <= reach + 1e-9).all()
        assert (reach - spanned).max() < 0.02 * np.linalg.norm(placed.thing.box[1] - placed.thing.box[0])


def test_a_thing_shows_no_more_than_it_would_alone() -> None:
    scene = household_things.scene(0, None, 5)
    shares = [placed.visible_share for placed in scene.placed]
    assert len(shares) == 5
    assert 0 <= min(shares) < 1
    assert max(shares) <= 1
