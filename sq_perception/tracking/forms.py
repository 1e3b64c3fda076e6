"""Which of the parameter vectors of one body continues a track.

The 24 turns T of a cube onto itself rename the axes of a body: R -> R T, sizes change places, a rotation vector w of
the body's frame becomes T^T w.  The 8 that leave z on its line describe the same body (its equivalent forms).  The
other 16 exchange z with x or y.  They describe the same body only where e1 = e2, and nearly so where both are alike:
of the three principal cross sections of a body xy is rounded by e2, yz and zx by e1.  After the exchange of z with x
the section yz has become xy, and the two others have to share one exponent, so that

    e2' = e1,    e1' = (e1 + e2) / 2,

wrong by (e1 - e2) / 2 in each of the two.  A box whose roundings differ by less than the noise is therefore fitted
now with this axis as z and now with that one.  Such an exchange is undone where |e1 - e2| is below a limit, with the
variances

    (e1 - e2)^2 on the exponents,    (0.1 (e1 - e2) a)^2 on the sizes a

added to what was observed.  Candidates are compared by their likelihood, d^2 + log det S, so that an exchange has to
earn its wider covariance.
"""

from __future__ import annotations

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.tracking import state
from sq_perception.tracking.state import LENGTH, SHAPE, SIZE, SIZE_AND_SHAPE, TURN

EXCHANGE = 0.5
"""Largest |e1 - e2| for which z may change places with x or y.  Chosen: the exponents of fitted boxes and ovals differ
by less, a cylinder's by more.  In 1400 looks at bodies that stood still tracks exchanged axes 4 times with 0.3, never
with 0.4 to 2."""
_SHORTLIST = 4
"""Forms compared with their whole covariances; the others are farther off already by their variances."""
_SIZE_PER_SHAPE = 0.1
"""Deviation of the sizes, as a share, after an exchange, for each |e1 - e2|; see the module.  Chosen."""
_SAME_NAME = np.pi / 4
"""Radians: nearer to an axis than to any other one."""
_SELDOM_TURNED = 2 * np.log(100)
"""Cost in d^2 + log det S: of the bodies that a frame shows, a hand has turned fewer than one in a hundred so far."""


def _turns() -> np.ndarray:
    """The 24 rotation matrices with entries 0 and +-1, the 8 that leave z on its line first."""
    found = []
    for order in ((0, 1, 2), (1, 0, 2), (0, 2, 1), (2, 1, 0), (1, 2, 0), (2, 0, 1)):
        for signs in np.ndindex(2, 2, 2):
            turn = np.eye(3)[:, list(order)] * (1 - 2 * np.array(signs))
            if np.linalg.det(turn) > 0:
                found.append(turn)
    return np.array(found)


TURNS = _turns()
EXACT = 8
"""The number of turns that describe the same body; the others need its exponents exchanged."""
_QUATERNIONS = quaternions.from_matrix(TURNS)


def _changes() -> np.ndarray:
    changes = np.zeros((len(TURNS), LENGTH, LENGTH))
    changes[:, range(3, 8), range(3, 8)] = 1
    changes[:, SIZE, SIZE] = np.abs(TURNS).transpose(0, 2, 1)
    changes[:, TURN, TURN] = TURNS.transpose(0, 2, 1)
    changes[EXACT:, SHAPE, SHAPE] = [[0.5, 0.5], [1.0, 0.0]]
    return changes


_CHANGES = _changes()


def candidates(observed: np.ndarray) -> np.ndarray:
    """All 24 forms (..., 24, 12) of states (..., 12)."""
    shape = np.broadcast_to(observed[..., None, 3:5], (*observed.shape[:-1], len(TURNS), 2))
    return np.concatenate(
        [
            np.einsum("kij,...j->...ki", _CHANGES[:, SIZE, SIZE], observed[..., 0:3]),
            np.einsum("kij,...kj->...ki", _CHANGES[:, SHAPE, SHAPE], shape),
            np.broadcast_to(observed[..., None, 5:8], (*shape.shape[:-1], 3)),
            quaternions.multiply(observed[..., None, 8:12], _QUATERNIONS),
        ],
        axis=-1,
    )


