"""Joining a fit with a prediction: closed form for Gaussians, and a box seen face-on."""

from __future__ import annotations

import numpy as np
import pytest

from sq_perception.fitting.fit import Fit, Status
from sq_perception.fitting.prediction import completed
from sq_perception.geometry import rotation
from sq_perception.geometry.superquadric import Superquadric


def fit_of(covariance, size=(0.1, 0.2, 0.3), status=Status.WEAK, turn=(0, 0, 0, 1.0)):
    body = Superquadric(np.array(size), [0.2, 0.2], [0.0, 0.0, 1.0], np.array(turn))
    return Fit(body, 0.001, 0.001, 0.9, 0.4, covariance, status, "half size along z undetermined", 5, 1.0)


def face_on(sigma=0.2):
    """a3 is open, and the face towards the camera at t3 - a3 is known to a millimetre."""
    covariance = np.diag(np.full(11, 1e-6))
    along = np.zeros(11)
    along[[2, 7]] = 1.0
    return covariance + sigma**2 * np.outer(along, along)


def test_the_open_size_takes_the_prediction_and_the_seen_face_stays():
    fit = fit_of(face_on())
    predicted = Superquadric([0.1, 0.2, 0.05], [0.2, 0.2], [0, 0, 0.75], [0, 0, 0, 1.0])
    joined = completed(fit, predicted, share=0.2)
    size, centre = joined.superquadric.size, joined.superquadric.translation
    prior, measured = 1 / (0.2 * 0.05) ** 2, 1 / (0.2**2 + 1e-6)
    assert size[2] == pytest.approx((0.05 * prior + 0.3 * measured) / (prior + measured), abs=1e-9)
    assert joined.sigma_size[2] == pytest.approx((prior + measured) ** -0.5, rel=1e-6)
    assert centre[2] - size[2] == pytest.approx(1.0 - 0.3, abs=1e-4)
    np.testing.assert_allclose(size[:2], [0.1, 0.2])
    assert "prediction: z 51 +- 10 mm" in joined.message
    assert joined.status == Status.WEAK


def test_the_order_of_the_prediction_s_axes_does_not_matter():
    fit = fit_of(face_on())
    predicted = Superquadric([0.1, 0.2, 0.05], [0.3, 0.3], [0, 0, 0.75], [0, 0, 0, 1.0])
    quarter = rotation.from_rotation_vector(np.array([0, np.pi / 2, 0]))
    other = Superquadric([0.05, 0.2, 0.1], [0.3, 0.3], [0, 0, 0.75], quarter)
    np.testing.assert_allclose(
        completed(fit, other).superquadric.size, completed(fit, predicted).superquadric.size, rtol=1e-6
    )


def test_what_is_known_stays():
    predicted = Superquadric([1.0, 1.0, 1.0], [0.2, 0.2], [0, 0, 1.0], [0, 0, 0, 1.0])
    for fit in (
        fit_of(np.diag(np.full(11, 1e-6))),
        fit_of(np.full((11, 11), np.nan)),
        fit_of(face_on(), status=Status.FAILED),
    ):
        assert completed(fit, predicted) is fit
