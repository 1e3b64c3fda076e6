"""What the benchmark of the segmentation counts, on label images of a few pixels."""

from __future__ import annotations

import numpy as np
import pytest
from segmentation import score

TRUTH = np.repeat([[0, 1, 1, 1, 1, 2, 2, 2, 2, 0]], 10, axis=0)


def test_the_same_labels_in_another_order():
    found = np.choose(TRUTH, [0, 2, 1])
    result = score(TRUTH, found)
    assert result.ious == (1.0, 1.0)
    assert (result.objects, result.segments, result.hits, result.cut, result.joined) == (2, 2, 2, 0, 0)


def test_joined():
    result = score(TRUTH, (TRUTH > 0).astype(int))
    assert sorted(result.ious) == [0.0, 0.5]
    assert (result.segments, result.hits, result.cut, result.joined) == (1, 1, 0, 1)


def test_cut():
    found = TRUTH.copy()
    found[:4][TRUTH[:4] == 1] = 3
    result = score(TRUTH, found)
    assert result.ious == (pytest.approx(0.6), 1.0)
    assert (result.segments, result.hits, result.cut, result.joined) == (3, 2, 1, 0)


def test_nothing_found_and_nothing_there():
    nothing = np.zeros_like(TRUTH)
    assert score(TRUTH, nothing).ious == (0.0, 0.0)
    assert score(TRUTH, nothing).hits == 0
    assert score(nothing, TRUTH).segments == 2
