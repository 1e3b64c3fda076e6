"""The state of a tracked body and the errors it is measured in.

State and error
---------------
A state is the flat parameter vector (12,) of a superquadric in the world frame.  Its error lives in the 11 dimensions

    a1, a2, a3,  e1, e2,  t1, t2, t3 (world),  w1, w2, w3 (rotation vector in the body's own frame)

so that x + d has the sizes a + d_a, the exponents e + d_e, the centre t + d_t and the rotation R exp([d_w]).  Sizes are
in metres as the fits' are, and not in logarithms: that something flat is twice as thick moves its centre by its
thickness, and in logarithms that is another motion for each thickness that an observation takes it to have.  In the
body's frame a turn of the world changes no number of the rotation.  Every function takes leading batch dimensions.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric

LENGTH = 11
SIZE, SHAPE, CENTRE, TURN = slice(0, 3), slice(3, 5), slice(5, 8), slice(8, 11)
SIZE_AND_SHAPE, POSE = slice(0, 5), slice(5, 11)
"""Parts of the error."""
DETERMINED = 0.2
"""Radians: a turn about an axis whose standard deviation is larger is not determined by an observation.  Chosen:
three of them reach the next axis of a cube, and fewer another side of the body."""
_LEFT = 0.1
"""Share of a size that a correction leaves at least.  Chosen."""
_SHAPE_LIMITS = (0.01, 2.0)
"""Exponents: down to where the gauge was tried, up to where bodies are convex (:mod:`geometry.superquadric`)."""


class Observed(Protocol):
    """What the tracker reads of a body of one frame, as :class:`~sq_perception.recovery.recoverer.Recovery` is.

    ``superquadric`` is a single body in the optical frame.  ``covariance`` is (11, 11), of a1 a2 a3 e1 e2 t1 t2 t3 and
    the rotation vector in the object frame, metres and radians; NaN where unknown.  ``is_predicted`` tells that much of
    it is a prediction's, which errs alike from everywhere.  ``repeats`` is above 0 for an answer that was given before,
    of readings that are the same but for noise: its error is the same, too.  ``seen`` (3,) is the share, 0 to 1, of
    each size that the measured points span.
    """

    @property
    def superquadric(self) -> Superquadric: ...

    @property
    def covariance(self) -> np.ndarray: ...

    @property
    def is_predicted(self) -> bool: ...

    @property
    def repeats(self) -> int: ...

    @property
    def seen(self) -> np.ndarray: ...


def difference(state: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The error (..., 11) that leads from one state (..., 12) to another."""
    turn = quaternions.multiply(quaternions.conjugate(state[..., 8:12]), other[..., 8:12])
    return np.concatenate(
        [
            other[..., 0:8] - state[..., 0:8],
            quaternions.to_rotation_vector(turn),
        ],
        axis=-1,
    )


def moved(state: np.ndarray, error: np.ndarray) -> np.ndarray:
    """The state (..., 12) at the end of an error (..., 11); sizes stay above 0, exponents within (0, 2]."""
    turn = quaternions.from_rotation_vector(error[..., TURN])
    return np.concatenate(
        [
            np.maximum(state[..., 0:3] + error[..., SIZE], _LEFT * state[..., 0:3]),
            np.clip(state[..., 3:5] + error[..., SHAPE], *_SHAPE_LIMITS),
            state[..., 5:8] + error[..., CENTRE],
            quaternions.normalize(quaternions.multiply(state[..., 8:12], turn)),
        ],
        axis=-1,
    )


def in_metres(covariance: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Covariances (..., 11, 11) of errors in shares of the sizes (..., 3) -> of errors in metres."""
    scale = np.concatenate([size, np.ones((*size.shape[:-1], LENGTH - 3))], axis=-1)
    return np.asarray(scale[..., :, None] * covariance * scale[..., None, :])


def turned(covariance: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Covariances (..., 11, 11) of bodies in one frame -> in a frame that is turned, p_new = matrix (3, 3) p."""
    change = np.eye(LENGTH)
    change[CENTRE, CENTRE] = matrix
    return change @ covariance @ change.T


def mahalanobis(covariance: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Squared Mahalanobis distance (...) of errors (..., n) with covariances (..., n, n)."""
    solved = np.linalg.solve(covariance, error[..., None])[..., 0]
    return np.einsum("...i,...i->...", error, solved)


def diagonal(size: float, shape: float, centre: float, turn: float) -> np.ndarray:
    """(11, 11) covariance of independent errors with these standard deviations."""
    return np.diag(np.square([size] * 3 + [shape] * 2 + [centre] * 3 + [turn] * 3))


def as_pose(pose: object) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (4,), a quaternion x y z w, and translation (3,) of a pose.

    ``pose`` is a 4 x 4 matrix or a pair (quaternion, translation); None is the identity.

    Raises
    ------
    ValueError
        For anything else, numbers that are not finite, or a matrix that is no rigid motion.
    """
    if pose is None:
        return np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3)
    if isinstance(pose, tuple | list) and len(pose) == 2:
        quaternion, translation = (np.asarray(part, dtype=float) for part in pose)
        if quaternion.shape != (4,) or translation.shape != (3,):
            raise ValueError(f"camera_pose: expected shapes (4,) and (3,), got {quaternion.shape}, {translation.shape}")
        if not (np.isfinite(quaternion).all() and np.isfinite(translation).all() and np.linalg.norm(quaternion) > 1e-9):
            raise ValueError(f"camera_pose: expected a finite rotation and translation, got {pose}")
        return quaternions.normalize(quaternion), translation
    matrix = np.asarray(pose, dtype=float)
    if matrix.shape != (4, 4):
        raise ValueError(f"camera_pose: expected a 4 x 4 matrix or (quaternion, translation), got {matrix.shape}")
    rotation = matrix[:3, :3]
    rigid = np.isfinite(matrix).all() and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-5)
    if not rigid or np.linalg.det(rotation) < 0 or not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-9):
        raise ValueError(f"camera_pose: expected a rigid motion, got {matrix.tolist()}")
    return quaternions.from_matrix(rotation), matrix[:3, 3]
