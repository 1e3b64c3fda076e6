"""What the page draws, as arrays: points of the depth image, meshes of bodies, shells of their uncertainty, a picture.

Optical frame of the depth image (x right, y down, z forward), metres; for images of the unit cube that of
:func:`sq_perception.imaging.unit_cube.camera`.  Colours are uint8 red, green, blue.

Meshes have one topology, so that the vertices of a body that changes replace those before: rows of parametric points
from pole to pole.  Uniform angles crowd them where the surface bends, as in :mod:`sq_perception.geometry.mesh`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.camera import Camera

ROWS, COLUMNS = 32, 32
"""Rows and columns of a mesh; multiples of 8, so that the corners of a box are among the points."""
SHELL_SIGMAS = 2.0
"""Standard deviations between a body and its shell."""
LARGEST_SHELL = 3.0
"""Half sizes of a shell over those of its body, at most: what is hardly known would hide the rest."""
PICTURE_WIDTH = 384
COLOUR_MAP = cv2.COLORMAP_TURBO
_SPAN_PERCENTILES = (1.0, 99.0)
_SPAN_POINTS = 20000
_NEAR_GREY, _FAR_GREY = np.array([150.0, 162, 182]), np.array([52.0, 62, 84])
_POINT_SHARE = 0.5
"""Share of the pixels that a point stands for, so that what lies behind the points is to be seen between them."""
_LEAST_SPAN = 0.05
"""Share of the depth at the far end: a flat wall is not to be drawn in the colours of its noise."""


@dataclass(frozen=True, eq=False)
class Bodies:
    """What one node found in a frame, n bodies in the optical frame, failed ones left out.

    Attributes
    ----------
    superquadrics : Superquadric
        A batch (n,).
    sigma_size : (n, 3)
        Standard deviations of the half sizes, metres, NaN where unknown.
    score : (n,)
    ids : n of int
    is_weak : n of bool
        Whether the view leaves something open.
    colours : (n, 3)
        Red, green, blue in [0, 1].
    failed : n of int
        Ids of the objects of which no body is known.
    """

    superquadrics: Superquadric
    sigma_size: np.ndarray
    score: np.ndarray
    ids: Sequence[int]
    is_weak: Sequence[bool]
    colours: np.ndarray
    failed: Sequence[int] = ()

    def __len__(self) -> int:
        return len(self.superquadrics)


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points (n, 3) float32 in the optical frame, their colours (n, 3), and how large a point is drawn, metres."""

    points: np.ndarray
    colours: np.ndarray
    point_size: float


