"""The chain of all stages: known bodies come back, whatever way they were seen; hard images get an answer too."""

import re
import subprocess
import sys
import threading
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from table_scenes import VGA, Table

from sq_perception.fitting.fit import Status
from sq_perception.geometry import rotation
from sq_perception.geometry.metrics import volume_iou
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import canonical_view, raycast, unit_cube
from sq_perception.imaging.camera import Camera
from sq_perception.learning import checkpoint
from sq_perception.learning.networks import Regressor, RegressorConfig
from sq_perception.recovery import own_segments, seen_object, supports
from sq_perception.recovery.recoverer import FrameRecovery, Recoverer, RecoveryOptions, render_recovery
from sq_perception.segmentation.evidence import FrameEvidence
from sq_perception.segmentation.support_plane import Plane
from sq_perception.simulation.scenes import TABLE_CAMERA, plane_depth, table_scene

CAMERA = Camera(320, 240, 270.0, 270.0, 159.5, 119.5)
STAGES = {"segmentation", "network", "fit", "score", "total"}


def seen(bodies, camera, background=np.nan):
    depth, index = raycast.render(Superquadric.stack(bodies), camera)
    return np.where(np.isfinite(depth), depth, background).astype(np.float32), (index + 1).astype(np.int32)


def random_bodies(count, seed, scale=0.1, depth=0.8):
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        size, shape, place = scale * rng.uniform(0.35, 1, 3), rng.uniform(0.1, 1, 2), rng.uniform(-0.05, 0.05, 2)
        found.append(Superquadric(size, shape, [*place, depth], rotation.random(1, rng)[0]))
    return found


def iou(a, b):
    return float(volume_iou(Superquadric.stack([a]), Superquadric.stack([b]))[0])


@pytest.fixture(scope="module")
def symmetry():
    return Recoverer(method="symmetry")


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """An untrained network: its predictions are bodies, and bad ones."""
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "random.safetensors"
    checkpoint.save(path, Regressor(RegressorConfig(widths=(8, 8, 8, 8), blocks=1, hidden=16)))
    return path


@pytest.mark.parametrize("seed", range(4))
def test_symmetry_recovers_thesis_images(symmetry, seed):
    truth = random_bodies(1, seed, scale=0.28, depth=0.5)[0]
    truth = Superquadric(truth.size, truth.shape, truth.translation + [0.5, 0.5, 0], truth.rotation)
    camera = unit_cube.camera()
    depth, _ = seen([truth], camera)
    depth = unit_cube.depth_from_grey(unit_cube.grey_from_depth(depth))
    found = symmetry.recover(depth, camera)
    assert len(found.bodies) == 1
    assert found.bodies[0].status != Status.FAILED
    assert iou(found.bodies[0].superquadric, truth) > 0.97
    assert found.bodies[0].score > 0.93
    covariance = found.bodies[0].covariance
    np.testing.assert_array_equal(np.sqrt(np.diag(covariance)[:3]), found.bodies[0].sigma_size)
    assert np.linalg.eigvalsh(covariance).min() > 0
    assert set(found.milliseconds) == STAGES
    assert found.plane is None


@pytest.mark.parametrize("seed", range(3))
def test_the_flat_front_of_an_occluder_is_no_support(symmetry, seed):
    """A wide box before the body is the largest plane of the image, and the body is behind it, not on it."""
    truth = random_bodies(1, seed, scale=0.1)[0]
    truth = Superquadric(truth.size, truth.shape, truth.translation + [0, 0, 0.1], truth.rotation)
    depth, labels = seen([truth], CAMERA, background=1.6)
    rows, _ = np.nonzero(labels)
    below = np.arange(CAMERA.height)[:, None] > np.quantile(rows, 0.75)
    depth = np.where(below, np.float32(np.nanmin(depth) - 0.05), depth)
    found = symmetry.recover(depth, CAMERA, np.where(below, 0, labels))
    assert found.bodies[0].status != Status.FAILED
    assert iou(found.bodies[0].superquadric, truth) > 0.85


