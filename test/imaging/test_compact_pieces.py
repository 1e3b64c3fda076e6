"""Compact pieces of a set of cells: all of it, none twice, of about one size."""

import numpy as np
import pytest

from sq_perception.imaging.segment_view import compact_pieces


def square(side: int) -> np.ndarray:
    cells = np.zeros((40, 40), bool)
    cells[4 : 4 + side, 7 : 7 + side] = True
    return cells


@pytest.mark.parametrize("count", [1, 3, 4, 6])
def test_they_are_a_partition(count: int) -> None:
    cells = square(24)
    found = compact_pieces(cells, count, (0.0, 0.0))
    np.testing.assert_array_equal(found >= 0, cells)
    sizes = np.bincount(found[cells])
    assert len(sizes) == count
    assert sizes.min() > 0.5 * np.count_nonzero(cells) / count


def test_four_of_a_square_are_its_quarters() -> None:
    found = compact_pieces(square(24), 4, (0.0, 0.0))
    assert np.bincount(found[found >= 0]).tolist() == [144] * 4
    for number in range(4):
        rows, columns = np.nonzero(found == number)
        assert np.ptp(rows) == np.ptp(columns) == 11


def test_no_more_pieces_than_cells() -> None:
    cells = square(1)
    assert compact_pieces(cells, 4, (20.0, 20.0))[cells].tolist() == [0]
