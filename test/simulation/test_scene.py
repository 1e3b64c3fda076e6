"""Scenes: what is drawn obeys its protocol, rests on its plane and is seen where it lies."""

from __future__ import annotations

import numpy as np
import pytest

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import unit_cube
from sq_perception.imaging.camera import Camera
from sq_perception.simulation.scenes import Scene, plane_depth, table_scene, thesis_scene


@pytest.mark.parametrize("seed", range(20))
def test_thesis_bodies_obey_the_protocol(seed):
    scene = thesis_scene(np.random.default_rng(seed))
    cube = unit_cube.cube_from_optical(scene.bodies)
    assert ((cube.size * 255 >= 25) & (cube.size * 255 <= 75)).all()
    assert ((cube.shape >= 0.1) & (cube.shape <= 1)).all()
    assert ((cube.translation * 255 >= 88 - 1e-9) & (cube.translation * 255 <= 168 + 1e-9)).all()
    depth, labels = scene.render()
    assert depth.shape == (256, 256)
    assert set(np.unique(labels)) == {0, 1}
    assert (np.isfinite(depth) == (labels == 1)).all()


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("count", [1, 4])
def test_bodies_rest_on_the_table_and_do_not_meet(seed, count):
    scene = table_scene(np.random.default_rng(seed), count)
    normal, offset = scene.plane[:3], scene.plane[3]
    assert np.linalg.norm(normal) == pytest.approx(1)
    for k, body in enumerate(scene.bodies):
        surface = body.sample_surface(4000, np.random.default_rng(1))
        height = surface @ normal + offset
        assert height.min() > -1e-9
        assert height.min() < 2e-3
        for other in list(scene.bodies)[:k]:
            assert (other.gauge(surface) > 1).all()


@pytest.mark.parametrize("seed", range(6))
def test_every_pixel_lies_on_its_body_or_on_the_table(seed):
    scene = table_scene(np.random.default_rng(seed), 3)
    depth, labels = scene.render()
    points = scene.camera.points(depth.astype(float))
    assert set(np.unique(labels)) == {0, 1, 2, 3}
    for k, body in enumerate(scene.bodies):
        assert np.abs(body.sampson_distance(points[labels == k + 1])).max() < 1e-4
    table = points[(labels == 0) & np.isfinite(depth)]
    assert np.abs(table @ scene.plane[:3] + scene.plane[3]).max() < 1e-5


def test_a_seed_names_a_scene():
    first, again, other = (table_scene(np.random.default_rng(seed), 2) for seed in (4, 4, 5))
    np.testing.assert_array_equal(first.bodies.to_flat(), again.bodies.to_flat())
    assert not np.allclose(first.bodies.to_flat(), other.bodies.to_flat())


def test_plane_straight_ahead_has_its_own_depth_and_its_back_is_not_seen():
    camera = Camera(5, 4, 3.0, 3.0, 2.0, 1.5)
    np.testing.assert_allclose(plane_depth(np.array([0, 0, -1.0, 2.0]), camera), 2.0)
    assert np.isinf(plane_depth(np.array([0, 0, 1.0, -2.0]), camera)).all()


def test_a_body_below_the_table_is_not_seen():
    body = Superquadric(np.full((1, 3), 0.1), np.ones((1, 2)), np.array([[0, 0, 3.0]]), np.array([[0, 0, 0, 1.0]]))
    depth, labels = Scene(body, Camera(9, 9, 9.0, 9.0, 4.0, 4.0), np.array([0, 0, -1.0, 2.0])).render()
    np.testing.assert_allclose(depth, 2.0)
    assert not labels.any()


def test_misuse_is_named():
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="1 to 10"):
        table_scene(rng, 0)
    with pytest.raises(ValueError, match="pinhole"):
        table_scene(rng, 1, unit_cube.camera())
    with pytest.raises(ValueError, match="no room for 3 bodies"):
        table_scene(rng, 3, Camera(64, 48, 2000.0, 2000.0, 31.5, 23.5))


def test_where_a_view_has_no_room_for_all_bodies_another_one_is_taken():
    assert len(table_scene(np.random.default_rng([3, 1, 0]), 10).bodies) == 10
