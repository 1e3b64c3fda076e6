"""Which parameter vector of an observed body continues a track.

The 24 rotations T of a cube rename a body's axes: R -> R T, sizes change places, and a rotation vector w of the body's
frame becomes T^T w.  Eight of them keep z on its line and describe the same body.  The other sixteen exchange z with x
or y.  Of the principal cross sections, xy is rounded by e2, yz and zx by e1; after the exchange of z and x the section
yz has become xy, and the other two share one exponent:

    e2' = e1,    e1' = (e1 + e2) / 2,

wrong by (e1 - e2) / 2 in each of them.  A box whose exponents differ by less than the noise is fitted now with one axis
as z and now with another.  So an exchange is a candidate too where |e1 - e2| < EXCHANGE, with the variance (e1 - e2)^2
added to both exponents.  The candidate of greatest likelihood is taken: least d^2 + log det S.
"""

from __future__ import annotations

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.tracking import state
from sq_perception.tracking.state import LENGTH, POSE, SHAPE, SIZE, TURN

EXCHANGE = 0.5
"""Chosen: the exponents of fitted boxes and ovals differ by less, those of cylinders by more."""
_HAND = 0.5
"""Standard deviation, radians, of how a body may have been rotated while its track did not follow it.  Chosen: 90
degrees cost as much as three deviations of size."""


def _rotations() -> np.ndarray:
    """The 24 rotation matrices with entries 0 and +-1, the 8 that leave z on its line first."""
    found = []
    for order in ((0, 1, 2), (1, 0, 2), (0, 2, 1), (2, 1, 0), (1, 2, 0), (2, 0, 1)):
        for signs in np.ndindex(2, 2, 2):
            turn = np.eye(3)[:, list(order)] * (1 - 2 * np.array(signs))
            if np.linalg.det(turn) > 0:
                found.append(turn)
    return np.array(found)


TURNS = _rotations()
EXACT = 8
"""The number of rotations that describe the same body."""
_QUATERNIONS = quaternions.from_matrix(TURNS)
_CHANGES = np.zeros((len(TURNS), LENGTH, LENGTH))
"""What the renaming of axes makes of an error."""
_CHANGES[:, range(3, 8), range(3, 8)] = 1
_CHANGES[:, SIZE, SIZE] = np.abs(TURNS).transpose(0, 2, 1)
_CHANGES[:, TURN, TURN] = TURNS.transpose(0, 2, 1)
_CHANGES[EXACT:, SHAPE, SHAPE] = [[0.5, 0.5], [1.0, 0.0]]


def candidates(observed: np.ndarray) -> np.ndarray:
    """All 24 forms (..., 24, 12) of states (..., 12)."""
    changed = np.einsum("kij,...j->...ki", _CHANGES[:, :8, :8], observed[..., :8])
    return np.concatenate([changed, quaternions.multiply(observed[..., None, 8:12], _QUATERNIONS)], axis=-1)


def nearest(
    track: np.ndarray, track_covariance: np.ndarray, observed: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The form of each of n observations (n, 12) that continues its track (n, 12), and its covariance (n, 11, 11).

    ``track_covariance`` and ``covariance`` are (n, 11, 11), world frame.
    """
    each = np.arange(len(track))
    unlike = np.abs(observed[:, 3] - observed[:, 4])
    is_box = unlike < EXCHANGE
    count = len(TURNS) if is_box.any() else EXACT
    forms = candidates(observed)[:, :count]
    changed = _CHANGES[:count] @ covariance[:, None] @ _CHANGES[:count].swapaxes(-1, -2)
    changed[:, EXACT:, range(3, 5), range(3, 5)] += unlike[:, None, None] ** 2
    total = changed + track_covariance[:, None]
    cost = state.mahalanobis(total, state.difference(track[:, None], forms)) + np.linalg.slogdet(total)[1]
    cost[:, EXACT:][~is_box] = np.inf
    best = np.argmin(cost, axis=1)
    return forms[each, best], changed[each, best]


def loosen_pose(covariance: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Covariances (n, 11, 11) of bodies that were carried by ``distance`` (n,) metres and may have been rotated."""
    variance = np.zeros((len(covariance), LENGTH))
    variance[:, POSE] = np.concatenate([np.tile(distance[:, None], 3), np.full((len(covariance), 3), _HAND)], axis=1)
    return covariance + variance[:, :, None] ** 2 * np.eye(LENGTH)


def rename_axes(
    track: np.ndarray, track_covariance: np.ndarray, observed: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """An observation (12,) that its track does not follow, and its covariance, with the axes named as the track's.

    The rotation about an axis that the observation leaves open, as of something round, is the track's.
    """
    distance = np.linalg.norm(observed[None, 5:8] - track[5:8], axis=-1)
    free = loosen_pose(track_covariance[None], distance)
    (form,), (changed,) = nearest(track[None], free, observed[None], covariance[None])
    is_open = np.diag(changed)[TURN] > state.DETERMINED**2
    turn = np.where(is_open, state.difference(form, track)[TURN], 0)
    return np.append(form[:8], quaternions.multiply(form[8:], quaternions.from_rotation_vector(turn))), changed
