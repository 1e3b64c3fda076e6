"""Each stage of a camera does what its equation says; planes stay planes."""

import numpy as np
import pytest

from sq_perception.imaging.camera import Camera
from sq_perception.simulation import camera_stages as stages
from sq_perception.simulation.camera_stages import RANGES, Filling, Stages, draw_stages
from sq_perception.simulation.scenes import plane_depth

CAMERA = Camera(90, 60, 100.0, 100.0, 44.5, 29.5)
PLANE = np.array([0.2, -0.5, -1.0, 0.8])
NAN = np.nan


def plane() -> np.ndarray:
    return plane_depth(PLANE, CAMERA).astype(np.float32)


def step(left: float, right: float, column: int = 45) -> np.ndarray:
    """Two surfaces that face the camera, float32 (60, 90)."""
    return np.where(np.arange(90) < column, np.float32(left), np.float32(right)) + np.zeros((60, 1), np.float32)


@pytest.mark.parametrize("factor", [0.25, 0.5])
def test_the_spatial_filter_is_a_double_exponential_of_steps_below_its_threshold(factor: float) -> None:
    w = 1 / step(1.0, 1.02)
    found = 1 / stages.spatial(1 / w, factor, 0.03, 1)[30]
    k = np.arange(90) - 45
    rise = np.where(k >= 0, 1 - (1 - factor) ** (k + 1.0) / (2 - factor), (1 - factor) ** (-k * 1.0) / (2 - factor))
    np.testing.assert_allclose(found, w[30, 0] + (w[30, -1] - w[30, 0]) * rise, atol=1e-6)


def test_the_spatial_filter_keeps_planes_larger_steps_and_gaps_and_lessens_noise() -> None:
    image = step(1.0, 1.2)
    np.testing.assert_allclose(stages.spatial(image, 0.3, 0.1, 5), image, rtol=1e-6)
    image[:, 40:43] = NAN
    np.testing.assert_array_equal(np.isnan(stages.spatial(image, 0.3, 1.0, 2)), np.isnan(image))
    inner = np.s_[20:-20, 20:-20]  # rows begin with their first reading
    image = plane()
    np.testing.assert_allclose(stages.spatial(image, 0.5, 0.1, 2)[inner], image[inner], rtol=1e-5)
    noisy = image + np.random.default_rng(0).normal(0, 0.002, image.shape).astype(np.float32)
    assert np.std((stages.spatial(noisy, 0.5, 0.1, 2) - image)[inner]) < 0.5 * np.std((noisy - image)[inner])


def test_the_temporal_filter_weighs_frames_and_holds_readings() -> None:
    w = [np.full((2, 2), each, np.float32) for each in (1.0, 1.01, 0.99)]
    w[1][0, 0] = NAN  # held
    w[2][0, 1] = 2.0  # another surface
    w[0][1, 0] = NAN  # seen later
    found = 1 / stages.temporal([1 / each for each in w], 0.4, 0.1)
    assert found[1, 1] == pytest.approx(0.4 * 0.99 + 0.6 * (0.4 * 1.01 + 0.6 * 1.0))
    assert found[0, 0] == pytest.approx(0.4 * 0.99 + 0.6 * 1.0)
    assert found[0, 1] == pytest.approx(2.0)
    assert found[1, 0] == pytest.approx(0.4 * 0.99 + 0.6 * 1.01)


def test_a_decimated_plane_is_that_of_the_decimated_camera() -> None:
    """The median of an affine w over 3 x 3 pixels is that of the middle one; a missing reading does not count."""
    small = stages.decimate_camera(CAMERA, 3)
    image = plane()
    np.testing.assert_allclose(stages.decimate(image, 3), plane_depth(PLANE, small), rtol=1e-6)
    image[::3, ::3] = NAN
    assert np.isfinite(stages.decimate(image, 3)).all()
    assert np.isnan(stages.decimate(np.full((4, 4), np.float32(NAN)), 2)).all()


def test_a_ring_is_as_wide_as_asked_for_on_both_sides() -> None:
    lost = np.isnan(stages.ring(step(0.8, 1.0), 4, 1, 0.05))
    np.testing.assert_array_equal(np.flatnonzero(lost[30]), [44, 45, 46, 47, 48])
    assert not np.isnan(stages.ring(step(0.8, 0.82), 4, 1, 0.05)).any()
    assert not np.isnan(stages.ring(plane(), 4, 1, 0.1)).any()
    mask = np.zeros((60, 90), bool)
    mask[20:40, 30:50] = True
    around = np.isnan(stages.ring_around(step(1.0, 1.0), mask, 3))
    assert not (around & mask).any()
    np.testing.assert_array_equal(np.flatnonzero(around[30]), [27, 28, 29, 50, 51, 52])


