"""What belongs together: components at one depth, and convex parts, whose lines of sight stay free."""

import numpy as np
import pytest
from table_scenes import ious

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera
from sq_perception.segmentation import convex_parts, segments

CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
TILTED = np.array([0.3, 0.2, 0.1, 0.9])
NOISE = 0.001


def body(x, size=(0.05, 0.05, 0.05), shape=(1.0, 1.0), z=0.7, rotation=UPRIGHT):
    return Superquadric(np.array(size), np.array(shape), np.array([x, 0.0, z]), rotation / np.linalg.norm(rotation))


def seen(bodies, noise=NOISE, background=1.2):
    """Depth float32, 0 for none, before a wall; labels from 1."""
    depth, index = raycast.render(Superquadric.stack(bodies), CAMERA)
    depth = np.where(index >= 0, depth, background)
    depth += noise * depth**2 * np.random.default_rng(0).standard_normal(depth.shape)
    return depth.astype(np.float32), (index + 1).astype(np.int32)


def names(labels):
    return sorted(set(np.unique(labels)) - {0})


@pytest.mark.parametrize("noise", [0.0, 0.001, 0.004])
@pytest.mark.parametrize("shape", [(1.0, 1.0), (0.1, 0.1), (0.1, 1.0), (0.6, 0.3)])
def test_a_convex_body_has_one_part(shape, noise):
    depth, truth = seen([body(0, (0.08, 0.05, 0.04), shape, rotation=TILTED)], noise)
    np.testing.assert_array_equal(convex_parts.correct(truth, depth, CAMERA, max(noise, 5e-4)), truth)


@pytest.mark.parametrize("noise", [0.0005, 0.003])
def test_bodies_that_touch_are_parted(noise):
    bodies = [body(-0.1), body(0.0), body(0.1, shape=(0.2, 0.2), rotation=TILTED, size=(0.05, 0.04, 0.04))]
    depth, truth = seen(bodies, noise)
    found = convex_parts.correct((truth > 0).astype(np.int32), depth, CAMERA, noise)
    assert len(names(found)) == 3
    assert min(ious(truth, found)) > 0.9


def test_what_is_not_convex_is_parted_from_what_it_touches():
    """An angle of two bars, whose own lines are crossed for a sixth, with a ball at its end."""
    bars = [
        Superquadric(np.array(size), np.array([0.1, 0.1]), np.array(place), UPRIGHT)
        for size, place in (((0.032, 0.09, 0.032), (-0.12, 0.0, 0.7)), ((0.07, 0.032, 0.032), (-0.082, 0.058, 0.7)))
    ]
    ball = Superquadric(np.full(3, 0.035), np.array([1.0, 1.0]), np.array([0.023, 0.058, 0.7]), UPRIGHT)
    depth, index = seen([*bars, ball])
    truth = np.where(index == 3, 2, np.minimum(index, 1))
    found = convex_parts.correct((truth > 0).astype(np.int32), depth, CAMERA, NOISE)
    assert len(names(found)) == 2
    assert min(ious(truth, found)) > 0.9


