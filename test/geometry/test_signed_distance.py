"""Signed distances: closed forms, that they are lower bounds, gradients, unions and doubts."""

import math

import numpy as np
import pytest

import sq_perception as sq
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.signed_distance import signed_distance
from sq_perception.geometry.superquadric import Superquadric

TURN = quaternions.random(1, np.random.default_rng(0))[0]


def placed(size: list[float], shape: list[float], taper: tuple[float, float] = (0.0, 0.0)) -> Superquadric:
    return Superquadric(np.array(size), np.array(shape), np.array([0.3, -0.2, 0.5]), TURN, np.array(taper))


def around(body: Superquadric, count: int, seed: int) -> np.ndarray:
    return body.translation + np.random.default_rng(seed).uniform(-2, 2, (count, 3))


def test_a_sphere_is_exact_in_closed_form() -> None:
    ball = placed([0.7, 0.7, 0.7], [1.0, 1.0])
    points = around(ball, 2000, 1)
    offset = points - ball.translation
    length = np.linalg.norm(offset, axis=1)
    distance, gradient = ball.signed_distance(points, gradient=True)
    assert np.allclose(distance, length - 0.7, atol=1e-9)
    assert np.allclose(gradient, offset / length[:, None], atol=1e-7)


def test_a_sharp_box_is_nearly_that_of_a_box() -> None:
    box = placed([0.9, 0.5, 0.2], [0.01, 0.01])
    points = around(box, 2000, 2)
    over = np.abs(box.to_object(points)) - box.size
    exact = np.linalg.norm(np.maximum(over, 0), axis=1) + np.minimum(over.max(axis=1), 0)
    distance = box.signed_distance(points)
    assert (distance <= exact + 0.01).all()
    assert (distance >= exact - 1e-9).all()  # the box encloses the body


STRAIGHT, TAPERED = (0.0, 0.0), (0.5, -0.3)
FORMS = [(shape, taper) for taper in (STRAIGHT, TAPERED) for shape in ((0.1, 0.1), (0.3, 0.8), (1.0, 1.0), (0.1, 1.0))]


@pytest.mark.parametrize(("shape", "taper"), [*FORMS, ((1.5, 1.8), STRAIGHT), ((1.5, 1.8), (0.3, 0.3))])
def test_it_never_exceeds_the_distance_and_comes_near_it(shape, taper) -> None:
    """Outside, no point of the surface is nearer; the samples of it are farther than the nearest."""
    body = placed([1.0, 0.6, 0.3], list(shape), taper)
    surface = body.sample_surface(4000, np.random.default_rng(3))
    points = around(body, 400, 4)
    to_samples = np.linalg.norm(points[:, None] - surface[None], axis=2).min(axis=1)
    distance = body.signed_distance(points)
    outside = body.gauge(points) > 1
    assert (distance[outside] <= to_samples[outside]).all()
    assert np.median(distance[outside] / to_samples[outside]) > 0.85
    assert (distance[~outside] <= 0).all()


def test_inside_it_is_no_shallower_than_the_depth() -> None:
    """A ball about p of the radius -s is not in the body: some surface point is as near."""
    body = placed([1.0, 0.6, 0.3], [0.4, 0.9])
    surface = body.sample_surface(60_000, np.random.default_rng(5))
    points = body.translation + 0.5 * (surface[::600] - body.translation)
    depth = np.linalg.norm(points[:, None] - surface[None], axis=2).min(axis=1)
    assert (-body.signed_distance(points) >= depth - 0.02).all()


def test_a_surface_point_has_distance_zero_and_its_normal_and_the_centre_a_finite_one() -> None:
    body = placed([1.0, 0.6, 0.3], [0.5, 0.8])
    surface = body.sample_surface(500, np.random.default_rng(6))
    distance, gradient = body.signed_distance(surface, gradient=True)
    assert np.allclose(distance, 0, atol=1e-9)
    assert np.einsum("ij,ij->i", gradient, body.normals(surface)).min() > 0.999
    body = placed([1.0, 0.6, 0.3], [0.5, 0.8], (0.3, 0.3))
    assert body.signed_distance(body.translation[None])[0] == pytest.approx(-0.3, abs=0.02)


def test_the_gradient_says_how_the_distance_grows() -> None:
    """Of points near the surface, where the bound is tight, along the gradient and against it."""
    body = placed([1.0, 0.6, 0.3], [1.0, 1.0])
    surface = body.sample_surface(300, np.random.default_rng(7))
    points = surface + 0.03 * body.normals(surface)
    distance, gradient = body.signed_distance(points, gradient=True)
    assert np.allclose(np.linalg.norm(gradient, axis=1), 1)
    for step in (-0.01, 0.01):
        assert np.allclose(body.signed_distance(points + step * gradient) - distance, step, rtol=0.05)


def test_a_union_is_its_nearest_body() -> None:
    both = Superquadric.stack([placed([1.0, 0.6, 0.3], [0.5, 0.8]), placed([0.2, 0.3, 0.9], [1.0, 1.0])])
    points = around(both[0], 500, 8)
    assert np.array_equal(both.signed_distance(points), np.min([body.signed_distance(points) for body in both], axis=0))


def test_doubts_are_taken_off() -> None:
    """With sizes alone in doubt, on the axis of one, that one's; a doubt of the place counts along the normal."""
    body = placed([1.0, 0.6, 0.3], [1.0, 1.0])
    tip = body.translation + 2.0 * body.rotation_matrix[:, 0]
    covariance = np.zeros((11, 11))
    covariance[0, 0] = 0.1**2
    assert signed_distance(body, tip[None], covariance, 2.0)[0][0] == pytest.approx(1.0 - 0.2, abs=1e-6)
    covariance[5:8, 5:8] = 0.05**2 * np.eye(3)
    assert signed_distance(body, tip[None], covariance, 1.0)[0][0] == pytest.approx(1 - math.hypot(0.1, 0.05), abs=1e-6)
    # Against drawn bodies: the deviation of the distance of a point near the surface.
    rng = np.random.default_rng(9)
    near = body.translation + 1.1 * (body.sample_surface(20, rng) - body.translation)
    covariance = np.diag(np.array([0.02, 0.01, 0.005, 0.02, 0.02, 0.01, 0.01, 0.01, 0.02, 0.02, 0.02]) ** 2)
    drawn = []
    for _ in range(400):
        by = rng.standard_normal(11) * np.sqrt(np.diag(covariance))
        turn = quaternions.multiply(body.rotation, quaternions.from_rotation_vector(by[8:]))
        shape = np.minimum(body.shape + by[3:5], 2.0)
        drawn.append(Superquadric(body.size + by[:3], shape, body.translation + by[5:8], turn).signed_distance(near))
    taken = body.signed_distance(near) - signed_distance(body, near, covariance, 1.0)[0]
    assert np.allclose(taken, np.std(drawn, axis=0), rtol=0.25)


def test_misuse_raises() -> None:
    body = placed([1.0, 0.6, 0.3], [1.0, 1.0])
    with pytest.raises(ValueError, match="shape"):
        body.signed_distance(np.zeros(3))
    with pytest.raises(ValueError, match="k_sigma"):
        signed_distance(body, np.zeros((1, 3)), None, 1.0)
    failed = sq.fit_points(np.zeros((1, 3)))
    with pytest.raises(ValueError, match="covariance"):
        failed.signed_distance(np.zeros((1, 3)), 1.0)
