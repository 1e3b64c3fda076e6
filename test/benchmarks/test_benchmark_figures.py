"""What benchmarks measure with: errors, hulls, segments, figures of a scene, cameras, and what they change and undo."""

from pathlib import Path

import ablation
import cv2
import fit_parts
import household_things
import numpy as np
import public_frames
import pytest
import render_search
import torch
import tracking
import two_cameras
from camera_bias import far_side
from common import hull_columns, tabletop
from common.package_constants import constants, varied
from python_process import run_python
from render_search import search
from scipy.spatial import ConvexHull
from segmentation import score
from unit_axis import soft_images

from sq_perception import Fit, FrameRecovery, RecordedFrame, Recoverer, Recovery, Status, Superquadric
from sq_perception.fitting.priors import HullPrior
from sq_perception.geometry import metrics, rotation
from sq_perception.geometry.mesh import mesh
from sq_perception.geometry.union import DIRECTIONS
from sq_perception.imaging import raycast, soft_render, unit_cube
from sq_perception.segmentation.options import SegmentationOptions
from sq_perception.simulation.scenes import thesis_bodies
from sq_perception.simulation.things_on_table import TABLE_CAMERA, things_on_table
from sq_perception.tracking.association import TURNS

BODY = Superquadric([0.06, 0.04, 0.03], [0.3, 0.7], [0.05, -0.03, 0.7], [0.3, -0.2, 0.5, 0.8])


def test_an_error_does_not_depend_on_the_names_of_axes():
    for turn in TURNS:
        named = rotation.multiply(BODY.rotation, rotation.from_matrix(turn))
        size = np.abs(turn).T @ (BODY.size * [1.1, 1.0, 0.9])
        error, order = tracking.size_errors(Superquadric(size, BODY.shape, BODY.translation, named), BODY)
        np.testing.assert_allclose(error, [0.1, 0.0, -0.1], atol=1e-12)
        np.testing.assert_allclose(size[order], BODY.size * [1.1, 1.0, 0.9])


def test_a_body_has_the_segment_that_overlaps_it_most():
    truth, found = np.zeros((10, 40), np.int32), np.zeros((10, 40), np.int32)
    truth[:, :20], truth[:, 20:30] = 1, 2
    found[:, :13], found[:, 13:20], found[:, 20:29] = 3, 2, 1
    fit = Fit(BODY, 0.0, Status.CONVERGED, "")
    bodies = tuple(Recovery(fit, 1.0, label, 10) for label in (3, 1, 2))
    owner, cut = tracking.owners(truth, FrameRecovery(bodies, {}, found, None, ""))
    assert owner == {0: 0, 1: 1}
    assert cut == {0}


def test_the_camera_goes_about_a_table_that_rests():
    (shown,) = tracking.scenes(1, 1)
    for angle in (30.0, 90.0):
        here, (turn, position) = tracking.moved(shown, angle)
        back = here.bodies.transformed(turn, position)
        np.testing.assert_allclose(back.translation, shown.bodies.translation, atol=1e-12)
        height = here.bodies.translation @ here.plane[:3] + here.plane[3]
        np.testing.assert_allclose(height, shown.bodies.translation @ shown.plane[:3] + shown.plane[3], atol=1e-12)
        assert here.plane[2] < 0


def test_the_things_rest_where_they_are():
    truth = things_on_table(np.random.default_rng([1, 2]), 3)
    there, (turn, position) = two_cameras.from_aside(truth, 60.0)
    for one, other in zip(truth.placed, there.placed, strict=True):
        back = other.parts.transformed(turn, position)
        np.testing.assert_allclose(back.translation, one.parts.translation, atol=1e-12)
        height = other.parts.translation @ there.plane[:3] + there.plane[3]
        np.testing.assert_allclose(height, one.parts.translation @ truth.plane[:3] + truth.plane[3], atol=1e-12)
    again, _ = two_cameras.from_aside(truth, 0.0)
    np.testing.assert_allclose(again.depth, truth.depth)
    np.testing.assert_array_equal(again.labels, truth.labels)
    assert np.isfinite(there.depth[there.labels > 0]).all()


