"""The plane that things stand on: planes of a depth image, and which of them is the table.

Equation
--------
n.p + d = 0 with |n| = 1 in the optical frame and n towards the camera, so that the height of a point above it is

    h(p) = n.p + d  =  z (n_x (u - cx)/fx + n_y (v - cy)/fy + n_z) + d        for a pinhole camera.

Depth noise of triangulating and time-of-flight cameras grows about as g(z) = z^2; tolerances are therefore
sigma(z) = sigma_1 z^2 with sigma_1 measured on the plane itself.  Planes are found by RANSAC on a seeded subsample and
least squares on the inliers.  The table is the one with many points that lies low in the image, right below what is on
no plane.

Metres and pixels.  Reference: M. A. Fischler, R. C. Bolles, Random Sample Consensus, Comm. ACM 24 (1981).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sq_perception.geometry.kernels import kernel
from sq_perception.geometry.quantiles import deviation
from sq_perception.imaging import regions
from sq_perception.imaging.camera import Camera

TOLERANCE = 0.008
"""Half thickness of a plane while it is searched, metres at a depth of one metre."""
_LEAST_SHARE = 0.05
"""Share of the valid pixels that a plane has at least."""
_PLANE_POINTS, _POINTS = 1500, 8000
"""On so many points planes are counted, and the best one is fitted."""
_HYPOTHESES, _FEW_POINTS = 1000, 300
"""So many draws are counted on a few points."""
_TYPICAL_HEIGHT, _FAR = 0.1, 0.1
"""Metres above their support of what is on no plane: exp(-h / this) is near.  The mean of that at least: where all is
far from all planes, it says nothing."""

LEAST_GROWTH = 0.1
"""Of the noise: nearer than 0.3 m it falls no further, as a sensor's own quantisation and calibration remain."""
LEAST_SIGMA = 5e-4
"""Noise of the depth at one metre, metres, that is assumed at least: rendered images have none."""
CLEARLY = 4.0
"""Standard deviations of the noise from which on a height is none of it."""


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

    @property
    def clear_height(self) -> float:
        """Height from which on something is clearly above the plane, metres at one metre of depth.

        Half of the tolerance is a compromise: bent depth of real cameras stays below, thin objects stay above.
        """
        return max(0.5 * TOLERANCE, CLEARLY * self.sigma)

    def height(self, points: np.ndarray) -> np.ndarray:
        """Height (...) of points (..., 3) above the plane, metres."""
        return points @ self.equation[:3] + self.equation[3]

    def image_relative(self, depth: np.ndarray, camera: Camera) -> np.ndarray:
        """Height, float32 (height, width), above the plane as at one metre of depth, 0 for depth 0; of a pinhole
        camera's depth image."""
        x = (np.arange(camera.width) - camera.cx) / camera.fx
        y = (np.arange(camera.height) - camera.cy) / camera.fy
        return np.asarray(_relative(depth, x, y, self.equation))


def noise_growth(z: np.ndarray) -> np.ndarray:
    """Growth of the depth noise, 1 at one metre."""
    return np.maximum(z * z, LEAST_GROWTH)


def planes(points: np.ndarray) -> list[Plane]:
    """Up to three planes of points (n, 3), the one with most of them first; each is taken away before the next."""
    rng, total = np.random.default_rng(0), len(points)
    found: list[Plane] = []
    for _ in range(3):  # a table, the floor below it and a wall behind it
        if len(points) < max(12, _LEAST_SHARE * total):
            break
        plane, inside = _dominant_plane(points, rng)
        if plane is None or inside.sum() < _LEAST_SHARE * total:
            break
        near = points[inside]
        spread = np.abs(near @ plane[:3] + plane[3]) / noise_growth(near[:, 2])
        found.append(Plane(plane, float(inside.sum() / total), deviation(spread)))
        points = points[~inside]
    return found


def support(depth: np.ndarray, valid: np.ndarray, camera: Camera) -> Plane | None:
    """The plane that things stand on; None if there is none.

    The support has many points, and a normal that points up in the image.  The camera is mounted upright or looks
    straight down; a table seen from straight above has the normal of a wall, so that such planes count as well, though
    less: where there is a wall, a floor or a table in the same image has a normal that points up.  What stands on a
    support begins right above it: of the points on no plane, the mean of exp(-h / typical height) is large.

    Parameters
    ----------
    depth, valid : (height, width)
        Metres, and where they are a measurement.
    """
    candidates = planes(some_points(depth, valid, camera))
    if not candidates:
        return None
    points = some_points(depth, valid, camera, _PLANE_POINTS)
    heights = np.stack([plane.height(points) for plane in candidates])
    rest = heights[:, (np.abs(heights) > TOLERANCE * noise_growth(points[:, 2])).all(axis=0)]
    near = np.where(rest > 0, np.exp(-np.abs(rest) / _TYPICAL_HEIGHT), 0.0).sum(axis=1) / max(rest.shape[1], 1)
    votes = [_vote(plane) * max(each, _FAR) ** 2 for plane, each in zip(candidates, near.tolist(), strict=True)]
    return candidates[int(np.argmax(votes))]


