"""What the ablation leaves out is there to be left out."""

from __future__ import annotations

import ablation
import fit_parts
import pytest


@pytest.mark.parametrize("row", ablation.ROWS, ids=lambda row: row.name)
def test_what_a_row_changes_in_the_program_exists(row: ablation.Row) -> None:
    with row.program():
        pass


@pytest.mark.parametrize("part", fit_parts.PARTS)
def test_a_part_that_is_left_out_of_the_fit_exists(part: str) -> None:
    with fit_parts.PARTS[part]():
        pass
