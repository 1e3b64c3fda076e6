"""The terms of a fit's cost: losses, stiffnesses, and what is known beyond the image."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Terms(NamedTuple):
    """Constants of the residuals; see :mod:`sq_perception.fitting.residuals` and :mod:`sq_perception.fitting.priors`.

    Points that lie inside the body, behind its surface, count by Cauchy's loss of scale ``inner_cauchy`` if that is
    not 0, all others by Huber's.  A rendered depth is found by Newton's method until |g - 1| < ``hit_tolerance``,
    then in first order. Rendered residuals up to ``dead_zone`` noise levels count as 0: what rounding may do.
    ``outline_stiffness`` is 1/sigma_o; ``plane`` is n and d of n.x + d = height, ``expected`` three half sizes; a
    stiffness or price of 0 switches its term off.  The rows of ``hull_directions`` are n_j, of ``hull_root`` those of
    W; no rows switch that term off.
    """

    huber: float = 3.0
    inner_cauchy: float = 0.0
    outline_huber: float = 3.0
    grazing: float = 0.01
    hit_tolerance: float = 1e-4
    dead_zone: float = 0.0
    outline_stiffness: float = 1.0
    pinhole: float = 0.0
    plane: np.ndarray = np.zeros(4)
    plane_stiffness: float = 0.0
    gap_stiffness: float = 0.0
    rest_stiffness: float = 0.0
    proportion_stiffness: float = 0.0
    roundness_stiffness: float = 0.0
    expected: np.ndarray = np.ones(3)
    expectation_stiffness: float = 0.0
    volume_price: float = 0.0
    hull_directions: np.ndarray = np.empty((0, 3))
    hull_support: np.ndarray = np.empty(0)
    hull_root: np.ndarray = np.empty((0, 0))
