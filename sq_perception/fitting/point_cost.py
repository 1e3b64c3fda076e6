"""Points without a camera: the mixture of bodies and outliers that they come from, and its likeliest bodies; compiled.

Of bodies whose surfaces have the area A together, each point p comes from a random place, moved along the normal by
noise of the standard deviation s, or with probability w from anywhere in the volume V of the cloud's box:

    P(p) = (1 - w) / A  N(d(p); 0, s^2)  +  w / V,        d = (g - 1) / |grad g|

with the gauge g and the first-order (Sampson) distance d.  Expectation-maximisation (Liu et al., Robust and Accurate
Superquadric Recovery: a Probabilistic Approach, CVPR 2022): the probability r that each point belongs to the body, then
w and s from r, then steps of the image fit's least squares on Sampson distances, weighted by r / s^2
(:mod:`sq_perception.fitting.levenberg_marquardt`).  Several bodies share the points: each takes those that are nearest
to it, softly.

A probe is a point known to lie outside, or inside, of the object: d is then held at 0 or above, or at 0 or below.

A cloud is normalised first, so that the result does not depend on its frame, scale, order or density: coordinates are
along its principal axes, about its median, in units of its root mean square radius; a large cloud is thinned evenly in
space.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sq_perception.fitting.cost import LANES, RAY_COLUMNS, STEP_LENGTH, Ray, Terms, rays_of
from sq_perception.fitting.intersection import ROWS, Lane, gauge_along, padded, place
from sq_perception.fitting.levenberg_marquardt import State, minimize
from sq_perception.fitting.residuals import FOOT, sampson, surface_distance, to_foot
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.kernels import kernel
from sq_perception.geometry.superquadric import Superquadric

_PROBE_STEP, _PROBE_WEIGHT = 0.05, 100.0
"""How far along the normals probes lie, in radii of the cloud, and the weight of their squared distance: a quarter of
what a point weighs whose noise is as large."""


@kernel
def distances(points: np.ndarray, body: np.ndarray, m: np.ndarray) -> np.ndarray:
    """Sampson distance (n,) of points (n, 3) to a body, positive outside."""
    return surface_distance(rays_of(points), body, m)


@kernel
def area(body: np.ndarray) -> float:
    """Area of the surface, of an ellipsoid by Thomsen's formula and of a box exactly, in between by the exponents."""
    a, b, c = body[0], body[1], body[2]
    p = 1.6075
    round_area = 4.0 * math.pi * (((a * b) ** p + (a * c) ** p + (b * c) ** p) / 3.0) ** (1.0 / p)
    box_area = 8.0 * (a * b + a * c + b * c)
    share = min(0.5 * (body[3] + body[4]), 1.0)
    return box_area + share * share * (round_area - box_area)


class Cloud(NamedTuple):
    """What bodies are fitted to, in units of the cloud.

    ``points`` (n, 3) lie on surfaces, or anywhere; ``probes`` (m, 3) are known to be outside (``sides`` 1) or inside
    (-1), as far as the point that each is derived from, of index ``owners`` (-1 for none), is of a surface.
    ``background`` is 1 / V, ``probe_weight`` the weight of a squared distance of a probe on the wrong side.
    """

    points: np.ndarray
    probes: np.ndarray
    sides: np.ndarray
    owners: np.ndarray
    background: float
    probe_weight: float


