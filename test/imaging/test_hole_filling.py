"""Gaps between readings take the nearest reading; holes, and images without gaps, stay as they are."""

import numpy as np
import pytest
from table_scenes import VGA, Table

from sq_perception.imaging import hole_filling
from sq_perception.recovery.recoverer import Recoverer
from sq_perception.simulation import scenes, sensor_noise

ROWS, COLUMNS = np.indices((24, 32))
SLOPE = (1 + 0.01 * ROWS + 0.002 * COLUMNS).astype(np.float32)
PATTERNS = {
    "single readings": (ROWS % 4 == 3) & (COLUMNS % 4 == 2),
    "every second line": ROWS % 2 == 1,
    "a chess board": (ROWS + COLUMNS) % 2 == 1,
    "registered to three times as many pixels a side": (ROWS % 3 != 0) | (COLUMNS % 3 != 0),
}


@pytest.mark.parametrize("pattern", PATTERNS.values(), ids=PATTERNS)
def test_gaps_take_the_nearest_reading_and_its_label(pattern: np.ndarray) -> None:
    labels = np.where(pattern, 9, ROWS // 4 + 1)
    filled, named, gaps = hole_filling.fill(np.where(pattern, np.float32(np.nan), SLOPE), labels)
    inside = np.s_[2:-4, 2:-4]
    rows, columns = np.nonzero(~pattern)
    away = np.hypot(ROWS[inside][..., None] - rows, COLUMNS[inside][..., None] - columns)
    nearest = away <= away.min(axis=-1, keepdims=True)
    assert (nearest & (filled[inside][..., None] == SLOPE[rows, columns])).any(axis=-1).all()
    assert (nearest & (named[inside][..., None] == labels[rows, columns])).any(axis=-1).all()
    assert np.array_equal(filled[~pattern], SLOPE[~pattern])
    assert np.array_equal(gaps, pattern & np.isfinite(filled))


def test_large_holes_stay_and_nothing_that_was_given_is_written_to() -> None:
    image = np.where(PATTERNS["every second line"], np.float32(np.nan), SLOPE)
    image[8:15, 8:15] = np.nan
    given, labels = image.copy(), ROWS // 4
    filled, named, _ = hole_filling.fill(image, labels)
    assert np.isnan(filled[9:14, 9:14]).all()
    assert np.isfinite(filled[:, :8]).all()
    assert named is not labels
    assert np.array_equal(image, given, equal_nan=True)
    assert np.array_equal(labels, ROWS // 4)


def test_an_image_without_gaps_or_with_single_ones_as_of_recorded_frames_is_given_back() -> None:
    single = np.where((ROWS % 8 == 3) & (COLUMNS % 8 == 2), np.float32(np.nan), SLOPE)
    for image in (SLOPE, single):
        assert hole_filling.fill(image) == (image, None, None)


@pytest.mark.parametrize("masks", ["given", "own"])
def test_things_are_found_and_fitted_in_depth_registered_to_more_pixels(masks: str) -> None:
    scene = scenes.table_scene(np.random.default_rng(3), 2)
    depth, labels = scene.render()
    rows, columns = np.indices(depth.shape)
    sparse = np.where((rows % 3 == 0) & (columns % 3 == 0), depth, np.nan).astype(np.float32)
    frame = Recoverer().recover(sparse, scene.camera, labels if masks == "given" else None)
    assert len(frame.bodies) == 2
    away = [min(np.linalg.norm(b.superquadric.translation - t.translation) for b in frame.bodies) for t in scene.bodies]
    assert max(away) < 0.01


@pytest.mark.parametrize("first", [0, 1])
def test_what_stands_in_for_missing_lines_shifts_no_body(first: int) -> None:
    table = Table(distance=0.9)
    box, can = ((0.05, 0.03, 0.06), (0.1, 0.1)), ((0.035, 0.035, 0.06), (0.1, 1.0))
    bodies = [table.body(-0.12, 0.0, *box, turn=0.7), table.body(0.1, 0.05, *can)]
    depth, labels = table.see(bodies, noise=0.0005)
    whole = Recoverer().recover(depth, VGA, labels)
    depth[first::2] = np.nan
    frame = Recoverer().recover(depth, VGA, labels)
    for found, of_all in zip(frame.bodies, whole.bodies, strict=True):
        true = bodies[found.label - 1]
        np.testing.assert_allclose(found.superquadric.translation, true.translation, atol=4e-4)
        assert abs(found.pixels / of_all.pixels - 0.5) < 0.05


def test_pixels_of_a_body_are_those_that_were_measured() -> None:
    """Also where some of its segment are outliers, as the rim is that a sensor adds."""
    scene = scenes.table_scene(np.random.default_rng(3), 3)
    depth = sensor_noise.preset("realsense_d435").measure(scene.render()[0], scene.camera, np.random.default_rng(4))
    depth[1::2] = np.nan
    frame = Recoverer().recover(depth, scene.camera)
    assert len(frame.bodies) == 3
    for body in frame.bodies:
        assert body.pixels == np.count_nonzero(np.isfinite(depth) & (frame.labels == body.label))
