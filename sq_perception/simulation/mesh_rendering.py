"""Depth images of triangle meshes.

With the corners a, b, c of a triangle in the optical frame and the ray z d of a pixel, d = (x, y, 1),

    z = a.(b x c) / (e1 + e2 + e3),   e1 = d.(b x c),  e2 = d.(c x a),  e3 = d.(a x b),

and the ray meets the triangle where e1, e2, e3 have the same sign: exact in perspective, without clipping or
interpolation.  Pinhole cameras only; the mesh lies in front of the camera.  Metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sq_perception.geometry.kernels import kernel
from sq_perception.imaging.camera import Camera, Lens


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles: vertices (n, 3), and faces (m, 3) of vertex indices."""

    vertices: np.ndarray
    faces: np.ndarray


def render_mesh(mesh: Mesh, camera: Camera) -> np.ndarray:
    """Depth (height, width) of a mesh in the optical frame; +inf where there is none.

    Faces are seen from both sides.

    Raises
    ------
    ValueError
        For another camera than a pinhole one, or a mesh that is not wholly in front of it.
    """
    if not camera.is_pinhole or mesh.vertices[:, 2].min() <= 0:
        raise ValueError("expected a pinhole camera and a mesh in front of it")
    depth = np.full((camera.height, camera.width), np.inf)
    corners = np.ascontiguousarray(mesh.vertices[mesh.faces], dtype=float)
    pixels = camera.project(corners)
    windows = np.concatenate([np.ceil(pixels.min(axis=1) - 1e-6), np.floor(pixels.max(axis=1) + 1e-6) + 1], axis=1)
    limits = np.array([camera.width, camera.height, camera.width, camera.height])
    windows = np.clip(windows, 0, limits).astype(np.int64)
    _rasterise(corners, windows, camera.lens, depth)
    return depth


@kernel
def _rasterise(corners: np.ndarray, windows: np.ndarray, lens: Lens, depth: np.ndarray) -> None:
    fx, fy, cx, cy, _ = lens
    for k in range(corners.shape[0]):
        a, b, c = corners[k]
        left, top, right, bottom = windows[k]
        bc, ca, ab = np.cross(b, c), np.cross(c, a), np.cross(a, b)
        volume = a[0] * bc[0] + a[1] * bc[1] + a[2] * bc[2]
        if volume == 0.0:
            continue
        for v in range(top, bottom):
            y = (v - cy) / fy
            for u in range(left, right):
                x = (u - cx) / fx
                e1 = x * bc[0] + y * bc[1] + bc[2]
                e2 = x * ca[0] + y * ca[1] + ca[2]
                e3 = x * ab[0] + y * ab[1] + ab[2]
                if not ((e1 >= 0 and e2 >= 0 and e3 >= 0) or (e1 <= 0 and e2 <= 0 and e3 <= 0)):
                    continue
                total = e1 + e2 + e3
                if total == 0.0:
                    continue
                z = volume / total
                if 0.0 < z < depth[v, u]:
                    depth[v, u] = z
