"""The lens' equation against OpenCV's, its inverse against itself, and where neither has an answer."""

import cv2
import numpy as np
import pytest
from distorted_views import BARREL, FISHEYE, PINCUSHION, RATIONAL, RAW, rays

from sq_perception.imaging.distortion import Distortion

K5 = (-0.3, 0.1, 0.001, -0.002, -0.01)
OPENCV = [
    ("plumb_bob", K5[:4]),
    ("plumb_bob", K5),
    ("rational_polynomial", RATIONAL.coefficients),
    ("rational_polynomial", RATIONAL.coefficients + (0,) * 4),
    ("rational_polynomial", RATIONAL.coefficients + (0,) * 6),
]


@pytest.fixture
def points(rng):
    return np.concatenate([rng.uniform(-0.8, 0.8, (500, 2)), [[0, 0], [1e-5, -2e-5], [3e-9, 0], [0.4, 0]]])


@pytest.mark.parametrize(("model", "coefficients"), OPENCV)
def test_polynomials_are_those_of_opencv(points, model, coefficients):
    solid = np.column_stack([points, np.ones(len(points))])
    expected = cv2.projectPoints(solid, np.zeros(3), np.zeros(3), np.eye(3), np.array(coefficients))[0][:, 0]
    found = Distortion(model, coefficients).forward(points)
    known = np.isfinite(found[:, 0])
    np.testing.assert_allclose(found[known], expected[known], atol=1e-12)
    assert known.mean() > 0.8


def test_the_fisheye_is_that_of_opencv(points):
    solid = np.column_stack([points, np.ones(len(points))])[:, None]
    coefficients = np.array(FISHEYE.coefficients)
    expected = cv2.fisheye.projectPoints(solid, np.zeros(3), np.zeros(3), np.eye(3), coefficients)[0][:, 0]
    np.testing.assert_allclose(FISHEYE.forward(points), expected, atol=1e-9)
    np.testing.assert_allclose(FISHEYE.forward(points[:500]), expected[:500], atol=1e-12)


def test_an_ideal_fisheye_sees_angles_and_other_lenses_without_distortion_move_nothing(points):
    for lens in (Distortion("plumb_bob", (0,) * 5), Distortion("rational_polynomial", (0,) * 8)):
        np.testing.assert_array_equal(lens.forward(points), points)
        np.testing.assert_array_equal(lens.inverse(points), points)
    lens = Distortion("equidistant", (0, 0, 0, 0))
    angle = np.linspace(0, 1.5, 50)
    np.testing.assert_allclose(lens.forward(np.stack([np.tan(angle), 0 * angle], -1))[:, 0], angle, atol=1e-12)


@pytest.mark.parametrize("lens", [BARREL, PINCUSHION, RATIONAL, FISHEYE, Distortion("plumb_bob", (-0.2, 0, 0, 0))])
def test_the_inverse_is_the_way_back(lens, rng):
    """From rays to images and back, up to where the lens turns back: everything the model can see."""
    wide = rng.uniform(-3, 3, (4000, 2))
    images = lens.forward(wide)
    known = np.isfinite(images[:, 0])
    assert known.sum() > 100
    np.testing.assert_array_equal(np.isnan(images[:, 0]), np.isnan(images[:, 1]))
    # The slope of the map is the accuracy of its inverse: near the turn 1e-13 of an image is more of a ray.
    back = lens.inverse(images)
    assert np.isfinite(back[known]).all()
    np.testing.assert_allclose(lens.forward(back[known]), images[known], atol=1e-11)
    close = known & (np.hypot(*wide.T) < 0.9)
    np.testing.assert_allclose(back[close], wide[close], atol=1e-9)
    assert np.isnan(back[~known]).all()


@pytest.mark.parametrize("lens", [BARREL, PINCUSHION, RATIONAL])
def test_all_of_a_vga_image_has_rays(lens):
    """In its middle, where five steps of OpenCV's iteration converge, they are OpenCV's."""
    found = rays(RAW, lens)[..., :2].reshape(-1, 2)
    assert np.isfinite(found).all()
    images = rays(RAW)[..., :2].reshape(-1, 1, 2)
    expected = cv2.undistortPoints(images, np.eye(3), np.array(lens.coefficients))[:, 0]
    middle = np.hypot(*images[:, 0].T) < 0.3
    np.testing.assert_allclose(found[middle], expected[middle], atol=2e-4)


def test_what_the_lens_cannot_show_is_nan():
    """r' = r - 0.2 r^3 is largest at r^2 = 1 / 0.6, with 2/3 of that radius."""
    lens = Distortion("plumb_bob", (-0.2, 0.0, 0.0, 0.0))
    turn = np.sqrt(1 / 0.6)
    assert np.isfinite(lens.forward(np.array([0.99 * turn, 0]))).all()
    assert np.isnan(lens.forward(np.array([1.01 * turn, 0]))).all()
    inside, outside = lens.inverse(np.array([[0.99 * turn * 2 / 3, 0], [1.01 * turn * 2 / 3, 0]]))
    assert 0.8 * turn < inside[0] < turn
    assert np.isnan(outside).all()
    # A fisheye sees more than half of space; a pinhole image cannot.
    assert np.isnan(Distortion("equidistant", (0, 0, 0, 0)).inverse(np.array([1.6, 0]))).all()
    assert np.isnan(lens.forward(np.array([np.nan, 0]))).all()
    assert np.isnan(lens.inverse(np.array([[np.nan, 0], [np.inf, 0]]))).all()


@pytest.mark.filterwarnings("error")
def test_absurd_lenses_have_answers(rng):
    """Whatever the coefficients, an image has the place that its ray's equation gives, or none."""
    images = rng.uniform(-2, 2, (200, 2))
    for scale in (1e-9, 1.0, 1e3, 1e6):
        for count in (4, 5, 8):
            lens = Distortion("plumb_bob", tuple(rng.uniform(-scale, scale, count)))
            found = lens.inverse(images)
            known = np.isfinite(found[:, 0])
            np.testing.assert_allclose(lens.forward(found[known]), images[known], atol=1e-9)
        Distortion("equidistant", tuple(rng.uniform(-scale, scale, 4))).inverse(images)
