"""Exact depth images of superquadrics: rays against the gauge, Newton from the bounding box inwards.

Depth is the z coordinate in the optical frame (metres), +inf where a pixel sees no body.
"""

from __future__ import annotations

import numba
import numpy as np

from sq_perception.geometry.kernels import box_interval, in_object_frame, kernel, parallel_kernel, ray_entry, support
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.camera import Camera, Lens


def render(bodies: Superquadric, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Depth and visible body of every pixel.

    Parameters
    ----------
    bodies : Superquadric
        One body or a batch (n,) in the optical frame, NumPy.
    camera : Camera

    Returns
    -------
    depth : float64 (height, width)
        Depth of the nearest surface in metres, +inf where there is none.  A pinhole camera sees only what is in front
        of it; a camera inside a body does not see that body.
    index : int32 (height, width)
        Number of the visible body within the batch, -1 where there is none.

    Raises
    ------
    ValueError
        For a batch of more dimensions.
    """
    if len(bodies.batch_shape) > 1:
        raise ValueError(f"bodies: expected one or a batch (n,), got a batch of shape {bodies.batch_shape}")
    if not bodies.batch_shape:
        bodies = Superquadric.from_flat(bodies.to_flat()[None])
    depth = np.full((camera.height, camera.width), np.inf)
    index = np.full((camera.height, camera.width), -1, dtype=np.int32)
    matrices = np.ascontiguousarray(bodies.rotation_matrix, dtype=float)
    flat = np.ascontiguousarray(bodies.to_flat(), dtype=float)
    windows = _windows(flat, matrices, camera.lens, camera.width, camera.height)
    _render_bodies(flat, matrices, windows, camera.lens, depth, index)
    return depth, index


@kernel
def _windows(flat: np.ndarray, matrices: np.ndarray, lens: Lens, width: int, height: int) -> np.ndarray:
    """Pixels (n, 4): left, top, right, bottom, the last two exclusive, outside of which no part of a body is seen.

    Those of the corners of the box around each body.
    """
    fx, fy, cx, cy, pinhole = lens
    windows = np.zeros((flat.shape[0], 4), np.int64)
    reach = np.empty(3)
    for k in range(flat.shape[0]):
        a1, a2, a3, e1, e2, t1, t2, t3 = flat[k, :8]
        for axis in range(3):
            m = matrices[k, axis]
            reach[axis] = support(m[0], m[1], m[2], a1, a2, a3, e1, e2)
        if pinhole and t3 + reach[2] <= 0.0:
            continue
        left, top, right, bottom = 0.0, 0.0, float(width), float(height)
        if not pinhole or t3 - reach[2] > 1e-6:
            least_u, most_u, least_v, most_v = np.inf, -np.inf, np.inf, -np.inf
            for corner in range(8):
                x = t1 + (reach[0] if corner & 1 else -reach[0])
                y = t2 + (reach[1] if corner & 2 else -reach[1])
                scale = 1.0 / (t3 + (reach[2] if corner & 4 else -reach[2])) if pinhole else 1.0
                u, v = fx * x * scale + cx, fy * y * scale + cy
                least_u, most_u, least_v, most_v = min(least_u, u), max(most_u, u), min(least_v, v), max(most_v, v)
            left, right = max(left, np.floor(least_u)), min(right, np.ceil(most_u) + 1.0)
            top, bottom = max(top, np.floor(least_v)), min(bottom, np.ceil(most_v) + 1.0)
        if left < right and top < bottom:
            windows[k, 0], windows[k, 1], windows[k, 2], windows[k, 3] = int(left), int(top), int(right), int(bottom)
    return windows


@parallel_kernel
def _render_bodies(
    flat: np.ndarray,
    matrices: np.ndarray,
    windows: np.ndarray,
    lens: Lens,
    depth: np.ndarray,
    index: np.ndarray,
) -> None:
    fx, fy, cx, cy, pinhole = lens
    for v in numba.prange(depth.shape[0]):
        for k in range(flat.shape[0]):
            left, top, right, bottom = windows[k]
            if v < top or v >= bottom:
                continue
            a1, a2, a3, e1, e2, t1, t2, t3 = flat[k, :8]
            m = matrices[k]
            for u in range(left, right):
                x, y = (u - cx) / fx, (v - cy) / fy
                if pinhole:
                    px, py, rx, ry = -t1, -t2, x, y
                else:
                    px, py, rx, ry = x - t1, y - t2, 0.0, 0.0
                origin, way = in_object_frame(m, px, py, -t3), in_object_frame(m, rx, ry, 1.0)
                # What begins behind something nearer needs no search.
                t_in, _ = box_interval(origin, way, (a1, a2, a3))
                if t_in >= depth[v, u]:
                    continue
                hit, t = ray_entry(origin, way, (a1, a2, a3, e1, e2))
                if hit and t < depth[v, u] and (t > 0.0 or not pinhole):
                    depth[v, u] = t
                    index[v, u] = k
