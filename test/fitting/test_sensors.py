"""Fits to what simulated sensors measure of a body on a table."""

import numpy as np
import pytest

from sq_perception.fitting import surface_fit
from sq_perception.fitting.surface_fit import FitOptions
from sq_perception.simulation import scenes, sensor_noise


def lone_body_on_a_table(seed: int, sensor: str) -> tuple[scenes.Scene, np.ndarray, np.ndarray]:
    """A scene, what a sensor measures of it, and the body's mask."""
    rng = np.random.default_rng(seed)
    scene = scenes.table_scene(rng, 1)
    depth, labels = scene.render()
    return scene, sensor_noise.preset(sensor).measure(depth, scene.camera, rng), labels == 1


@pytest.mark.parametrize("knows_plane", [True, False])
def test_edges_that_a_time_of_flight_camera_mixes_do_not_make_a_body_sure_of_a_wrong_size(knows_plane) -> None:
    """Without a plane, 6 in 10 were wrong: what is known of the surroundings is no reason to be surer of the body."""
    off = []
    for seed in range(8):
        scene, depth, mask = lone_body_on_a_table(seed, "azure_kinect")
        fit = surface_fit.fit(depth, mask, scene.camera, options=FitOptions(plane=scene.plane if knows_plane else None))
        extent = scene.bodies[0].support(fit.superquadric.rotation_matrix.T)
        off.append(np.abs(fit.superquadric.size - extent) / fit.sigma_size)
    assert np.mean(np.array(off) < 2) > 0.75


def test_what_is_seen_of_a_small_near_body_is_what_is_seen_of_a_large_far_one() -> None:
    small = 0.2
    for seed in range(7):
        scene, depth, mask = lone_body_on_a_table(seed, "realsense_d435")
        nearer = scene.plane * [1, 1, 1, small]
        large = surface_fit.fit(depth, mask, scene.camera, options=FitOptions(plane=scene.plane))
        tiny = surface_fit.fit(depth * np.float32(small), mask, scene.camera, options=FitOptions(plane=nearer))
        order, other = np.argsort(large.superquadric.size), np.argsort(tiny.superquadric.size)
        size = large.superquadric.size[order]
        off = np.abs(tiny.superquadric.size[other] / small - size)
        assert (off < 0.1 * size).all()