def depth_span(depth: np.ndarray) -> tuple[float, float] | None:
    """Nearest and farthest depth, metres, that the colours distinguish; None where nothing was measured.

    One reading in a hundred lies beyond either end.
    """
    seen = depth[:: max(1, depth.size // _SPAN_POINTS), :]
    seen = seen[np.isfinite(seen)]
    if not seen.size:
        return None
    near, far = (float(value) for value in np.percentile(seen, _SPAN_PERCENTILES))
    return near, max(far, near + _LEAST_SPAN * max(abs(far), 1e-6))


def steady_span(before: tuple[float, float] | None, now: tuple[float, float]) -> tuple[float, float]:
    """The span before, unless an end has moved by more than 5 % of it: colours are not to flicker."""
    if before is None:
        return now
    length = before[1] - before[0]
    moved = max(abs(before[0] - now[0]), abs(before[1] - now[1]))
    return now if moved > 0.05 * length else before


def cloud(depth: np.ndarray, camera: Camera, span: tuple[float, float], most: int) -> Cloud:
    """The measured points of a depth image, every k-th row and column so that there are at most ``most``.

    They are grey, darker with the depth: colours are left to the bodies.

    Raises
    ------
    ValueError
        If the image does not fit the camera, or ``most`` is below 1.
    """
    camera.check_image(depth)
    if most < 1:
        raise ValueError(f"number of points: expected at least 1, got {most}")
    step = 1
    while math.ceil(depth.shape[0] / step) * math.ceil(depth.shape[1] / step) > most:
        step += 1
    first = step // 2 if min(depth.shape) > step // 2 else 0
    thin = depth[first::step, first::step]
    v, u = np.nonzero(np.isfinite(thin))
    seen = thin[v, u]
    points = camera.unproject(first + step * u, first + step * v, seen).astype(np.float32)
    typical = float(np.median(seen)) if seen.size else 1.0
    pixel = (typical if camera.is_pinhole else 1.0) / min(camera.fx, camera.fy)
    share = np.clip((seen - span[0]) / (span[1] - span[0]), 0.0, 1.0)[:, None]
    greys = np.rint((1 - share) * _NEAR_GREY + share * _FAR_GREY).astype(np.uint8)
    return Cloud(points, greys, _POINT_SHARE * step * pixel)


def coloured(depth: np.ndarray, span: tuple[float, float]) -> np.ndarray:
    """Colours (height, width, 3) of depths (height, width): red is near, blue far, dark grey not measured."""
    near, far = span
    with np.errstate(invalid="ignore"):
        share = np.nan_to_num(np.clip((far - depth) / (far - near), 0.0, 1.0))
    # The ends of the map are nearly black.
    index = np.rint(20 + 220 * share).astype(np.uint8)
    colours = np.ascontiguousarray(cv2.applyColorMap(index, COLOUR_MAP)[..., ::-1])
    colours[~np.isfinite(depth)] = 38
    return colours


def colour_scale() -> list[tuple[int, int, int]]:
    """Nine colours of :func:`coloured`, from near to far."""
    shown = coloured(np.linspace(0.0, 1.0, 9)[None], (0.0, 1.0))[0]
    return [(int(red), int(green), int(blue)) for red, green, blue in shown]


def picture(depth: np.ndarray, span: tuple[float, float]) -> np.ndarray:
    """The depth image (height, width) as a picture of PICTURE_WIDTH columns."""
    height = max(1, round(depth.shape[0] * PICTURE_WIDTH / depth.shape[1]))
    return coloured(cv2.resize(depth, (PICTURE_WIDTH, height), interpolation=cv2.INTER_NEAREST), span)


def mesh_faces() -> np.ndarray:
    """Triangles (m, 3), uint32, outwards: the same for every mesh."""
    rows = 1 + np.arange((ROWS - 1) * COLUMNS).reshape(ROWS - 1, COLUMNS)
    grid = np.concatenate([np.zeros_like(rows[:1]), rows, np.full_like(rows[:1], 1 + rows.size)])
    here, above = grid[:-1], grid[1:]
    right, beyond = (np.roll(row, -1, axis=1) for row in (here, above))
    # At the poles one of two triangles has two corners that are one.
    faces = [np.stack([here, right, beyond], axis=-1)[1:], np.stack([here, beyond, above], axis=-1)[:-1]]
    return np.concatenate(faces).reshape(-1, 3).astype(np.uint32)


def mesh_vertices(body: Superquadric) -> np.ndarray:
    """Vertices (k, 3), float32, of one body in its own frame, centred: pole, rows, pole."""
    eta = np.linspace(-np.pi / 2, np.pi / 2, ROWS + 1)[1:-1]
    omega = np.linspace(-np.pi, np.pi, COLUMNS, endpoint=False)
    grid = np.meshgrid(eta, omega, indexing="ij")
    rows = Superquadric.at_origin(body.size, body.shape, body.taper).parametric_points(grid[0].ravel(), grid[1].ravel())
    top = np.array([[0.0, 0.0, body.size[2]]])
    return np.concatenate([-top, rows, top]).astype(np.float32)


def shell(body: Superquadric, sigma_size: np.ndarray) -> Superquadric | None:
    """The body with its half sizes SHELL_SIGMAS standard deviations larger; None where none of them is known."""
    sigma = np.nan_to_num(np.asarray(sigma_size, dtype=float), nan=0.0, posinf=np.inf)
    if not (sigma > 0).any():
        return None
    size = np.minimum(body.size + SHELL_SIGMAS * sigma, LARGEST_SHELL * body.size)
    return Superquadric(size, body.shape, body.translation, body.rotation, body.taper)


def label_position(body: Superquadric) -> np.ndarray:
    """Where the label of a body stands, (3,): a little above its highest point (y down)."""
    up = np.array([0.0, -1.0, 0.0])
    return body.translation + up * (float(body.support(up[None])[0]) + 0.1 * float(body.size.min()))


def view_volume(camera: Camera, length: float) -> np.ndarray:
    """Line segments (j, 2, 3) of what a camera sees up to a depth: a pyramid, or a box for orthographic images."""
    u, v = np.array([0.0, 1, 1, 0]) * camera.width - 0.5, np.array([0.0, 0, 1, 1]) * camera.height - 0.5
    near, far = camera.unproject(u, v, np.zeros(4)), camera.unproject(u, v, np.full(4, length))
    edges = [np.stack([near, far], axis=1), np.stack([far, np.roll(far, -1, axis=0)], axis=1)]
    if not camera.is_pinhole:
        edges.append(np.stack([near, np.roll(near, -1, axis=0)], axis=1))
    return np.concatenate(edges).astype(np.float32)
