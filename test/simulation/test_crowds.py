"""Crowds: they touch, do not overlap, and are taken apart again."""

from __future__ import annotations

import numpy as np
import pytest

from sq_perception.imaging.camera import Camera
from sq_perception.segmentation.segments import segment
from sq_perception.simulation import scenes, sensor_noise


@pytest.mark.parametrize("seed", range(8))
def test_a_crowd_rests_touches_and_does_not_overlap(seed):
    rng = np.random.default_rng(seed)
    scene = scenes.draw_crowd(rng, 5)
    normal, offset = scene.plane[:3], scene.plane[3]
    surfaces = [body.sample_surface(4000, np.random.default_rng(1)) for body in scene.bodies]
    gaps = []
    for k, body in enumerate(scene.bodies):
        height = surfaces[k] @ normal + offset
        assert height.min() > -1e-9
        assert height.min() < 2e-3
        others = [body.gauge(surface) for j, surface in enumerate(surfaces) if j != k]
        assert min(gauge.min() for gauge in others) > 0.97
        gaps.append(min(gauge.min() for gauge in others))
    assert min(gaps) < 1.05  # at least one pair touches


def test_crowds_are_refused_where_there_is_no_room():
    with pytest.raises(ValueError, match="1 to 12"):
        scenes.draw_crowd(np.random.default_rng(0), 13)
    with pytest.raises(ValueError, match="no room"):
        scenes.draw_crowd(np.random.default_rng(0), 3, Camera(64, 48, 2000.0, 2000.0, 31.5, 23.5))


@pytest.mark.parametrize("seed", range(4))
def test_a_crowd_seen_by_a_stereo_camera_is_parted(seed):
    """Noise that is alike over windows of pixels makes folds and hides them; lines of sight are longer than windows."""
    rng = np.random.default_rng(seed)
    scene = scenes.draw_crowd(rng, 6)
    depth, truth = scene.render()
    found = segment(sensor_noise.preset("realsense_d435").measure(depth, scene.camera, rng), scene.camera)
    visible = [k for k in set(np.unique(truth)) - {0} if np.sum(truth == k) > 1500]
    assert len(visible) - 1 <= len(found.ids) <= 6
    good = [
        max(np.sum((found.labels == j) & (truth == k)) / np.sum((found.labels == j) | (truth == k)) for j in found.ids)
        for k in visible
    ]
    assert np.mean(good) > 0.8
