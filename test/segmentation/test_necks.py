"""What a thing narrows towards belongs to it; what stands on a wide top is a thing of its own."""

from __future__ import annotations

import numpy as np
import pytest

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera
from sq_perception.segmentation import necks

CAMERA = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)
SLANT = np.deg2rad(35)
UP = np.array([0.0, -np.cos(SLANT), -np.sin(SLANT)])
PLANE = np.append(UP, 0.6 * np.sin(SLANT))
"""The line of sight meets the support 0.6 m away."""
TURN = np.array([np.sin((np.pi / 2 + SLANT) / 2), 0.0, 0.0, np.cos((np.pi / 2 + SLANT) / 2)])
"""Of bodies whose z axis is the normal of the support."""
FLAT, BALL = (0.1, 1.0), (1.0, 1.0)


def upright(size, shape, height, aside=0.0):
    return Superquadric(np.array(size), np.array(shape), np.array([aside, 0.0, 0.6]) + height * UP, TURN)


def seen(*groups):
    """Depth and labels; each group of bodies has a label, from 1."""
    bodies = [one for group in groups for one in group]
    depth, index = raycast.render(Superquadric.stack(bodies), CAMERA)
    label = np.append(np.repeat(np.arange(1, len(groups) + 1), [len(group) for group in groups]), 0)
    noise = 5e-4 * np.random.default_rng(0).standard_normal(depth.shape)
    return np.where(index >= 0, depth + noise, 0).astype(np.float32), label[index].astype(np.int32)


BODY = upright((0.035, 0.035, 0.05), FLAT, 0.05)
SHOULDER = upright((0.035, 0.035, 0.04), BALL, 0.10)
NECK = upright((0.014, 0.014, 0.02), FLAT, 0.155)
CAP = upright((0.017, 0.017, 0.008), FLAT, 0.183)


def test_axis_of_the_scene():
    np.testing.assert_allclose(BODY.rotation_matrix[:, 2], UP, atol=1e-12)
    np.testing.assert_allclose(np.array([0.0, 0.0, 0.6]) @ PLANE[:3] + PLANE[3], 0.0, atol=1e-12)


def test_a_neck_and_its_cap_belong_to_the_bottle():
    depth, labels = seen([BODY, SHOULDER], [NECK], [CAP])
    np.testing.assert_array_equal(necks.joined(labels, depth, CAMERA, PLANE), labels > 0)


@pytest.mark.parametrize("radius", [0.014, 0.02, 0.03])
def test_what_stands_on_a_flat_top_is_a_thing(radius):
    depth, labels = seen([BODY], [upright((radius, radius, 0.03), FLAT, 0.13)])
    np.testing.assert_array_equal(necks.joined(labels, depth, CAMERA, PLANE), labels)


def test_what_stands_beside_the_middle_is_a_thing():
    depth, labels = seen([BODY, SHOULDER], [upright((0.014, 0.014, 0.02), FLAT, 0.155, aside=0.025)])
    np.testing.assert_array_equal(necks.joined(labels, depth, CAMERA, PLANE), labels)


def test_a_thing_behind_is_no_neck():
    behind = Superquadric(NECK.size, NECK.shape, NECK.translation + np.array([0.0, 0.0, 0.2]), TURN)
    depth, labels = seen([BODY, SHOULDER], [behind])
    np.testing.assert_array_equal(necks.joined(labels, depth, CAMERA, PLANE), labels)


def test_from_above_nothing_is_joined():
    depth, labels = seen([BODY, SHOULDER], [NECK])
    above = np.array([0.0, 0.0, -1.0, 0.6])
    np.testing.assert_array_equal(necks.joined(labels, depth, CAMERA, above), labels)