def around(
    labels: np.ndarray, ids: tuple[int, ...], depth: np.ndarray, valid: np.ndarray, camera: Camera,
    known: np.ndarray | None = None,
) -> Plane | None:
    """The support plane from the unlabelled pixels near the bodies: below all of them, and touched.

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
    # Pixels next to a body are none of its surroundings, as they may show either.
    near &= valid & (cv2.dilate((labels > 0).view(np.uint8), np.ones((5, 5), np.uint8)) == 0)
    if np.count_nonzero(near) < 30:
        return None
    if known is not None:
        rows, columns = np.nonzero(near)
        points = camera.unproject(columns, rows, depth[rows, columns])
        on = np.abs(points @ known[:3] + known[3]) < TOLERANCE * noise_growth(points[:, 2])
        near[rows[on], columns[on]] = False
        if np.count_nonzero(~on) < _LEAST_SHARE * len(points):
            return None
    best: Plane | None = None
    best_vote = 0.0
    for plane in planes(some_points(depth, near, camera)):
        contact = []
        for points in bodies:
            heights = plane.height(points) / noise_growth(points[:, 2])
            lowest, middle = np.quantile(heights, (0.02, 0.5))
            # What a body lies behind is not what it stands on, but perhaps the front of its occluder.
            contact.append(np.exp(-np.abs(lowest) / (4 * TOLERANCE)) if middle > 0 else 0.0)
        vote = _vote(plane) * float(np.mean(contact))
        if vote > best_vote:
            best, best_vote = plane, vote
    return best


def some_points(depth: np.ndarray, wanted: np.ndarray, camera: Camera, count: int = _POINTS) -> np.ndarray:
    """Points (k, 3) of the wanted pixels; about ``count``, evenly taken, where there are more."""
    pixels = np.flatnonzero(wanted)
    rows, columns = np.divmod(pixels[:: max(1, pixels.size // count)], camera.width)
    return camera.unproject(columns, rows, depth[rows, columns])


def _dominant_plane(points: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray | None, np.ndarray]:
    """The plane (4,) with most points within the tolerance * z^2, and which points these are."""
    few = points[:: max(1, len(points) // _PLANE_POINTS)]
    candidates = _through_three(few, rng)
    if not len(candidates):
        return None, np.zeros(len(points), bool)
    few = few[:: max(1, len(few) // _FEW_POINTS)]
    weighted = np.stack([*few.T, np.ones(len(few))]) / (TOLERANCE * noise_growth(few[:, 2]))
    plane = candidates[_votes(candidates, weighted.astype(np.float32)).argmax()].astype(float)
    growth = noise_growth(points[:, 2])
    reach, weights, rows = TOLERANCE * growth, growth**-2, np.ascontiguousarray(points.T)
    for share in (1.0, 1.0, 0.5):
        inside = np.abs(plane[:3] @ rows + plane[3]) < share * reach
        if np.count_nonzero(inside) < 12:
            return None, inside
        plane = least_squares_plane(rows, weights * inside)
    return plane, np.abs(plane[:3] @ rows + plane[3]) < reach


def _through_three(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Planes float32 (k, 4) through random triples of points, those on a line left out."""
    corners = points[rng.integers(len(points), size=(_HYPOTHESES, 3))]
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


def _vote(plane: Plane) -> float:
    up = -plane.equation[1]
    return plane.share * (0.25 + max(0.0, up))


@kernel
def _relative(depth: np.ndarray, x: np.ndarray, y: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """The rest of a row is constant, and no pixel branches: a row becomes vector code."""
    height = np.empty(depth.shape, np.float32)
    for v in range(depth.shape[0]):
        slope = plane[1] * y[v] + plane[2]
        for u in range(depth.shape[1]):
            z = np.float64(depth[v, u])
            relative = (z * (plane[0] * x[u] + slope) + plane[3]) / max(z * z, LEAST_GROWTH)
            height[v, u] = relative if z > 0 else 0.0
    return height
