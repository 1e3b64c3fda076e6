"""Segments split by their bodies: two where two describe the image more briefly, and one otherwise."""

from __future__ import annotations

import numpy as np
import pytest

from sq_perception.fitting import surface_fit
from sq_perception.geometry import rotation
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera
from sq_perception.recovery import scene_description, segment_split
from sq_perception.recovery.recoverer import Recoverer, RecoveryOptions
from sq_perception.recovery.scene_description import Evidence, price, unexplained
from sq_perception.segmentation import segments
from sq_perception.segmentation.segments import Segmentation
from sq_perception.simulation.scenes import plane_depth

CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
NOISE = 0.001
BOX, BALL = (0.1, 0.1), (1.0, 1.0)

PITCH, DISTANCE = 0.75, 0.7
PLANE = np.append(-np.array([0.0, np.cos(PITCH), np.sin(PITCH)]), DISTANCE * np.sin(PITCH))
ACROSS = np.array([-1.0, 0.0, 0.0])
AXES = np.stack([ACROSS, np.cross(PLANE[:3], ACROSS), PLANE[:3]], axis=1)


def standing(x, y, size, shape=BOX, turn=0.0):
    """A body on the table, ``y`` metres behind the point that the camera looks at."""
    centre = np.array([0, 0, DISTANCE]) + AXES @ np.array([x, y, size[2]])
    about = rotation.from_rotation_vector(np.array([0.0, 0.0, turn]))
    return Superquadric(np.array(size), np.array(shape), centre, rotation.multiply(rotation.from_matrix(AXES), about))


def seen(bodies, noise=NOISE, seed=0):
    """Depth float32 with noise that grows as z^2, and the visible body of each pixel from 1."""
    depth, index = raycast.render(Superquadric.stack(bodies), CAMERA)
    depth = np.where(index >= 0, depth, plane_depth(PLANE, CAMERA))
    depth = depth + noise * depth**2 * np.random.default_rng(seed).standard_normal(depth.shape)
    return np.where(np.isfinite(depth), depth, np.nan).astype(np.float32), (index + 1).astype(np.int32)


def fit_of(depth):
    def fit(mask):
        fit.calls += 1
        return surface_fit.fit(depth, mask, CAMERA, options=surface_fit.FitOptions(plane=PLANE))

    fit.calls = 0
    return fit


def parted(depth, labels, are_one=None):
    """Labels with their fits after splitting, and how many fits it took."""
    fit = fit_of(depth)
    fits = {int(k): fit(labels == k) for k in np.unique(labels[labels > 0])}
    fit.calls = 0
    result = segment_split.split(depth, CAMERA, labels, PLANE, fits, fit, NOISE, are_one=are_one)
    assert set(result.fits) == set(np.unique(result.labels)) - {0}
    assert ((result.labels > 0) == (labels > 0)).all()
    return result, fit.calls


def cut(labels, label, across):
    """A label cut in two at a column."""
    columns = np.arange(labels.shape[1])[None, :]
    return np.where((labels == label) & (columns > across), labels.max() + 1, labels).astype(np.int32)


def overlap(labels, truth):
    """IoU of each true segment with the one that fits it best."""
    found = [labels == k for k in np.unique(labels[labels > 0])]
    return [
        max(np.sum(one & (truth == k)) / np.sum(one | (truth == k)) for one in found) for k in range(1, truth.max() + 1)
    ]


LONG_BOX = (0.09, 0.04, 0.035)


def test_two_boxes_under_one_label_become_two():
    bodies = [standing(-0.055, 0, (0.05, 0.04, 0.03)), standing(0.035, 0.01, (0.04, 0.03, 0.06))]
    depth, truth = seen(bodies)
    result, _ = parted(depth, (truth > 0).astype(np.int32))
    assert len(result.fits) == 2
    assert min(overlap(result.labels, truth)) > 0.9


def test_what_belongs_together_is_not_split():
    bodies = [standing(-0.055, 0, (0.05, 0.04, 0.03)), standing(0.035, 0.01, (0.04, 0.03, 0.06))]
    depth, truth = seen(bodies)
    asked = []

    def are_one(labels, parts):
        asked.append(parts)
        return True

    result, calls = parted(depth, (truth > 0).astype(np.int32), are_one)
    assert not result.parted
    assert calls == 0
    assert [len(parts) for parts in asked] == [2]


