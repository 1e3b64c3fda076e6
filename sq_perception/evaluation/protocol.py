"""What an evaluation compares by default; importable at once, for the help of the command."""

from typing import Literal

FITS: tuple[Literal["auto", "symmetry", "classic"], ...] = ("auto", "symmetry", "classic")
"""Network and surface fit, the surface fit alone, and the fit of Solina and Bajcsy."""
BODIES = 20_000
"""Bodies for networks, as many as the thesis tested on."""
FIT_BODIES = 2000
"""The first of these for fits, which take some ten times as long."""
DEFAULT_SEED = 2020
"""Of the test set."""
