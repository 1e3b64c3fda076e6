"""The plane that things stand on: planes of a depth image, and which of them is the table.

Equation
--------
n.p + d = 0 with |n| = 1 in the optical frame and n towards the camera, so that the height of a point above it is

    h(p) = n.p + d  =  z (n_x (u - cx)/fx + n_y (v - cy)/fy + n_z) + d        for a pinhole camera,

one multiplication per pixel.  Depth noise of triangulating and time-of-flight cameras grows about as z^2; tolerances
are therefore sigma(z) = sigma_1 z^2 with sigma_1 measured on the plane itself.

Planes are found by RANSAC on a seeded subsample and least squares on the inliers.  Of a share s of the points, n draws
of three miss a plane with the probability (1 - s^3)^n: more are drawn where no large plane is found.  The table is the
one with many points that lies low in the image, right below what is on no plane.

Metres and pixels.  Reference: M. A. Fischler, R. C. Bolles, Random Sample Consensus, Comm. ACM 24 (1981).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from sq_perception.geometry.kernels import kernel
from sq_perception.geometry.quantiles import MEDIAN_TO_SIGMA
from sq_perception.imaging import regions
from sq_perception.imaging.camera import Camera
from sq_perception.segmentation import coarse_grid
from sq_perception.segmentation.extent import LARGEST_THING, largest_edge

TOLERANCE = 0.008
"""Half thickness of a plane while it is searched, metres at a depth of one metre."""
_LEAST_SHARE = 0.1
"""Share of the valid pixels that a plane has at least."""
_LEAST_BEFORE_WALL, _FRONTAL = 0.03, 0.3
"""That share where only planes were found that face the camera, and the cosine between their normals and the image's
vertical at most: before a wall a low camera sees little of a table.  What faces the camera too is the front of a
thing."""
_SEED = 0
"""Seed of the random samples; the same image gives the same planes."""
_PLANE_POINTS, _REFINE_POINTS = 1500, 8000
"""On so many points planes are counted, and the best one is fitted: a share of a tenth is then known to 8 % of itself,
and a height to a hundredth of the noise."""
_HYPOTHESES, _MOST_HYPOTHESES, _MISSED = 200, 2000, 0.01
"""Draws at first, and at most until a plane is missed with that probability.  200 alone missed a table of 10 to 15 % of
the points seven times of 20."""
LAYER = 0.7
"""Share of the points within two tolerances that lie within one: of a plane nearly all, of noise half."""
_FEW_POINTS, _FINALISTS = 300, 100
"""On so many points more draws are counted, and the best of them on all."""
_PLANES = 3
"""A table, the floor below it and a wall behind it."""
_APART = 2
"""Pixels next to a body that are none of its surroundings, as they may show either."""
LEVEL, _STOREY, _TABLE_SHARE = 0.99, 0.3, 0.4
"""Cosine between the normals of level planes, metres from a floor to the table above it, and the share that a small one
shows of what the floor does.  Of lower steps the larger level is the support; things on a lower one are not found."""

_CLOSE, _HELD_SHARE = 0.6, 0.1
"""Metres above a support in which what stands on it is, and the least share of what is on no plane that is there: the
wall behind a table has a tenth and less of it, and may be eight times as large in the image."""
_TYPICAL_HEIGHT, _FAR = 0.1, 0.1
"""Metres above their support of what is on no plane: exp(-h / this) is near.  A bin's wall, seen from above, is below
the middle of the image as a table is, but things are anywhere before it, not on it.  The square of the mean counts: of
four recorded bins the bottom was chosen once without, always with it; simulated stools, boards and cartons gain.
And that mean at least: where all is far from all planes, it says nothing."""
_STRAY = 0.003
"""Share of the points that may be on no plane although nothing is there: of normal noise 0.3 % lies beyond three
deviations, and tolerances are wider."""

LEAST_GROWTH = 0.1
"""Of the noise: nearer than 0.3 m it falls no further, as a sensor's own quantisation and calibration remain."""


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane with many points.

    Attributes
    ----------
    equation : (4,)
        n and d, height above it = n.p + d, n towards the camera.
    share
        Share of the image's points that lie on it.
    sigma
        Standard deviation of their heights at a depth of one metre, metres.
    """

    equation: np.ndarray
    share: float
    sigma: float

    def height(self, points: np.ndarray) -> np.ndarray:
        """Height (...) of points (..., 3) above the plane, metres."""
        return points @ self.equation[:3] + self.equation[3]


def noise_growth(z: np.ndarray) -> np.ndarray:
    """Growth of the depth noise, 1 at one metre."""
    return np.maximum(z * z, LEAST_GROWTH)


def planes(depth: np.ndarray, valid: np.ndarray, camera: Camera) -> list[Plane]:
    """Up to three planes, the one with most points first; each is taken away before the next is searched."""
    points = _some_points(depth, valid, camera, _REFINE_POINTS)
    rng = np.random.default_rng(_SEED)
    total = len(points)
    found: list[Plane] = []
    for _ in range(_PLANES):
        walls_alone = bool(found) and all(abs(plane.equation[1]) < _FRONTAL for plane in found)
        least = (_LEAST_BEFORE_WALL if walls_alone else _LEAST_SHARE) * total
        if len(points) < max(12, least):
            break
        plane, inside = _dominant_plane(points, least / len(points), rng)
        if plane is None or inside.sum() < (_LEAST_SHARE * total if abs(plane[1]) < _FRONTAL else least):
            break
        near = points[inside]
        spread = np.abs(near @ plane[:3] + plane[3]) / noise_growth(near[:, 2])
        found.append(Plane(plane, float(inside.sum() / total), float(MEDIAN_TO_SIGMA * np.median(spread))))
        points = points[~inside]
    return found


def support(
    candidates: list[Plane],
    depth: np.ndarray,
    valid: np.ndarray,
    camera: Camera,
) -> Plane | None:
    """The plane that things stand on, of some planes of an image; None if none of them is one.

    The support has many points, and a normal that points up in the image.  The camera is mounted upright or looks
    straight down; a table seen from straight above has the normal of a wall, so that such planes count as well, though
    less: where there is a wall, a floor or a table in the same image has a normal that points up.  What stands on a
    support begins right above it.  Of a table and the floor below it the table is the support, even if the image shows
    more of the floor; a plane no larger than a thing is such a table only if it has a good share of the floor's points.

    A plane with hardly anything close above it is none, such as a wall metres behind the table of a low camera.

    Parameters
    ----------
    candidates
        As by :func:`planes`.
    depth, valid : (height, width)
        Metres, and where they are a measurement.
    """
    if not candidates:
        return None
    points = _some_points(depth, valid, camera, _PLANE_POINTS)
    held, near, rest = _held(candidates, points)
    votes = {plane: _vote(plane) * share**2 for plane, share in zip(candidates, near, strict=True)}
    best = max(votes, key=votes.__getitem__)
    if rest > _STRAY and abs(best.equation[1]) < _FRONTAL and max(held) < _HELD_SHARE:
        return None

    def is_thing(plane: Plane) -> bool:
        return largest_edge(_largest_part(plane, depth, valid, camera), plane.equation[:3]) <= LARGEST_THING

    tables = [
        plane
        for plane in votes
        if plane.equation[:3] @ best.equation[:3] > LEVEL
        and best.equation[3] - plane.equation[3] > _STOREY
        and (plane.share > _TABLE_SHARE * best.share or not is_thing(plane))
    ]
    return max(tables, key=votes.__getitem__) if tables else best


def around(
    labels: np.ndarray,
    ids: tuple[int, ...],
    depth: np.ndarray,
    valid: np.ndarray,
    camera: Camera,
    known: np.ndarray | None = None,
) -> np.ndarray | None:
    """The support plane (4,) from the unlabelled pixels near the bodies: below all of them, and touched.

    None also where these pixels show no plane but a ``known`` one (4,).
    """
    near = np.zeros(labels.shape, bool)
    bodies = []
    for label in ids:
        mask = (labels == label) & valid
        left, top, width, height = regions.box(mask)
        margin = 10 + (width + height - 2) // 3
        near[max(top - margin, 0) : top + height + margin, max(left - margin, 0) : left + width + margin] = True
        rows, columns = np.nonzero(mask[top : top + height, left : left + width])
        bodies.append(regions.some_points(top + rows, left + columns, depth, camera, 500))
    left, top, width, height = regions.box(near)
    left, top = max(left - _APART, 0), max(top - _APART, 0)
    window = slice(top, top + height + 2 * _APART), slice(left, left + width + 2 * _APART)
    labelled = cv2.dilate((labels[window] > 0).view(np.uint8), np.ones((2 * _APART + 1, 2 * _APART + 1), np.uint8)) > 0
    depth, near = depth[window], near[window] & valid[window] & ~labelled
    camera = camera.cropped(left, top, depth.shape[1], depth.shape[0])
    if np.count_nonzero(near) < 30:
        return None
    if known is not None:
        points = _some_points(depth, near, camera, _PLANE_POINTS)
        off = np.abs(points @ known[:3] + known[3]) >= TOLERANCE * noise_growth(points[:, 2])
        if np.count_nonzero(off) < _LEAST_SHARE * len(points):
            return None
    best, best_vote = None, 0.0
    for plane in planes(depth, near, camera):
        contact = []
        for points in bodies:
            heights = plane.height(points) / noise_growth(points[:, 2])
            lowest, middle = np.quantile(heights, (0.02, 0.5))
            # What a body lies behind is not what it stands on, but perhaps the front of its occluder.
            contact.append(np.exp(-np.abs(lowest) / (4 * TOLERANCE)) if middle > 0 else 0.0)
        vote = _vote(plane) * float(np.mean(contact))
        if vote > best_vote:
            best, best_vote = plane.equation, vote
    return best


def _some_points(depth: np.ndarray, wanted: np.ndarray, camera: Camera, count: int) -> np.ndarray:
    """Points (k, 3) of the wanted pixels; about ``count``, evenly taken, where there are more."""
    pixels = np.flatnonzero(wanted)
    rows, columns = np.divmod(pixels[:: max(1, pixels.size // count)], camera.width)
    return camera.unproject(columns, rows, depth[rows, columns])


def _dominant_plane(points: np.ndarray, least: float, rng: np.random.Generator) -> tuple[np.ndarray | None, np.ndarray]:
    """The plane (4,) with most points within the tolerance * z^2, and which points these are.

    One with a share of less than ``least`` of them need not be found.
    """
    few = points[:: max(1, len(points) // _PLANE_POINTS)]
    weight = (1 / (TOLERANCE * noise_growth(few[:, 2]))).astype(np.float32)
    weighted = np.stack([*few.T, np.ones(len(few))]).astype(np.float32) * weight
    candidates = _through_three(few, _HYPOTHESES, rng)
    if not len(candidates):
        return None, np.zeros(len(points), bool)
    votes = _votes(candidates, weighted)
    best, most = candidates[votes.argmax()], int(votes.max())
    share = max(most / len(few), least)
    needed = math.log(_MISSED) / math.log1p(-(min(share, 0.99) ** 3))
    if needed > _HYPOTHESES:
        more = _through_three(few, min(round(needed), _MOST_HYPOTHESES), rng)
        fewer = np.ascontiguousarray(weighted[:, :: max(1, len(few) // _FEW_POINTS)])
        more = more[np.argsort(-_votes(more, fewer), kind="stable")[:_FINALISTS]]
        votes = _votes(more, weighted)
        top = more[votes.argmax()][None] if len(more) else more
        # Of points all over the room a tenth may lie in a layer as thick, but as many beside it.
        if len(top) and votes.max() > max(most, LAYER * _votes(top, weighted / 2)[0]):
            best = top[0]
    plane = best.astype(float)
    growth = noise_growth(points[:, 2])
    reach, weights, rows = TOLERANCE * growth, growth**-2, np.ascontiguousarray(points.T)
    for share in (1.0, 1.0, 0.5):
        inside = np.abs(plane[:3] @ rows + plane[3]) < share * reach
        if np.count_nonzero(inside) < 12:
            return None, inside
        plane = least_squares_plane(rows, weights * inside)
    return plane, np.abs(plane[:3] @ rows + plane[3]) < reach


def _through_three(points: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Planes float32 (k, 4) through ``count`` triples of points, those on a line left out."""
    corners = points[rng.integers(len(points), size=(count, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    usable = length > 1e-9
    normals = normals[usable] / length[usable, None]
    offsets = -np.einsum("ij,ij->i", normals, corners[usable, 0])
    return np.column_stack([normals, offsets]).astype(np.float32)


@kernel
def _votes(planes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """How many points (4, m), divided by their tolerance, lie within it of each plane (n, 4)."""
    votes = np.zeros(len(planes), np.int32)
    for k in range(len(planes)):
        a, b, c, d = planes[k]
        for i in range(points.shape[1]):
            votes[k] += abs(a * points[0, i] + b * points[1, i] + c * points[2, i] + d * points[3, i]) < 1
    return votes


def least_squares_plane(points: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The plane (4,) through weighted points (3, n), normal towards the camera."""
    middle = points @ weights / weights.sum()
    centred = points - middle[:, None]
    _, axes = np.linalg.eigh((weights * centred) @ centred.T)
    normal = axes[:, 0]
    offset = -normal @ middle
    return np.append(normal, offset) * (1.0 if offset > 0 else -1.0)


def _largest_part(plane: Plane, depth: np.ndarray, valid: np.ndarray, camera: Camera) -> np.ndarray:
    """Points (n, 3) of a coarse image that lie on a plane, of the largest connected part: the tops of two cartons may
    lie in one plane."""
    k, rows, columns, points = coarse_grid.samples(depth, valid, camera)
    on = _lie_on(plane, points)
    part = coarse_grid.connected_parts(rows, columns, on, depth[::k, ::k].shape)
    counts = np.bincount(part)
    counts[0] = 0
    return np.asarray(points[on & (part == counts.argmax())])


def _lie_on(plane: Plane, points: np.ndarray) -> np.ndarray:
    """Which points (n, 3) lie within the tolerance of a plane."""
    return np.asarray(np.abs(plane.height(points)) < TOLERANCE * noise_growth(points[:, 2]))


def _held(candidates: list[Plane], points: np.ndarray) -> tuple[list[float], list[float], float]:
    """How well each of some planes explains the points that lie on none of them, by two measures, and their share.

    First the share of these points that is as close above the plane as what stands on a support, then how near above it
    they are, 0 to 1.  ``points`` (n, 3) are all of the image.
    """
    heights = np.stack([plane.height(points) for plane in candidates])
    rest = heights[:, (np.abs(heights) > TOLERANCE * noise_growth(points[:, 2])).all(axis=0)]
    if not rest.size:
        return [0.0] * len(candidates), [1.0] * len(candidates), 0.0
    held = np.mean((rest > 0) & (rest < _CLOSE), axis=1)
    near = np.mean(np.where(rest > 0, np.exp(-np.abs(rest) / _TYPICAL_HEIGHT), 0.0), axis=1)
    return held.tolist(), np.maximum(near, _FAR).tolist(), rest.shape[1] / len(points)


def _vote(plane: Plane) -> float:
    up = -plane.equation[1]
    return plane.share * (0.25 + max(0.0, up))
