"""Segmentation: objects with known masks on a known plane, and images that hold none."""

import numpy as np
import pytest
from table_scenes import VGA, Table, best_iou, ious, noisy

from sq_perception.geometry import rotation
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast, unit_cube
from sq_perception.imaging.camera import Camera
from sq_perception.recordings.frame_file import read
from sq_perception.segmentation.options import SegmentationOptions
from sq_perception.segmentation.segments import from_labels, segment
from sq_perception.segmentation.support_plane import around
from sq_perception.simulation import sensor_noise
from sq_perception.simulation.scenes import plane_depth

CAMERA = Camera(320, 240, 270.0, 270.0, 159.5, 119.5)
TABLE = Table(0.7, distance=0.7 / np.sin(0.7))
PLANE, NORMAL = TABLE.plane, TABLE.plane[:3]


def table_depth(camera=CAMERA, plane=PLANE):
    return noisy(plane_depth(plane, camera), 0.0)


def scene(bodies, noise=0.0, seed=0):
    return TABLE.see(bodies, noise, seed, CAMERA)


THREE = [
    TABLE.body(-0.25, 0.0, (0.06, 0.04, 0.09), (0.2, 0.2)),
    TABLE.body(0.02, 0.05, (0.05, 0.05, 0.07), (0.1, 1.0)),
    TABLE.body(0.25, -0.05, (0.05, 0.05, 0.05), (1.0, 1.0)),
]


@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_three_objects_on_a_table(noise):
    depth, truth = scene(THREE, noise=noise)
    found = segment(depth, CAMERA)
    assert found.ids == (1, 2, 3)
    sizes = [np.sum(found.labels == k) for k in found.ids]
    assert sizes == sorted(sizes, reverse=True)
    for k in (1, 2, 3):
        assert best_iou(truth == k, found.labels) > (0.93 if noise else 0.95)
    assert found.plane is not None
    assert np.degrees(np.arccos(np.clip(found.plane[:3] @ NORMAL, -1, 1))) < 0.3
    assert found.plane[3] == pytest.approx(PLANE[3], abs=0.002)


def test_the_same_image_gives_the_same_objects():
    depth, _ = scene(THREE, noise=0.002)
    first, second = segment(depth, CAMERA), segment(depth, CAMERA)
    np.testing.assert_array_equal(first.labels, second.labels)
    np.testing.assert_array_equal(first.plane, second.plane)


def test_a_speck_is_no_object_and_a_noisy_empty_table_has_none():
    speck = np.full((CAMERA.height, CAMERA.width), np.nan, np.float32)
    speck[100:105, 100:105] = 1.0
    assert segment(speck, CAMERA).ids == ()
    for seed in range(5):
        depth, _ = scene([TABLE.body(5.0, 5.0, (0.01, 0.01, 0.01), (0.2, 0.2))], noise=0.003, seed=seed)
        assert segment(depth, CAMERA).ids == ()


def test_options_choose():
    depth, _ = scene(THREE)
    assert segment(depth, CAMERA, SegmentationOptions(max_objects=2)).ids == (1, 2)
    assert segment(depth, CAMERA, SegmentationOptions(depth_range=(5.0, 6.0))).ids == ()
    near = segment(depth, CAMERA, SegmentationOptions(depth_range=(0.0, 1.0)))
    assert near.ids
    assert np.nanmax(depth[near.labels > 0]) <= 1.0


def test_labels_that_would_become_others_are_refused():
    labels = np.full((CAMERA.height, CAMERA.width), 2**32 + 2)
    with pytest.raises(ValueError, match="numbers below"):
        from_labels(labels, np.ones(labels.shape), CAMERA)


def test_orthographic_components():
    camera = unit_cube.camera(128)
    bodies = [
        Superquadric(np.full(3, 0.18), np.array([0.5, 1.0]), np.array([0.3, 0.3, 0.5]), np.array([0, 0, 0, 1.0])),
        Superquadric(np.full(3, 0.1), np.array([0.5, 1.0]), np.array([0.75, 0.7, 0.5]), np.array([0, 0, 0, 1.0])),
    ]
    depth, index = raycast.render(Superquadric.stack(bodies), camera)
    found = segment(np.where(np.isfinite(depth), depth, np.nan), camera)
    assert found.plane is None
    np.testing.assert_array_equal(found.labels, index + 1)


