"""Starts from central symmetry: a superquadric is its own reflection through its centre C.

Under orthographic projection the hidden half is the visible half reflected, and the silhouette's centre is the
centre's projection.  With p(u) the point seen at pixel u and u' the pixel opposite to u about the silhouette's centre,
the ray of u enters the body at p(u) and leaves it near 2 C - p(u').  So, for every pair,

    midpoint    m = (p(u) - p(u')) / 2                  (relative to C)
    half chord  h = C - (p(u) + p(u')) / 2              (must point away from the camera)

which bounds the centre's depth: z_C >= (z(u) + z(u')) / 2, with equality at the outline.  The largest of these is z_C,
and the chords together are the whole body: its second moments are M = sum |h| (m m^T + h h^T / 3) / sum |h|.

The principal axes of M are the axes of the body, up to their order: which one is z is not known, so each is tried.  A
half size is sqrt(M_kk / 0.27): the share is 0.2 for an ellipsoid, 1/3 for a box.  For pinhole cameras all this holds
approximately, the better the smaller the body against its distance; it starts an iteration.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from sq_perception.fitting import box_start
from sq_perception.fitting.box_start import principal_axes, three_orders
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.observation import Observation
from sq_perception.geometry.kernels import kernel
from sq_perception.imaging.camera import Lens
from sq_perception.imaging.lens import point_at

MOMENT_SHARE = 0.27
START_EXPONENT = 0.5
"""Both between those of an ellipsoid (0.2, 1) and of a box (1/3, 0)."""
_RANK = 4
"""The centre's depth is the largest mean depth but for this many pairs, in case of a stray pixel."""
_MOST_PAIRS = 2500
"""Enough for second moments to 2 %."""
_EIGHTH_TURN = math.pi / 4
_EXPONENTS = (0.3, 0.8)
"""Of the last starts of all: between box and ellipsoid, nearer to either."""


def groups(observation: Observation) -> Iterator[list[State]]:
    """Starts in the order in which to try them; the points' box where nothing shows the symmetry."""
    completed = completed_moments(observation)
    if completed is None:
        yield box_start.principal(observation.points)
        return
    centre, moments = completed
    axes = principal_axes(moments)
    for turned in [axes, *eighth_turns(axes)]:
        yield states(centre, moments, turned)


def everything(observation: Observation) -> list[State]:
    """All starts at once, for images on which the first ones failed: boxes, and deeper and turned twice."""
    found = box_start.principal(observation.points)
    completed = completed_moments(observation)
    if completed is None:
        return found
    centre, moments = completed
    axes = principal_axes(moments)
    deeper = centre + np.array([0.0, 0.0, 0.5 * math.sqrt(float(np.trace(moments)) / 3)])
    for middle in (centre, deeper):
        for exponent in _EXPONENTS:
            for turned in [axes, *eighth_turns(axes), *double_turns(axes)]:
                found += states(middle, moments, turned, exponent)
    return found


