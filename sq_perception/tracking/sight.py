"""Whether a body should have been seen where it is thought to be, and from where it is seen.

26 points of the surface, in the directions of a cube's faces, edges and corners, speak for a body; those on the far
side are left out.  A point is evidence of absence only where the image measured something farther: beyond the image,
where nothing was measured, or where something lies in front or at the body's place, nothing shows that it has gone.

Unless that is another body that was seen: two cannot be in one place, and a track whose surface lies mostly in or at
others, such as that of a piece that a segmentation once cut off, has gone.

Optical frame, metres.
"""

from __future__ import annotations

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import perforation
from sq_perception.imaging.camera import Camera

_DIRECTIONS = np.array([d for d in np.ndindex(3, 3, 3) if d != (1, 1, 1)], dtype=float) - 1
_TOLERANCE = 0.25
"""Share of the smallest half size: a depth that differs by less is the body's own.  Chosen: above noise and misfit,
below a thing that stands behind."""
_TOLD = 0.25
"""Share of the points of the near side that have to tell something, three of mostly twelve.  Chosen."""


def expected(
    states: np.ndarray, camera: Camera | None, depth: np.ndarray | None, rotation: np.ndarray, position: np.ndarray
) -> np.ndarray:
    """Whether unseen tracks (n, 12) should have been seen, (n,), by a camera with this pose in the world.

    Those that it sees through for the greater part of the near side that it could see; all of them where the frame's
    camera or depth image is not known.
    """
    if camera is None or depth is None or not len(states):
        return np.ones(len(states), dtype=bool)
    back = quaternions.conjugate(rotation)
    home = -quaternions.to_matrix(back) @ position
    return open_share(Superquadric.from_flat(states).transformed(back, home), camera, depth) >= 0.5


def open_share(bodies: Superquadric, camera: Camera, depth: np.ndarray) -> np.ndarray:
    """Share (n,) of the near side that the camera sees through, of what it could see; 0 where that is too little.

    Parameters
    ----------
    bodies : Superquadric
        A batch (n,).
    camera : Camera
    depth : float (height, width)
        What was measured; NaN, inf or (pinhole) 0 and less: nothing.
    """
    points, near = _near_side(bodies, camera)
    pixels = camera.project(points)
    inside = near & (pixels >= 0).all(axis=-1) & (pixels <= [camera.width - 1, camera.height - 1]).all(axis=-1)
    column, row = np.where(inside[..., None], np.rint(np.nan_to_num(pixels)), 0).astype(int).transpose(2, 0, 1)
    measured = _readings(depth[row, column].astype(float), camera)
    valid = np.isfinite(measured)
    if (inside & ~valid).any():
        # A point that falls into a gap between readings of the same surface is told by these.
        measured = perforation.filled(_readings(depth, camera))[0][row, column].astype(float)
        valid = np.isfinite(measured)
    tolerance = _TOLERANCE * bodies.size.min(axis=-1)[:, None]
    behind = np.where(inside & valid, measured, -np.inf) - points[..., 2]
    clear, told = (behind > tolerance).sum(axis=1), (behind >= -tolerance).sum(axis=1)
    return np.where(told >= _TOLD * near.sum(axis=1), clear / np.maximum(told, 1), 0.0)


def _readings(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """The depths, NaN where nothing was measured."""
    return np.where(np.isfinite(depth) & ((depth > 0) | (not camera.is_pinhole)), depth, np.nan)


def taken_share(states: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Share (n,) of the surfaces of tracks (n, 12) that lies in others (m, 12), or at them."""
    if not len(others):
        return np.zeros(len(states))
    bodies = Superquadric.from_flat(states)
    points = _surface(bodies)
    away = Superquadric.from_flat(others).sampson_distance(points.reshape(1, -1, 3))
    tolerance = _TOLERANCE * bodies.size.min(axis=-1)[:, None]
    return np.asarray((away.reshape(-1, *points.shape[:2]) < tolerance).any(axis=0).mean(axis=1))


def _near_side(bodies: Superquadric, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Surface points (n, 26, 3), and which of them (n, 26) face the camera."""
    points = _surface(bodies)
    normals = bodies.gauge_gradient(points)
    sight = points if camera.is_pinhole else np.array([0.0, 0.0, 1.0])
    return points, (normals * sight).sum(axis=-1) < 0


def _surface(bodies: Superquadric) -> np.ndarray:
    """Points (n, 26, 3) of the surfaces of bodies (n,)."""
    along = _DIRECTIONS * bodies.size[:, None]
    local = Superquadric.at_origin(bodies.size, bodies.shape, bodies.taper)
    return np.asarray(bodies.to_parent(along / local.gauge(along)[..., None]))


def towards(centres: np.ndarray, rotation: np.ndarray, position: np.ndarray, orthographic: bool) -> np.ndarray:
    """Unit vectors (m, 3) from centres (m, 3) to the camera; an orthographic one looks along its z from everywhere."""
    if orthographic:
        return np.broadcast_to(-quaternions.to_matrix(rotation)[:, 2], centres.shape)
    way = position - centres
    return way / np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1e-12)
