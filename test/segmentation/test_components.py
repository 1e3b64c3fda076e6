"""Components of what is above a support: cut at depth steps, without what a sensor smears over them."""

import numpy as np

from sq_perception.imaging.camera import Camera
from sq_perception.segmentation import segments

CAMERA = Camera(320, 240, 525.0, 525.0, 159.5, 119.5)


def taken_apart(depth, sigma=1e-3):
    depth = depth.astype(np.float32)
    return segments.take_apart(depth, depth > 0, CAMERA, sigma)


def test_a_bridge_of_two_pixels_over_a_step_does_not_connect():
    """Two boards, one behind the other, and a smeared edge that leads from the one to the other."""
    depth = np.zeros((CAMERA.height, CAMERA.width))
    depth[40:200, 60:150], depth[40:200, 160:250] = 0.7, 0.8
    depth[100:102, 150:160] = np.linspace(0.7, 0.8, 12)[1:-1]
    found = taken_apart(depth)
    assert found[120, 100] != found[120, 200]
    assert (found[40:200, 60:150] == found[120, 100]).all()
    assert (found[40:200, 160:250] == found[120, 200]).all()


def test_a_fringe_of_something_near_is_not_one_with_what_is_far_behind_it():
    """Two strips that steps make narrow, side by side: a thing's fringe, and what is seen past it."""
    depth = np.zeros((CAMERA.height, CAMERA.width))
    depth[40:200, 150:154], depth[40:200, 154:158] = 0.7, 2.3
    found = taken_apart(depth)
    for label in range(1, found.max() + 1):
        of_one = depth[found == label]
        assert of_one.size == 0 or of_one.max() < 1.1 * of_one.min()


def test_a_side_with_steps_from_pixel_to_pixel_is_one():
    """Seen at a grazing angle: each column is 1.6 % farther than the last one, or more."""
    depth = np.zeros((CAMERA.height, CAMERA.width))
    depth[60:180, 100:116] = 1 / np.linspace(1 / 0.7, 1 / 0.92, 16)
    found = taken_apart(depth, sigma=3e-3)
    assert len(set(found[depth > 0])) == 1
    assert found[120, 108] > 0


def test_bits_and_nothing_have_no_label():
    depth = np.zeros((CAMERA.height, CAMERA.width))
    assert not taken_apart(depth).any()
    depth[100:104, 100:104] = 0.7  # 5 mm
    assert not taken_apart(depth).any()
