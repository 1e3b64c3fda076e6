"""What the benchmark of tracking measures with: errors whatever the axes are called, and whose segment is whose."""

import numpy as np
import tracking

from sq_perception import Fit, FrameRecovery, Recovery, Status, Superquadric
from sq_perception.geometry import rotation
from sq_perception.tracking.association import TURNS

BODY = Superquadric([0.06, 0.04, 0.03], [0.3, 0.7], [0.05, -0.03, 0.7], [0.3, -0.2, 0.5, 0.8])


def test_an_error_does_not_depend_on_the_names_of_axes():
    for turn in TURNS:
        named = rotation.multiply(BODY.rotation, rotation.from_matrix(turn))
        size = np.abs(turn).T @ (BODY.size * [1.1, 1.0, 0.9])
        error, order = tracking.size_errors(Superquadric(size, BODY.shape, BODY.translation, named), BODY)
        np.testing.assert_allclose(error, [0.1, 0.0, -0.1], atol=1e-12)
        np.testing.assert_allclose(size[order], BODY.size * [1.1, 1.0, 0.9])


def test_a_body_has_the_segment_that_overlaps_it_most():
    truth, found = np.zeros((10, 40), np.int32), np.zeros((10, 40), np.int32)
    truth[:, :20], truth[:, 20:30] = 1, 2
    found[:, :13], found[:, 13:20], found[:, 20:29] = 3, 2, 1
    fit = Fit(BODY, 0.0, Status.CONVERGED, "")
    bodies = tuple(Recovery(fit, 1.0, label, 10) for label in (3, 1, 2))
    owner, cut = tracking.owners(truth, FrameRecovery(bodies, {}, found, None, ""))
    assert owner == {0: 0, 1: 1}
    assert cut == {0}


def test_the_camera_goes_about_a_table_that_rests():
    (shown,) = tracking.scenes(1, 1)
    for angle in (30.0, 90.0):
        here, (turn, position) = tracking.moved(shown, angle)
        back = here.bodies.transformed(turn, position)
        np.testing.assert_allclose(back.translation, shown.bodies.translation, atol=1e-12)
        height = here.bodies.translation @ here.plane[:3] + here.plane[3]
        np.testing.assert_allclose(height, shown.bodies.translation @ shown.plane[:3] + shown.plane[3], atol=1e-12)
        assert here.plane[2] < 0
