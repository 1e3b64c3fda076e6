"""The classic fit: exact on complete clouds, plausible on views, honest on bad input."""

import numpy as np
import pytest

from sq_perception.fitting import solina_bajcsy
from sq_perception.fitting.fit import Fit, Status
from sq_perception.geometry import metrics
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric


def random_body(rng: np.random.Generator) -> Superquadric:
    size = rng.uniform(0.03, 0.1, 3)
    return Superquadric(size, rng.uniform(0.2, 1.0, 2), rng.uniform(-1, 1, 3), quaternions.random(1, rng)[0])


@pytest.mark.parametrize("seed", range(5))
def test_long_bodies_are_recovered_from_their_whole_surface(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = Superquadric(
        [0.04, 0.03, 0.1], rng.uniform(0.3, 1.0, 2), rng.uniform(-1, 1, 3), quaternions.random(1, rng)[0]
    )
    fit = solina_bajcsy.fit(truth.sample_surface(800, rng))
    assert fit.status == Status.CONVERGED
    assert metrics.volume_iou(fit.superquadric, truth) > 0.98
    assert fit.residual < 1e-4


def test_the_body_moves_with_its_points_and_its_sizes_follow_the_unit_of_length(rng: np.random.Generator) -> None:
    points = random_body(rng).sample_surface(400, rng)
    turn, shift = quaternions.random(1, rng)[0], np.array([0.3, -0.2, 1.0])
    still, large = (solina_bajcsy.fit(each).superquadric for each in (points, points * 1000))
    assert large.size == pytest.approx(still.size * 1000, rel=1e-3)
    moved = solina_bajcsy.fit(points @ quaternions.to_matrix(turn).T + shift).superquadric
    assert metrics.volume_iou(still.transformed(turn, shift), moved) > 0.98


def test_the_lone_axis_becomes_z() -> None:
    rng = np.random.default_rng(1)
    for size, lone in (([0.1, 0.03, 0.02], 0.1), ([0.1, 0.09, 0.02], 0.02)):
        body = Superquadric(size, [1.0, 1.0], [0.0, 0.0, 0.0], quaternions.random(1, rng)[0])
        start = solina_bajcsy.moment_start(body.sample_surface(2000, rng))
        assert start.parameters[2] == pytest.approx(lone, rel=0.1)
        assert np.linalg.det(start.rotation) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        (np.random.default_rng(0).normal(size=(11, 3)), "11 points"),
        (np.linspace(0, 1, 50)[:, None] * np.array([1.0, 2.0, 3.0]), "line"),
        (np.zeros((50, 3)), "line"),
    ],
)
def test_hopeless_clouds_fail_with_a_reason_and_a_box(points: np.ndarray, reason: str) -> None:
    fit = solina_bajcsy.fit(points)
    assert fit.status == Status.FAILED
    assert reason in fit.message
    assert np.isfinite(fit.superquadric.to_flat()).all()


def test_points_that_are_not_finite_are_ignored(rng: np.random.Generator) -> None:
    points = random_body(rng).sample_surface(300, rng)
    dirty = np.concatenate([points, [[np.nan, 0, 0], [np.inf, 1, 2]]])
    assert solina_bajcsy.fit(dirty).superquadric.to_flat() == pytest.approx(
        solina_bajcsy.fit(points).superquadric.to_flat()
    )


@pytest.mark.parametrize("points", [np.zeros((5, 2)), np.zeros(3), np.full((20, 3), np.nan), np.empty((0, 3))])
def test_misuse_raises(points: np.ndarray) -> None:
    with pytest.raises(ValueError, match="point"):
        solina_bajcsy.fit(points)


def noisy_cloud(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    points = random_body(rng).sample_surface(600, rng)
    return points + rng.normal(0, 0.001, points.shape)


def cost(fit: Fit, points: np.ndarray) -> float:
    found = fit.superquadric
    residual = np.sqrt(np.prod(found.size)) * (found.adjusted_inside_outside(points) - 1)
    return float(residual @ residual)


@pytest.mark.parametrize("seed", [5, 112, 464, 621])
def test_escapes_leave_a_shallow_minimum_and_repeat(seed: int) -> None:
    """From the start alone, the fit of these clouds ends in a minimum at least four times as high."""
    points = noisy_cloud(seed)
    plain = solina_bajcsy.fit(points)
    escaped = solina_bajcsy.fit(points, escapes=8)
    assert cost(escaped, points) < 0.5 * cost(plain, points)
    assert escaped.iterations > plain.iterations
    again = solina_bajcsy.fit(points, escapes=8)
    np.testing.assert_array_equal(again.superquadric.to_flat(), escaped.superquadric.to_flat())


@pytest.mark.parametrize("seed", range(4))
def test_escapes_never_make_it_worse(seed: int) -> None:
    points = noisy_cloud(seed)
    plain, escaped = solina_bajcsy.fit(points), solina_bajcsy.fit(points, escapes=3)
    assert cost(escaped, points) <= cost(plain, points) * (1 + 1e-6)