def test_iou_with_a_hull_is_the_iou_of_the_bodies(rng: np.random.Generator) -> None:
    columns = hull_columns.Columns.of(mesh(BODY, 128).vertices)
    assert columns.volume == pytest.approx(float(BODY.volume()), rel=2e-3)
    assert columns.iou(BODY) > 0.995
    for _ in range(5):
        turn, shift = rotation.from_rotation_vector(rng.normal(0, 0.2, 3)), rng.normal(0, 0.01, 3)
        moved = BODY.transformed(turn, BODY.translation - rotation.to_matrix(turn) @ BODY.translation + shift)
        assert columns.iou(moved) == pytest.approx(float(metrics.volume_iou(moved, BODY, 128)), abs=3e-3)


def test_hull_points_span_the_hull() -> None:
    scene = things_on_table(np.random.default_rng(3), 4)
    assert scene.camera == TABLE_CAMERA
    for placed in scene.placed:
        points = household_things.hull_points(placed.thing.parts)
        reach = placed.thing.support(DIRECTIONS)
        spanned = (points[ConvexHull(points).vertices] @ DIRECTIONS.T).max(axis=0)
        assert (spanned <= reach + 1e-9).all()
        assert (reach - spanned).max() < 0.02 * np.linalg.norm(placed.thing.box[1] - placed.thing.box[0])


def test_a_thing_shows_no_more_than_it_would_alone() -> None:
    shares = [placed.visible_share for placed in household_things.scene(0, None, 5).placed]
    assert len(shares) == 5
    assert 0 <= min(shares) < 1
    assert max(shares) <= 1


TRUTH = np.repeat([[0, 1, 1, 1, 1, 2, 2, 2, 2, 0]], 10, axis=0)


CUT = TRUTH.copy()
CUT[:4][TRUTH[:4] == 1] = 3


@pytest.mark.parametrize(
    ("found", "ious", "counts"),
    [
        (np.choose(TRUTH, [0, 2, 1]), (1.0, 1.0), (2, 2, 0, 0)),
        ((TRUTH > 0).astype(int), (0.5, 0.0), (1, 1, 0, 1)),
        (CUT, (0.6, 1.0), (3, 2, 1, 0)),
        (np.zeros_like(TRUTH), (0.0, 0.0), (0, 0, 0, 0)),
    ],
    ids=["in another order", "joined", "cut", "nothing found"],
)
def test_segments_are_compared_with_the_truth(found, ious, counts):
    result = score(TRUTH, found)
    assert sorted(result.ious) == pytest.approx(sorted(ious))
    assert (result.objects, result.segments, result.hits, result.cut, result.joined) == (2, *counts)
    assert score(np.zeros_like(TRUTH), TRUTH).segments == 2


def test_a_far_side_errs_by_what_was_added(rng: np.random.Generator) -> None:
    corners = rng.uniform(-0.05, 0.05, (8, 3)) + [0.0, 0.0, 0.8]
    middle = corners.mean(axis=0)
    directions = np.vstack([DIRECTIONS, middle / np.linalg.norm(middle)])
    support = (corners @ directions.T).max(axis=0)
    support[-1] += 0.007
    hull = HullPrior(directions, support, np.eye(len(directions)), 0.1)
    assert far_side(hull, corners) == pytest.approx(0.007)