def completed_moments(observation: Observation) -> tuple[np.ndarray, np.ndarray] | None:
    """Centre (3,) and second moments (3, 3) about it of the completed body; None if no pixel has an opposite."""
    camera = observation.camera
    stride = max(1, round(math.sqrt(len(observation.pixels) / _MOST_PAIRS)))
    u, v, pairs = _opposite_pairs(observation.depth, observation.mask, camera.lens, stride)
    if len(pairs) < 3:
        return None
    rank = len(pairs) - 1 - min(max(_RANK // stride**2, int(0.002 * len(pairs))), len(pairs) - 1)
    depth = float(np.partition(pairs[:, 5], rank)[rank])
    centre = camera.unproject(np.array(u), np.array(v), np.array(depth))
    return centre, _moments(pairs, centre, observation.footprint / 2)


@kernel
def _moments(pairs: np.ndarray, centre: np.ndarray, shortest: float) -> np.ndarray:
    """sum |h| (m m^T + h h^T / 3) / sum |h| over pairs of m and C - h."""
    moments = np.zeros((3, 3))
    total = 0.0
    for i in range(pairs.shape[0]):
        weight = max(centre[2] - pairs[i, 5], shortest)
        total += weight
        for j in range(3):
            chord = centre[j] - pairs[i, 3 + j]
            for k in range(j + 1):
                moments[j, k] += weight * (pairs[i, j] * pairs[i, k] + chord * (centre[k] - pairs[i, 3 + k]) / 3.0)
    for j in range(3):
        for k in range(j + 1):
            moments[j, k] /= total
            moments[k, j] = moments[j, k]
    return moments


@kernel
def _opposite_pairs(
    depth: np.ndarray,
    inside: np.ndarray,
    lens: Lens,
    stride: int,
) -> tuple[float, float, np.ndarray]:
    """Centre of the silhouette (u, v), and for each pixel with an opposite: half difference and mean of the points.

    Of the pairs, those of every ``stride``-th row and column.
    """
    height, width = depth.shape
    total_u, total_v, count = 0.0, 0.0, 0
    for v in range(height):
        in_row = 0
        for u in range(width):
            if inside[v, u]:
                total_u += u
                in_row += 1
        total_v += v * in_row
        count += in_row
    centre_u, centre_v = total_u / count, total_v / count
    pairs = np.empty((((height - 1) // stride + 1) * ((width - 1) // stride + 1), 6))
    k = 0
    for v in range(0, height, stride):
        for u in range(0, width, stride):
            if not inside[v, u] or not np.isfinite(depth[v, u]):
                continue
            u2, v2 = int(np.floor(2.0 * centre_u - u + 0.5)), int(np.floor(2.0 * centre_v - v + 0.5))
            if u2 < 0 or v2 < 0 or u2 >= width or v2 >= height:
                continue
            if not inside[v2, u2] or not np.isfinite(depth[v2, u2]):
                continue
            x, y, z = point_at(u, v, np.float64(depth[v, u]), lens)
            x2, y2, z2 = point_at(u2, v2, np.float64(depth[v2, u2]), lens)
            pairs[k, 0], pairs[k, 1], pairs[k, 2] = 0.5 * (x - x2), 0.5 * (y - y2), 0.5 * (z - z2)
            pairs[k, 3], pairs[k, 4], pairs[k, 5] = 0.5 * (x + x2), 0.5 * (y + y2), 0.5 * (z + z2)
            k += 1
    return centre_u, centre_v, pairs[:k]


def eighth_turns(axes: np.ndarray) -> list[np.ndarray]:
    """The axes turned by 45 degrees about each of themselves: where two moments are alike, their axes are arbitrary."""
    turned = []
    for k in range(3):
        turn = np.eye(3)
        i, j = (k + 1) % 3, (k + 2) % 3
        c, s = math.cos(_EIGHTH_TURN), math.sin(_EIGHTH_TURN)
        turn[i, i], turn[i, j], turn[j, i], turn[j, j] = c, -s, s, c
        turned.append(axes @ turn)
    return turned


def double_turns(axes: np.ndarray) -> list[np.ndarray]:
    """The axes turned by 45 degrees about two of themselves, one after the other: 6 orders."""
    twice = []
    for k, once in enumerate(eighth_turns(axes)):
        for j, both in enumerate(eighth_turns(once)):
            if j != k:
                twice.append(both)
    return twice


def states(centre: np.ndarray, moments: np.ndarray, axes: np.ndarray, exponent: float = START_EXPONENT) -> list[State]:
    """The three bodies with these axes and moments, one for each choice of z."""
    found = []
    for rotation in three_orders(axes):
        spread = np.einsum("ji,jk,ki->i", rotation, moments, rotation)
        size = np.sqrt(np.maximum(spread, 1e-12) / MOMENT_SHARE)
        found.append(State(np.concatenate([size, [exponent, exponent], centre]), rotation, math.inf, 0))
    return found