def test_a_thing_on_the_lower_of_two_levels_reaches_below_the_higher_one(symmetry):
    """Most of what is seen of it is its top, which lies above the higher level, the support of the frame."""
    pitch, drop, half = np.deg2rad(60), 0.1, 0.055
    normal = -np.array([0.0, np.cos(pitch), np.sin(pitch)])
    away = np.array([0.0, -np.sin(pitch), np.cos(pitch)])
    turn = rotation.from_matrix(np.stack([[1.0, 0.0, 0.0], away, normal], axis=1))
    other = Superquadric([0.05, 0.04, half], [0.2, 0.2], np.array([-0.12, 0.0, 0.8]) + half * normal, turn)
    truth = Superquadric([0.05, 0.03, half], [0.2, 0.9], np.array([0.12, 0.0, 0.8]) + (half - drop) * normal, turn)
    depth, labels = seen([other, truth], CAMERA, background=np.inf)
    _, rays = CAMERA.rays(*np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height)))
    higher = -0.8 * np.sin(pitch) / (rays @ normal)
    levels = np.where(higher * rays[..., 0] < 0.0, higher, -(0.8 * np.sin(pitch) + drop) / (rays @ normal))
    labels[levels < depth] = 0
    found = symmetry.recover(np.minimum(depth, levels).astype(np.float32), CAMERA, labels)
    assert abs(found.plane[3] - 0.8 * np.sin(pitch)) < 0.01
    by_label = {body.label: body.superquadric for body in found.bodies}
    assert iou(by_label[1], other) > 0.9
    assert iou(by_label[2], truth) > 0.9


def test_a_plane_above_a_thing_loses_no_body(symmetry, monkeypatch):
    """As a cupboard's board above a pan: the fit refuses such a support, the user gets the body all the same."""
    truth = random_bodies(1, 3, scale=0.1)[0]
    depth, labels = seen([truth], CAMERA, background=1.6)
    above = np.array([0.0, -1.0, 0.0, truth.translation[1] - 0.3])
    monkeypatch.setattr(supports, "support", lambda *_: above)
    (found,) = symmetry.recover(depth, CAMERA, labels).bodies
    assert found.status != Status.FAILED
    assert iou(found.superquadric, truth) > 0.85
    assert "plane found lies above it" in found.message


def test_a_frame_with_masks_keeps_their_values_and_order(symmetry):
    left, right = random_bodies(2, 7, scale=0.07)
    left = Superquadric(left.size, left.shape, [-0.15, 0, 0.8], left.rotation)
    right = Superquadric(0.7 * right.size, right.shape, [0.15, 0, 0.8], right.rotation)
    depth, labels = seen([left, right], CAMERA, background=1.4)
    labels = np.array([0, 90, 12])[labels].astype(np.uint8)
    found = symmetry.recover(depth, CAMERA, labels)
    by_label = {body.label: body for body in found.bodies}
    assert set(by_label) == {12, 90}
    pixels = [body.pixels for body in found.bodies]
    assert pixels == sorted(pixels, reverse=True)
    assert by_label[12].pixels == np.sum(labels == 12)
    assert iou(by_label[90].superquadric, left) > 0.9
    assert iou(by_label[12].superquadric, right) > 0.9
    np.testing.assert_array_equal(found.labels, labels)


def test_the_rendering_of_a_recovery_is_the_image(symmetry):
    depth, labels = seen(random_bodies(1, 3), CAMERA, background=1.4)
    rendered, index = render_recovery(symmetry.recover(depth, CAMERA, labels), CAMERA)
    assert np.mean((index >= 0) == (labels > 0)) > 0.995
    assert np.median(np.abs(rendered - depth)[(index >= 0) & (labels > 0)]) < 0.002
    assert set(np.unique(index)) == {-1, 0}


