"""Depth images of unions of superquadrics, some of them with cavities, and of triangle meshes; and canonical views.

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

Canonical views
---------------
Views of known bodies, rendered directly without an image, the source of training data, equal those that
:mod:`sq_perception.imaging.canonical_view` makes of images: rays along z on the view's own grid, fitted to the visible
part of the body.  A pinhole camera sees less of a body, of a convex one only points whose normals point to it: rays
that meet others are left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numba
import numpy as np

from sq_perception.geometry import kernels
from sq_perception.geometry.kernels import gauge, in_object_frame, kernel, parallel_kernel, ray_entry, ray_interval
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.camera import Camera, Lens
from sq_perception.imaging.canonical_view import HIDDEN, MARGIN, NEAREST, OUTLIERS_PER_END
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


_NOTHING, _BEHIND = -1e300, -2e300
"""In place of the z that a ray meets: it meets no surface, or an occluder before it could."""
_Sensed: TypeAlias = tuple[bool, float, float]
"""Whether a pinhole camera sees, its eye's z, and the step of depths, 0 for none."""
_Curtain: TypeAlias = tuple[float, float, float, float]
"""Middle x, y and side of the view that an occluder is given in, and how far in its direction it begins."""


class Occluder(NamedTuple):
    """An opaque occluder before each body (n,): all that lies beyond a front from one side.

    In the plane of the view, in units of its side and from its middle, (u, v) are coordinates along and across the
    direction the occluder comes from; hidden is

        c < u - bow |v - offset|^power < c + thickness,

    c such that ``share`` of the body's pixels lie beyond the front.  bow = 0 is a straight edge, power 1 a corner,
    power 2 a round object.
    """

    direction: np.ndarray  # (n,), angle of u, radians from the view's x axis
    bow: np.ndarray
    offset: np.ndarray
    power: np.ndarray
    thickness: np.ndarray
    share: np.ndarray  # (n,), share of the body's own pixels that is hidden, 0 to below 1; 0 is no occluder


def render_views(
    bodies: Superquadric, pixels: int = 64, levels: np.ndarray | None = None, distance: np.ndarray | None = None,
    occluder: Occluder | None = None, miss: np.ndarray | None = None,
) -> tuple[np.ndarray, Superquadric]:
    """Render the canonical view of each body alone, fitted to its visible part as :func:`canonical_view.from_mask`.

    bodies: NumPy batch (n,), in a frame like the cube's: y up, z towards the viewer.
    pixels: Side of the views.
    levels: (n,), grey levels per unit of the bodies' frame: depths are rounded down to them, as in an image of
        integers.
    distance: (n,), distance of a pinhole camera from the nearest face of the body's box, in the bodies' unit; infinite,
        as by default, for an orthographic camera.
    occluder: What stands before the bodies; its pixels are :data:`HIDDEN`.
    miss: (n, 4), how far the view's middle (x, y), nearest depth (z) and the logarithm of its side are off, the first
        three in sides: errors of a mask and of noisy depths.

    Returns images, float32 (n, pixels, pixels), and the batch in the canonical frame of its views.
    Raises ValueError for a distance that is not positive, or a share outside of [0, 1).
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
    fronts = np.zeros((len(bodies), 6)) if occluder is None else np.stack(occluder, axis=-1)
    if not ((fronts[:, 5] >= 0) & (fronts[:, 5] < 1)).all():
        raise ValueError("occluder: expected shares of at least 0 and below 1")
    misses = np.zeros((len(bodies), 4)) if miss is None else np.array(miss, dtype=float)
    _render_views(flat, matrices, anchor, side, steps, pinhole, eye, fronts, misses, images)
    identity = np.array([0.0, 0.0, 0.0, 1.0])
    shift = np.array([0.5, 0.5, NEAREST]) - anchor / side[:, None]
    return images, bodies.transformed(identity, shift, 1 / side[:, None])


@parallel_kernel
def _render_views(
    flat: np.ndarray, matrices: np.ndarray, anchor: np.ndarray, side: np.ndarray, quantum: np.ndarray,
    pinhole: np.ndarray, eye: np.ndarray, fronts: np.ndarray, misses: np.ndarray, images: np.ndarray,
) -> None:
    """Render all images; ``anchor`` and ``side`` become those of the views."""
    for k in numba.prange(flat.shape[0]):
        sensed = pinhole[k], eye[k], quantum[k]
        side[k] = _render_view(flat[k], matrices[k], anchor[k], side[k], sensed, fronts[k], misses[k], images[k])


@kernel
def _render_view(
    body: np.ndarray, turn: np.ndarray, anchor: np.ndarray, side: float, sensed: _Sensed, front: np.ndarray,
    miss: np.ndarray, image: np.ndarray,
) -> float:
    """Render, find the visible extent, and render again until the extent is the view's side."""
    pixels = image.shape[0]
    surface, reach = np.empty((pixels, pixels)), np.empty((pixels, pixels))
    is_occluded, is_missed = front[5] > 0.0, np.any(miss != 0.0)
    is_fitted = sensed[0] or is_occluded  # else all of the body's extent is seen, which is known
    # Where there is an occluder, the first round finds where that begins.
    rounds, curtain = 4, (anchor[0], anchor[1], side, np.inf)
    if is_occluded:
        _cast(body, turn, anchor, side, sensed, front, curtain, surface, reach)
        curtain = (anchor[0], anchor[1], side, _front_start(surface, reach, front[5]))
        rounds -= 1
    while True:
        _cast(body, turn, anchor, side, sensed, front, curtain, surface, reach)
        rounds -= 1
        seen = np.sort(surface.ravel()[surface.ravel() > _NOTHING])
        if len(seen) == 0 or rounds < 0:
            break
        outliers = int(len(seen) * OUTLIERS_PER_END)
        anchor[2] = seen[len(seen) - 1 - outliers]
        extent = anchor[2] - seen[outliers]
        rows, columns = np.nonzero(surface > _NOTHING)
        top, bottom, left, right = rows.min(), rows.max(), columns.min(), columns.max()
        extent = max(extent, max(bottom - top, right - left) * side / pixels if is_fitted else side / MARGIN)
        done = abs(extent * MARGIN - side) <= (0.005 + 1.5 * is_fitted / pixels) * side
        if done and not is_missed:
            break
        if is_fitted:
            anchor[0] += (0.5 * (left + right + 1) / pixels - 0.5) * side
            anchor[1] -= (0.5 * (top + bottom + 1) / pixels - 0.5) * side
        side = extent * MARGIN
        if is_missed and (done or rounds == 0):
            anchor += miss[:3] * side
            side *= np.exp(miss[3])
            rounds = 0
    for i in range(pixels):
        for j in range(pixels):
            if surface[i, j] > _NOTHING:
                image[i, j] = min(max((surface[i, j] - anchor[2]) / side + NEAREST, 1 / 255), 1.0)
            elif surface[i, j] == _BEHIND:
                image[i, j] = HIDDEN
    return side


