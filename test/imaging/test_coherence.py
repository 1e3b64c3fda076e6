"""Steps and gaps of depth images: which pieces of a mask are of the object, and which gaps take the nearest reading."""

import numpy as np
import pytest
from table_scenes import VGA, Table

from sq_perception.imaging import hole_filling, regions
from sq_perception.imaging.depth_steps import coherent
from sq_perception.recovery.recoverer import Recoverer
from sq_perception.simulation import scenes, sensor_noise

JUMP = 0.02


def test_the_fringe_of_an_occluder_is_no_part_of_the_body() -> None:
    depth = np.full((40, 60), 1.0)
    depth[:, 40:] = 0.6
    depth[:, 34:40] = np.nan
    mask = np.zeros(depth.shape, dtype=bool)
    mask[5:35, 10:43] = True
    core = coherent(depth, mask, JUMP)
    assert not core[:, 40:].any()
    assert core[5:35, 10:40].all()


def test_the_far_end_of_a_body_behind_a_bar_stays() -> None:
    depth = np.full((40, 60), 1.5)
    depth[5:35, 10:50] = 1.0
    depth[:, 36:40] = 0.6
    mask = depth == 1.0
    np.testing.assert_array_equal(coherent(depth, mask, JUMP), mask)


@pytest.mark.parametrize("behind", [1.5, np.nan])
def test_a_part_of_a_thing_that_another_one_hides_stays(behind: float) -> None:
    """A grip behind a head: its border is a border in the depth as well, or of what was measured at all."""
    depth = np.full((40, 60), behind)
    depth[5:25, 10:40] = 0.6
    depth[15:35, 40:55] = 0.7
    mask = depth < 1
    np.testing.assert_array_equal(coherent(depth, mask, JUMP), mask)


def test_what_is_seen_around_a_thing_or_through_it_goes() -> None:
    """A mask too large by five pixels, the table in it as large as half of the thing, and a hole in a handle."""
    depth = np.full((60, 80), 1.0)
    thing = np.zeros(depth.shape, bool)
    thing[15:45, 20:60] = True
    hole = np.zeros(depth.shape, bool)
    hole[22:38, 30:50] = True
    depth[thing & ~hole] = 0.6
    mask = np.zeros(depth.shape, bool)
    mask[10:50, 15:65] = True
    np.testing.assert_array_equal(coherent(depth, mask, JUMP), thing & ~hole)


def test_a_neighbour_that_goes_on_beyond_the_mask_goes() -> None:
    """An occluder, of which a third of the mask shows a part."""
    depth = np.full((60, 80), 1.0)
    depth[10:50, 10:40] = 0.7
    depth[:, 40:] = 0.5
    mask = np.zeros(depth.shape, bool)
    mask[10:50, 10:55] = True
    np.testing.assert_array_equal(coherent(depth, mask, JUMP), mask & (depth == 0.7))


NEAR = 0.03


def test_labels_are_beside_each_other_at_about_one_depth_also_across_pixels_without_one():
    labels = np.array([[1, 1, 2, 2], [1, 1, 2, 2], [1, 1, 2, 2]], np.int32)
    depth = np.where(labels == 1, 1.0, np.array([[1.01], [1.1], [1.5]])).astype(np.float32)
    np.testing.assert_array_equal(np.argwhere(regions.beside(labels, depth, NEAR)), [[1, 2], [2, 1]])
    depth[0, 2:] = 1.1
    assert not regions.beside(labels, depth, NEAR).any()
    labels = np.array([[1, 0, 0, 2]], np.int32)
    depth = np.array([[1.0, 0.0, 0.0, 1.01]], np.float32)
    assert regions.beside(labels, depth, NEAR)[1, 2]
    depth[0, 1:3] = 1.0
    assert not regions.beside(labels, depth, NEAR).any(), "what has no label is between them"


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
    for image in (SLOPE, np.where((ROWS % 8 == 3) & (COLUMNS % 8 == 2), np.float32(np.nan), SLOPE)):
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
    for found, of_all in zip(Recoverer().recover(depth, VGA, labels).bodies, whole.bodies, strict=True):
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
