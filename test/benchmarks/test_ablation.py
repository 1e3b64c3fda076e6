"""What the ablation leaves out is there to be left out."""

import ablation
import pytest


@pytest.mark.parametrize("row", ablation.ROWS, ids=lambda row: row.name)
def test_what_a_row_changes_in_the_program_exists(row: ablation.Row) -> None:
    with row.program():
        pass
