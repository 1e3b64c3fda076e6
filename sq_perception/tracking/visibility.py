"""Whether a body that was not observed should have been, and from where a body is seen.

26 points of the surface, in the directions of a cube's faces, edges and corners, stand for a body; those on the far
side do not count.  A point is evidence of absence only where the image measured something farther: beyond the image,
where nothing was measured, and where something lies in front or in the body's place, nothing shows that it has gone.

Optical frame, metres.
"""

from __future__ import annotations

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import hole_filling
from sq_perception.imaging.camera import Camera

_DIRECTIONS = np.array([d for d in np.ndindex(3, 3, 3) if d != (1, 1, 1)], dtype=float) - 1


def is_missing(
    states: np.ndarray, camera: Camera | None, depth: np.ndarray | None, rotation: np.ndarray, position: np.ndarray
) -> np.ndarray:
    """Whether bodies (n, 12), seen by a camera with this pose in the world, are not where they should be, bool (n,).
    The camera sees through most of the near side that it could see.  Without camera or depth image all are missing."""
    if camera is None or depth is None or not len(states):
        return np.ones(len(states), dtype=bool)
    back = quaternions.conjugate(rotation)
    home = -quaternions.to_matrix(back) @ position
    return open_share(Superquadric.from_flat(states).transformed(back, home), camera, depth) >= 0.5


def open_share(bodies: Superquadric, camera: Camera, depth: np.ndarray) -> np.ndarray:
    """Share (n,) of the near side that the camera sees through, of what it could see; 0 where that is nothing.

    ``bodies`` are a batch (n,); in ``depth`` (height, width) NaN, inf and, of a pinhole camera, 0 and less are nothing.
    """
    along = _DIRECTIONS * bodies.size[:, None]
    surface = along / Superquadric.at_origin(bodies.size, bodies.shape).gauge(along)[..., None]
    points = np.asarray(bodies.to_parent(surface))
    sight = points if camera.is_pinhole else np.array([0.0, 0.0, 1.0])
    near = (bodies.gauge_gradient(points) * sight).sum(axis=-1) < 0
    pixels = camera.project(points)
    inside = near & (pixels >= 0).all(axis=-1) & (pixels <= [camera.width - 1, camera.height - 1]).all(axis=-1)
    column, row = np.where(inside[..., None], np.rint(np.nan_to_num(pixels)), 0).astype(int).transpose(2, 0, 1)
    measured = _readings(depth[row, column].astype(float), camera)
    if (inside & ~np.isfinite(measured)).any():  # perhaps a gap between readings of one surface
        measured = hole_filling.fill(_readings(depth, camera))[0][row, column].astype(float)
    # Share of the smallest half size by which depths differ that are the body's own. Chosen: above noise and misfit,
    # below a thing that stands behind.
    tolerance = 0.25 * bodies.size.min(axis=-1)[:, None]
    behind = np.where(inside & np.isfinite(measured), measured, -np.inf) - points[..., 2]
    clear, observed = (behind > tolerance).sum(axis=1), (behind >= -tolerance).sum(axis=1)
    return clear / np.maximum(observed, 1)


def _readings(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """The depths, NaN where nothing was measured."""
    return np.where(np.isfinite(depth) & ((depth > 0) | (not camera.is_pinhole)), depth, np.nan)


def directions(centres: np.ndarray, rotation: np.ndarray, position: np.ndarray, orthographic: bool) -> np.ndarray:
    """Unit vectors (m, 3) from centres (m, 3) to the camera; an orthographic one looks along its z from everywhere."""
    if orthographic:
        return np.broadcast_to(-quaternions.to_matrix(rotation)[:, 2], centres.shape)
    way = position - centres
    return way / np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1e-12)
