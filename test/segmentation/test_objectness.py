"""What is a thing: its height over its whole area, what is too large and what is alone, and what is said of it."""

import numpy as np
import pytest
from table_scenes import BOX, VGA, Table, best_iou, ious, judged_by_network

from sq_perception.recovery.recoverer import Recoverer
from sq_perception.segmentation import objectness
from sq_perception.segmentation.objectness import HeightEvidence
from sq_perception.segmentation.segments import segment


@pytest.mark.parametrize("height", [0.004, 0.01])
def test_a_mean_of_independent_readings_is_as_sure_as_their_number_makes_it(height):
    """Of n readings with the deviation s the mean has s / sqrt(n); blocks are a quarter of the segment, 16 x 16."""
    rng = np.random.default_rng(0)
    labels = np.zeros((256, 256), np.int32)
    labels[64:96, 64:96] = 1
    relative = (height * (labels > 0) + 0.008 * rng.standard_normal(labels.shape)).astype(np.float32)
    (rise,) = HeightEvidence(relative, labels, 0.008).rise(labels, (1,))
    assert rise == pytest.approx(height * 16 / 0.008, rel=0.15)


def test_waves_of_the_support_are_not_averaged_away():
    """Waves longer than a block leave its mean as they are: a mean over them is no surer than one reading."""
    labels = np.zeros((256, 256), np.int32)
    labels[64:96, 64:96] = 1
    waves = 0.004 * np.sqrt(2) * np.sin(2 * np.pi * np.arange(256) / 128)
    relative = np.where(labels > 0, 0.02, waves[None, :] + 1e-9).astype(np.float32)
    (rise,) = HeightEvidence(relative, labels, 0.004).rise(labels, (1,))
    assert rise == pytest.approx(0.02 / 0.004, rel=0.1)


def test_what_rises_more_or_looks_more_like_an_object_is_likelier_one():
    rises, looks = [objectness.prior(z) for z in (0, 1, 3, 6, 8)], [objectness.prior(4, each) for each in (-5, 0, 5)]
    assert np.all(np.diff(rises) > 0)
    assert np.all(np.diff(looks) > 0)
    assert objectness.prior(100) == objectness.prior(8)
    assert objectness.prior(6) == pytest.approx(objectness.LEAST, abs=0.03)
    assert 0 <= objectness.prior(0, -1e4) < objectness.prior(8, 1e4) <= 1


def test_a_book_that_is_lower_than_six_deviations_is_surely_a_thing():
    """14 000 readings 17 mm above a table with a noise of 2.6 mm."""
    table = Table(pitch=0.9, distance=0.8)
    depth, truth = table.see([table.body(0, 0, (0.12, 0.085, 0.0085), (0.05, 0.05))], 2.6e-3 / 0.8**2)
    assert np.count_nonzero(truth) > 14_000
    found = judged_by_network(depth, VGA)
    assert best_iou(truth == 1, found.labels) > 0.9
    assert found.objectness[0] > 0.9


@pytest.mark.parametrize("sensor", ["realsense_d435", "kinect_v1", "azure_kinect"])
def test_flat_cartons_of_unequal_thickness_are_found(sensor):
    """Their tops span a plane of their own, which is no wall that they are parts of."""
    table = Table(pitch=0.8, distance=1.0)
    places = ((-0.2, 0.15, 0.015), (-0.2, -0.12, 0.02), (0.14, -0.05, 0.025), (0.2, 0.2, 0.03))
    bodies = [table.body(x, y, (0.1, 0.075, high / 2), (0.06, 0.06), 0.3 * k) for k, (x, y, high) in enumerate(places)]
    for seed in range(2):
        depth, truth = table.sensed(bodies, sensor, seed)
        assert min(ious(truth, judged_by_network(depth, VGA).labels)) > 0.8


