"""Closing two flat jaws on a superquadric: widths, contacts and their uncertainty, in closed form.

A body with the support function h and the centre t spans along a unit direction n from n.t - h(n) to n.t + h(n): the
opening for jaws that close along n is 2 h(n).  A superquadric is centrally symmetric, so the chord through c + t
along n leaves it at two points; both lie in the friction cone of the jaws if the normals there are within atan(mu)
of +-n.  Along the axes this holds exactly, and for a round body in the whole circle around its axis.  The candidates
are the axes and twelve directions in each plane of two axes.

The variance of a reach E(n) = n.t + h(n) follows from the covariance C of the body to first order,

    sigma^2 = g^T C g,   g = dE / d(a1 a2 a3, t, w) = (|m| dh/d(a |m|), n, p x m),

with m = R^T n, p the body's point farthest along m and w the turn in the body's frame.  Along the axes E does not
depend on the exponents; in other directions that small effect is neglected.

Metres, in the frame of the bodies.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from sq_perception.geometry.kernels import gauge_derivatives, kernel, support_derivatives
from sq_perception.geometry.superquadric import Superquadric, nested_norm_and_slopes

UNKNOWN = 0.1  # default standard deviation, as a share of a half size


def _directions() -> np.ndarray:
    """Return (33, 3) closing directions in a body's frame, one of each opposite pair."""
    found = [np.eye(3)]
    for first, second in ((0, 1), (0, 2), (1, 2)):
        angle = np.delete(np.arange(12), 6)[1:] * (np.pi / 12)
        found.append(np.outer(np.cos(angle), np.eye(3)[first]) + np.outer(np.sin(angle), np.eye(3)[second]))
    return np.concatenate(found)


DIRECTIONS = _directions()


