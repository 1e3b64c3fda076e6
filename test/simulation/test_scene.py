"""Scenes: what is drawn obeys its protocol, rests on its plane and is seen where it lies; crowds touch.

And of all that is simulated: a seed names it.
"""

import numpy as np
import pytest
from table_scenes import best_iou

from sq_perception import Camera, Superquadric
from sq_perception.imaging import unit_cube
from sq_perception.segmentation.segments import segment
from sq_perception.simulation import scenes, sensor_noise
from sq_perception.simulation.furniture import things_in_furniture
from sq_perception.simulation.household import draw_thing
from sq_perception.simulation.scenes import Scene, plane_depth, table_scene, thesis_bodies, thesis_scene
from sq_perception.simulation.segment_views import draw_segment_views
from sq_perception.simulation.thing_views import draw_thing_views
from sq_perception.simulation.things_on_table import TABLE_CAMERA, things_on_table

SMALL = TABLE_CAMERA.cropped(80, 60, 480, 360)
TELE = Camera(64, 48, 2000.0, 2000.0, 31.5, 23.5)
"""Too narrow a view for several bodies."""


def test_bodies_of_the_thesis_fill_the_ranges_of_its_protocol():
    bodies = thesis_bodies(4000, np.random.default_rng(3))
    ranges = ((255 * bodies.size, 25, 75), (bodies.shape, 0.1, 1.0), (255 * bodies.translation, 88, 168))
    for values, low, high in ranges:
        assert low <= values.min() < low + 0.01 * high
        assert high - 0.01 * high < values.max() <= high
        np.testing.assert_allclose(values.mean(axis=0), (low + high) / 2, rtol=0.03)


@pytest.mark.parametrize("seed", range(20))
def test_the_thesis_camera_sees_its_body_on_nothing(seed):
    depth, labels = thesis_scene(np.random.default_rng(seed)).render()
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


@pytest.mark.parametrize(
    "draw",
    [
        lambda rng: {"bodies": table_scene(rng, 2).bodies.to_flat()},
        lambda rng: {"parts": np.concatenate([draw_thing(rng).parts.to_flat() for _ in range(3)])},
        lambda rng: vars(things_on_table(rng, 3)),
        lambda rng: vars(things_in_furniture("bin", rng, SMALL)),
        lambda rng: vars(draw_thing_views(6, rng)),
        lambda rng: vars(draw_segment_views(2, rng)),
    ],
    ids=["bodies", "things", "table", "furniture", "views of things", "views of segments"],
)
def test_a_seed_names_what_is_drawn(draw):
    first, again, other = (draw(np.random.default_rng(seed)) for seed in (9, 9, 10))
    arrays = [name for name, value in first.items() if isinstance(value, np.ndarray)]
    for name in arrays:
        np.testing.assert_array_equal(first[name], again[name])
    assert not all(np.array_equal(first[name], other[name]) for name in arrays)


def test_plane_straight_ahead_has_its_own_depth_and_neither_its_back_nor_what_is_below_is_seen():
    camera = Camera(5, 4, 3.0, 3.0, 2.0, 1.5)
    np.testing.assert_allclose(plane_depth(np.array([0, 0, -1.0, 2.0]), camera), 2.0)
    assert np.isinf(plane_depth(np.array([0, 0, 1.0, -2.0]), camera)).all()
    body = Superquadric(np.full((1, 3), 0.1), np.ones((1, 2)), np.array([[0, 0, 3.0]]), np.array([[0, 0, 0, 1.0]]))
    depth, labels = Scene(body, Camera(9, 9, 9.0, 9.0, 4.0, 4.0), np.array([0, 0, -1.0, 2.0])).render()
    np.testing.assert_allclose(depth, 2.0)
    assert not labels.any()


@pytest.mark.parametrize(
    ("draw", "arguments", "words"),
    [
        (table_scene, (0,), "1 to 10"),
        (table_scene, (1, unit_cube.camera()), "pinhole"),
        (table_scene, (3, TELE), "no room for 3 bodies"),
        (scenes.draw_crowd, (13,), "1 to 12"),
        (scenes.draw_crowd, (3, TELE), "no room"),
    ],
)
def test_misuse_is_named(draw, arguments, words):
    with pytest.raises(ValueError, match=words):
        draw(np.random.default_rng(0), *arguments)


def test_where_a_view_has_no_room_for_all_bodies_another_one_is_taken():
    assert len(table_scene(np.random.default_rng([3, 1, 0]), 10).bodies) == 10


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


@pytest.mark.parametrize("seed", range(4))
def test_a_crowd_seen_by_a_stereo_camera_is_parted(seed):
    """Noise that is alike over windows of pixels makes folds and hides them; lines of sight are longer than windows."""
    rng = np.random.default_rng(seed)
    scene = scenes.draw_crowd(rng, 6)
    depth, truth = scene.render()
    found = segment(sensor_noise.preset("realsense_d435").measure(depth, scene.camera, rng), scene.camera)
    visible = [k for k in set(np.unique(truth)) - {0} if np.sum(truth == k) > 1500]
    assert len(visible) - 1 <= len(found.ids) <= 6
    assert np.mean([best_iou(truth == k, found.labels) for k in visible]) > 0.8
