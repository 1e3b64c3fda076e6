"""What the benchmark of the segmentation counts, on label images of a few pixels."""

import numpy as np
import pytest
from segmentation import score

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
