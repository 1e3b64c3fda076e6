"""Depth images of objects: unions of superquadrics, some of them with cavities, and triangle meshes.

Unions
------
A ray meets the nearest part of a union.  If that point is inside a cavity, the ray continues to where it leaves the
cavity, whose far wall is the object again.  Cavities are open to the outside and otherwise lie within the union.  Table
and wall are behind.

Meshes
------
With the corners a, b, c of a triangle in the optical frame and the ray z d of a pixel, d = (x, y, 1),

    z = a.(b x c) / (e1 + e2 + e3),   e1 = d.(b x c),  e2 = d.(c x a),  e3 = d.(a x b),

and the ray meets the triangle if e1, e2, e3 have the same sign: exact in perspective, without clipping or
interpolation.  Pinhole cameras only; the mesh is in front of the camera.  Metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from sq_perception.geometry.kernels import gauge, in_object_frame, kernel, parallel_kernel, ray_interval
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.camera import Camera, Lens
from sq_perception.imaging.raycast import render, windows


def render_things(
    parts: Superquadric, owner: np.ndarray, cavities: Superquadric, cavity_owner: np.ndarray, camera: Camera,
    table: np.ndarray | None = None, behind: float = np.inf,
) -> tuple[np.ndarray, np.ndarray]:
    """Render depth, float64 (height, width), metres, +inf for nothing, and the visible part's owner, int32, -1 for
    none.  Parts (k,) and cavities (m,) in a pinhole camera's frame before a ``table`` (4,), n up, and a wall at
    ``behind``."""
    depth, index = render(parts, camera)
    thing = np.append(np.asarray(owner, dtype=np.int32), np.int32(-1))[index]
    if len(cavities):
        matrices = np.ascontiguousarray(cavities.rotation_matrix, dtype=float)
        flat = np.ascontiguousarray(cavities.to_flat(), dtype=float)
        _hollow_out(flat, matrices, np.asarray(cavity_owner, dtype=np.int32), camera.lens, depth, thing)
    plane = np.array([0.0, 0.0, 0.0, 1.0]) if table is None else np.asarray(table, dtype=float)
    _add_background(plane, float(behind), camera.lens, depth, thing)
    return depth, thing


@kernel
def _add_background(plane: np.ndarray, behind: float, lens: Lens, depth: np.ndarray, thing: np.ndarray) -> None:
    """Add table and wall where they are nearer than the objects, in place."""
    fx, fy, cx, cy, _ = lens
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            z = behind
            slope = plane[0] * (u - cx) / fx + plane[1] * (v - cy) / fy + plane[2]
            if slope < 0.0 and plane[3] > 0.0:
                z = min(z, -plane[3] / slope)
            if z < depth[v, u]:
                depth[v, u] = z
                thing[v, u] = -1


@parallel_kernel
def _hollow_out(
    flat: np.ndarray, matrices: np.ndarray, owner: np.ndarray, lens: Lens, depth: np.ndarray, thing: np.ndarray
) -> None:
    fx, fy, cx, cy, _ = lens
    for v in numba.prange(depth.shape[0]):
        for u in range(depth.shape[1]):
            if thing[v, u] < 0:
                continue
            for k in range(flat.shape[0]):
                if owner[k] != thing[v, u]:
                    continue
                a1, a2, a3, e1, e2, t1, t2, t3 = flat[k, :8]
                m = matrices[k]
                x, y = (u - cx) / fx, (v - cy) / fy
                origin, way = in_object_frame(m, -t1, -t2, -t3), in_object_frame(m, x, y, 1.0)
                (ox, oy, oz), (dx, dy, dz) = origin, way
                z = depth[v, u]
                if gauge(ox + z * dx, oy + z * dy, oz + z * dz, a1, a2, a3, e1, e2, 0.0, 0.0) < 1.0:
                    hit, _, last = ray_interval(origin, way, (a1, a2, a3, e1, e2, 0.0, 0.0))
                    if hit and last > z:
                        depth[v, u] = last


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh: vertices (n, 3), and faces (m, 3) of vertex indices."""

    vertices: np.ndarray
    faces: np.ndarray


def render_mesh(mesh: Mesh, camera: Camera) -> np.ndarray:
    """Render the depth (height, width) of a mesh in the optical frame, seen from both sides; +inf for no surface.
    Raises ValueError for another camera than a pinhole one, or a mesh that is not wholly in front of it."""
    if not camera.is_pinhole or mesh.vertices[:, 2].min() <= 0:
        raise ValueError("expected a pinhole camera and a mesh in front of it")
    depth = np.full((camera.height, camera.width), np.inf)
    corners = np.ascontiguousarray(mesh.vertices[mesh.faces], dtype=float)
    _rasterise(corners, windows(corners, camera), camera.lens, depth)
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
