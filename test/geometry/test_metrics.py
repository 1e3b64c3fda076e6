"""IoU by column counting against brute force, closed forms, invariances."""

import numpy as np
import pytest

from sq_perception.geometry import Superquadric, metrics, rotation
from sq_perception.simulation.scenes import thesis_bodies

IDENTITY = np.array([0.0, 0, 0, 1])


def test_column_counting_is_the_thesis_grid() -> None:
    """Equation 5.1 with every one of the 24^3 points evaluated; only points on a surface may fall either way."""
    a, b = thesis_bodies(20, np.random.default_rng(0)), thesis_bodies(20, np.random.default_rng(1))
    axis = np.linspace(0, 1, 24)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    in_a, in_b = a.gauge(grid[None]) <= 1, b.gauge(grid[None]) <= 1
    expected = (in_a & in_b).sum(1) / (in_a | in_b).sum(1)
    np.testing.assert_allclose(metrics.thesis_iou(a, b, 24), expected, atol=1e-9)


def test_shifted_and_nested_bodies_have_their_closed_forms() -> None:
    a = Superquadric(np.array([0.1, 0.2, 0.3]), np.full(2, 0.01), np.zeros(3), IDENTITY)
    b = a.transformed(IDENTITY, np.array([0.0, 0.1, 0.0]))
    assert (metrics.volume_iou(a, b, 200), metrics.volume_iou(a, a, 100)) == (pytest.approx(0.3 / 0.5, abs=0.01), 1)
    assert metrics.volume_iou(a, a.transformed(IDENTITY, np.array([5.0, 0, 0]))) == 0
    bodies = thesis_bodies(10, np.random.default_rng(2))
    inner = Superquadric(bodies.size * 0.8, bodies.shape, bodies.translation, bodies.rotation)
    np.testing.assert_allclose(metrics.volume_iou(inner, bodies, 128), 0.8**3, atol=0.01)


def test_invariant_under_forms_and_rigid_motion() -> None:
    a, b = thesis_bodies(5, np.random.default_rng(3)), thesis_bodies(5, np.random.default_rng(4))
    expected = metrics.volume_iou(a, b, 96)
    for form in a.equivalent_forms():
        np.testing.assert_allclose(metrics.volume_iou(form, b, 96), expected, atol=1e-9)
    q = rotation.random(1, np.random.default_rng(5))[0]
    moved = metrics.volume_iou(a.transformed(q, np.ones(3), 3.0), b.transformed(q, np.ones(3), 3.0), 96)
    np.testing.assert_allclose(moved, expected, atol=0.015)


def test_batches_must_match() -> None:
    with pytest.raises(ValueError, match="two batches"):
        metrics.volume_iou(thesis_bodies(2, np.random.default_rng(0)), thesis_bodies(3, np.random.default_rng(0)))
