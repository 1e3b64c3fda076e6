"""Borders of a label image, on images of a few pixels, counted by hand."""

from __future__ import annotations

import numpy as np

from sq_perception.imaging import regions

NEAR = 0.03


def test_borders_count_contacts_by_how_far_the_two_are_apart():
    labels = np.array([[1, 1, 2, 2], [1, 1, 2, 2], [1, 1, 2, 2]], np.int32)
    depth = np.where(labels == 1, 1.0, np.array([[1.01], [1.1], [1.5]])).astype(np.float32)
    met, beside, behind = regions.borders(labels, depth, 2, NEAR)
    assert met[1, 2] == met[2, 1] == 3
    assert beside[1, 2] == beside[2, 1] == 1, "the first row, 1 cm apart"
    assert behind[2, 1] == 2, "the first row is no step"
    assert behind[1, 2] == 0
    # Each 2 x 3 pixels, with one side on the other.
    assert met[0, 1] == met[0, 2] == 2 + 3 + 2


def test_contacts_go_across_pixels_without_a_depth():
    labels = np.array([[1, 0, 0, 2]], np.int32)
    depth = np.array([[1.0, 0.0, 0.0, 1.2]], np.float32)
    met, beside, behind = regions.borders(labels, depth, 2, NEAR)
    assert met[1, 2] == 1
    assert beside[1, 2] == 0
    assert behind[2, 1] == 1
    depth[0, 1:3] = 2.0
    met, _, behind = regions.borders(labels, depth, 2, NEAR)
    assert met[1, 2] == 0
    assert not behind.any(), "nothing is behind what has no label"