def test_flush_boxes_that_form_one_box_stay_one():
    """Nothing in the image distinguishes two equal boxes side by side from a long one."""
    depth, truth = seen([standing(x, 0, (0.045, 0.04, 0.04)) for x in (-0.045, 0.045)])
    whole, _ = parted(depth, (truth > 0).astype(np.int32))
    assert len(whole.fits) == 1
    assert whole.fits[1].superquadric.size.max() == pytest.approx(0.09, abs=0.004)


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("away", [-1, 1])
def test_an_l_shape_becomes_two_bodies(side, away):
    bodies = [standing(0, 0, (0.09, 0.025, 0.03)), standing(side * 0.065, away * 0.085, (0.025, 0.06, 0.03))]
    depth, truth = seen(bodies)
    result, _ = parted(depth, (truth > 0).astype(np.int32))
    assert len(result.fits) == 2
    assert result.parted == ((1, 2),)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("size", "shape"), [((0.05, 0.05, 0.05), BALL), (LONG_BOX, BOX), ((0.04, 0.06, 0.05), (0.6, 0.9))]
)
def test_a_superquadric_on_noise_costs_no_fit_and_stays(seed, size, shape):
    depth, truth = seen([standing(0, 0, size, shape, turn=0.5)], 0.002, seed)
    result, calls = parted(depth, truth)
    assert not result.parted
    assert calls == 0


def test_bodies_apart_cost_no_fit():
    depth, truth = seen([standing(x, 0, (0.03, 0.03, 0.03), turn=0.3) for x in (-0.1, 0.0, 0.1)])
    result, calls = parted(depth, truth)
    assert not result.parted
    assert calls == 0


def test_what_hangs_on_another_is_no_body_of_its_own():
    """A bottle: a can and its neck, which stands on the can and not on the table."""
    neck = standing(0, 0, (0.012, 0.012, 0.03), (0.1, 1.0))
    neck = Superquadric(neck.size, neck.shape, neck.translation + 0.1 * PLANE[:3], neck.rotation)
    depth, truth = seen([standing(0, 0, (0.03, 0.03, 0.05), (0.1, 1.0)), neck])
    result, _ = parted(depth, (truth > 0).astype(np.int32))
    assert len(result.fits) == 1


def test_a_mug_stays_with_its_handle():
    """The handle hovers beside the can."""
    handle = standing(0.042, 0, (0.015, 0.005, 0.03))
    handle = Superquadric(handle.size, handle.shape, handle.translation + 0.03 * PLANE[:3], handle.rotation)
    depth, truth = seen([standing(0, 0, (0.035, 0.035, 0.055), (0.1, 1.0)), handle])
    result, _ = parted(depth, (truth > 0).astype(np.int32))
    assert len(result.fits) == 1


def test_labels_have_no_order():
    """The same segments under other numbers: the same segments afterwards."""
    bodies = [standing(-0.055, 0, (0.05, 0.04, 0.03)), standing(0.035, 0.01, (0.04, 0.03, 0.06))]
    depth, truth = seen([*bodies, standing(0.13, -0.05, (0.03, 0.03, 0.03), BALL)])
    labels = np.where(truth == 3, 2, np.minimum(truth, 1)).astype(np.int32)
    first, _ = parted(depth, labels)
    second, _ = parted(depth, np.array([0, 7, 4])[labels].astype(np.int32))
    assert len(first.fits) == len(second.fits) == 3
    pairs = np.unique(np.stack([first.labels.ravel(), second.labels.ravel()]), axis=1)
    assert pairs.shape[1] == 4  # a one-to-one map of four values


def description_length(evidence, bodies):
    """L of an image by bodies, as the repair compares it."""
    return unexplained(evidence, bodies) + len(bodies) * price(evidence)


def test_the_description_is_that_of_a_set():
    bodies = [standing(-0.055, 0, (0.05, 0.04, 0.03)), standing(0.035, 0.01, (0.04, 0.03, 0.06))]
    depth, truth = seen(bodies)
    evidence = Evidence.of(depth, truth > 0, CAMERA, NOISE)
    assert description_length(evidence, bodies) == pytest.approx(description_length(evidence, bodies[::-1]), abs=1e-9)
    assert description_length(evidence, bodies) < description_length(evidence, bodies[:1])
    assert description_length(evidence, bodies) < description_length(evidence, [])


def test_the_description_is_additive_and_counts_what_it_says():
    """Without bodies every pixel is an outlier; a true body leaves half a nat for each independent observation."""
    body = standing(0, 0, LONG_BOX)
    depth, truth = seen([body])
    evidence = Evidence.of(depth, truth > 0, CAMERA, NOISE)
    n = evidence.observations
    assert description_length(evidence, []) == pytest.approx(scene_description.OUTLIER * n)
    left = scene_description.unexplained(evidence, [body])
    assert left < 0.5 * n  # the tolerance for real objects lies above the noise
    assert description_length(evidence, [body]) == pytest.approx(left + 5.5 * np.log(n))
    hidden = Superquadric(body.size, body.shape, body.translation - 0.5 * PLANE[:3], body.rotation)
    assert scene_description.unexplained(evidence, [body, hidden]) == pytest.approx(left)


