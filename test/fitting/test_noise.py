"""How noisy a depth image is, and what noise and sensors leave of what a fit knows."""

import math

import numpy as np
import pytest

from sq_perception.fitting import observation, surface_fit
from sq_perception.fitting.options import MODEL_ERROR
from sq_perception.fitting.surface_fit import FitOptions
from sq_perception.geometry import rotation
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera
from sq_perception.simulation import scenes, sensor_noise
from sq_perception.simulation.scenes import plane_depth

INSIDE = np.ones((120, 160), dtype=bool)


def slope(rng: np.random.Generator, sigma: float) -> np.ndarray:
    v, u = np.indices(INSIDE.shape)
    return 0.8 + 0.0004 * u + 0.0007 * v + 1e-6 * u * v + sigma * rng.standard_normal(INSIDE.shape)


@pytest.mark.parametrize("sigma", [1e-4, 1e-3, 5e-3])
def test_gaussian_noise_on_a_slope(sigma: float, rng: np.random.Generator) -> None:
    found = observation.estimate_noise(slope(rng, sigma).astype(np.float32), INSIDE, 1e-6)
    assert found.sigma == pytest.approx(sigma, rel=0.1)
    assert found.quantum == 0


@pytest.mark.parametrize("levels", [1.0, 2.0, 4.0])
def test_noise_of_whole_steps_is_no_multiple_of_a_step(levels: float, rng: np.random.Generator) -> None:
    step = 1 / 256
    depth = np.round(slope(rng, levels * step) / step) * step
    found = observation.estimate_noise(depth.astype(np.float32), INSIDE, 1e-6)
    assert found.sigma == pytest.approx(np.hypot(levels, 1 / np.sqrt(12)) * step, rel=0.08)
    assert found.quantum == 0


def test_rounding_alone(rng: np.random.Generator) -> None:
    step = 1 / 256
    found = observation.estimate_noise((np.round(slope(rng, 0.0) / step) * step).astype(np.float32), INSIDE, 1e-6)
    assert found.sigma == pytest.approx(step / np.sqrt(12))
    assert found.quantum == pytest.approx(step)


@pytest.mark.parametrize("levels", [0.3, 0.35, 0.4])
def test_noise_of_less_than_half_a_step_joins_the_rounding(levels: float, rng: np.random.Generator) -> None:
    """On a bowl, whose slopes of all sizes make the errors of rounding of neighbours independent."""
    step, (v, u) = 1 / 256, np.indices(INSIDE.shape)
    bowl = 200 + 0.02 * ((u - 80) ** 2 + (v - 60) ** 2)
    depth = np.round(bowl + levels * rng.standard_normal(INSIDE.shape)) * step
    found = observation.estimate_noise(depth.astype(np.float32), INSIDE, 1e-6)
    assert found.sigma == pytest.approx(np.hypot(levels, 1 / np.sqrt(12)) * step, rel=0.15)


def test_a_fit_is_surer_the_less_noise_there_is() -> None:
    """Also below half a step, which was taken for none: what it left was no noise, and deviations grew ten times."""
    camera = Camera(256, 256, 255.0, 255.0, 127.5, 127.5, "orthographic")
    body = Superquadric([0.25, 0.2, 0.15], [0.3, 0.6], [0.02, 0.01, 0.5], [0.3, 0.5, 0.1, 0.8])
    exact, index = raycast.render(body, camera)
    step, deviations = 1 / 255, []
    for levels in (0.3, 0.6, 2.0, 6.0):
        noise = levels * step * np.random.default_rng(3).standard_normal(exact.shape)
        depth = np.where(index >= 0, np.round((exact + noise) / step) * step, np.nan)
        fit = surface_fit.fit(depth, index >= 0, camera)
        assert fit.noise == pytest.approx(np.hypot(levels, 1 / np.sqrt(12)) * step, rel=0.1)
        deviations.append(fit.sigma_size)
    assert (np.diff(deviations, axis=0) > 0).all()


