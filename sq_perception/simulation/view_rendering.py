"""Canonical views of known bodies, rendered without the detour over an image: the source of training data.

What :mod:`sq_perception.imaging.canonical_view` makes of an image of a body is rendered directly: rays along z on the
view's own grid, the view fitted to what of the body is visible.  Frames and values are those of that module.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from sq_perception.geometry.kernels import gauge_derivatives, kernel, parallel_kernel, ray_entry
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.canonical_view import HIDDEN, MARGIN, NEAREST, OUTLIERS_PER_END

_NOTHING = -1e300
_BEHIND = -2e300
_MOST_ROUNDS = 4
_SAME_EXTENT = 0.005


@dataclass(frozen=True, eq=False)
class Occluder:
    """Something opaque before each body (n,): all that lies beyond a front that came in from one side.

    In the plane of the view, in units of its side and from its middle, (u, v) are coordinates along and across the
    direction the occluder comes from; hidden is

        c < u - bow |v - offset|^power < c + thickness,

    c such that ``share`` of the body's pixels lie beyond the front.  bow = 0 is a straight edge, power 1 a corner,
    power 2 a round thing.

    Attributes
    ----------
    direction : (n,)
        Angle of u, radians from the view's x axis.
    bow, offset, power, thickness : (n,)
    share : (n,)
        Of the body's own pixels, 0 to below 1; 0 is no occluder.
    """

    direction: np.ndarray
    bow: np.ndarray
    offset: np.ndarray
    power: np.ndarray
    thickness: np.ndarray
    share: np.ndarray


def render_views(
    bodies: Superquadric,
    pixels: int = 64,
    levels: np.ndarray | None = None,
    distance: np.ndarray | None = None,
    occluder: Occluder | None = None,
    miss: np.ndarray | None = None,
) -> tuple[np.ndarray, Superquadric]:
    """Canonical views of single bodies, without the detour over an image: the source of training data.

    A canonical view is orthographic whatever camera took the image, but a pinhole camera sees less of the body: of a
    convex body just the points whose normals point to it.  Rays along z, less what faces away from the eye, are so the
    view of an image with any number of pixels.  The view is fitted to what is visible, as
    :func:`canonical_view.from_mask` does it.

    Parameters
    ----------
    bodies : Superquadric
        NumPy batch (n,), in a frame like the cube's: y up, z towards the viewer.
    pixels : int
        Side of the views.
    levels : (n,), optional
        Grey levels per unit of the bodies' frame: depths are rounded down to them, as in an image of integers.
    distance : (n,), optional
        Distance of a pinhole camera from the nearest face of the body's box, in the bodies' unit; infinite, as by
        default, for an orthographic camera.
    occluder : Occluder, optional
        What stands before the bodies; its pixels are :data:`HIDDEN`.
    miss : (n, 4), optional
        How far the view's middle (x, y), nearest depth (z) and the logarithm of its side are off, the first three in
        sides: errors of a mask and of noisy depths.

    Returns
    -------
    images : float32 (n, pixels, pixels)
    bodies : Superquadric
        The batch in the canonical frame of its views.
    """
    lower, upper = bodies.bounding_box()
    side = MARGIN * (upper - lower)[:, :2].max(axis=1)
    anchor = np.stack([0.5 * (lower[:, 0] + upper[:, 0]), 0.5 * (lower[:, 1] + upper[:, 1]), upper[:, 2]], axis=-1)
    flat = np.ascontiguousarray(bodies.to_flat(), dtype=float)
    matrices = np.ascontiguousarray(bodies.rotation_matrix, dtype=float)
    images = np.zeros((len(bodies), pixels, pixels), dtype=np.float32)
    steps = np.zeros(len(bodies)) if levels is None else 1 / np.asarray(levels, dtype=float)
    away = np.full(len(bodies), np.inf) if distance is None else np.asarray(distance, dtype=float)
    if (away <= 0).any():
        raise ValueError("distance: expected positive distances of the camera")
    pinhole = np.isfinite(away)
    eye = upper[:, 2] + np.where(pinhole, away, 0.0)
    fronts = np.zeros((len(bodies), 6))
    if occluder is not None:
        if not ((occluder.share >= 0) & (occluder.share < 1)).all():
            raise ValueError("occluder: expected shares of at least 0 and below 1")
        columns = (occluder.direction, occluder.bow, occluder.offset, occluder.power, occluder.thickness)
        fronts[:] = np.stack([*columns, occluder.share], axis=-1)
    misses = np.zeros((len(bodies), 4)) if miss is None else np.array(miss, dtype=float)
    _render_views(flat, matrices, anchor, side, steps, pinhole, eye, fronts, misses, images)
    identity = np.array([0.0, 0.0, 0.0, 1.0])
    shift = np.array([0.5, 0.5, NEAREST]) - anchor / side[:, None]
    return images, bodies.transformed(identity, shift, 1 / side[:, None])


@parallel_kernel
def _render_views(
    flat: np.ndarray,
    matrices: np.ndarray,
    anchor: np.ndarray,
    side: np.ndarray,
    quantum: np.ndarray,
    pinhole: np.ndarray,
    eye: np.ndarray,
    fronts: np.ndarray,
    misses: np.ndarray,
    images: np.ndarray,
) -> None:
    """Render, read off what is visible, and render again until the extent is that of the visible part."""
    pixels = images.shape[1]
    for k in numba.prange(flat.shape[0]):
        a1, a2, a3, e1, e2, t1, t2, t3 = flat[k, :8]
        m = matrices[k]
        eye_1, eye_2, eye_3 = m[2, 0] * (eye[k] - t3), m[2, 1] * (eye[k] - t3), m[2, 2] * (eye[k] - t3)
        middle_x, middle_y, unit = anchor[k, 0], anchor[k, 1], side[k]
        occluded = fronts[k, 5] > 0.0
        measured = pinhole[k] or occluded
        missed = misses[k, 0] != 0.0 or misses[k, 1] != 0.0 or misses[k, 2] != 0.0 or misses[k, 3] != 0.0
        front = np.inf
        surface = np.empty((pixels, pixels))
        seen = np.empty(pixels * pixels)
        reach = np.empty(pixels * pixels)
        last_round = _MOST_ROUNDS - 1
        for turn in range(_MOST_ROUNDS + 1):
            hits = 0
            first_row, last_row, first_column, last_column = pixels, -1, pixels, -1
            for i in range(pixels):
                for j in range(pixels):
                    x = anchor[k, 0] + ((j + 0.5) / pixels - 0.5) * side[k]
                    y = anchor[k, 1] - ((i + 0.5) / pixels - 0.5) * side[k]
                    if occluded:
                        distance = _front_distance((x - middle_x) / unit, (y - middle_y) / unit, fronts[k])
                        if front < distance < front + fronts[k, 4]:
                            surface[i, j] = _BEHIND
                            continue
                    x -= t1
                    y -= t2
                    ox, oy, oz = m[0, 0] * x + m[1, 0] * y, m[0, 1] * x + m[1, 1] * y, m[0, 2] * x + m[1, 2] * y
                    hit, t = ray_entry((ox, oy, oz), (-m[2, 0], -m[2, 1], -m[2, 2]), (a1, a2, a3, e1, e2))
                    surface[i, j] = _NOTHING
                    if hit and pinhole[k]:
                        px, py, pz = ox - t * m[2, 0], oy - t * m[2, 1], oz - t * m[2, 2]
                        _, nx, ny, nz, _, _ = gauge_derivatives(px, py, pz, a1, a2, a3, e1, e2)
                        hit = nx * (eye_1 - px) + ny * (eye_2 - py) + nz * (eye_3 - pz) > 0.0
                    if hit:
                        z = t3 - t
                        if quantum[k] > 0.0:
                            z = (np.floor(z / quantum[k]) + 0.5) * quantum[k]
                        surface[i, j] = z
                        seen[hits] = z
                        if occluded:
                            reach[hits] = distance
                        hits += 1
                        first_row, last_row = min(first_row, i), max(last_row, i)
                        first_column, last_column = min(first_column, j), max(last_column, j)
            if hits == 0 or turn > last_round:
                break
            if occluded and turn == 0:
                front = np.sort(reach[:hits])[int((1.0 - fronts[k, 5]) * (hits - 1))]
                continue
            ordered = np.sort(seen[:hits])
            outliers = int(hits * OUTLIERS_PER_END)
            anchor[k, 2] = ordered[hits - 1 - outliers]
            extent = ordered[hits - 1 - outliers] - ordered[outliers]
            if measured:
                extent = max(extent, max(last_row - first_row, last_column - first_column) * side[k] / pixels)
            else:
                extent = max(extent, side[k] / MARGIN)
            done = abs(extent * MARGIN - side[k]) <= (_SAME_EXTENT + 1.5 * measured / pixels) * side[k]
            if done and not missed:
                break
            if measured:
                anchor[k, 0] += (0.5 * (first_column + last_column + 1) / pixels - 0.5) * side[k]
                anchor[k, 1] -= (0.5 * (first_row + last_row + 1) / pixels - 0.5) * side[k]
            side[k] = extent * MARGIN
            if missed and (done or turn == last_round):
                for axis in range(3):
                    anchor[k, axis] += misses[k, axis] * side[k]
                side[k] *= np.exp(misses[k, 3])
                last_round = turn
        for i in range(pixels):
            for j in range(pixels):
                if surface[i, j] > _NOTHING:
                    value = (surface[i, j] - anchor[k, 2]) / side[k] + NEAREST
                    images[k, i, j] = min(max(value, 1 / 255), 1.0)
                elif surface[i, j] == _BEHIND:
                    images[k, i, j] = HIDDEN


@kernel
def _front_distance(x: float, y: float, front: np.ndarray) -> float:
    """How far a point of the view lies in the direction of an occluder, its bow taken off; see :class:`Occluder`."""
    cosine, sine = np.cos(front[0]), np.sin(front[0])
    across = abs(cosine * y - sine * x - front[2])
    return cosine * x + sine * y - front[1] * across ** front[3]
