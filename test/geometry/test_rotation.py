"""Quaternions x y z w: agreement with SciPy, inverses, gradients."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sq_perception.geometry import rotation


@pytest.fixture
def quaternions() -> np.ndarray:
    return rotation.random(200, np.random.default_rng(1))


def test_matrices_and_products_are_scipys(quaternions: np.ndarray) -> None:
    np.testing.assert_allclose(rotation.to_matrix(quaternions), Rotation.from_quat(quaternions).as_matrix(), atol=1e-12)
    left, right = quaternions[:100], quaternions[100:]
    expected = (Rotation.from_quat(left) * Rotation.from_quat(right)).as_matrix()
    np.testing.assert_allclose(rotation.to_matrix(rotation.multiply(left, right)), expected, atol=1e-12)


def test_matrix_round_trip_for_every_largest_component(quaternions: np.ndarray) -> None:
    half_turns = np.eye(4)
    for q in (quaternions, half_turns, half_turns + 1e-9):
        back = rotation.from_matrix(rotation.to_matrix(q))
        np.testing.assert_allclose(
            rotation.geodesic_angle(q / np.linalg.norm(q, axis=-1, keepdims=True), back), 0, atol=1e-7
        )


def test_rotation_vectors_are_scipys_and_come_back_also_near_zero_and_from_either_sign() -> None:
    rng = np.random.default_rng(3)
    for scale in (0, 1e-9, 1e-5, 1.0, 3.1):
        direction = rng.standard_normal((50, 3))
        vector = scale * direction / np.linalg.norm(direction, axis=-1, keepdims=True)
        quaternion = rotation.from_rotation_vector(vector)
        for same in (quaternion, -quaternion):
            np.testing.assert_allclose(rotation.to_rotation_vector(same), vector, rtol=1e-9, atol=1e-15)
    long = rotation.from_rotation_vector(np.array([0, 0, 4.0]))
    np.testing.assert_allclose(rotation.to_rotation_vector(long), [0, 0, 4.0 - 2 * np.pi])
    rng = np.random.default_rng(2)
    for scale in (0, 1e-9, 1e-5, 1.0, 3.0):
        vectors = rng.standard_normal((50, 3)) * scale
        expected = Rotation.from_rotvec(vectors).as_matrix()
        np.testing.assert_allclose(rotation.to_matrix(rotation.from_rotation_vector(vectors)), expected, atol=1e-12)


def test_random_rotations_are_uniform() -> None:
    """The rotated pole is uniform on the sphere, and the angle has density (1 - cos) / pi."""
    q = rotation.random(20000, np.random.default_rng(3))
    pole = rotation.to_matrix(q)[..., :, 2]
    np.testing.assert_allclose(pole.mean(axis=0), 0, atol=0.02)
    np.testing.assert_allclose(np.cov(pole.T), np.eye(3) / 3, atol=0.02)
    angle = rotation.geodesic_angle(q, np.broadcast_to([0.0, 0, 0, 1], q.shape))
    assert angle.mean() == pytest.approx(np.pi / 2 + 2 / np.pi, abs=0.02)


def test_geodesic_angle_measures_the_turn_between(quaternions: np.ndarray) -> None:
    turn = rotation.from_rotation_vector(np.array([0.0, 0.3, 0.4]))
    turned = rotation.multiply(quaternions, np.broadcast_to(turn, quaternions.shape))
    np.testing.assert_allclose(rotation.geodesic_angle(quaternions, turned), 0.5, atol=1e-9)
    np.testing.assert_allclose(rotation.geodesic_angle(quaternions, -turned), 0.5, atol=1e-9)


def test_gradients_are_right() -> None:
    torch.manual_seed(0)
    six = torch.randn(5, 6, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(rotation.from_six, six)
    vector = torch.cat([torch.randn(4, 3), torch.zeros(1, 3)]).double().requires_grad_()
    assert torch.autograd.gradcheck(rotation.from_rotation_vector, vector)


def test_six_numbers_give_the_columns_they_name() -> None:
    q = rotation.random(50, np.random.default_rng(4))
    m = rotation.to_matrix(q)
    six = np.concatenate([2.0 * m[..., :, 0], 3.0 * m[..., :, 1] + 0.7 * m[..., :, 0]], axis=-1)
    np.testing.assert_allclose(rotation.geodesic_angle(rotation.from_six(six), q), 0, atol=1e-6)