@dataclass(frozen=True, eq=False)
class KnownBodies:
    """n bodies with their uncertainty."""

    flat: np.ndarray  # (n, 14), parameters with tapers
    turns: np.ndarray  # (n, 3, 3), rotation matrices
    covariance: np.ndarray  # (n, 9, 9), of sizes, centre and turn

    @classmethod
    def of(cls, bodies: Superquadric, covariance: np.ndarray | None) -> KnownBodies:
        """Make them of a NumPy batch (n,) and covariances (n, 11, 11); an unknown variance becomes a wide guess."""
        flat = np.ascontiguousarray(bodies.to_numbers(), dtype=float)
        turns = np.ascontiguousarray(bodies.rotation_matrix)
        wide = np.zeros((len(flat), 9))
        wide[:, :3] = UNKNOWN * bodies.size
        wide[:, 3:6] = UNKNOWN * bodies.size.mean(axis=1, keepdims=True)
        wide[:, 6:] = UNKNOWN
        guess = wide[:, :, None] ** 2 * np.eye(9)
        if covariance is None:
            return cls(flat, turns, guess)
        given = np.asarray(covariance, dtype=float)
        if given.shape != (len(flat), 11, 11):
            raise ValueError(f"covariance: expected shape ({len(flat)}, 11, 11), got {given.shape}")
        given = np.delete(np.delete(given, [3, 4], axis=1), [3, 4], axis=2)  # without the exponents
        variance = np.diagonal(given, axis1=1, axis2=2)
        known = np.isfinite(variance) & (variance >= 0)
        given = np.where(known[:, :, None] & known[:, None, :], given, guess)
        sound = np.isfinite(given).all(axis=(1, 2))
        return cls(flat, turns, np.where(sound[:, None, None], given, guess))

    def __len__(self) -> int:
        return len(self.flat)

    @property
    def middle(self) -> np.ndarray:
        """Centres (n, 3)."""
        return self.flat[:, 5:8]

    def in_place(self) -> KnownBodies:
        """Return the bodies with centres that are known exactly."""
        covariance = self.covariance.copy()
        covariance[:, 3:6] = covariance[:, :, 3:6] = 0.0
        return replace(self, covariance=covariance)

    def reaches(self, owner: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return h(n) (k,) and the sigma (k,) of n.t + h(n), for bodies ``owner`` (k,) and directions (k, 3)."""
        return _reaches(self.flat, self.turns, self.covariance, owner, directions)

    def middle_angles(self, owner: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return the angle (k,) between directions (k, 3) and the normals where central lines along them leave.

        Tapers are left out of account: without them the gauge has the same gradient all along such a line.
        """
        size, e1, e2 = self.flat[owner, :3], self.flat[owner, 3], self.flat[owner, 4]
        q = np.abs((directions[:, None] @ self.turns[owner])[:, 0]) / size
        value, slopes = nested_norm_and_slopes(q[:, 0], q[:, 1], q[:, 2], e1, e2)
        steepness = np.linalg.norm(np.stack(slopes, axis=1) / size, axis=1)
        return np.asarray(np.arccos(np.clip(value / steepness, -1.0, 1.0)))

    def chords(
        self, owner: np.ndarray, offset: np.ndarray, direction: np.ndarray, steepest: float = np.pi
    ) -> tuple[np.ndarray, np.ndarray]:
        """Find where the line through t + offset (k, 3) along direction (k, 3) leaves body ``owner``, and how squarely.

        Returns the distances (k, 2) along +direction and against it from the offset, NaN where the line misses the
        body, and the larger angle (k,) to the normals at both ends, NaN likewise and above ``steepest`` radians.
        """
        ends, cosine = np.empty((2, len(owner))), np.empty((2, len(owner)))
        least = np.cos(steepest)
        starts = np.flatnonzero(np.diff(owner, prepend=-1, append=-1))
        for first, last in pairwise(starts):
            body, rows = owner[first], slice(first, last)
            ends[:, rows], cosine[:, rows] = _chords(
                self.flat[body], self.turns[body], offset[rows], direction[rows], least
            )
        lower = cosine.min(axis=0)
        return ends.T, np.arccos(np.clip(np.where(lower >= least, lower, np.nan), -1.0, 1.0))


@kernel
def _reaches(
    flat: np.ndarray, turns: np.ndarray, covariance: np.ndarray, owner: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    reach, sigma = np.empty(len(owner)), np.empty(len(owner))
    m, farthest, gradient = np.empty(3), np.empty(3), np.empty(9)
    for k in range(len(owner)):
        body, n = flat[owner[k]], directions[k]
        for i in range(3):
            m[i] = n[0] * turns[owner[k], 0, i] + n[1] * turns[owner[k], 1, i] + n[2] * turns[owner[k], 2, i]
        a1, a2, a3, e1, e2, k1, k2 = body[0], body[1], body[2], body[3], body[4], body[12], body[13]
        reach[k], x, y, z, _, _, _, _ = support_derivatives(m[0], m[1], m[2], a1, a2, a3, e1, e2, k1, k2)
        farthest[0], farthest[1], farthest[2] = x, y, z
        for i in range(3):
            gradient[i] = farthest[i] * m[i] / body[i]
            gradient[3 + i] = n[i]
        gradient[6] = farthest[1] * m[2] - farthest[2] * m[1]
        gradient[7] = farthest[2] * m[0] - farthest[0] * m[2]
        gradient[8] = farthest[0] * m[1] - farthest[1] * m[0]
        variance = 0.0
        for i in range(9):
            half = 0.5 * covariance[owner[k], i, i] * gradient[i]
            for j in range(i):
                half += covariance[owner[k], i, j] * gradient[j]
            variance += 2 * half * gradient[i]
        sigma[k] = math.sqrt(max(variance, 0.0))
    return reach, sigma


@kernel
def _chords(
    body: np.ndarray, turn: np.ndarray, offset: np.ndarray, direction: np.ndarray, least: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return ends and cosines (2, k) of one body's chords; second ends only where the first cosine is large enough."""
    at, way = np.empty((3, len(offset))), np.empty((3, len(offset)))
    for k in range(len(offset)):
        for i in range(3):
            at[i, k] = offset[k, 0] * turn[0, i] + offset[k, 1] * turn[1, i] + offset[k, 2] * turn[2, i]
            way[i, k] = direction[k, 0] * turn[0, i] + direction[k, 1] * turn[1, i] + direction[k, 2] * turn[2, i]
    ends, cosine = np.full((2, len(offset)), np.nan), np.full((2, len(offset)), np.nan)
    _leave(body, at, way, ends[0], cosine[0])
    square = np.flatnonzero(cosine[0] >= least)
    run, cosine_there = np.empty(len(square)), np.empty(len(square))
    _leave(body, at[:, square], -way[:, square], run, cosine_there)
    ends[1, square], cosine[1, square] = run, cosine_there
    return ends, cosine


@kernel
def _leave(body: np.ndarray, at: np.ndarray, way: np.ndarray, run: np.ndarray, cosine: np.ndarray) -> None:
    """Return where lines from at (3, k) along way (3, k) leave a body, in its frame, and the cosine to the normal, by
    Newton's method from the box around it; loops over all lines without a branch, for vector code."""
    a1, a2, a3, e1, e2, k1, k2 = body[0], body[1], body[2], body[3], body[4], body[12], body[13]
    half = a1 * (1.0 + abs(k1)), a2 * (1.0 + abs(k2)), a3
    x, y, z = at[0], at[1], at[2]
    u, v, w = way[0], way[1], way[2]
    for k in range(len(run)):
        run[k] = np.inf
        for i in range(3):
            if way[i, k] != 0.0:
                run[k] = min(run[k], (half[i] - at[i, k] * np.sign(way[i, k])) / abs(way[i, k]))
        run[k] = max(run[k], 0.0)
    for _ in range(4):
        for k in range(len(run)):
            t = run[k]
            value, g_x, g_y, g_z, _, _, _, _ = gauge_derivatives(
                x[k] + t * u[k], y[k] + t * v[k], z[k] + t * w[k], a1, a2, a3, e1, e2, k1, k2
            )
            slope = g_x * u[k] + g_y * v[k] + g_z * w[k]
            run[k] = t - (value - 1.0) / (slope if slope > 1e-12 else np.nan)  # flatter lines do not leave it
    for k in range(len(run)):
        t = run[k]
        _, g_x, g_y, g_z, _, _, _, _ = gauge_derivatives(
            x[k] + t * u[k], y[k] + t * v[k], z[k] + t * w[k], a1, a2, a3, e1, e2, k1, k2
        )
        slope = g_x * u[k] + g_y * v[k] + g_z * w[k]
        cosine[k] = slope / math.sqrt(g_x * g_x + g_y * g_y + g_z * g_z)