@dataclass(frozen=True, eq=False)
class UnitCloud:
    """A cloud in its own frame, p = centre + scale axes q: q (n, 3), neighbours one after the other, and outward
    normals (n, 3), if any."""

    points: np.ndarray
    normals: np.ndarray | None
    centre: np.ndarray
    axes: np.ndarray
    scale: float

    @classmethod
    def of(cls, points: np.ndarray, normals: np.ndarray | None, most: int) -> UnitCloud:
        """The cloud of finite points (n, 3), at most so many of them."""
        from scipy.spatial import cKDTree  # here: a node that recovers does without

        centre = np.median(points, axis=0)
        centred = points - centre
        scale = float(np.sqrt(np.mean(np.einsum("ij,ij->i", centred, centred)))) or 1.0
        centred /= scale
        _, axes = np.linalg.eigh(centred.T @ centred)
        axes *= np.where(np.sum((centred @ axes) ** 3, axis=0) < 0, -1.0, 1.0)
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        centred = centred @ axes
        # A tree's leaves are neighbours one after the other.
        order = cKDTree(centred, leafsize=1, balanced_tree=False, compact_nodes=False).indices
        if len(order) > most:
            order = order[np.linspace(0, len(order) - 1, most).astype(int)]
        turned = None
        if normals is not None:
            length = np.linalg.norm(normals[order], axis=1, keepdims=True)
            turned = normals[order] @ axes / np.where(length > 0, length, 1.0)
        return cls(np.ascontiguousarray(centred[order]), turned, centre, axes, scale)

    @property
    def extent(self) -> float:
        """Half of the diagonal of the box, in units of the cloud."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0))) / 2

    @property
    def background(self) -> float:
        """Density of outliers, which may be anywhere in the box."""
        sides = np.ptp(self.points, axis=0)
        return 1 / float(np.prod(np.maximum(sides, 0.01 * max(float(sides.max()), 1e-9))))

    def surface(self, count: int | None = None) -> Cloud:
        """About ``count`` points, or all of them; normals give each a probe on either side."""
        step = 1 if count is None else max(1, round(len(self.points) / count))
        points = np.ascontiguousarray(self.points[::step])
        if self.normals is None:
            return Cloud(points, np.empty((0, 3)), np.empty(0), np.empty(0, np.int64), self.background, 0.0)
        step_out = _PROBE_STEP * self.normals[::step]
        owners = np.tile(np.arange(len(points)), 2)
        sides = np.repeat([1.0, -1.0], len(points))
        probes = np.concatenate([points + step_out, points - step_out])
        return Cloud(points, probes, sides, owners, self.background, _PROBE_WEIGHT)

    def body(self, numbers: np.ndarray, turn: np.ndarray) -> Superquadric:
        """A body (10,) with its rotation (3, 3) in the frame of the user."""
        return Superquadric(
            numbers[0:3] * self.scale, numbers[3:5], self.centre + self.scale * (self.axes @ numbers[5:8]),
            quaternions.from_matrix(self.axes @ turn), numbers[8:10],
        )


class Mixture(NamedTuple):
    """Bodies (k, 10) and their rotations (k, 3, 3), the noise, the share of the background, and the log-likelihood."""

    bodies: np.ndarray
    turns: np.ndarray
    sigma: float
    share: float
    likelihood: float


class Course(NamedTuple):
    """How to settle: what is given and not estimated, the least sigma, most rounds, and the gain a point to end at."""

    keep_sigma: bool
    keep_share: bool
    least_sigma: float
    rounds: int
    tolerance: float
    is_centred: bool


@kernel
def outward(points: np.ndarray, body: np.ndarray, m: np.ndarray, sigma: float) -> np.ndarray:
    """How far (n,) noise moves points of a convex surface outward on average.

    Each point is carried to the surface and displaced six ways, which makes the mean distance exact to the second order
    (S. Julier, J. Uhlmann 1997).
    """
    mean = np.empty(points.shape[0])
    rays, lanes = rays_of(points), np.empty((ROWS, LANES))
    step = math.sqrt(3.0) * sigma
    for first in range(0, points.shape[0], LANES):
        part = rays[first : first + LANES]
        place(part, mean[:0], body, m, lanes)
        filled = padded(part.shape[0], lanes)
        to_foot(filled, body, lanes)
        out = mean[first : first + LANES]
        for i in range(part.shape[0]):
            out[i] = -sampson(lanes, i)
        for row in (Lane.QX, Lane.QY, Lane.QZ):
            for move in (-step, 2.0 * step):
                for i in range(filled):
                    lanes[row, i] += move
                gauge_along(filled, body, lanes)
                for i in range(part.shape[0]):
                    out[i] += sampson(lanes, i) / 6.0
            for i in range(filled):
                lanes[row, i] -= step
    return mean


@kernel
def shares(cloud: Cloud, mixture: Mixture, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The probability (n, k) that each point belongs to each body, its distance (n, k), and its log-likelihood (n,)."""
    bodies, turns, sigma, share, _ = mixture
    n, count = cloud.points.shape[0], bodies.shape[0]
    distance, probability, likelihood = np.empty((n, count)), np.empty((n, count)), np.empty(n)
    whole = 0.0
    for k in range(count):
        distance[:, k] = distances(cloud.points, bodies[k], turns[k]) - offsets[:, k]
        whole += area(bodies[k])
    inlying = (1.0 - share) / (whole * math.sqrt(2.0 * math.pi) * sigma)
    outlying = share * cloud.background + 1e-300
    for i in range(n):
        total = outlying
        for k in range(count):
            probability[i, k] = inlying * math.exp(-0.5 * min((distance[i, k] / sigma) ** 2, 1400.0))
            total += probability[i, k]
        for k in range(count):
            probability[i, k] /= total
        likelihood[i] = math.log(total)
    return probability, distance, likelihood