@pytest.mark.parametrize("shape", [(48, 48), (5, 300), (299, 4), (121, 7), (3, 3)])
def test_images_of_any_shape(shape: tuple[int, int], rng: np.random.Generator) -> None:
    depth = (1 + 0.01 * rng.standard_normal(shape)).astype(np.float32)
    assert 0 < observation.estimate_noise(depth, np.ones(shape, dtype=bool), 1e-6).sigma < 0.1


def test_outliers_do_not_count(rng: np.random.Generator) -> None:
    depth = slope(rng, 1e-3)
    depth[rng.random(depth.shape) < 0.02] += 0.3
    assert observation.estimate_noise(depth.astype(np.float32), INSIDE, 1e-6).sigma == pytest.approx(1e-3, rel=0.25)


def test_a_fit_takes_noise_that_is_given(rng: np.random.Generator) -> None:
    body = Superquadric([0.08, 0.06, 0.05], [0.3, 0.6], [0.05, 0.0, 0.9], [0.3, 0.5, 0.1, 0.8])
    depth, index = raycast.render(body, CAMERA)
    depth = np.where(index >= 0, depth, np.nan)
    depth += 0.002 * depth**2 * rng.standard_normal(depth.shape)
    given = surface_fit.FitOptions(noise=0.002 * 0.87**2)
    fit = surface_fit.fit(depth, index >= 0, CAMERA, options=given)
    assert fit.noise == pytest.approx(0.002 * 0.87**2, rel=0.1)
    np.testing.assert_allclose(np.sort(fit.superquadric.size), np.sort(body.size), rtol=0.06)


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
        assert (np.abs(tiny.superquadric.size[other] / small - size) < 0.1 * size).all()


CAMERA = Camera(320, 240, 270.0, 270.0, 159.5, 119.5)
_TILT = math.radians(35.0)
UP = np.array([0.0, -math.cos(_TILT), -math.sin(_TILT)])
FOOT = np.array([0.02, 0.05, 0.45])
_TURN = rotation.from_matrix(np.stack([[1.0, 0.0, 0.0], np.cross(UP, [1.0, 0.0, 0.0]), UP], axis=1))
JAR = Superquadric(
    [[0.035, 0.035, 0.05], [0.022, 0.022, 0.012]],
    [[0.15, 1.0], [0.15, 1.0]],
    np.array([FOOT + 0.05 * UP, FOOT + 0.112 * UP]),
    np.array([_TURN, _TURN]),
)
"""A body of 10 cm, and its lid."""


def half_extents(axes: np.ndarray) -> np.ndarray:
    """Of the jar along axes (3, 3), rows."""
    reach = [part.support(axes) + axes @ part.translation for part in JAR]
    back = [part.support(axes) - axes @ part.translation for part in JAR]
    return (np.max(reach, axis=0) + np.max(back, axis=0)) / 2


@pytest.mark.parametrize("seed", [4, 5, 7])
def test_a_body_of_noise_is_no_surer_than_the_thing_that_it_may_be(seed: int) -> None:
    """The exact course alone was off by 3.5 of its deviations, where the tolerant one told another size."""
    plane = np.append(UP, -UP @ FOOT)
    shown, _ = raycast.render(JAR, CAMERA)
    mask = np.isfinite(shown)
    noise = np.random.default_rng(seed).normal(0, 0.01, shown.shape)
    depth = (np.where(mask, shown, plane_depth(plane, CAMERA)) + noise).astype(np.float32)
    found = surface_fit.fit(depth, mask, CAMERA, options=FitOptions(plane=plane))
    as_thing = surface_fit.fit(depth, mask, CAMERA, options=FitOptions(plane=plane, model_error=MODEL_ERROR))
    body, thing, partner = found.superquadric, as_thing.superquadric, slice(None)
    partner = np.abs(body.rotation_matrix.T @ thing.rotation_matrix).argmax(axis=1)
    assert (found.sigma_size > 0.7 * np.abs(body.size - thing.size[partner])).all()
    assert (np.abs(body.size - half_extents(body.rotation_matrix.T)) < 2.5 * found.sigma_size).all()
