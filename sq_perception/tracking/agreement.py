"""Whether an observation agrees with its track, and in what it does not.

With the error e = z - x^ and S, the covariances of both added as if they erred apart, an observation agrees if

    e^T S^-1 e < chi2_11(0.999)

and neither its centre nor its rotation alone is outside of chi2_3(0.999).  A centre or a rotation that is, by more than
errors of no importance, has strayed.

Errors that views have in common are in both, the estimate and the observation, and cancel in e.  So for views from one
side S is up to 2.5 times too large, and strays are noticed later than they could be.  That is a margin for fits whose
errors are larger than they say: if observations err twice as much as they say, then with the S of
:mod:`~sq_perception.tracking.fusion` resting bodies move in 9 % of the frames instead of 1 %, and sizes after forty
frames err by 1.7 % instead of 0.7 %.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sq_perception.tracking import state
from sq_perception.tracking.state import CENTRE, LENGTH, SIZE_AND_SHAPE, TURN

LIMITS = {3: 16.266236196238125, 5: 20.515005652432876, LENGTH: 31.26413362023999}
"""What a chi-squared number of so many dimensions stays below with probability 0.999.  Chosen: one good observation in
1000 is doubted."""
STILL_SHARE = 0.05
"""Displacements below this share of the mean half size, and turns below so many radians, are no motion.
Chosen: a millimetre or two of a household thing, and 3 degrees."""


class Agreement(NamedTuple):
    """How n observations agree with their tracks; all (n,).

    ``agrees`` as a whole, ``fits`` in sizes and exponents, ``slid`` or ``turned``, if centre or rotation strayed: bool.
    ``excess`` is e^T S^-1 e over its limit, at least 1.
    """

    agrees: np.ndarray
    fits: np.ndarray
    slid: np.ndarray
    turned: np.ndarray
    excess: np.ndarray


def compared(size: np.ndarray, total: np.ndarray, error: np.ndarray) -> Agreement:
    """The agreement of errors (n, 11) with their covariances (n, 11, 11); bodies with half sizes (n, 3)."""

    def outside(part: slice) -> np.ndarray:
        return state.mahalanobis(total[:, part, part], error[:, part]) > LIMITS[part.stop - part.start]

    slid = outside(CENTRE) & (np.linalg.norm(error[:, CENTRE], axis=-1) > STILL_SHARE * size.mean(axis=-1))
    turned = outside(TURN) & (np.linalg.norm(error[:, TURN], axis=-1) > STILL_SHARE)
    excess = state.mahalanobis(total, error) / LIMITS[LENGTH]
    agrees = (excess <= 1) & ~slid & ~turned
    return Agreement(agrees, ~outside(SIZE_AND_SHAPE), slid, turned, np.maximum(excess, 1))


def same_side(before: np.ndarray, now: np.ndarray) -> bool:
    """Whether two vectors are less than 60 degrees apart; zero is apart from everything."""
    return bool(before @ now > 0.5 * np.linalg.norm(before) * np.linalg.norm(now))
