"""Faces that look at the camera through rounded readings: what is open, and that it is said so."""

import numpy as np
import pytest

from sq_perception.fitting import surface_fit
from sq_perception.fitting.cost import Ray
from sq_perception.fitting.valleys import faces_camera
from sq_perception.geometry.metrics import volume_iou
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast, unit_cube


def test_one_depth_in_common_makes_a_face(rng: np.random.Generator) -> None:
    step = 1 / 256
    rays = np.zeros((1000, len(Ray)))
    rays[:, Ray.DEPTH] = np.round(rng.uniform(0.2, 0.8, 1000) / step) * step
    assert not faces_camera(rays, step)
    rays[:100, Ray.DEPTH] = 128 * step
    assert faces_camera(rays, step)


@pytest.mark.parametrize("hidden", [30, 45, 65])
@pytest.mark.parametrize("spin", [0.2, 0.7])
def test_the_hidden_half_size_of_a_face_lies_within_its_deviation(hidden: float, spin: float) -> None:
    body = Superquadric(
        np.array([60, 40, hidden]) / 255, [0.12, 0.15], [0.5, 0.5, 0.5], [0.0, 0.0, np.sin(spin), np.cos(spin)]
    )
    depth, _ = raycast.render(body, unit_cube.camera())
    grey = unit_cube.grey_from_depth(depth)
    fit = surface_fit.fit(unit_cube.depth_from_grey(grey), grey > 0, unit_cube.camera())
    along = int(np.argmax(np.abs(fit.superquadric.rotation_matrix[2])))
    error = abs(fit.superquadric.size[along] - hidden / 255)
    assert error < 2.5 * fit.sigma_size[along]
    assert fit.sigma_size[along] > 3 * np.delete(fit.sigma_size, along).max()


def test_where_two_faces_are_seen_nothing_is_open() -> None:
    body = Superquadric([0.2, 0.15, 0.25], [0.12, 0.15], [0.5, 0.5, 0.5], [0.35, 0.3, 0.1, 0.85])
    depth, _ = raycast.render(body, unit_cube.camera())
    grey = unit_cube.grey_from_depth(depth)
    fit = surface_fit.fit(unit_cube.depth_from_grey(grey), grey > 0, unit_cube.camera())
    assert (fit.sigma_size < 0.01 * fit.superquadric.size).all()
    np.testing.assert_allclose(np.sort(fit.superquadric.size), [0.15, 0.2, 0.25], rtol=0.01)


def test_a_body_that_passes_readings_at_more_than_half_a_step_is_not_the_last() -> None:
    body = unit_cube.optical_from_cube(
        Superquadric(
            [0.160507, 0.150236, 0.170657],
            [0.884777, 0.915079],
            [0.379145, 0.402456, 0.529095],
            [-0.671346, 0.200430, -0.628333, -0.338112],
        )
    )
    depth, _ = raycast.render(body, unit_cube.camera())
    grey = unit_cube.grey_from_depth(depth)
    measured = unit_cube.depth_from_grey(grey)
    fit = surface_fit.fit(measured, grey > 0, unit_cube.camera())
    passed, _ = raycast.render(fit.superquadric, unit_cube.camera())
    beyond = np.abs(passed - measured)[grey > 0] > 0.6 / 255
    assert np.mean(beyond) < 0.01
    assert volume_iou(fit.superquadric, body) > 0.98
