"""Things under so much noise that a superquadric explains them: what it hides of their form is in the deviations."""

import math

import numpy as np
import pytest

from sq_perception.fitting import surface_fit
from sq_perception.fitting.options import MODEL_ERROR
from sq_perception.fitting.surface_fit import FitOptions
from sq_perception.geometry import rotation
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera
from sq_perception.simulation.scenes import plane_depth

CAMERA = Camera(320, 240, 270.0, 270.0, 159.5, 119.5)
_TILT = math.radians(35.0)
UP = np.array([0.0, -math.cos(_TILT), -math.sin(_TILT)])
FOOT = np.array([0.02, 0.05, 0.45])
_TURN = rotation.from_matrix(np.stack([[1.0, 0.0, 0.0], np.cross(UP, [1.0, 0.0, 0.0]), UP], axis=1))
JAR = Superquadric(
    [[0.035, 0.035, 0.05], [0.022, 0.022, 0.012]],
    [[0.15, 1.0], [0.15, 1.0]],
    np.array([FOOT + 0.05 * UP, FOOT + 0.112 * UP]),
    np.array([_TURN, _TURN]),
)
"""A body of 10 cm, and its lid."""


def half_extents(axes: np.ndarray) -> np.ndarray:
    """Of the jar along axes (3, 3), rows."""
    reach = [part.support(axes) + axes @ part.translation for part in JAR]
    back = [part.support(axes) - axes @ part.translation for part in JAR]
    return (np.max(reach, axis=0) + np.max(back, axis=0)) / 2


@pytest.mark.parametrize("seed", [4, 5, 7])
def test_a_body_of_noise_is_no_surer_than_the_thing_that_it_may_be(seed: int) -> None:
    """The exact course alone was off by 3.5 of its deviations, where the tolerant one told another size."""
    plane = np.append(UP, -UP @ FOOT)
    shown, _ = raycast.render(JAR, CAMERA)
    mask = np.isfinite(shown)
    noise = np.random.default_rng(seed).normal(0, 0.01, shown.shape)
    depth = (np.where(mask, shown, plane_depth(plane, CAMERA)) + noise).astype(np.float32)
    found = surface_fit.fit(depth, mask, CAMERA, options=FitOptions(plane=plane))
    as_thing = surface_fit.fit(depth, mask, CAMERA, options=FitOptions(plane=plane, model_error=MODEL_ERROR))
    body, thing, partner = found.superquadric, as_thing.superquadric, slice(None)
    partner = np.abs(body.rotation_matrix.T @ thing.rotation_matrix).argmax(axis=1)
    assert (found.sigma_size > 0.7 * np.abs(body.size - thing.size[partner])).all()
    assert (np.abs(body.size - half_extents(body.rotation_matrix.T)) < 2.5 * found.sigma_size).all()