def test_failed_bodies_are_listed_and_not_rendered(symmetry):
    depth = np.full((240, 320), 1.0, np.float32)
    labels = np.zeros(depth.shape, np.int32)
    labels[100, 100:140] = 1
    labels[200, 50:61], labels[50:55, 50:52], labels[50, 80] = 2, 3, 4
    found = symmetry.recover(depth, CAMERA, labels)
    for k, (body, words) in enumerate(zip(found.bodies, ("line", "11 pixels", "10 pixels", "1 pixels"), strict=True)):
        assert (body.label, body.status, body.score) == (k + 1, Status.FAILED, 0)
        assert words in body.message
        assert (body.superquadric.size > 0).all()
        np.testing.assert_array_equal(body.superquadric.to_flat(), body.superquadric.canonical_form().to_flat())
    assert found.recovered == ()
    assert (render_recovery(found, CAMERA)[1] == -1).all()


@pytest.mark.parametrize("method", ["symmetry", "classic"])
def test_a_mask_of_which_next_to_nothing_was_measured_shows_no_body(method):
    """A thing too near for the sensor, whose outline alone has readings, halfway to what is behind."""
    depth, labels = seen(random_bodies(1, 2), CAMERA, background=1.2)
    rows, columns = np.nonzero(labels)
    some = slice(0, len(rows), 60)
    near = depth[rows[some], columns[some]]
    depth[labels > 0] = np.nan
    depth[rows[some], columns[some]] = (near + 1.2) / 2
    body = Recoverer(method=method).recover(depth, CAMERA, labels).bodies[0]
    assert body.status == Status.FAILED
    assert f"{len(near)} of " in body.message


@pytest.mark.parametrize("method", ["symmetry", "classic"])
@pytest.mark.parametrize(
    ("image", "why"),
    [
        (np.full((48, 64), np.nan), "no depth"),
        (np.zeros((48, 64)), "no depth"),
        (np.full((48, 64), -1.0), "no depth"),
        (np.full((48, 64), np.inf), "no depth"),
        (np.full((48, 64), 1.0), "stands on"),
    ],
)
def test_images_without_objects_say_why(method, image, why):
    found = Recoverer(method=method).recover(image, Camera(64, 48, 60.0, 60.0, 32, 24))
    assert found.bodies == ()
    assert why in found.message
    assert found.labels.shape == (48, 64)


@pytest.mark.parametrize("masked", [False, True])
def test_depths_in_millimetres_are_said(symmetry, masked):
    depth, labels = seen([random_bodies(1, 3, scale=0.1)[0]], CAMERA)
    for scale, is_said in ((1, False), (1000, True)):
        found = symmetry.recover((scale * depth).astype(np.float32), CAMERA, labels if masked else None)
        assert ("for millimetres" in found.message) == is_said


def test_masks_without_an_object_and_masked_labels_are_none_and_ones_of_another_size_are_refused(symmetry):
    camera, depth = Camera(64, 48, 60.0, 60.0, 32, 24), np.ones((48, 64), np.float32)
    assert symmetry.recover(depth, camera, np.zeros((48, 64), int)).message == "the masks hold no object"
    with pytest.raises(ValueError, match=r"labels: expected the shape of the depth, \(48, 64\), got \(24, 32\)"):
        symmetry.recover(depth, camera, np.zeros((24, 32), int))
    depth, labels = seen(random_bodies(2, 3), CAMERA, background=1.4)
    found = symmetry.recover(depth, CAMERA, np.ma.masked_array(labels, labels == 2))
    assert [body.label for body in found.bodies] == [1]


@pytest.mark.parametrize("most", [1, 2, 3])
def test_a_frame_with_more_objects_says_so(symmetry, most):
    labels = np.zeros((48, 64), int)
    labels[10:30, 10:20] = 1
    labels[10:20, 30:40] = 2
    camera = Camera(64, 48, 60.0, 60.0, 32, 24)
    options = RecoveryOptions(method="symmetry", max_objects=most)
    found = symmetry.recover(np.ones((48, 64), np.float32), camera, labels, options)
    assert [body.label for body in found.bodies] == [1, 2][:most]
    assert ("max_objects = 1" in found.message) == (most == 1)
    assert bool(found.message) == (most == 1)