def test_a_body_before_what_was_seen_costs_its_pixels():
    body = standing(0, 0, LONG_BOX)
    depth, truth = seen([body])
    evidence = Evidence.of(depth, truth > 0, CAMERA, NOISE)
    larger = Superquadric(1.3 * body.size, body.shape, body.translation, body.rotation)
    assert scene_description.unexplained(evidence, [larger]) > scene_description.unexplained(evidence, [body]) + 20


def test_nothing_measured_changes_nothing():
    depth, truth = seen([standing(0, 0, LONG_BOX)])
    fit = fit_of(depth)
    fits = {1: fit(truth == 1)}
    fit.calls = 0
    blind = np.full_like(depth, np.nan)
    for image in (blind, np.zeros_like(depth), np.full_like(depth, np.inf)):
        result = segment_split.split(image, CAMERA, truth, PLANE, fits, fit, NOISE)
        assert not result.parted
        assert fit.calls == 0
    assert not segment_split.split(depth, CAMERA, np.zeros_like(truth), PLANE, {}, fit, NOISE).parted


def test_without_time_nothing_is_fitted():
    depth, truth = seen([standing(-0.055, 0, (0.05, 0.04, 0.03)), standing(0.035, 0.01, (0.04, 0.03, 0.06))])
    labels, fit = (truth > 0).astype(np.int32), fit_of(depth)
    fits = {1: fit(labels == 1)}
    fit.calls = 0
    result = segment_split.split(depth, CAMERA, labels, PLANE, fits, fit, NOISE, time_budget=1e-9)
    assert not result.parted
    assert fit.calls == 0


def test_misuse_raises():
    depth, truth = seen([standing(0, 0, LONG_BOX)])
    fit = fit_of(depth)
    with pytest.raises(ValueError, match="fit a camera"):
        segment_split.split(depth[1:], CAMERA, truth, PLANE, {}, fit, NOISE)
    orthographic = Camera(320, 240, 262.5, 262.5, 159.5, 119.5, "orthographic")
    with pytest.raises(ValueError, match="pinhole"):
        Evidence.of(depth, truth > 0, orthographic, NOISE)


def test_masks_from_outside_win():
    """A box cut in two by given labels stays so; found by the program itself it is one, and the stage is timed."""
    depth, truth = seen([standing(0, 0, LONG_BOX, turn=0.4)])
    recoverer = Recoverer(method="symmetry")
    given = cut(truth, 1, np.median(np.nonzero(truth)[1]))
    frame = recoverer.recover(depth, CAMERA, given)
    np.testing.assert_array_equal(frame.labels, given)
    assert len(frame.bodies) == 2
    own = recoverer.recover(depth, CAMERA)
    assert len(own.bodies) == 1
    assert own.milliseconds["repair"] > 0


def test_a_repaired_frame_is_consistent(monkeypatch):
    """Own segments that merge two bodies: afterwards labels, bodies, pixels and their order agree."""
    bodies = [standing(-0.055, 0, (0.05, 0.04, 0.03)), standing(0.035, 0.01, (0.04, 0.03, 0.06))]
    depth, truth = seen([*bodies, standing(0.15, -0.05, (0.035, 0.035, 0.035))])
    merged = np.where(truth == 3, 2, np.minimum(truth, 1)).astype(np.int32)
    wrong = Segmentation(merged, PLANE, (1, 2), sigma=NOISE)
    monkeypatch.setattr(segments, "segment", lambda *_: wrong)
    frame = Recoverer(method="symmetry").recover(depth, CAMERA)
    assert len(frame.recovered) == 3
    assert min(overlap(frame.labels, truth)) > 0.9
    assert sorted(body.label for body in frame.bodies) == sorted(set(np.unique(frame.labels)) - {0})
    assert [body.pixels for body in frame.bodies] == [np.sum(frame.labels == body.label) for body in frame.bodies]
    assert [body.pixels for body in frame.bodies] == sorted((body.pixels for body in frame.bodies), reverse=True)
    assert all(body.score > 0.5 for body in frame.bodies)
    untouched = Recoverer(method="symmetry").recover(depth, CAMERA, options=RecoveryOptions("symmetry", repair=False))
    np.testing.assert_array_equal(untouched.labels, merged)