def test_pieces_of_one_body_are_joined_and_those_of_two_are_not():
    depth, truth = seen([body(-0.05), body(0.05)])
    v, u = np.indices(truth.shape)
    pieces = np.where(truth > 0, 1 + (u // 20) + 100 * (v // 20) + 10000 * truth, 0)
    pieces = np.unique(pieces, return_inverse=True)[1].reshape(truth.shape).astype(np.int32)
    found = convex_parts.correct(pieces, depth, CAMERA, NOISE)
    assert pieces.max() >= 8
    assert len(names(found)) == 2
    assert min(ious(truth, found)) > 0.99


def test_other_names_give_the_same_segments():
    depth, truth = seen([body(-0.1), body(0.0), body(0.1)])
    one = np.where(truth == 3, 2, np.minimum(truth, 1)).astype(np.int32)
    two = np.array([0, 9, 4], np.int32)[one]
    first, second = (convex_parts.correct(labels, depth, CAMERA, NOISE) for labels in (one, two))
    pairs = np.unique(np.stack([first.ravel(), second.ravel()]), axis=1)
    assert pairs.shape[1] == len(names(first)) + 1 == 4


@pytest.mark.parametrize("depth", [0.0, 1.0])
def test_nothing_to_say_changes_nothing(depth):
    labels = np.zeros((240, 320), np.int32)
    image = np.full(labels.shape, depth, np.float32)
    np.testing.assert_array_equal(convex_parts.correct(labels, image, CAMERA, NOISE), labels)
    labels[50:100, 50:100] = 3
    np.testing.assert_array_equal(convex_parts.correct(labels, image, CAMERA, NOISE) > 0, labels > 0)


def behind_a_post(tilt=0.0, between=0.5):
    """Two parts of a board 0.7 m away, the right one turned by a tilt about its near edge, beside what is between."""
    depth, labels = np.full((CAMERA.height, CAMERA.width), 1.5), np.zeros((CAMERA.height, CAMERA.width), np.int32)
    v, u = np.indices(depth.shape)
    x = (u - CAMERA.cx) / CAMERA.fx
    parts = [(u > 90) & (u < 140), (u > 180) & (u < 230), (u >= 140) & (u <= 180)]
    # A point (x z, y z, z) of the turned part: z - 0.7 = tan(tilt) (x z - start).
    turned = (0.7 - np.tan(tilt) * ((180 - CAMERA.cx) / CAMERA.fx * 0.7)) / (1 - np.tan(tilt) * x)
    for k, (where, z) in enumerate(zip(parts, (0.7, turned, between), strict=True)):
        here = where & (v > 80) & (v < 160)
        depth, labels = np.where(here, z, depth), np.where(here, k + 1, labels)
    return depth.astype(np.float32), labels.astype(np.int32)


def of_parts(depth, labels, **options):
    found = convex_parts.correct(labels, depth, CAMERA, NOISE, **options)
    return [found[120, u] for u in (115, 205, 160)]


def test_a_board_goes_on_behind_what_is_nearer():
    left, right, post = of_parts(*behind_a_post())
    assert left == right != post
    assert len(set(of_parts(*behind_a_post(tilt=0.5)))) == 3, "they are two faces"
    assert len(set(of_parts(*behind_a_post(between=0.9)))) == 3, "the gap shows what lies behind"


NARROW = Camera(320, 240, 525.0, 525.0, 159.5, 119.5)


def taken_apart(depth, sigma=1e-3):
    depth = depth.astype(np.float32)
    return segments.take_apart(depth, depth > 0, NARROW, sigma)


def test_a_bridge_of_two_pixels_over_a_step_does_not_connect():
    """Two boards, one behind the other, and a smeared edge that leads from the one to the other."""
    depth = np.zeros((NARROW.height, NARROW.width))
    depth[40:200, 60:150], depth[40:200, 160:250] = 0.7, 0.8
    depth[100:102, 150:160] = np.linspace(0.7, 0.8, 12)[1:-1]
    found = taken_apart(depth)
    assert found[120, 100] != found[120, 200]
    assert (found[40:200, 60:150] == found[120, 100]).all()
    assert (found[40:200, 160:250] == found[120, 200]).all()


def test_a_fringe_of_something_near_is_not_one_with_what_is_far_behind_it():
    """Two strips that steps make narrow, side by side: a thing's fringe, and what is seen past it."""
    depth = np.zeros((NARROW.height, NARROW.width))
    depth[40:200, 150:154], depth[40:200, 154:158] = 0.7, 2.3
    found = taken_apart(depth)
    for label in range(1, found.max() + 1):
        of_one = depth[found == label]
        assert of_one.size == 0 or of_one.max() < 1.1 * of_one.min()


def test_a_side_with_steps_from_pixel_to_pixel_is_one():
    """Seen at a grazing angle: each column is 1.6 % farther than the last one, or more."""
    depth = np.zeros((NARROW.height, NARROW.width))
    depth[60:180, 100:116] = 1 / np.linspace(1 / 0.7, 1 / 0.92, 16)
    found = taken_apart(depth, sigma=3e-3)
    assert len(set(found[depth > 0])) == 1
    assert found[120, 108] > 0


def test_bits_and_nothing_have_no_label():
    depth = np.zeros((NARROW.height, NARROW.width))
    assert not taken_apart(depth).any()
    depth[100:104, 100:104] = 0.7  # 5 mm
    assert not taken_apart(depth).any()