@pytest.mark.parametrize(("size", "shape"), [((0.033, 0.033, 0.06), (0.1, 1.0)), ((0.05, 0.03, 0.08), BOX)])
def test_a_label_without_readings_does_not_part_a_thing(size, shape):
    """A dark band all around it, at several heights."""
    table = Table(pitch=0.8, distance=0.8)
    bodies = [table.body(0, 0, size, shape, 0.4), table.body(0.2, 0.05, (0.04, 0.03, 0.03))]
    for seed, (top, bottom) in enumerate(((0.3, 0.5), (0.45, 0.6), (0.25, 0.6))):
        depth, truth = table.sensed(bodies, "realsense_d435", seed)
        rows = np.flatnonzero((truth == 1).any(axis=1))
        first, last = (int(np.quantile(rows, share)) for share in (top, bottom))
        depth[first:last][truth[first:last] == 1] = np.nan
        found = judged_by_network(depth, VGA)
        assert best_iou((truth == 1) & np.isfinite(depth), found.labels) > 0.8


def test_a_limit_that_no_object_exceeds_changes_nothing():
    """Boxes of 6 cm in a row, whose gaps a sensor closes: together they are longer than the limit."""
    table = Table(pitch=1.0, distance=0.8)
    bodies = [table.body(0.065 * k - 0.23, 0.03 * (k % 2), (0.03, 0.03, 0.02 + 0.006 * (k % 3))) for k in range(8)]
    depth, truth = table.sensed(bodies, "realsense_d435", 0)
    wide, narrow = (judged_by_network(depth, VGA, max_size=limit) for limit in (0.6, 0.12))
    assert min(ious(truth, wide.labels)) > 0.5
    np.testing.assert_array_equal(wide.labels, narrow.labels)
    assert narrow.larger == 0


def test_what_is_larger_than_a_thing_is_left_out_as_a_whole_and_said():
    table = Table(pitch=0.5, distance=2.2)
    column = table.body(0.1, 0.4, (0.2, 0.15, 0.5), (0.05, 0.05), 0.4)
    can = table.body(-0.3, -0.1, (0.05, 0.05, 0.08), (0.1, 1.0))
    depth, truth = table.sensed([column, can], "realsense_d435", 1)
    found = Recoverer(threads=1).recover(depth, VGA)
    assert best_iou(truth == 2, found.labels) > 0.7
    assert not found.labels[truth == 1].any()
    assert "1 object is larger than max_size = 0.6 m and left out" in found.message
    assert all(objectness.LEAST <= body.objectness <= 1 for body in found.bodies)


@pytest.mark.parametrize("size", [(0.05, 0.03, 0.08), (0.033, 0.033, 0.06), (0.045, 0.035, 0.025)])
@pytest.mark.parametrize("is_round", [False, True])
def test_a_view_of_nothing_but_a_body_is_that_body_and_not_its_own_table(size, is_round):
    """A crop of the image whose background was set to nothing."""
    table = Table(pitch=0.7, distance=0.8)
    depth, truth = table.see([table.body(0, 0, size, (0.1, 1.0 if is_round else 0.1), 0.5)], 1e-3)
    rows, columns = np.nonzero(truth)
    left, top, right, bottom = columns.min(), rows.min(), columns.max() + 1, rows.max() + 1
    crop = np.where(truth > 0, depth, np.nan)[top:bottom, left:right].astype(np.float32)
    found = Recoverer(threads=1).recover(crop, VGA.cropped(left, top, right - left, bottom - top))
    np.testing.assert_array_equal(found.labels > 0, np.isfinite(crop))
    assert len(found.bodies) == 1
    assert found.plane is None
    assert "no support plane found" in found.message


def test_a_small_table_in_the_dark_is_a_support_all_the_same():
    """Its own outline is a silhouette, but larger than a thing, and things stand on it."""
    table = Table(pitch=0.9, distance=0.9)
    depth, truth = table.see([table.body(-0.1, 0, (0.04, 0.03, 0.04)), table.body(0.1, 0, (0.03, 0.03, 0.05))], 1e-3)
    v, u = np.indices(depth.shape)
    disc = np.hypot(u - VGA.cx, v - VGA.cy) < 235
    found = segment(np.where(disc, depth, np.nan).astype(np.float32), VGA)
    assert found.plane == pytest.approx(table.plane, abs=0.01)
    assert min(ious(truth, found.labels)) > 0.85
