"""Pictures and figures of what was recovered.

What an evaluation compares by default is here, importable at once.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sq_perception.recovery.options import Method

FITS: dict[Method, str] = {
    "auto": "surface fit, started by central symmetry and the shipped network",
    "symmetry": "surface fit, started by central symmetry alone",
    "classic": "Solina and Bajcsy's iterative fit to the points",
}
BODIES = 20_000  # bodies for networks, as many as the thesis tested on
FIT_BODIES = 2000  # the first of these for fits, which take some ten times as long
DEFAULT_SEED = 2020  # seed of the test set