def test_parting_segments_makes_no_more_objects_than_are_wanted(monkeypatch):
    labels = np.zeros((48, 64), np.int32)
    for k in range(3):
        labels[10:30, 10 + 15 * k : 20 + 15 * k] = k + 1
    parted = FrameEvidence(labels, (1, 2, 3))
    monkeypatch.setattr(own_segments.SegmentNetwork, "improve", lambda *_: parted)
    camera = Camera(64, 48, 60.0, 60.0, 32, 24)
    found = Recoverer().recover(np.ones((48, 64), np.float32), camera, options=RecoveryOptions(max_objects=2))
    assert [body.label for body in found.bodies] == [1, 2]
    assert set(np.unique(found.labels)) == {0, 1, 2}
    assert "max_objects = 2" in found.message


def test_segments_of_nothing_take_no_place_of_objects(monkeypatch):
    """The network drops the larger of two boxes: the one object that is wanted is the other."""
    table = Table()
    depth, truth = table.see([table.body(-0.1, 0, (0.06, 0.06, 0.05)), table.body(0.12, 0, (0.03, 0.03, 0.03))])

    def without_the_largest(_, found):
        return found.keep(dict.fromkeys(found.ids[1:], 1.0))

    monkeypatch.setattr(own_segments.SegmentNetwork, "improve", without_the_largest)
    found = Recoverer().recover(depth, VGA, options=RecoveryOptions(max_objects=1))
    assert [body.label for body in found.bodies] == [1]
    assert np.mean(truth[found.labels == 1] == 2) > 0.95


@pytest.mark.parametrize("form", ["half precision", "masked"])
def test_the_same_readings_in_another_form_give_the_same_body(symmetry, form):
    """Of half precision not even with a warning: the farthest reading is no number of it."""
    depth, labels = seen(random_bodies(1, 3), CAMERA, background=1.4)
    half, wrong = depth.astype(np.float16), np.indices(depth.shape)[0] % 3 == 0
    images = {
        "half precision": (half, half.astype(np.float32)),
        "masked": (np.ma.masked_array(np.where(wrong, 0.5 * depth, depth), wrong), np.where(wrong, np.nan, depth)),
    }[form]
    found, known = (symmetry.recover(image, CAMERA, labels).bodies[0].superquadric for image in images)
    np.testing.assert_array_equal(found.to_flat(), known.to_flat())


@pytest.mark.parametrize("method", ["symmetry", "classic", "auto", "network"])
@pytest.mark.parametrize("projection", ["pinhole", "orthographic"])
def test_no_depth_value_raises(method, projection, weights):
    rng = np.random.default_rng(4)
    recoverer = Recoverer(weights, method=method)
    for shape in ((1, 1), (2, 9), (24, 32)):
        camera = Camera(shape[1], shape[0], 30.0, 30.0, shape[1] / 2, shape[0] / 2, projection)
        bits = np.frombuffer(rng.bytes(4096), np.float32)  # readings from 1e-45 to 3e38 m, whose squares are no numbers
        for palette in ([np.nan, 1.0], [1.0], [np.nan, np.inf, 0, -1, 1e-9, 0.5, 1e9], bits):
            depth = rng.choice(palette, size=shape)
            for labels in (None, np.ones(shape, np.uint8), rng.integers(0, 5, shape)):
                found = recoverer.recover(depth, camera, labels)
                assert isinstance(found, FrameRecovery)
                for body in found.bodies:
                    assert np.isfinite(body.superquadric.to_flat()).all()
                    assert 0 <= body.score <= 1


def test_images_whose_columns_lie_in_a_row_are_put_in_order_before_kernels_see_them(symmetry):
    """Kernels are compiled for arrays of a kind; for another one the first frame would wait for a compiler."""
    depth, labels = table_scene(np.random.default_rng(3), 1, CAMERA).render()
    usual, turned = symmetry.recover(depth, CAMERA), symmetry.recover(np.asfortranarray(depth), CAMERA)
    assert symmetry.read(np.asfortranarray(depth), CAMERA).depth.flags.c_contiguous
    np.testing.assert_array_equal(usual.labels, turned.labels)
    assert symmetry.recover(depth, CAMERA, np.asfortranarray(labels)).labels.flags.c_contiguous


