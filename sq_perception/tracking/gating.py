"""Whether an observation agrees with its track, and in what it does not.

With the error e = z - x^ and S, the sum of both covariances, an observation agrees if

    e^T S^-1 e < chi2_11(0.999)

and neither its centre nor its rotation alone lies outside of chi2_3(0.999) by more than what no one would call motion.

Errors common to several views are in the estimate and in the observation and cancel in e, so that for views from one
side S is up to 2.5 times too large: a margin for fits whose errors exceed what they report.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sq_perception.tracking import state
from sq_perception.tracking.state import CENTRE, LENGTH, SIZE_AND_SHAPE, TURN

LIMITS = {3: 16.266236196238125, 5: 20.515005652432876, LENGTH: 31.26413362023999}
"""chi-squared numbers of so many dimensions stay below with probability 0.999.  Chosen: one good observation in 1000 is
doubted."""
STILL_SHARE = 0.05
"""No motion: displacements below this share of the mean half size, and rotations below so many radians.  Chosen: one or
two millimetres of a household thing, 3 degrees."""


class Agreement(NamedTuple):
    """How n observations agree with their tracks, arrays (n,)."""

    agrees: np.ndarray
    fits: np.ndarray  # in sizes and exponents; agrees: as a whole
    slid: np.ndarray
    turned: np.ndarray  # the rotation is elsewhere; slid: the centre
    excess: np.ndarray  # e^T S^-1 e over its limit, at least 1


def compare(size: np.ndarray, total: np.ndarray, error: np.ndarray) -> Agreement:
    """The agreement of errors (n, 11) with covariances S (n, 11, 11), of bodies with half sizes (n, 3)."""

    def is_outside(part: slice) -> np.ndarray:
        return state.mahalanobis(total[:, part, part], error[:, part]) > LIMITS[part.stop - part.start]

    slid = is_outside(CENTRE) & (np.linalg.norm(error[:, CENTRE], axis=-1) > STILL_SHARE * size.mean(axis=-1))
    turned = is_outside(TURN) & (np.linalg.norm(error[:, TURN], axis=-1) > STILL_SHARE)
    excess = state.mahalanobis(total, error) / LIMITS[LENGTH]
    return Agreement((excess <= 1) & ~slid & ~turned, ~is_outside(SIZE_AND_SHAPE), slid, turned, np.maximum(excess, 1))


def same_side(before: np.ndarray, now: np.ndarray) -> bool:
    """Whether two vectors are less than 60 degrees apart; False for zero."""
    return bool(before @ now > 0.5 * np.linalg.norm(before) * np.linalg.norm(now))