@pytest.mark.parametrize(("rule", "expected"), [("left", 1.0), ("farthest", 1.2), ("nearest", 1.0)])
def test_gaps_are_filled_by_the_rule(rule: Filling, expected: float) -> None:
    """Between a near surface on the left and above, and a far one below."""
    image = np.full((5, 6), np.float32(1.0))
    image[3:] = 1.2
    image[2, 2:4] = NAN
    found = stages.fill(image, rule)
    np.testing.assert_allclose(found[2, 2:4], expected)
    assert np.isfinite(found).all()


@pytest.mark.parametrize("whole", [True, False])
def test_alignment_shifts_by_the_disparity_and_leaves_a_shadow(whole: bool) -> None:
    """Surfaces at 0.5 and 1 m, 2 and 1 pixels of disparity for a baseline of 10 mm: a pixel is covered, or missing."""
    for x, lost in ((0.01, 0), (-0.01, 1)):
        found = stages.align(step(0.5, 1.0), CAMERA, np.array([x, 0.0, 0.0]), CAMERA, whole)
        edge = 45 + round(100 * x / 0.5)
        assert found[30, edge - 1] == pytest.approx(0.5)
        assert np.count_nonzero(np.isnan(found[30, 5:-5])) == lost
        assert found[30, edge + lost] == pytest.approx(1.0)


def test_alignment_keeps_planes_and_points_leave_gaps_in_finer_images() -> None:
    finer = Camera(180, 120, 200.0, 200.0, 89.5, 59.5)
    whole, points = (stages.align(plane(), CAMERA, np.zeros(3), finer, each) for each in (True, False))
    assert np.isfinite(whole).all()
    assert np.isfinite(points).mean() == pytest.approx(0.25)
    true = plane_depth(PLANE, finer)
    known = np.isfinite(points)
    np.testing.assert_allclose(points[known], true[known], rtol=0.01)  # half a pixel away
    np.testing.assert_array_equal(stages.align(plane(), CAMERA, np.zeros(3), CAMERA, True), plane())


def test_bending_keeps_the_middle_and_grows_with_the_square() -> None:
    at = np.array([0.1, 0.0])
    found = stages.bend(step(1.0, 1.0), CAMERA, at, np.zeros(2), 0.02)
    x = (np.arange(90) - CAMERA.cx) / CAMERA.fx - 0.1
    y = (29 - CAMERA.cy) / CAMERA.fy
    np.testing.assert_allclose(found[29] - 1, 0.02 * (x * x + y * y), atol=1e-6)
    tilted = stages.bend(step(1.0, 1.0), CAMERA, at, np.array([0.02, 0.0]), 0.0)
    np.testing.assert_allclose(tilted[29] - 1, 0.02 * x, atol=1e-6)


def test_rounding_medians_and_blocks_stay_near_and_keep_gaps() -> None:
    image = plane()
    image[10:20, 10:20] = NAN
    known = np.isfinite(image)
    found = stages.round_depth(image, 0.01)
    assert np.abs(found - image)[known].max() <= 0.0051
    np.testing.assert_array_equal(np.isfinite(found), known)
    assert np.isnan(stages.median(image, 5)[12:18, 12:18]).all()
    np.testing.assert_allclose(stages.median(image, 3)[30:50, 30:80], image[30:50, 30:80], atol=1e-6)
    flat = stages.blocks(step(0.7, 0.7), 0.01)
    assert np.ptp(flat) < 1e-6
    assert abs(1 / flat[0, 0] - 1 / 0.7) <= 0.0051
    packed = stages.blocks(image, 0.001)
    np.testing.assert_array_equal(np.isfinite(packed), known)
    assert 0 < np.abs(1 / packed - 1 / image)[30:].max() < 0.02  # every wave of a block by half of its step at most


def test_cameras_are_drawn_from_the_ranges_and_one_without_stages_changes_nothing() -> None:
    drawn = [draw_stages(np.random.default_rng(k)) for k in range(300)]
    assert drawn[7] == draw_stages(np.random.default_rng(7))
    assert np.mean([each.outer > 0 for each in drawn]) == pytest.approx(RANGES.ring, abs=0.1)
    assert {each.rounds for each in drawn} == set(range(RANGES.rounds[1] + 1))
    assert all(abs(each.beside) <= RANGES.baseline[1] for each in drawn)
    image, mask = plane(), np.zeros((60, 90), bool)
    np.testing.assert_array_equal(Stages().process(image, mask, CAMERA), image)
    mask[20:40, 30:50] = True
    for each in drawn[:40]:
        inside = each.process(image, mask, CAMERA)[24:36, 34:46]
        assert np.isfinite(inside).mean() > 0.9
        assert np.nanmax(np.abs(inside / image[24:36, 34:46] - 1)) < 0.02
