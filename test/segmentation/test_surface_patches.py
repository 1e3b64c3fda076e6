"""Folds against closed forms: planes, edges between two planes, spheres; patches of rendered bodies."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from sq_perception.geometry import rotation
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera
from sq_perception.segmentation import surface_patches
from sq_perception.segmentation.surface_patches import find

CAMERA = Camera(320, 240, 525.0, 525.0, 159.5, 119.5)


def plane_depth(normal, distance):
    """Depth of the plane n.p = distance."""
    v, u = np.indices((CAMERA.height, CAMERA.width))
    return distance / (CAMERA.rays(u, v)[1] @ np.asarray(normal, float))


def patches(depth, wanted=None, sigma=1e-4):
    depth = np.where(np.isfinite(depth), depth, 0).astype(np.float32)
    return find(depth, depth > 0 if wanted is None else wanted, CAMERA, sigma)


def turned(angle):
    return np.array([np.sin(angle), 0.0, np.cos(angle)])


@pytest.mark.parametrize("normal", [(0, 0, 1), (0.5, 0, 1), (-0.3, 0.8, 1), (0, -1.2, 1)])
def test_a_plane_has_no_fold_however_it_is_turned(normal):
    found = patches(plane_depth(np.array(normal) / np.linalg.norm(normal), 0.7))
    assert found.count == 1
    assert np.nanmax(np.abs(found.fold)) < 0.01
    assert found.curvature[1] == 0
    # w = n.ray / distance
    np.testing.assert_allclose(found.planes[1], np.array(normal) / np.linalg.norm(normal) / 0.7, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("half", np.deg2rad([20, 30, 45]))
@pytest.mark.parametrize("sign", [-1, 1], ids=["convex", "concave"])
def test_an_edge_folds_by_the_tangent_of_half_its_angle(half, sign):
    left, right = (plane_depth(turned(side * half), 0.7 * np.cos(half)) for side in (-1, 1))
    # Both pass through (0, 0, 0.7): the nearer one of them makes a valley, the farther one a ridge.
    found = patches(np.minimum(left, right) if sign > 0 else np.maximum(left, right))
    assert found.count == 2
    middle = found.fold.shape[1] // 2
    s = found.fold[20:-20, middle - 1 : middle + 2] * surface_patches._FOLD
    # The mean over a square blunts the edge by up to a quarter of the chord's radius.
    assert 0.7 * np.tan(half) < np.nanmax(sign * s) < 1.05 * np.tan(half)


@pytest.mark.parametrize("inside", [False, True])
def test_curvature_of_a_sphere(inside):
    radius, centre = 0.08, np.array([0, 0, 0.7])
    v, u = np.indices((CAMERA.height, CAMERA.width))
    d = CAMERA.rays(u, v)[1]
    a, b = (d * d).sum(-1), d @ centre
    rest = b * b - a * (centre @ centre - radius**2)
    near = np.hypot(*(CAMERA.unproject(u, v, np.full(u.shape, 0.7))[..., :2].transpose(2, 0, 1))) < 0.02
    depth = np.where(near, (b + (1 if inside else -1) * np.sqrt(np.maximum(rest, 0))) / a, 0)
    found = patches(depth)
    assert found.count == 1
    assert found.curvature[1] == pytest.approx((2 if inside else -2) / radius, rel=0.25)


def test_faces_of_a_box_are_patches():
    turn = rotation.from_rotation_vector(np.array([0.5, 0.6, 0.0]))
    body = Superquadric([0.05, 0.05, 0.05], [0.1, 0.1], [0, 0, 0.6], turn)
    found = patches(raycast.render(body, CAMERA)[0])
    large = np.bincount(found.labels.ravel())[1:]
    assert np.count_nonzero(large > 100) == 3
    assert np.nanmax(found.fold) < 0.8, "a convex body has no concave edge"


def test_no_patch_reaches_over_a_depth_step():
    depth = np.where(np.arange(320) < 160, 0.7, 0.8) + np.zeros((240, 1))
    found = patches(depth)
    assert found.count == 2
    for label in (1, 2):
        assert np.ptp(found.depth[found.labels == label]) == 0


@pytest.mark.parametrize("seed", range(3))
def test_noise_that_is_alike_over_windows_makes_no_folds(seed):
    """As that of stereo cameras: 5 mm in windows of 11 x 9 pixels, on a plane seen beside the same plane.

    Taken for independent noise of that size it folds the plane into many patches.
    """
    rng = np.random.default_rng(seed)
    noise = cv2.boxFilter(rng.standard_normal((240, 320)), -1, (11, 9), borderType=cv2.BORDER_REFLECT)
    depth = 1.0 + 0.005 * noise / noise.std()
    wanted = np.zeros(depth.shape, bool)
    wanted[:, 160:] = True
    measured = find(depth.astype(np.float32), wanted, CAMERA, 0.005, ~wanted)
    assumed = find(depth.astype(np.float32), wanted, CAMERA, 0.005)
    assert measured.count < 6
    assert assumed.count > 10 * measured.count


def test_bodies_too_far_for_a_chord_have_no_patches():
    assert patches(np.full((240, 320), 50.0)) is None


@pytest.mark.parametrize("wall", [1.5, 50.0])
def test_a_wall_behind_does_not_make_the_chords_of_things_longer_or_shorter(wall):
    """A ridge a little above its support, and a wall of more pixels than the ridge."""
    depth = np.maximum(*(plane_depth(turned(side * np.deg2rad(30)), 0.6) for side in (-1, 1)))
    wanted = np.zeros(depth.shape, bool)
    wanted[120:200, 100:220] = True
    support = np.zeros(depth.shape, bool)
    support[205:], depth[205:] = True, 0.6
    alone = find(depth.astype(np.float32), wanted, CAMERA, 1e-4, support)
    before = np.where(np.arange(240)[:, None] < 100, wall, depth).astype(np.float32)
    both = find(before, wanted | (before == np.float32(wall)), CAMERA, 1e-4, support)
    assert both.stride == alone.stride
    inside = slice(130 // alone.stride, 190 // alone.stride), slice(110 // alone.stride, 210 // alone.stride)
    np.testing.assert_allclose(both.fold[inside], alone.fold[inside], rtol=1e-5)
    assert len(np.unique(both.labels[inside])) == len(np.unique(alone.labels[inside])) == 2


def test_nothing_wanted():
    assert patches(np.full((240, 320), np.nan)) is None


def test_a_fringe_of_something_near_is_no_patch_with_what_is_far_behind_it():
    """Two strips too narrow to be smooth, side by side: a thing's fringe, and what is seen past it."""
    depth = np.zeros((CAMERA.height, CAMERA.width))
    depth[40:200, 150:154], depth[40:200, 154:158] = 0.7, 2.3
    found = patches(depth)
    assert found.count >= 2
    for label in range(1, found.count + 1):
        of_one = found.depth[found.labels == label]
        assert of_one.max() < 1.1 * of_one.min()