@pytest.mark.parametrize("shape", [(0.1, 0.1), (0.1, 1.0), (1.0, 1.0)])
@pytest.mark.parametrize("turn", range(4))
def test_a_lone_body_is_no_table(shape, turn):
    body = Superquadric([0.08, 0.06, 0.1], shape, [0, 0, 0.7], rotation.random(4, np.random.default_rng(5))[turn])
    depth, index = raycast.render(body, CAMERA)
    found = segment(np.where(np.isfinite(depth), depth, np.nan), CAMERA)
    assert found.plane is None
    assert best_iou(index >= 0, found.labels) > 0.95


def test_labels_from_outside_win():
    depth, truth = scene(THREE, noise=0.002)
    given = np.where(truth == 1, 40, np.where(truth == 3, 7, 0)).astype(np.uint8)
    found = from_labels(given, depth, CAMERA)
    np.testing.assert_array_equal(found.labels, given)
    counts = {40: np.sum(given == 40), 7: np.sum(given == 7)}
    assert found.ids == tuple(sorted(counts, key=counts.get, reverse=True))
    assert np.degrees(np.arccos(np.clip(found.plane[:3] @ NORMAL, -1, 1))) < 0.7
    assert found.plane[3] == pytest.approx(PLANE[3], abs=0.004)


def test_the_plane_below_the_bodies_and_not_the_wall_behind_them():
    depth, truth = scene(THREE[:1], noise=0.001)
    depth = np.fmin(depth, np.where(np.arange(240)[:, None] < 90, np.float32(1.05), np.float32(np.inf)))
    depth = np.where(truth > 0, scene(THREE[:1])[0], depth)
    found = from_labels(truth, depth, CAMERA)
    assert np.degrees(np.arccos(np.clip(found.plane[:3] @ NORMAL, -1, 1))) < 1.0


@pytest.mark.parametrize("wall", [1.5, 3.0])
@pytest.mark.parametrize(("degrees", "edge"), [(7.0, 0.85), (9.0, 1.0), (9.0, 1.2)])
def test_a_low_camera_finds_what_stands_before_a_wall_that_fills_most_of_the_image(wall, degrees, edge):
    camera = Camera(640, 480, 554.3, 554.3, 319.5, 239.5)
    down = np.deg2rad(degrees)
    up = np.array([0.0, -np.cos(down), -np.sin(down)])
    away = np.array([0.0, -np.sin(down), np.cos(down)])
    bodies = [
        Superquadric(
            np.array(size),
            np.array([0.2, 0.8]),
            x * np.array([1.0, 0.0, 0.0]) + far * away + (size[2] - 0.13) * up,
            rotation.from_matrix(np.stack([[1.0, 0.0, 0.0], away, up], axis=1)),
        )
        for x, far, size in ((-0.1, 0.6, (0.03, 0.03, 0.05)), (0.06, 0.7, (0.04, 0.03, 0.08)))
    ]
    table = table_depth(camera, np.append(up, 0.13))
    rendered, index = raycast.render(Superquadric.stack(bodies), camera)
    room = np.minimum(np.where(table < edge, table, wall), rendered).astype(np.float32)
    depth = sensor_noise.preset("kinect_v1").measure(room, camera, np.random.default_rng(0))
    found = segment(depth, camera)
    assert found.plane is not None
    assert found.plane[:3] @ up > 0.99
    assert min(best_iou(index == k, found.labels) for k in range(2)) > 0.85


@pytest.mark.parametrize("pitch", [0.09, 0.12, 0.16])
def test_a_table_of_which_single_pixels_are_measured_holds_things_up(pitch):
    """As sensors see it at a grazing angle: whole where it is near, one pixel in ten farther away."""
    table = Table(pitch=pitch, distance=0.8)
    things = [table.body(-0.1, 0.0, (0.03, 0.03, 0.06)), table.body(0.08, 0.05, (0.04, 0.03, 0.04), (0.1, 1.0))]
    depth, truth = table.see(things, 1e-3)
    depth[(truth == 0) & (depth > 0.55) & (np.random.default_rng(0).random(depth.shape) > 0.1)] = np.nan
    found = segment(depth, VGA)
    assert found.plane is not None
    assert min(best_iou(truth == k, found.labels) for k in (1, 2)) > 0.85


