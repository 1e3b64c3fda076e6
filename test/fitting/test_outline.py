"""The outline of a body: reading its precision ends, whatever is read, and makes it no less precise."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sq_perception.fitting import surface_fit
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.multistart import Problem
from sq_perception.fitting.observation import Crop
from sq_perception.fitting.options import FitOptions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera

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