def _added(observed: np.ndarray, forms: np.ndarray) -> np.ndarray:
    """Variances (..., k, 11) that an exchange of z adds to forms (..., k, 12) of observations (..., 12)."""
    unlike = np.abs(observed[..., 3] - observed[..., 4])[..., None, None]
    added = np.zeros((*forms.shape[:-1], LENGTH))
    added[..., SIZE] = (_SIZE_PER_SHAPE * unlike * forms[..., SIZE]) ** 2
    added[..., SHAPE] = unlike**2
    return added


def nearest(
    track: np.ndarray, track_covariance: np.ndarray, observed: np.ndarray, covariance: np.ndarray, exchange: float
) -> tuple[np.ndarray, np.ndarray]:
    """Each of n observations in the form that continues its track: states (n, 12) and covariances (n, 11, 11).

    Parameters
    ----------
    track, observed : (n, 12)
    track_covariance, covariance : (n, 11, 11)
        World frame.
    exchange
        Largest |e1 - e2| for which z may change places with x or y.
    """
    count = len(track)
    forms = candidates(observed)
    errors = state.difference(track[:, None], forms)
    added = _added(observed, forms)

    own = np.einsum("nii->ni", covariance)
    variances = np.einsum("kij,nj->nki", _CHANGES**2, own) + np.einsum("nii->ni", track_covariance)[:, None]
    variances[:, EXACT:] += added[:, EXACT:]
    rough = (errors**2 / variances + np.log(variances)).sum(axis=-1)
    rough[:, EXACT:][np.abs(observed[:, 3] - observed[:, 4]) > exchange] = np.inf

    some = np.argpartition(rough, _SHORTLIST - 1, axis=1)[:, :_SHORTLIST]
    row = np.arange(count)[:, None]
    changes = _CHANGES[some]
    changed = changes @ covariance[:, None] @ changes.swapaxes(-1, -2)
    changed[..., range(LENGTH), range(LENGTH)] += np.where(some[..., None] >= EXACT, added[row, some], 0)
    total = changed + track_covariance[:, None]
    cost = state.mahalanobis(total, errors[row, some]) + np.linalg.slogdet(total)[1]
    cost = np.where(np.isfinite(rough[row, some]), cost, np.inf)
    best = np.argmin(cost, axis=1)
    each = np.arange(count)
    return forms[each, some[each, best]], changed[each, best]


def named(
    track: np.ndarray, track_covariance: np.ndarray, observed: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """An observation (12,) that its track does not follow, and its covariance, with the axes named as the track's.

    An exact form with axes within 45 degrees of those of the same names is taken.  Otherwise either the fit has taken
    another axis as z, or somebody has turned the body.  Sizes and exponents decide: those of the exchange that
    keeps the names against those of the exact forms, whatever their turn.  Where they are alike, as for a cube, the
    names are kept.  The turn about an axis that the observation leaves open, as something round does, is the track's.
    """
    form, changed = _form(track, track_covariance, observed, covariance)
    is_open = np.diag(changed)[TURN] > state.DETERMINED**2
    turn = np.where(is_open, state.difference(form, track)[TURN], 0)
    return np.append(form[:8], quaternions.multiply(form[8:], quaternions.from_rotation_vector(turn))), changed


def _form(
    track: np.ndarray, track_covariance: np.ndarray, observed: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The result of :func:`named`, before open turns."""
    (exact,), (known,) = nearest(track[None], track_covariance[None], observed[None], covariance[None], exchange=0.0)
    if np.linalg.norm(state.difference(track, exact)[TURN]) <= _SAME_NAME:
        return exact, known
    forms = candidates(observed)
    errors = state.difference(track, forms)
    changed = _CHANGES @ covariance @ _CHANGES.swapaxes(-1, -2)
    changed[EXACT:, range(LENGTH), range(LENGTH)] += _added(observed, forms)[EXACT:]
    total = (changed + track_covariance)[:, SIZE_AND_SHAPE, SIZE_AND_SHAPE]
    cost = state.mahalanobis(total, errors[:, SIZE_AND_SHAPE]) + np.linalg.slogdet(total)[1]
    keeps = np.linalg.norm(errors[:, TURN], axis=-1) <= _SAME_NAME
    keeps[:EXACT] = False
    best = int(np.argmin(np.where(keeps, cost, np.inf)))
    if not keeps[best] or cost[best] > cost[:EXACT].min() + _SELDOM_TURNED:
        return exact, known
    return forms[best], changed[best]