def test_a_scene_has_the_figures_of_its_truth() -> None:
    scene = tabletop.scene(3)
    objects = []
    for each in scene.placed:
        thing = {"name": each.thing.name, "kind": each.thing.kind, "hull": each.thing.hull.tolist()}
        pose = np.block([[each.rotation, each.translation[:, None]], [np.zeros(3), 1.0]]).tolist()
        objects.append({**thing, "label": each.label, "size": each.thing.edges.tolist(), "pose": pose})
    frame = RecordedFrame(scene.depth, scene.camera, scene.labels, "scene")
    found, bodies = public_frames.answers("scene", {"sensor": "simulated", "objects": objects}, frame, Recoverer())
    figures = public_frames.summary(found)
    assert bodies >= figures["found"] >= len(objects) - 1  # three quarters of one are hidden
    assert figures["posed"] == len(objects)
    assert figures["iou"] > 85
    assert figures["edges median"] < 4
    assert figures["far side"] < 6
    assert figures["beyond 3"] < 5


@pytest.mark.parametrize("row", ablation.ROWS, ids=lambda row: row.name)
def test_what_a_row_changes_in_the_program_exists(row: ablation.Row) -> None:
    with row.program():
        pass


@pytest.mark.parametrize("part", fit_parts.PARTS)
def test_a_part_that_is_left_out_of_the_fit_exists(part: str) -> None:
    with fit_parts.PARTS[part]():
        pass


def test_defaults_of_options_get_other_values_and_their_own_ones_back() -> None:
    before = SegmentationOptions()
    defaults = [constant for constant in constants("segmentation") if constant.field]
    assert {constant.field for constant in defaults} == {"max_objects", "max_size"}
    for constant in defaults:
        value = constant.value
        constant.set(varied(value, 0.7))
        assert getattr(SegmentationOptions(), constant.field) < value
        constant.set(value)
    assert SegmentationOptions() == before


IMPORT = """
import os, sys
before = dict(os.environ)
sys.path.insert(0, sys.argv[1])
for module in sys.argv[2:]:
    __import__(module)
    changed = {name: value for name, value in os.environ.items() if before.get(name) != value and "THREADS" in name}
    if changed:
        sys.exit(f"{changed} set by the import of {module}")
"""
READ = "constants", "frame_time", "real_scenes", "segmentation", "single_body", "speed", "tracking"


def test_an_import_leaves_the_number_of_threads_alone(repository: Path) -> None:
    # Numba refuses to compile once its threads run and NUMBA_NUM_THREADS names another number.
    run_python("-c", IMPORT, repository / "benchmarks", *READ)


@pytest.mark.parametrize("name", ["hostile", "kills", "soak"])
def test_helpers_of_the_tests_are_found(name: str, repository: Path) -> None:
    pytest.importorskip("rclpy", reason="needs the extra 'ros'")
    run_python(repository / "benchmarks" / f"{name}.py", "--help")


def test_error_is_that_of_the_two_renderers() -> None:
    bodies = thesis_bodies(2, np.random.default_rng(0))
    found = search(bodies, np.array([20.0, 117.3]), np.array([0.5, 4.82]), 32)
    tensors = Superquadric.from_flat(torch.tensor(bodies.to_flat()))
    soft = soft_images(tensors, soft_render.grid_points(32), 117.3, 0.5).numpy()
    error = 0.0
    for body, image in zip(bodies, soft, strict=True):
        depth, _ = raycast.render(unit_cube.optical_from_cube(body), unit_cube.camera(32))
        error += np.abs(unit_cube.grey_from_depth(depth) / 255 - image).mean() / 2
    assert found.error[1, 0] == pytest.approx(error, rel=1e-4)
    assert found.best == (117.3, 4.82, found.error.min())


def test_the_script_prints_the_optimum_and_draws_the_map(capsys, tmp_path, monkeypatch) -> None:
    picture = tmp_path / "map.png"
    arguments = ["--bodies", "2", "--resolution", "16", "--steps", "4", "--picture", str(picture)]
    monkeypatch.setattr("sys.argv", ["render_search.py", *arguments])
    render_search.main()
    assert "least MAE" in capsys.readouterr().out
    assert cv2.imread(str(picture)) is not None