def test_what_is_out_of_range_of_an_object_is_not_measured(symmetry):
    """Its near edge is cut off by the range: as if the sensor had lost it, and no free space before the rest."""
    depth, labels = table_scene(np.random.default_rng(3), 1, CAMERA).render()
    depth = depth.astype(np.float32)
    cut = float(np.quantile(depth[labels > 0], 0.3))
    lost = np.where((labels > 0) & (depth < cut), np.float32(np.nan), depth)
    cropped = symmetry.recover(depth, CAMERA, labels, RecoveryOptions(method="symmetry", depth_range=(cut, 9.0)))
    without = symmetry.recover(lost, CAMERA, labels, RecoveryOptions(method="symmetry", depth_range=(cut, 9.0)))
    np.testing.assert_array_equal(cropped.bodies[0].superquadric.to_flat(), without.bodies[0].superquadric.to_flat())


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("pixels", [0, 2, 3])
def test_what_goes_on_all_around_a_mask_that_is_too_small_is_the_object(symmetry, pixels, seed):
    """It is no free space beside it; of a right mask nothing is added."""
    scene = table_scene(np.random.default_rng(seed), 1, CAMERA)
    depth, labels = scene.render()
    small = cv2.erode((labels > 0).astype(np.uint8), np.ones((2 * pixels + 1,) * 2, np.uint8)).astype(np.int32)
    assert small.sum() > 200
    found = symmetry.recover(depth.astype(np.float32), CAMERA, small)
    assert iou(found.bodies[0].superquadric, scene.bodies[0]) > 0.95
    (obj,) = seen_object.objects(depth, FrameEvidence(small, (1,), Plane(scene.plane, 1.0, 1e-3)), CAMERA)
    whole = seen_object.complete(replace(obj, plane=scene.plane), depth, CAMERA, small)
    assert not (whole.mask & (labels == 0)).any()
    assert (whole.mask & ~obj.mask).any() == (pixels > 0)


@pytest.mark.parametrize("share", [0.6, 0.75])
def test_a_mask_tells_of_a_thing_where_nothing_was_measured(share):
    """A can whose upper part shines: masks from colour show it, those from depth do not."""
    down = np.deg2rad(35)
    table = np.array([[1, 0, 0], [0, -np.sin(down), -np.cos(down)], [0, np.cos(down), -np.sin(down)]])
    can = Superquadric([0.04, 0.04, 0.11], [0.1, 1.0], [0.0, 0.0, 0.8], rotation.from_matrix(table))
    normal = table[:, 2]
    plane = np.append(normal, -normal @ (can.translation - 0.11 * normal))
    depth, index = raycast.render(can, TABLE_CAMERA)
    depth = np.fmin(depth, plane_depth(plane, TABLE_CAMERA))
    depth = np.where(np.isfinite(depth), depth, np.nan) + np.random.default_rng(0).normal(0, 0.001, depth.shape)
    mask = index == 0
    rows = np.flatnonzero(mask.any(axis=1))
    depth[: rows[0] + int(share * len(rows))][mask[: rows[0] + int(share * len(rows))]] = np.nan
    of_colour, of_depth = (
        Recoverer(threads=1).recover(depth, TABLE_CAMERA, labels.astype(np.int32)).bodies[0].superquadric
        for labels in (mask, mask & np.isfinite(depth))
    )
    assert of_colour.size.max() == pytest.approx(0.11, rel=0.15)
    assert of_depth.size.max() < 0.08


def test_a_network_that_predicts_bodies_is_asked_where_symmetry_leaves_more_than_noise(weights, monkeypatch):
    """Of a clean image nothing is predicted; of one that no superquadric explains the bodies of all objects, once."""
    camera = unit_cube.camera()
    recoverer, asked = Recoverer(weights), []
    network = recoverer._load_network(False)
    predict = network.predict
    monkeypatch.setattr(type(network), "predict", lambda _, views: asked.append(len(views)) or predict(views))
    bodies = [Superquadric([0.12, 0.1, 0.09], [0.4, 0.7], [x, 0.5, 0.5], [0.3, 0.2, 0.1, 0.9]) for x in (0.27, 0.73)]
    depth, labels = seen(bodies, camera)
    depth = unit_cube.depth_from_grey(unit_cube.grey_from_depth(depth))
    assert all(body.status == Status.CONVERGED for body in recoverer.recover(depth, camera, labels).bodies)
    assert asked == []
    folded = depth + np.where(np.arange(256) % 16 < 8, np.float32(0.03), np.float32(0))
    recoverer.recover(folded, camera, labels)
    assert asked == [2]