def test_misuse_is_refused():
    depth, truth = scene(THREE)
    with pytest.raises(ValueError, match="does not fit"):
        from_labels(truth[:100], depth, CAMERA)
    box, nowhere = (-1.0, -1.0, -1.0, 1.0, 1.0, 1.0), (0.0, 0.0, 0.0, np.nan)
    for wrong in (
        {"depth_range": (2.0, 1.0)},
        {"max_objects": 0},
        {"max_objects": 2.5},
        {"max_objects": np.nan},
        {"max_size": 0.0},
        {"workspace": box, "workspace_pose": ((0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))},
        {"workspace": box, "workspace_pose": ((0.0, 0.0, 0.0, 1.0), nowhere[1:])},
        {"workspace": box, "workspace_pose": (nowhere[1:], nowhere)},
    ):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            SegmentationOptions(**wrong)


def test_separate_objects_on_recorded_tables(shared_data):
    """Human masks of the mOSD boxes, which stand apart: mean IoU above 0.95."""
    ious = []
    for path in sorted((shared_data / "mosd_learn").glob("*.npz")):
        with np.load(path) as archive:
            if str(archive["category"]) != "boxes":
                continue
        frame = read(path)
        found = segment(frame.depth, frame.camera)
        measured = np.isfinite(frame.depth)
        for label in np.unique(frame.labels[frame.labels > 0]):
            ious.append(best_iou((frame.labels == label) & measured, np.where(measured, found.labels, 0)))
    assert np.mean(ious) > 0.95


def test_another_support_is_sought_where_the_surroundings_show_one():
    """A body on a shelf 10 cm above the table, to the right of the image's middle, and one that the table alone is
    around."""
    shelf = PLANE - np.array([0, 0, 0, 0.1])
    bodies = [TABLE.body(-0.25, 0.0, (0.06, 0.04, 0.09), (0.2, 0.2)), TABLE.body(0.2, 0.0, (0.05, 0.05, 0.12))]
    depth, labels = scene(bodies)
    on_shelf = (np.arange(CAMERA.width) > CAMERA.width // 2) & ~(labels == 1)
    depth = np.where(on_shelf, np.fmin(depth, table_depth(plane=shelf)), depth).astype(np.float32)
    labels[(labels == 2) & (depth < table_depth(plane=shelf) - 1e-3)] = 3
    labels[labels == 2] = 0
    on_shelf, on_table = (around(labels, (k,), depth, np.isfinite(depth), CAMERA, PLANE) for k in (3, 1))
    np.testing.assert_allclose(on_shelf.equation, shelf, atol=2e-3)
    assert on_table is None


@pytest.mark.parametrize("seed", [14, 24])
def test_the_tops_of_two_cartons_are_no_support(seed: int) -> None:
    """A plane through both, or the lower one's top, is nearer to their sides than the floor is."""
    rng = np.random.default_rng(seed)
    table = Table(pitch=rng.uniform(0.8, 1.4), distance=rng.uniform(1.2, 1.6))
    cartons = []
    for x in (-0.3, 0.3):
        y, half = rng.uniform(-0.1, 0.1), (rng.uniform(0.12, 0.22), rng.uniform(0.12, 0.22), rng.uniform(0.08, 0.2))
        cartons.append(table.body(x, y, half, (0.05, 0.05), rng.uniform(-0.4, 0.4)))
    depth, truth = table.see(cartons, noise=1e-3, seed=seed)
    assert min(ious(truth, segment(depth, VGA).labels)) > 0.8


@pytest.mark.parametrize("seed", [7, 9, 14])
def test_the_diagonal_of_a_square_carton_is_no_edge(seed: int) -> None:
    """Half a metre wide, as much as an object may be; a square has no principal axes."""
    rng = np.random.default_rng(seed)
    table = Table(pitch=rng.uniform(0.6, 1.4), distance=rng.uniform(1.2, 1.6))
    half = rng.uniform(0.225, 0.27)
    size = (half, half, rng.uniform(0.1, 0.2))
    carton = table.body(0, 0.05, size, (0.05, 0.05), np.pi / 4 + rng.uniform(-0.2, 0.2))
    depth, truth = table.see([carton], noise=1e-3, seed=seed)
    assert min(ious(truth, segment(depth, VGA).labels)) > 0.8
