"""Other bodies that might explain an image: what they keep of the one at hand."""

import numpy as np
import pytest

from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.multistart import alike
from sq_perception.fitting.starts import other_orders, resized, turned
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric


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


def test_other_orders_are_the_same_box(state: State) -> None:
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


def test_a_turned_body_keeps_its_axis_and_the_moments_of_its_section(state: State) -> None:
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
