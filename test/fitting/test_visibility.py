"""How much of a surface was seen, where it can be counted by hand."""

from __future__ import annotations

import numpy as np
import pytest

from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.observation import Observation, observe
from sq_perception.fitting.visibility import visible_share
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast, unit_cube
from sq_perception.imaging.camera import Camera


def seen(body: Superquadric, camera: Camera, mask: np.ndarray | None = None) -> float:
    depth, index = raycast.render(body, camera)
    mask = index >= 0 if mask is None else mask & (index >= 0)
    observation = observe(np.where(mask, depth, np.nan), mask, camera, 1e-4, 0.0, None)
    assert isinstance(observation, Observation)
    return visible_share(State.of(body), observation)


def test_half_of_a_sphere() -> None:
    body = Superquadric([0.2, 0.2, 0.2], [1.0, 1.0], [0.5, 0.5, 0.5], [0.0, 0.0, 0.0, 1.0])
    assert seen(body, unit_cube.camera()) == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize("distance", [0.5, 1.0])
def test_a_near_camera_sees_less_than_half_of_a_sphere(distance: float) -> None:
    radius = 0.2
    body = Superquadric([radius] * 3, [1.0, 1.0], [0.0, 0.0, distance], [0.0, 0.0, 0.0, 1.0])
    cap = (1 - radius / distance) / 2
    assert seen(body, Camera(400, 400, 300.0, 300.0, 199.5, 199.5)) == pytest.approx(cap, abs=0.03)


def test_one_face_of_a_box() -> None:
    a, b, c = 0.1, 0.2, 0.15
    body = Superquadric([a, b, c], [0.05, 0.05], [0.5, 0.5, 0.5], [0.0, 0.0, 0.0, 1.0])
    assert seen(body, unit_cube.camera()) == pytest.approx(a * b / (2 * (a * b + b * c + c * a)), abs=0.03)


def test_what_the_mask_leaves_out_was_not_seen() -> None:
    body = Superquadric([0.2, 0.2, 0.2], [1.0, 1.0], [0.5, 0.5, 0.5], [0.0, 0.0, 0.0, 1.0])
    left = np.zeros((256, 256), dtype=bool)
    left[:, :128] = True
    assert seen(body, unit_cube.camera(), left) == pytest.approx(0.25, abs=0.03)


def test_turning_camera_and_body_changes_nothing(rng: np.random.Generator) -> None:
    body = Superquadric([0.1, 0.15, 0.2], [0.4, 0.8], [0.5, 0.5, 0.5], [0.2, 0.4, 0.1, 0.9])
    quarter = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    centre = np.array(body.translation)
    from_origin = Superquadric(body.size, body.shape, np.zeros(3), body.rotation)
    turned = from_origin.transformed(quarter, centre)
    assert seen(turned, unit_cube.camera()) == pytest.approx(seen(body, unit_cube.camera()), abs=0.02)
