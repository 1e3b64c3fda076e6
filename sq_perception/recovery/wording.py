"""A body as text, alike in lines, tables and pictures: FULL edges, as a ruler measures them, and how sure they are.

Lengths come in metres and are printed in millimetres; those of an orthographic image are shares of the unit cube.
"""

from __future__ import annotations

import math
from collections.abc import Iterable


def edges(size: Iterable[float], sigma_size: Iterable[float], is_cube: bool) -> str:
    """``480 x 196 x 214 mm (+-5 +-11 +-7)`` of half sizes and their standard deviations, NaN where unknown."""
    lengths = " x ".join(_length(2 * half, is_cube, 10) for half in size)
    unit = "of the cube" if is_cube else "mm"
    doubts = [f"+-{_length(2 * sigma, is_cube, 1)}" if math.isfinite(sigma) else "+-?" for sigma in sigma_size]
    return f"{lengths} {unit}" + ("" if set(doubts) == {"+-?"} else f" ({' '.join(doubts)})")


def place(translation: Iterable[float], is_cube: bool) -> str:
    """``0.12 0.03 0.84 m``: a centre."""
    return " ".join(f"{value:.2f}" for value in translation) + ("" if is_cube else " m")


def _length(metres: float, is_cube: bool, whole: int) -> str:
    """To a millimetre, or thousandth of the cube; to a tenth below so many of them."""
    digits = 0 if 1e3 * metres >= whole else 1
    return f"{metres:.{3 + digits}f}" if is_cube else f"{1e3 * metres:.{digits}f}"
