"""The search of the fit: other bodies that might explain an image, and how precisely the outline is read."""

import math

import numpy as np
import pytest

from sq_perception.fitting import surface_fit
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.multistart import Problem, alike
from sq_perception.fitting.observation import Crop
from sq_perception.fitting.options import FitOptions
from sq_perception.fitting.starts import other_orders, resized, turned
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera


@pytest.fixture
def state(rng: np.random.Generator) -> State:
    return State.of(Superquadric([0.05, 0.08, 0.11], [0.1, 0.1], [0.1, -0.2, 0.9], quaternions.random(1, rng)[0]))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_resized_body_keeps_the_face_that_the_camera_sees(state: State, axis: int) -> None:
    other = resized(state, axis, 0.03)
    direction = state.rotation[:, axis]
    near = -np.sign(direction @ state.parameters[5:8])
    face = state.parameters[5:8] + near * state.parameters[axis] * direction
    other_face = other.parameters[5:8] + near * other.parameters[axis] * direction
    np.testing.assert_allclose(other_face, face, atol=1e-12)
    assert other.parameters[axis] == 0.03
    np.testing.assert_array_equal(np.delete(other.parameters[:5], axis), np.delete(state.parameters[:5], axis))


def test_other_orders_are_the_same_box_and_a_turned_body_keeps_its_axis_and_moments(state: State) -> None:
    corners = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], dtype=float)

    def box(one: State) -> set[tuple[float, ...]]:
        points = corners * one.parameters[:3] @ one.rotation.T + one.parameters[5:8]
        return {tuple(point) for point in np.round(points, 9)}

    orders = other_orders(state)
    assert len(orders) == 2
    for other in orders:
        assert np.linalg.det(other.rotation) == pytest.approx(1)
        assert box(other) == box(state)
        assert abs(other.rotation[:, 2] @ state.rotation[:, 2]) < 1e-9
    other = turned(state)
    assert np.linalg.det(other.rotation) == pytest.approx(1)
    np.testing.assert_allclose(other.rotation[:, 2], state.rotation[:, 2], atol=1e-12)
    assert abs(other.rotation[:, 0] @ state.rotation[:, 0]) == pytest.approx(np.sqrt(0.5))
    assert (other.parameters[:2] ** 2).sum() == pytest.approx((state.parameters[:2] ** 2).sum())


def test_alike_are_bodies_of_the_same_sizes_and_cost(state: State) -> None:
    one = state._replace(cost=100.0)
    assert alike(one, other_orders(one)[0]._replace(cost=100.3))
    assert not alike(one, one._replace(cost=101.0))
    assert not alike(one, resized(one, 0, 1.05 * one.parameters[0])._replace(cost=100.0))


CAMERA = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
BODY = Superquadric([0.03, 0.04, 0.06], [0.3, 0.6], [0.01, -0.02, 0.5], [0.3, 0.2, -0.1, 0.9])


def problem_of(body: Superquadric) -> Problem:
    depth, index = raycast.render(Superquadric.stack([body]), CAMERA)
    crop = Crop.around(np.where(index >= 0, depth, 1.0), index >= 0, CAMERA, 1e-4)
    assert crop is not None
    return Problem.of(crop.observe(0.0, None), FitOptions(), 0.0)


@pytest.mark.parametrize(
    "readings", [[math.inf] * 9, [math.nan] * 9, [0.01] * 9, [0.01 * 0.5**k for k in range(5)] + [0.01 * 0.5**4]]
)
def test_a_reading_that_gets_no_smaller_is_the_last(monkeypatch: pytest.MonkeyPatch, readings: list[float]) -> None:
    problem = problem_of(BODY)
    left = iter(readings)
    monkeypatch.setattr(surface_fit, "_outline_sigma", lambda *_: next(left))
    rays = problem.draw(100, 0.3)
    _, state = surface_fit.sharpen_outline(problem, State.of(BODY), rays.free, rays)
    assert np.isfinite(state.parameters).all()


@pytest.mark.parametrize("longer", [1.0, 1.5, 3.0])
def test_a_body_that_sticks_out_loosens_no_outline(longer: float) -> None:
    """By an outline that is read from such a body, pixels that miss a body cost next to nothing, and it may go away."""
    problem = problem_of(BODY)
    body = Superquadric(longer * BODY.size, BODY.shape, BODY.translation, BODY.rotation)
    rays = problem.draw(500, 0.3)
    read, _ = surface_fit.sharpen_outline(problem, State.of(body), rays.free, rays)
    assert read.terms.outline_stiffness >= problem.terms.outline_stiffness
