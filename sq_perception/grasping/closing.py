"""Where two flat jaws may close on a superquadric: widths, contacts and how sure they are, in closed form.

A body with the support function h and the centre t spans along a unit direction n from n.t - h(n) to n.t + h(n): the
opening for jaws that close along n is 2 h(n).  A superquadric is centrally symmetric, so that the chord through c + t
along n leaves it at two points; both lie in the friction cone of jaws that close along n where the normals there are
no farther than atan(mu) from +-n.  Along the axes this is so exactly, and on a round body in the whole circle around
its axis.  Tried are the axes and twelve directions in each plane of two axes.

How sure a reach E(n) = n.t + h(n) is follows from the covariance C of the body to first order,

    sigma^2 = g^T C g,   g = dE / d(a1 a2 a3, t, w) = (|m| dh/d(a |m|), n, p x m),

with m = R^T n, p the body's point farthest along m and w the turn in the body's frame.  Along the axes E does not
depend on the exponents; beside them the little that it does is left out.

Metres, in the frame of the bodies.
"""

from __future__ import annotations

import numpy as np

from sq_perception.geometry.superquadric import Superquadric, nested_norm_and_slopes

MODEL_ERROR = 0.0025
"""Metres by which real things stray from superquadrics, as the repair of segments has it."""
UNKNOWN = 0.1
"""Of a half size: its standard deviation where a body comes without one."""
_STEP = np.pi / 12
_NEWTON_STEPS = 3
_KEPT = [0, 1, 2, 5, 6, 7, 8, 9, 10]
"""Rows of the covariance without the exponents."""


def _directions() -> np.ndarray:
    """(33, 3) closing directions in the frame of a body, one of each opposite pair."""
    found = [np.eye(3)]
    for first, second in ((0, 1), (0, 2), (1, 2)):
        angle = np.delete(np.arange(12), 6)[1:] * _STEP
        found.append(np.outer(np.cos(angle), np.eye(3)[first]) + np.outer(np.sin(angle), np.eye(3)[second]))
    return np.concatenate(found)


DIRECTIONS = _directions()


def known(bodies: Superquadric, covariance: np.ndarray | None) -> np.ndarray:
    """Covariances (n, 9, 9) of sizes, centre and turn; what is not finite is replaced by a wide guess."""
    wide = np.zeros((len(bodies), 9))
    wide[:, :3] = UNKNOWN * bodies.size
    wide[:, 3:6] = UNKNOWN * bodies.size.mean(axis=1, keepdims=True)
    wide[:, 6:] = UNKNOWN
    guess = wide[:, :, None] ** 2 * np.eye(9)
    if covariance is None:
        return guess
    given = np.asarray(covariance, dtype=float)
    if given.shape != (len(bodies), 11, 11):
        raise ValueError(f"covariance: expected shape ({len(bodies)}, 11, 11), got {given.shape}")
    given = given[:, _KEPT][:, :, _KEPT]
    sound = np.isfinite(given).all(axis=(1, 2)) & (np.diagonal(given, axis1=1, axis2=2) >= 0).all(axis=1)
    return np.where(sound[:, None, None], given, guess)


def reaches(
    bodies: Superquadric, covariance: np.ndarray, owner: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """h(n) (k,) and the standard deviation (k,) of n.t + h(n), of body ``owner`` (k,) along ``directions`` (k, 3)."""
    turn = bodies.rotation_matrix[owner]
    m = (directions[:, None] @ turn)[:, 0]
    size, shape = bodies.size[owner], bodies.shape[owner]
    q = size * np.abs(m)
    reach, slopes = nested_norm_and_slopes(q[:, 0], q[:, 1], q[:, 2], 2 - shape[:, 0], 2 - shape[:, 1])
    slope = np.stack(slopes, axis=1)
    farthest = slope * size * np.sign(m)
    gradient = np.concatenate([slope * np.abs(m), directions, np.cross(farthest, m)], axis=1)
    variance = np.einsum("ki,ki->k", (gradient[:, None] @ covariance[owner])[:, 0], gradient)
    return reach, np.sqrt(np.maximum(variance, 0.0))


def middle_angles(bodies: Superquadric, owner: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Angle (k,) between directions (k, 3) and the normals where the lines through the centre along them leave a body.

    The gradient of the gauge is the same all along such a line.
    """
    turn = bodies.rotation_matrix[owner]
    size, shape = bodies.size[owner], bodies.shape[owner]
    m = (directions[:, None] @ turn)[:, 0]
    q = np.abs(m) / size
    value, slopes = nested_norm_and_slopes(q[:, 0], q[:, 1], q[:, 2], shape[:, 0], shape[:, 1])
    steepness = np.linalg.norm(np.stack(slopes, axis=1) / size, axis=1)
    return np.asarray(np.arccos(np.clip(value / steepness, -1.0, 1.0)))


def chords(
    bodies: Superquadric, owner: np.ndarray, offset: np.ndarray, direction: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where the line through t + offset (k, 3) along direction (k, 3) leaves body ``owner``, and how squarely.

    Returns
    -------
    ends : (k, 2)
        Along +direction and against it, metres from the offset; NaN where the line misses the body.
    angle : (k,)
        The larger one between direction and the normals at both ends, radians; NaN likewise.
    """
    turn = bodies.rotation_matrix[owner]
    size, shape = bodies.size[owner], bodies.shape[owner]
    at, way = (offset[:, None] @ turn)[:, 0] / size, (direction[:, None] @ turn)[:, 0] / size
    # In units of the half sizes, from where the line leaves the box around the body: g is convex along it, and Newton's
    # steps from outside stay outside.
    sides = np.stack([np.ones(len(at)), -np.ones(len(at))], axis=1)
    with np.errstate(divide="ignore"):
        wall = (1 - sides[:, :, None] * (at * np.sign(way))[:, None]) / np.abs(way)[:, None]
    run = np.maximum(wall.min(axis=2), 0.0) * sides
    e1, e2 = shape[:, None, 0], shape[:, None, 1]
    for _ in range(_NEWTON_STEPS + 1):
        p = at[:, None] + run[..., None] * way[:, None]
        q = np.abs(p)
        value, slopes = nested_norm_and_slopes(q[..., 0], q[..., 1], q[..., 2], e1, e2)
        gradient = np.stack(slopes, axis=-1) * np.sign(p)
        slope = (gradient * way[:, None]).sum(axis=-1)
        outwards = slope * sides > 1e-12
        run = np.where(outwards, run - (value - 1) / np.where(outwards, slope, 1.0), np.nan)
    normal = gradient / size[:, None]
    cosine = slope * sides / np.linalg.norm(normal, axis=-1)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0)).max(axis=1)
    return run * sides, np.where(np.isfinite(run).all(axis=1), angle, np.nan)
