"""The state of a tracked body, its error, and covariances of it.

A state is the flat parameter vector (12,) of a superquadric in the world frame.  Its error has 11 dimensions,

    a1, a2, a3,  e1, e2,  t1, t2, t3 (world),  w1, w2, w3 (rotation vector in the body's own frame),

and x + d has the sizes a + d_a, the exponents e + d_e, the centre t + d_t and the rotation R exp([d_w]).  Sizes are in
metres, as in the fit's covariance, and not in logarithms: the centre of something flat that is seen from above moves by
what its thickness changes, which is linear in metres alone.  All functions take leading batch dimensions.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric

LENGTH = 11
SIZE, SHAPE, CENTRE, TURN = slice(0, 3), slice(3, 5), slice(5, 8), slice(8, 11)
SIZE_AND_SHAPE, POSE = slice(0, 5), slice(5, 11)
HAND = 1.0  # metres, and radians, that a hand moves a thing in a second at most.  Chosen: it sets things down.
DETERMINED = 0.2
"""Standard deviation in radians up to which a rotation about an axis counts as measured.  Chosen: three of them stay
below the 45 degrees at which another axis of the body is nearer."""
_LIMITS = np.array([[1e-3] * 3 + [0.01] * 2, [np.inf] * 3 + [2.0] * 2])
"""Least and greatest sizes (metres) and exponents that a correction leaves; bodies are convex up to exponents of 2."""


class Observed(Protocol):
    """What the tracker needs of a body in one frame; :class:`~sq_perception.recovery.recoverer.Recovery` has it.

    ``superquadric`` is a single body in the optical frame and ``covariance`` (11, 11) that of its error, NaN where
    unknown.  ``is_predicted``: a network's prediction is part of it, whose error is much the same from every side.
    ``repeats`` > 0: the answer was given for an earlier frame whose readings differ by noise alone; its error is the
    same again.  ``seen`` (3,) is the share of each size that the measured points span.
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
    """The error (..., 11) of one state (..., 12) against another: ``add(state, difference(state, other))`` is other."""
    turn = quaternions.multiply(quaternions.conjugate(state[..., 8:12]), other[..., 8:12])
    return np.concatenate([other[..., 0:8] - state[..., 0:8], quaternions.to_rotation_vector(turn)], axis=-1)


def add(state: np.ndarray, error: np.ndarray) -> np.ndarray:
    """The state (..., 12) plus an error (..., 11); sizes stay positive, exponents within (0, 2]."""
    turn = quaternions.from_rotation_vector(error[..., TURN])
    rotation = quaternions.normalize(quaternions.multiply(state[..., 8:12], turn))
    size_and_shape = np.clip(state[..., 0:5] + error[..., SIZE_AND_SHAPE], *_LIMITS)
    return np.concatenate([size_and_shape, state[..., 5:8] + error[..., CENTRE], rotation], axis=-1)


def scale_sizes(covariance: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Covariances (..., 11, 11) with errors of size as shares of the sizes (..., 3) -> in metres."""
    scale = np.concatenate([size, np.ones((*size.shape[:-1], LENGTH - 3))], axis=-1)
    return np.asarray(scale[..., :, None] * covariance * scale[..., None, :])


def rotate(covariance: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Covariances (..., 11, 11) in a frame that is rotated, p_new = matrix (3, 3) p."""
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


def parse_pose(pose: object) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (4,), a quaternion x y z w, and translation (3,) of a 4 x 4 matrix or a pair of them; None: identity.
    Raises ValueError for anything else, numbers that are not finite, or a matrix that is no rigid motion."""
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