@kernel
def maximize(
    cloud: Cloud, start: Mixture, terms: Terms, limits: tuple[np.ndarray, np.ndarray], course: Course
) -> Mixture:
    """Expectation-maximisation from a start."""
    bodies, turns, sigma, share, _ = start
    bodies, turns = bodies.copy(), turns.copy()
    n, m, count = cloud.points.shape[0], cloud.probes.shape[0], bodies.shape[0]
    rays, no_free = rays_of(np.concatenate((cloud.points, cloud.probes))), np.empty((0, RAY_COLUMNS))
    rays[n:, Ray.SIDE] = cloud.sides
    of_probe, offsets = np.empty((m, count)), np.zeros((n, count))
    likelihood = -np.inf
    for turn in range(course.rounds + 1):
        if course.is_centred and (turn < 3 or turn % 4 == 0):  # later it hardly changes
            for k in range(count):
                offsets[:, k] = outward(cloud.points, bodies[k], turns[k], sigma)
        probability, distance, each = shares(cloud, Mixture(bodies, turns, sigma, share, 0.0), offsets)
        total = each.sum()
        for k in range(count):
            of_probe[:, k] = distances(cloud.probes, bodies[k], turns[k])
        for i in range(m):
            nearest = of_probe[i].min()
            holds = 1.0 if cloud.owners[i] < 0 else probability[cloud.owners[i]].sum()
            total -= 0.5 * holds * cloud.probe_weight * min(cloud.sides[i] * nearest, 0.0) ** 2
        gain = total - likelihood
        likelihood = total
        if turn == course.rounds or (turn > 2 and abs(gain) < course.tolerance * n):
            break
        kept = probability.sum()
        if not course.keep_share:
            share = min(max(1.0 - kept / n, 1e-3), 0.95)
        if not course.keep_sigma:
            square = (probability * distance * distance).sum()
            sigma = max(math.sqrt(square / max(kept - STEP_LENGTH * count, 0.25 * kept + 1e-9)), course.least_sigma)
        for k in range(count):
            rays[:n, Ray.OFFSET] = offsets[:, k]
            rays[:n, Ray.WEIGHT] = probability[:, k] / (sigma * sigma)
            for i in range(m):  # what is inside belongs to the nearest body, what is outside to none
                is_its = cloud.sides[i] > 0.0 or of_probe[i, k] <= of_probe[i].min()
                holds = 1.0 if cloud.owners[i] < 0 else probability[cloud.owners[i]].sum()
                rays[n + i, Ray.WEIGHT] = holds * cloud.probe_weight if is_its else 0.0
            start_k = State(bodies[k], turns[k], np.inf, 0)
            # Not the literals: minimize would be compiled once more for them.
            residual, steps = int(FOOT), int(np.int64(2))
            bodies[k], turns[k], _, _ = minimize(residual, rays, no_free, terms, start_k, limits, steps, 1e-6)
    return Mixture(bodies, turns, sigma, share, likelihood)
