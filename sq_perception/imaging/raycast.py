"""Exact depth images of superquadrics: rays against the gauge, Newton from the bounding box inwards."""

from __future__ import annotations

import numba
import numpy as np

from sq_perception.geometry.kernels import (
    Triple,
    in_object_frame,
    inline_kernel,
    inside_box,
    kernel,
    parallel_kernel,
    ray_entry,
)
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.camera import Camera, Lens


def render(bodies: Superquadric, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Depth and visible body of every pixel.

    ``bodies``: one or a batch (n,) in the optical frame, NumPy; ValueError for a batch of more dimensions.

    Returns depth, float64 (height, width), of the nearest surface, metres, +inf where there is none, and index, int32
    (height, width), of the visible body within the batch, -1 where there is none.  A pinhole camera sees only what is
    in front of it; a camera inside a body does not see that body.
    """
    if len(bodies.batch_shape) > 1:
        raise ValueError(f"bodies: expected one or a batch (n,), got a batch of shape {bodies.batch_shape}")
    if not bodies.batch_shape:
        bodies = Superquadric.from_flat(bodies.to_numbers()[None])
    depth = np.full((camera.height, camera.width), np.inf)
    index = np.full((camera.height, camera.width), -1, dtype=np.int32)
    matrices = np.ascontiguousarray(bodies.rotation_matrix, dtype=float)
    flat = np.ascontiguousarray(bodies.to_numbers(), dtype=float)
    boxes = Superquadric.from_flat(flat).untapered().bounding_box()  # closed form, and hardly larger
    # Corners of a box: which of its lower and upper x, y and z each is at.
    corners = np.stack(boxes, axis=1)[:, np.indices((2, 2, 2)).reshape(3, 8).T, [0, 1, 2]]
    _render_bodies(flat, matrices, windows(corners, camera), camera.lens, depth, index)
    return depth, index


def windows(corners: np.ndarray, camera: Camera) -> np.ndarray:
    """The part of the image that each of n things can be seen in: int64 (n, 4), left, top, right and bottom pixel, the
    last two exclusive.

    A thing lies within the convex hull of its ``corners`` (n, k, 3).  One that reaches behind a pinhole camera may be
    seen anywhere in the image, one that is wholly behind it nowhere.
    """
    pixels, size = camera.project(corners), np.array([camera.width, camera.height])
    first, last = np.ceil(pixels.min(axis=1) - 1e-6), np.floor(pixels.max(axis=1) + 1e-6) + 1
    if camera.is_pinhole:
        z = corners[..., 2]
        # Depth before a pinhole camera, metres, below which a corner says nothing of where a thing is seen.
        reaches_behind = z.min(axis=1) <= 1e-6
        first[reaches_behind], last[reaches_behind] = 0, size
        last[z.max(axis=1) <= 0] = 0
    return np.clip(np.concatenate([first, last], axis=1), 0, [*size, *size]).astype(np.int64)


@parallel_kernel
def _render_bodies(
    flat: np.ndarray, matrices: np.ndarray, windows: np.ndarray, lens: Lens, depth: np.ndarray, index: np.ndarray
) -> None:
    fx, fy, cx, cy, pinhole = lens
    for v in numba.prange(depth.shape[0]):
        for k in range(flat.shape[0]):
            left, top, right, bottom = windows[k]
            if v < top or v >= bottom:
                continue
            a1, a2, a3, e1, e2, t1, t2, t3 = flat[k, :8]
            form = a1, a2, a3, e1, e2, flat[k, 12], flat[k, 13]
            m = matrices[k]
            for u in range(left, right):
                x, y = (u - cx) / fx, (v - cy) / fy
                if pinhole:
                    px, py, rx, ry = -t1, -t2, x, y
                else:
                    px, py, rx, ry = x - t1, y - t2, 0.0, 0.0
                origin, way = in_object_frame(m, px, py, -t3), in_object_frame(m, rx, ry, 1.0)
                # What begins behind something nearer needs no search.
                t_in, _ = inside_box(origin, way, form)
                if t_in >= depth[v, u]:
                    continue
                hit, t = ray_entry(origin, way, form)
                if hit and t < depth[v, u] and (t > 0.0 or not pinhole):
                    depth[v, u] = t
                    index[v, u] = k


@inline_kernel
def point_at(u: int, v: int, z: float, lens: Lens) -> Triple:
    """The point that a pixel sees at a depth."""
    scale = z if lens.is_pinhole else 1.0
    return (u - lens.cx) / lens.fx * scale, (v - lens.cy) / lens.fy * scale, z


@kernel
def heights(depth: np.ndarray, mask: np.ndarray, lens: Lens, plane: np.ndarray) -> np.ndarray:
    """Heights (h, w) above a plane (4,) of what the pixels of a mask (h, w) see, by their depths; NaN elsewhere."""
    found = np.full(depth.shape, np.nan)
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            if mask[v, u]:
                x, y, z = point_at(u, v, np.float64(depth[v, u]), lens)
                found[v, u] = plane[0] * x + plane[1] * y + plane[2] * z + plane[3]
    return found