def test_methods_do_what_they_say(weights):
    truth = random_bodies(1, 11)
    depth, labels = seen(truth, CAMERA, background=1.4)
    recoverer = Recoverer(weights)

    def run(**changes):
        return recoverer.recover(depth, CAMERA, labels, RecoveryOptions(**changes)).bodies[0]

    network = run(method="network")
    assert np.isnan(network.sigma_size).all()
    view = canonical_view.from_mask(depth, labels == 1, CAMERA)
    predicted = view.from_canonical(recoverer._load_network(False).predict(view.image[None])[0])
    assert iou(network.superquadric, predicted) > 0.99
    assert iou(run(method="auto").superquadric, truth[0]) > 0.9, "whatever the network says"
    assert iou(run(method="symmetry").superquadric, truth[0]) > 0.9
    assert run(method="classic").status != Status.FAILED


def test_s_and_tau_drive_the_score(symmetry):
    depth, labels = seen(random_bodies(1, 5), CAMERA, background=1.4)
    scores = [
        symmetry.recover(depth, CAMERA, labels, RecoveryOptions(method="symmetry", sharpness=s, tau=tau))
        .bodies[0]
        .score
        for s, tau in ((117.3, 4.82), (2.0, 4.82), (117.3, 0.05))
    ]
    assert scores[0] > scores[1] + 0.01
    assert scores[0] > scores[2] + 0.05


@pytest.mark.parametrize(("left", "right", "vouched"), [(0, 320, True), (60, 320, True), (60, 260, False)])
def test_what_runs_out_of_the_image_on_opposite_sides_has_half_a_score(symmetry, left, right, vouched):
    """A bar of which the image shows both ends, one or none."""
    bar = Superquadric([0.35, 0.05, 0.05], [0.2, 0.2], [0, 0, 0.8], [0.3, 0, 0, 1])
    depth, labels = seen([bar], CAMERA)
    window, camera = (slice(None), slice(left, right)), CAMERA.cropped(left, 0, right - left, CAMERA.height)
    (body,) = symmetry.recover(depth[window], camera, labels[window]).bodies
    assert body.status != Status.FAILED
    assert (body.score > 0.5) == vouched


@pytest.mark.parametrize("dark", [0, 16])
def test_what_fills_all_readings_is_a_surface_though_a_band_around_them_has_none(symmetry, dark):
    """A barrel of 60 cm before the camera, as in a rectified image: its ends were not there to agree with."""
    turn = rotation.from_rotation_vector(np.array([np.pi / 2, 0.0, 0.0]))
    barrel = Superquadric(np.array([0.3, 0.3, 1.0]), np.array([0.1, 1.0]), np.array([0.0, 0.0, 0.85]), turn)
    camera = Camera(320, 240, 350.0, 350.0, 159.5, 119.5)
    depth, _ = seen([barrel], camera)
    depth = depth + np.random.default_rng(1).normal(0, 0.001, depth.shape).astype(np.float32)
    depth = np.pad(depth, dark, constant_values=np.nan)
    camera = camera.cropped(-dark, -dark, *depth.shape[::-1])
    assert symmetry.recover(depth, camera).bodies == ()
    (body,) = symmetry.recover(depth, camera, np.isfinite(depth).astype(np.int32)).bodies
    assert body.score < 0.5


