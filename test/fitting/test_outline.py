"""The outline of a body: reading its precision ends, whatever is read."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sq_perception.fitting import outline
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.observation import Crop
from sq_perception.fitting.options import FitOptions
from sq_perception.fitting.problem import Problem
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera

CAMERA = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
BODY = Superquadric([0.03, 0.04, 0.06], [0.3, 0.6], [0.01, -0.02, 0.5], [0.3, 0.2, -0.1, 0.9])


@pytest.mark.parametrize(
    "readings", [[math.inf] * 9, [math.nan] * 9, [0.01] * 9, [0.01 * 0.5**k for k in range(5)] + [0.01 * 0.5**4]]
)
def test_a_reading_that_gets_no_smaller_is_the_last(monkeypatch: pytest.MonkeyPatch, readings: list[float]) -> None:
    depth, index = raycast.render(Superquadric.stack([BODY]), CAMERA)
    crop = Crop.around(np.where(index >= 0, depth, 1.0), index >= 0, CAMERA, 1e-4)
    assert crop is not None
    problem = Problem.of(crop.observed(0.0, None), FitOptions(), 0.0)
    left = iter(readings)
    monkeypatch.setattr(outline, "_sigma", lambda *_: next(left))
    rays = problem.draw(100, 0.3)
    _, state = outline.sharpened(problem, State.of(BODY), rays.free, rays)
    assert np.isfinite(state.parameters).all()
