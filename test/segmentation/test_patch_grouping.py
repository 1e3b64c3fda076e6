"""Joining patches: signs of borders, steps, vessels and what goes on behind, on images of a few samples."""

from __future__ import annotations

import numpy as np
import pytest

from sq_perception.imaging.camera import Camera
from sq_perception.segmentation.patch_grouping import bodies
from sq_perception.segmentation.surface_patches import Patches

CAMERA = Camera(60, 40, 50.0, 50.0, 29.5, 19.5)
"""A sample is 2 cm wide at a depth of one metre: a body shows at least 4 samples."""
NEAR_CAMERA = Camera(60, 40, 200.0, 200.0, 29.5, 19.5)
"""One whose half of an image shows 20 cm."""
LEFT, RIGHT = (slice(None), slice(0, 30)), (slice(None), slice(30, 60))


def patches(labels, depth=1.0, fold=0.0, curvature=(), planes=None):
    labels = np.asarray(labels, np.int32)
    count = int(labels.max())
    curved = np.zeros(count + 1)
    curved[1 : 1 + len(curvature)] = curvature
    return Patches(
        labels,
        count,
        np.broadcast_to(np.asarray(depth, np.float32), labels.shape).copy(),
        np.zeros(labels.shape, bool),
        np.broadcast_to(np.asarray(fold, np.float32), labels.shape).copy(),
        curved,
        np.full((count + 1, 3), np.nan) if planes is None else np.asarray(planes, float),
        1,
        0.02,
    )


def halves():
    labels = np.ones((40, 60), int)
    labels[RIGHT] = 2
    return labels


def edge(value):
    fold = np.zeros((40, 60))
    fold[:, 28:32] = value
    return fold


@pytest.mark.parametrize(("fold", "count"), [(-1.5, 1), (0.0, 1), (1.5, 2), (np.nan, 1)])
def test_convex_edges_join_and_concave_ones_part(fold, count):
    assert bodies(patches(halves(), fold=edge(fold)), CAMERA).max() == count


def test_a_leak_is_outvoted():
    fold = edge(1.5)
    fold[:8] = -1.5
    assert bodies(patches(halves(), fold=fold), CAMERA).max() == 2
    assert bodies(patches(halves(), fold=-fold), CAMERA).max() == 1


def test_of_two_edges_side_by_side_the_sharper_one_counts():
    fold = edge(1.2)
    fold[:, 31:33] = -3
    assert bodies(patches(halves(), fold=fold), CAMERA).max() == 1
    assert bodies(patches(halves(), fold=-fold), CAMERA).max() == 2


def test_a_step_parts_but_not_a_hollow_from_its_rim():
    depth = np.ones((40, 60))
    depth[RIGHT] = 1.1
    for camera in (CAMERA, NEAR_CAMERA):
        assert bodies(patches(halves(), depth), camera).max() == 2
        assert bodies(patches(halves(), depth, curvature=(20, 0)), camera).max() == 2, "it lies behind its rim"
    assert bodies(patches(halves(), depth, curvature=(0, 20)), NEAR_CAMERA).max() == 1
    assert bodies(patches(halves(), depth, curvature=(0, 20)), CAMERA).max() == 2, "a bin's wall of 0.9 m"
    depth[RIGHT] = 1.5
    for camera in (CAMERA, NEAR_CAMERA):
        assert bodies(patches(halves(), depth, curvature=(0, 20)), camera).max() == 2, "no vessel is that deep"


def occluded(tilt=0.0, between=0.8):
    """Two parts of a wall at z = 1, the second one turned by a tilt, behind a post."""
    labels = np.zeros((40, 60), int)
    labels[:, :20], labels[:, 20:40], labels[:, 40:] = 1, 2, 3
    depth = np.ones((40, 60))
    depth[:, 20:40] = between
    planes = [[np.nan] * 3, [0, 0, 1], [0, 0, 1 / between], [np.tan(tilt), 0, 1 - 0.4 * np.tan(tilt)]]
    return patches(labels, depth, planes=planes)


def test_a_plane_goes_on_behind_a_nearer_body():
    first, post, second = bodies(occluded(), CAMERA)[1:]
    assert first == second != post
    first, post, second = bodies(occluded(tilt=0.5), CAMERA)[1:]
    assert len({first, post, second}) == 3
    # The gap shows what lies behind: these are two.
    first, gap, second = bodies(occluded(between=1.3), CAMERA)[1:]
    assert len({first, gap, second}) == 3


def test_attached_fragments_join_and_free_ones_stay():
    labels = np.zeros((40, 60), int)
    labels[LEFT] = 1
    labels[10:11, 30:32] = 2
    labels[30:31, 50:52] = 3
    fold = np.full((40, 60), 1.5)
    body = bodies(patches(labels, fold=fold), CAMERA)
    assert body[2] == body[1] != body[3]