def test_missing_and_foreign_weights(tmp_path):
    with pytest.raises(checkpoint.CheckpointError, match="no such model file"):
        Recoverer(tmp_path / "missing.safetensors")
    (tmp_path / "text.safetensors").write_text("not weights")
    with pytest.raises(checkpoint.CheckpointError, match="readable"):
        Recoverer(tmp_path / "text.safetensors", method="network")
    without = Recoverer(tmp_path / "missing.safetensors", method="symmetry")
    depth, labels = seen(random_bodies(1, 1), CAMERA)
    assert without.recover(depth, CAMERA, labels).bodies
    with pytest.raises(checkpoint.CheckpointError):
        without.recover(depth, CAMERA, labels, RecoveryOptions(method="network"))


def test_misuse_is_refused(symmetry):
    image = "depth: expected a float image (height, width) in metres, got"
    for depth, labels, words in (
        (np.ones((10, 10)), None, "does not fit"),
        *((wrong, None, image) for wrong in (np.ones((240, 320), np.uint16), np.ones((240, 320, 1)), np.ones(320))),
        (np.array(1.0), None, image),
        (np.ones((240, 320)), np.ones((240, 320)), "integer"),
    ):
        with pytest.raises(ValueError, match=re.escape(words)):
            symmetry.recover(depth, CAMERA, labels)
    with pytest.raises(ValueError, match="method"):
        Recoverer(method="magic")
    with pytest.raises(ValueError, match="device: expected cpu, cuda or cuda:N, got"):
        Recoverer(method="symmetry", device="abacus")
    with pytest.raises(TypeError, match="model: expected a file of weights or its name, got RecoveryOptions"):
        Recoverer(RecoveryOptions())
    for name, value in (("sharpness", 0.0), ("sharpness", np.nan), ("tau", -1.0), ("time_budget", 0.0)):
        with pytest.raises(ValueError, match=name):
            RecoveryOptions(**{name: value})


def test_recorded_carton_and_milk(shared_data, symmetry):
    """What they measure, roughly: the carton's face is 40 cm wide and 31 cm high or more."""
    from sq_perception.recordings.frame_file import read

    frame = read(shared_data / "frames" / "felix_0.npz")
    found = symmetry.recover(frame.depth, frame.camera, frame.labels)
    size = np.sort(found.bodies[0].superquadric.size)[::-1]
    assert 0.18 < size[0] < 0.23
    assert 0.14 < size[1] < 0.19
    assert found.bodies[0].residual < 0.005
    frame = read(shared_data / "frames" / "pcl_milk.npz")
    found = symmetry.recover(frame.depth, frame.camera, frame.labels)
    assert sorted(body.label for body in found.recovered) == [1, 2, 3]


def test_frames_are_fitted_by_threads_that_stay():
    """Threads for each frame cost kilobytes that never come back: 75 MB in half an hour at 12 frames a second."""
    scene = table_scene(np.random.default_rng(3), 3, camera=Camera(160, 120, 140.0, 140.0, 79.5, 59.5))
    depth, labels = scene.render()

    def alive() -> set[int | None]:
        return {thread.native_id for thread in threading.enumerate()}

    others = alive()
    recoverer = Recoverer(method="symmetry", threads=2)
    own: set[int | None] = set()
    for _ in range(4):
        assert len(recoverer.recover(depth, scene.camera, labels).bodies) == 3
        own |= alive() - others
    assert 1 <= len(own) <= 3, "two that fit, and one for the network"


def test_a_forked_process_has_threads_of_its_own():
    """Those of its parent stay there, and who waits for one of them waits for ever."""
    code = (
        "import os, signal, numpy as np\n"
        "from sq_perception.imaging.camera import Camera\n"
        "from sq_perception.recovery.recoverer import Recoverer\n"
        "recoverer, camera = Recoverer(method='symmetry', threads=2), Camera(64, 48, 60.0, 60.0, 31.5, 23.5)\n"
        "labels = np.zeros((48, 64), int)\n"
        "labels[10:20, 10:20], labels[10:20, 30:40] = 1, 2\n"
        "found = lambda: len(recoverer.recover(np.ones((48, 64), np.float32), camera, labels).bodies)\n"
        "assert found() == 2\n"
        "if child := os.fork():\n"
        "    raise SystemExit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))\n"
        "signal.alarm(20)\n"
        "os._exit(found() != 2)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)
