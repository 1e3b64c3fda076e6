"""Which pieces of a mask are of the object: steps in depth part it from what is before and behind it, or within it."""

import numpy as np
import pytest

from sq_perception.imaging import regions
from sq_perception.imaging.depth_steps import coherent

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


def test_labels_are_beside_each_other_where_they_meet_at_about_one_depth():
    labels = np.array([[1, 1, 2, 2], [1, 1, 2, 2], [1, 1, 2, 2]], np.int32)
    depth = np.where(labels == 1, 1.0, np.array([[1.01], [1.1], [1.5]])).astype(np.float32)
    np.testing.assert_array_equal(np.argwhere(regions.beside(labels, depth, NEAR)), [[1, 2], [2, 1]])
    depth[0, 2:] = 1.1
    assert not regions.beside(labels, depth, NEAR).any()


def test_labels_are_beside_each_other_across_pixels_without_a_depth():
    labels = np.array([[1, 0, 0, 2]], np.int32)
    depth = np.array([[1.0, 0.0, 0.0, 1.01]], np.float32)
    assert regions.beside(labels, depth, NEAR)[1, 2]
    depth[0, 1:3] = 1.0
    assert not regions.beside(labels, depth, NEAR).any(), "what has no label is between them"
