"""Training data drawn and rendered on the fly: bodies of the thesis' protocol in their canonical views.

Protocol (thesis, chapter 5.1, in the unit cube): half sizes a in [25, 75] / 255, exponents e in [0.1, 1], centre at
(128 +- 40) / 255, rotations uniform, depth in 255 integer steps.
"""

from __future__ import annotations

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.canonical_view import render_views

GREY_LEVELS = 255.0
SIZE_RANGE = (25 / GREY_LEVELS, 75 / GREY_LEVELS)
SHAPE_RANGE = (0.1, 1.0)
TRANSLATION_RANGE = (88 / GREY_LEVELS, 168 / GREY_LEVELS)


def draw_bodies(count: int, rng: np.random.Generator) -> Superquadric:
    """A batch (count,) of bodies of the thesis' protocol in the cube frame."""
    return Superquadric(
        rng.uniform(*SIZE_RANGE, (count, 3)),
        rng.uniform(*SHAPE_RANGE, (count, 2)),
        rng.uniform(*TRANSLATION_RANGE, (count, 3)),
        quaternions.random(count, rng),
    )


def draw_views(count: int, rng: np.random.Generator, pixels: int = 64) -> tuple[np.ndarray, Superquadric]:
    """Views (count, pixels, pixels) of freshly drawn bodies, and the bodies (count,) in the views' frames."""
    return render_views(draw_bodies(count, rng), pixels, np.full(count, GREY_LEVELS))
