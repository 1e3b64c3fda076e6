"""Many crops in one call: the answers of single calls, in their order, whoever computes them."""

import numpy as np
import pytest

import sq_perception as sq
from sq_perception.simulation.scenes import table_scene

OPTIONS = sq.RecoveryOptions(method="symmetry")


@pytest.fixture(scope="module")
def crops():
    """Depth, camera and mask of six bodies, cut out of two images."""
    found = []
    for seed in range(2):
        scene = table_scene(np.random.default_rng([17, seed]), 3)
        depth, labels = scene.render()
        for k in range(3):
            rows, columns = np.nonzero(labels == k + 1)
            top, left = max(rows.min() - 12, 0), max(columns.min() - 12, 0)
            part = np.s_[top : rows.max() + 13, left : columns.max() + 13]
            height, width = depth[part].shape
            found.append((depth[part], scene.camera.cropped(left, top, width, height), labels[part] == k + 1))
            found[-1] += (scene.bodies[k],)
    return found


def test_each_crop_gives_its_body(crops):
    depths, cameras, masks, truth = zip(*crops, strict=True)
    for body, known in zip(sq.recover_crops(depths, cameras, masks, OPTIONS), truth, strict=True):
        assert sq.iou(body.superquadric, known) > 0.95
    alone = [np.where(mask, depth, np.nan) for depth, mask in zip(depths, masks, strict=True)]
    for body, known in zip(sq.recover_crops(alone, cameras, options=OPTIONS), truth, strict=True):
        assert sq.iou(body.superquadric, known) > 0.9


def test_processes_answer_as_this_one_does(crops):
    depths, cameras, masks, _ = zip(*crops, strict=True)
    here = sq.recover_crops(depths, cameras, masks, OPTIONS)
    for one, other in zip(here, sq.recover_crops(depths, cameras, masks, OPTIONS, jobs=2), strict=True):
        np.testing.assert_allclose(one.superquadric.to_flat(), other.superquadric.to_flat(), rtol=1e-6, atol=1e-9)


def test_a_mask_without_readings_has_no_body_and_an_image_one_camera_and_one_mask(crops):
    (depth, camera, mask, _), *_ = crops
    assert sq.recover_crops([np.full_like(depth, np.nan)], camera, [mask], OPTIONS) == [None]
    assert sq.recover_crops([], camera) == []
    with pytest.raises(ValueError, match="for each of 2 images, got 1 and 2"):
        sq.recover_crops([depth, depth], [camera], [mask, mask])
    with pytest.raises(ValueError, match="shape"):
        sq.recover_crops([depth], camera, [mask[1:]])