@kernel
def _cast(
    body: np.ndarray, turn: np.ndarray, anchor: np.ndarray, side: float, sensed: _Sensed, front: np.ndarray,
    curtain: _Curtain, surface: np.ndarray, reach: np.ndarray,
) -> None:
    """Return what the rays of a view meet: z of the body, :data:`_NOTHING`, or :data:`_BEHIND` an occluder; ``reach``
    becomes how far in its direction they are."""
    pixels = surface.shape[0]
    a1, a2, a3, e1, e2, t1, t2, t3 = body[:8]
    is_pinhole, eye, quantum = sensed
    middle_x, middle_y, unit, begins = curtain
    eye_1, eye_2, eye_3 = turn[2, 0] * (eye - t3), turn[2, 1] * (eye - t3), turn[2, 2] * (eye - t3)
    for i in range(pixels):
        for j in range(pixels):
            surface[i, j] = _NOTHING
            x = anchor[0] + ((j + 0.5) / pixels - 0.5) * side
            y = anchor[1] - ((i + 0.5) / pixels - 0.5) * side
            if front[5] > 0.0:
                reach[i, j] = _front_distance((x - middle_x) / unit, (y - middle_y) / unit, front)
                if begins < reach[i, j] < begins + front[4]:
                    surface[i, j] = _BEHIND
                    continue
            x, y = x - t1, y - t2
            ox, oy, oz = (
                turn[0, 0] * x + turn[1, 0] * y,
                turn[0, 1] * x + turn[1, 1] * y,
                turn[0, 2] * x + turn[1, 2] * y,
            )
            hit, t = ray_entry((ox, oy, oz), (-turn[2, 0], -turn[2, 1], -turn[2, 2]), (a1, a2, a3, e1, e2, 0.0, 0.0))
            if hit and is_pinhole:
                px, py, pz = ox - t * turn[2, 0], oy - t * turn[2, 1], oz - t * turn[2, 2]
                _, nx, ny, nz, _, _, _, _ = kernels.gauge_derivatives(px, py, pz, a1, a2, a3, e1, e2, 0.0, 0.0)
                hit = nx * (eye_1 - px) + ny * (eye_2 - py) + nz * (eye_3 - pz) > 0.0
            if hit:
                surface[i, j] = (np.floor((t3 - t) / quantum) + 0.5) * quantum if quantum > 0.0 else t3 - t


@kernel
def _front_start(surface: np.ndarray, reach: np.ndarray, share: float) -> float:
    """Return where an occluder begins in its direction, so that this share of the visible part lies beyond."""
    seen = np.sort(reach.ravel()[surface.ravel() > _NOTHING])
    return seen[int((1.0 - share) * (len(seen) - 1))] if len(seen) else np.inf


@kernel
def _front_distance(x: float, y: float, front: np.ndarray) -> float:
    """Return a point's coordinate in an occluder's direction, less its bow; see :class:`Occluder`."""
    cosine, sine = np.cos(front[0]), np.sin(front[0])
    across = abs(cosine * y - sine * x - front[2])
    return cosine * x + sine * y - front[1] * across ** front[3]
