"""Several superquadrics to the points or the mesh of one object: its parts.

Bodies share the points as in :mod:`sq_perception.fitting.point_cost`: each point belongs to the nearest surface,
softly, or to none.  Where the points close a volume, a grid tells what is outside of the object and what is inside:
probes on either side, evenly in space, keep bodies out of the one and have them fill the other.

The number of bodies is that of the shortest description (A. Leonardis, A. Jaklic, F. Solina, Superquadrics for
Segmenting and Modeling Range Data, IEEE PAMI 19(11), 1997).  In nats, for k bodies with the log-likelihood L of n
points,

    D(k) = -(n_e / n) L + k p / 2 log n_e

with p parameters a body and n_e independent witnesses: neighbouring points of a thing that is no superquadric err
alike.  From one body on, each is split in two along each of its axes, and bodies are added where points or the inside
are not explained; the likeliest union goes on.  In the end bodies without which the description is shorter are dropped.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from sq_perception.fitting import point_cost, points
from sq_perception.fitting.cost import STEP_LENGTH
from sq_perception.fitting.fit import Parts
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.observation import span
from sq_perception.fitting.options import MIN_PIXELS
from sq_perception.fitting.point_cost import Cloud, Course, Mixture, UnitCloud
from sq_perception.fitting.quality import fail
from sq_perception.fitting.starts import START_EXPONENT, boxes, principal_axes

MOST_PARTS = 6
_POINTS = 800
"""Points that parts are fitted to, and probes of both sides together."""
_WITNESSES = 600.0
"""n_e above."""
_RESOLUTION = 0.01
"""Least noise, in radii of the cloud: what a part may stray from a superquadric without another part."""
_GRID = 28
"""Cells along the longest side of the grid that tells inside from outside."""
_QUICK, _THOROUGH = 8, 30
"""Rounds of a candidate, and of the union that goes on."""


def decompose(
    thing: Any, normals: np.ndarray | None = None, *, most: int = MOST_PARTS, sigma: float | None = None
) -> Parts:
    """The parts of one object, at most ``most`` of them.

    Parameters
    ----------
    thing : (n, 3) or a mesh
        Points of its surface, metres or any unit, in any frame; or what has ``vertices`` (n, 3) and ``faces`` (m, 3),
        as a ``trimesh.Trimesh``.
    normals : (n, 3), optional
        Outward normals of points.
    most
        1 or more.
    sigma
        Standard deviation of the noise, in the unit of the points; None estimates it.

    Raises
    ------
    ValueError
        If an argument has the wrong form, or there is nothing finite in it.
    """
    began = time.perf_counter()
    if most < 1:
        raise ValueError(f"most: expected 1 or more parts, got {most}")
    given, normals = points.surface_of(thing, normals)
    cloud = UnitCloud.of(given, normals, points.MOST_POINTS)
    if reason := points.reason_to_fail(cloud):
        alone = fail(given, 0.01 * cloud.scale, math.nan, reason, began)
        return Parts((alone,), np.zeros(1), alone.status, reason, math.nan, alone.milliseconds)
    search = _Search(cloud, _with_probes(cloud, given), sigma)
    mixture = search.prune(search.grow(most))
    return _assess(cloud, mixture, began)


def decompose_all(things: Sequence[Any], *, most: int = MOST_PARTS, jobs: int | None = None) -> list[Parts]:
    """:func:`decompose` of many objects, ``jobs`` at a time (as many as there are cores if not given)."""
    with ThreadPoolExecutor(jobs) as executor:  # kernels let other threads of Python compute
        return list(executor.map(lambda thing: decompose(thing, most=most), things))


class _Search:
    """The unions of a cloud, from one body to the most."""

    def __init__(self, cloud: UnitCloud, data: Cloud, sigma: float | None) -> None:
        self._cloud, self._data, self._limits = cloud, data, points.limits_of(cloud, True)
        self._least = _RESOLUTION if sigma is None else max(sigma / cloud.scale, 1e-4)

    def grow(self, most: int) -> Mixture:
        """The union of the shortest description; growing ends when two more bodies in a row do not shorten it."""
        start = points.search(self._cloud, None, "auto", True, points.STAGES_OF_PARTS)
        best = current = self._maximize(start._replace(share=min(start.share, 0.3)), _THOROUGH)
        misses = 0
        while len(current.bodies) < most and misses < 2:
            candidates = [self._maximize(each, _QUICK) for each in self._candidates(current)]
            if not candidates:
                break
            candidates.sort(key=lambda each: -each.likelihood)
            followed = [self._maximize(each, _THOROUGH) for each in candidates[:2]]
            current = max(followed, key=lambda each: each.likelihood)
            misses = 0 if self.description(current) < self.description(best) else misses + 1
            best = best if misses else current
        return best

    def prune(self, mixture: Mixture) -> Mixture:
        """The union without the bodies that do not shorten its description."""
        while len(mixture.bodies) > 1:
            fewer = (_without(mixture, k) for k in range(len(mixture.bodies)))
            shortest = min((self._maximize(each, _THOROUGH) for each in fewer), key=self.description)
            if self.description(shortest) >= self.description(mixture):
                break
            mixture = shortest
        return mixture

    def description(self, mixture: Mixture) -> float:
        """D above."""
        of_body = 0.5 * STEP_LENGTH * math.log(_WITNESSES)
        return -_WITNESSES / len(self._data.points) * mixture.likelihood + of_body * len(mixture.bodies)

    def _maximize(self, mixture: Mixture, rounds: int) -> Mixture:
        course = Course(False, False, self._least, rounds, 1e-3, False)
        return point_cost.maximize(self._data, mixture, points.PRIOR, self._limits, course)

    def _candidates(self, mixture: Mixture) -> Iterator[Mixture]:
        wide = mixture._replace(sigma=max(mixture.sigma, 2 * _RESOLUTION))
        for k, (body, turn) in enumerate(zip(mixture.bodies, mixture.turns, strict=True)):
            for axis in range(3):
                halves = np.stack([body, body])
                halves[:, axis] *= 0.5
                halves[:, 8:] = 0.0
                halves[:, 5:8] += np.outer([-1.0, 1.0], turn[:, axis] * halves[0, axis])
                yield _with(_without(wide, k), halves, np.stack([turn, turn]))
        of_points = _nearest(self._data.points, mixture)
        unexplained = self._data.points[np.abs(of_points) > 2 * mixture.sigma]
        within = self._data.probes[self._data.sides < 0]
        unfilled = within[_nearest(within, mixture) > 0] if len(within) else within
        for some in (unexplained, unfilled):
            if (box := _box_of_group(some)) is not None:
                yield _with(wide, box.parameters[None], box.rotation[None])


def _without(mixture: Mixture, k: int) -> Mixture:
    return mixture._replace(bodies=np.delete(mixture.bodies, k, 0), turns=np.delete(mixture.turns, k, 0))


def _with(mixture: Mixture, bodies: np.ndarray, turns: np.ndarray) -> Mixture:
    return mixture._replace(bodies=np.append(mixture.bodies, bodies, 0), turns=np.append(mixture.turns, turns, 0))


def _nearest(some: np.ndarray, mixture: Mixture) -> np.ndarray:
    """Distance (n,) of some points to the nearest body."""
    pairs = zip(mixture.bodies, mixture.turns, strict=True)
    return np.min([point_cost.distances(some, body, turn) for body, turn in pairs], axis=0)


def _box_of_group(some: np.ndarray) -> State | None:
    """A box around the largest group of the points; None where there are too few."""
    from scipy.spatial import cKDTree  # here: a node that recovers does without

    if len(some) < 2 * MIN_PIXELS:
        return None
    near = cKDTree(some).query_ball_point(some, 0.5)
    group = some[near[int(np.argmax([len(each) for each in near]))]]
    if len(group) < MIN_PIXELS:
        return None
    axes = principal_axes(np.cov(group.T))
    low, high = span(group, axes.T, 0.0).T
    return boxes(low, high, axes, START_EXPONENT)[-1]


def _with_probes(cloud: UnitCloud, given: np.ndarray) -> Cloud:
    """The points of a cloud with probes outside and inside, where the points given (n, 3) close a volume."""
    from scipy import ndimage  # here: a node that recovers does without

    surface = cloud.surface(_POINTS)
    dense = (given - cloud.centre) @ cloud.axes / cloud.scale
    low, high = dense.min(axis=0), dense.max(axis=0)
    side = float((high - low).max()) / _GRID
    cells = np.clip(np.rint((dense - low) / side), 0, _GRID + 1).astype(int) + 2
    count = np.zeros(np.ceil((high - low) / side).astype(int) + 6, np.int64)
    np.add.at(count, tuple(cells.T), 1)
    hit = count[count > 0]
    occupied = count >= max(1.0, 0.2 * float(np.median(hit)))
    wall = ndimage.binary_dilation(occupied)
    labels, _ = ndimage.label(~wall)
    outside = labels == labels[0, 0, 0]
    inside = ~wall & ~outside
    if np.count_nonzero(inside) < 0.1 * np.count_nonzero(occupied):  # the points close no volume
        return surface
    probes, sides = [], []
    for cell, sign in ((outside, 1.0), (inside, -1.0)):
        at = np.argwhere(cell)
        at = at[:: max(1, len(at) * 2 // _POINTS)]
        probes.append((at - 2) * side + low)
        sides.append(np.full(len(at), sign))
    weight = 0.5 / (2 * _RESOLUTION) ** 2
    owners = np.full(sum(len(each) for each in sides), -1)
    return surface._replace(
        probes=np.concatenate(probes).copy(order="C"), sides=np.concatenate(sides), owners=owners, probe_weight=weight
    )


def _assess(cloud: UnitCloud, mixture: Mixture, began: float) -> Parts:
    surface = cloud.surface()
    none = np.zeros((len(cloud.points), len(mixture.bodies)))
    shares = point_cost.shares(surface, mixture, none)[0].mean(axis=0)
    fits = [points.assess(cloud, mixture, k, began) for k in range(len(shares))]
    return Parts.of(fits, shares, mixture.sigma * cloud.scale, (time.perf_counter() - began) * 1e3)
