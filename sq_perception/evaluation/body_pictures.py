"""Pictures of bodies from another place, ray cast and shaded as matt solids on their support plane."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patches import Polygon
from scipy.spatial import ConvexHull

from sq_perception.evaluation.plots import INK, WIRE, colour
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.mesh import mesh, outline
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera


def draw_bodies_3d(
    ax: Axes, bodies: Sequence[Superquadric], points: Sequence[np.ndarray] | None = None,
    plane: np.ndarray | None = None, colours: Sequence[Any] | None = None, *, elevation: float = 20.0,
    azimuth: float = 30.0, unit: str = "m", pixels: int = 560, wires: Sequence[np.ndarray] = (),
) -> None:
    """Shaded picture of bodies of the optical frame from another place, exact as the depth images are.

    ax: Plain 2D axes.
    bodies: Single bodies.
    points: Measured points (n, 3) per body, some of which are drawn as dots where no body hides them.
    plane: (4,), support plane: up is along its normal, and it is drawn as a grid with the bodies' footprints.
    colours: One per body.
    elevation, azimuth: Where one looks from, degrees: 0, 0 is the camera's side, azimuth 90 the right.
    unit: Name of the unit at the scale bar.
    pixels: Width and height of the picture.
    wires: Lines (n, 3), of the true bodies for instance, drawn in front of everything.
    """
    ax.set_axis_off()
    if not bodies:
        return
    upright = _upright(plane)
    view = _picture_axes(elevation, azimuth) @ upright
    turn = quaternions.from_matrix(view)
    turned = [body.transformed(turn, np.zeros(3)) for body in bodies]
    lines = [np.asarray(wire) @ view.T for wire in wires]
    shades = [np.asarray(colour(k) if colours is None else colours[k % len(colours)]) for k in range(len(bodies))]
    clouds = [np.asarray(cloud) @ view.T for cloud in points or []]
    shown = np.vstack([*(corner for body in turned for corner in body.bounding_box()), *lines])
    middle = 0.5 * (shown.min(axis=0) + shown.max(axis=0))
    half = 0.62 * float(np.ptp(shown, axis=0)[:2].max())
    side = 2 * pixels  # twice as fine as the picture
    scale = side / (2 * half)
    cx, cy = side / 2 - 0.5 - scale * middle[:2]
    camera = Camera(side, side, scale, scale, cx, cy, "orthographic")
    depth, index = raycast.render(Superquadric.stack(turned), camera)
    extent = (middle[0] - half, middle[0] + half, middle[1] + half, middle[1] - half)
    picture = _shade(depth, index, turned, shades, camera)
    ax.imshow(cv2.resize(picture, (pixels, pixels), interpolation=cv2.INTER_AREA), extent=extent, zorder=2)
    ax.set(xlim=extent[:2], ylim=extent[2:])
    if plane is not None:
        _draw_ground(ax, bodies, np.asarray(plane, dtype=float), view, upright, half)
    forward = np.array([0.0, 0.0, 1.0])
    for body, shade in zip(turned, shades, strict=True):
        segments = outline(body, 64)
        centres = segments.mean(axis=1)
        seen = (body.normals(centres) @ forward < 0) & ~_hidden(centres, depth, camera, 0.01 * half)
        edges = LineCollection(segments[seen][..., :2], colors=[0.35 * shade], linewidths=0.9, zorder=3)
        ax.add_collection(edges, autolim=False)
    for cloud, shade in zip(clouds, shades, strict=False):
        # Points that are drawn of the cloud of one body.
        cloud = cloud[:: max(1, len(cloud) // 1500)]
        cloud = cloud[~_hidden(cloud, depth, camera, 0.02 * half)]
        ax.scatter(cloud[:, 0], cloud[:, 1], s=1.6, color=[0.25 * shade], alpha=0.55, linewidths=0, zorder=4)
    cages = LineCollection([line[:, :2] for line in lines], colors=[WIRE], linewidths=1.0, zorder=5)
    ax.add_collection(cages, autolim=False)
    _scale_bar(ax, extent, unit)


def _picture_axes(elevation: float, azimuth: float) -> np.ndarray:
    """Rows: right, down, forward of a picture, in a frame of right, away and up."""
    tilt, turn = np.radians([elevation, azimuth])
    forward = np.array([-np.sin(turn) * np.cos(tilt), np.cos(turn) * np.cos(tilt), -np.sin(tilt)])
    right = np.array([np.cos(turn), np.sin(turn), 0.0])
    return np.stack([right, np.cross(forward, right), forward])


def _upright(plane: np.ndarray | None) -> np.ndarray:
    """Rows: right, away, up, in the optical frame."""
    up = np.array([0.0, -1.0, 0.0]) if plane is None else np.asarray(plane[:3]) / np.linalg.norm(plane[:3])
    forward = np.array([0.0, 0.0, 1.0])
    if abs(up @ forward) > 0.98:
        forward = np.array([0.0, -1.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right), up])


def _shade(
    depth: np.ndarray, index: np.ndarray, bodies: Sequence[Superquadric], shades: Sequence[np.ndarray], camera: Camera
) -> np.ndarray:
    """RGBA float picture (h, w, 4): matt bodies in front of nothing, with light from the upper left, in front."""
    light = np.array([-0.48, -0.72, -0.5]) / np.linalg.norm([-0.48, -0.72, -0.5])
    picture = np.ones((*depth.shape, 4), dtype=np.float32)
    picture[..., 3] = index >= 0
    for k, body in enumerate(bodies):
        rows, columns = np.nonzero(index == k)
        normals = body.normals(camera.unproject(columns, rows, depth[rows, columns]))
        diffuse = np.clip(normals @ light, 0, 1)
        facing = np.clip(-normals[:, 2], 0, 1)
        brightness = 0.62 + 0.34 * diffuse + 0.14 * facing
        gloss = 0.22 * diffuse[:, None] ** 6
        picture[rows, columns, :3] = np.clip(shades[k] * brightness[:, None] * (1 - gloss) + gloss, 0, 1)
    return picture


def _hidden(points: np.ndarray, depth: np.ndarray, camera: Camera, tolerance: float) -> np.ndarray:
    """Which points (n, 3) lie behind the rendered surface."""
    u, v = np.round(camera.project(points)).astype(int).T
    u, v = np.clip(u, 0, camera.width - 1), np.clip(v, 0, camera.height - 1)
    return points[:, 2] > depth[v, u] + tolerance


def _draw_ground(
    ax: Axes, bodies: Sequence[Superquadric], plane: np.ndarray, view: np.ndarray, upright: np.ndarray, half: float
) -> None:
    """The support plane as a grid around the bodies, and their footprints on it."""
    level = -plane[3] / np.linalg.norm(plane[:3])
    prints = []
    for body in bodies:
        flat = (mesh(body, 16).vertices @ upright.T)[:, :2]
        prints.append(flat[ConvexHull(flat).vertices])
    every = np.vstack(prints)
    step = _round_length(0.35 * half)
    low, high = np.floor(every.min(axis=0) / step - 0.5) * step, np.ceil(every.max(axis=0) / step + 0.5) * step

    def draw(corners: np.ndarray) -> np.ndarray:
        raised = np.concatenate([corners, np.full((*corners.shape[:-1], 1), level)], axis=-1)
        return (raised @ (view @ upright.T).T)[..., :2]

    lines = [[(x, low[1]), (x, high[1])] for x in np.arange(low[0], high[0] + 0.5 * step, step)]
    lines += [[(low[0], y), (high[0], y)] for y in np.arange(low[1], high[1] + 0.5 * step, step)]
    frame = np.array([(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])])
    ax.add_patch(Polygon(draw(frame), closed=True, facecolor="#eef1f4", edgecolor="none", zorder=0))
    grid = LineCollection(list(draw(np.array(lines))), colors="#cfd7de", linewidths=0.8, zorder=0.5)
    ax.add_collection(grid, autolim=False)
    for footprint in prints:
        ax.add_patch(Polygon(draw(footprint), closed=True, facecolor="#5d6b78", alpha=0.35, lw=0, zorder=1))


def _round_length(length: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above a length."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(factor * power for factor in (1, 2, 5) if factor * power <= length * (1 + 1e-9)))


def _scale_bar(ax: Axes, extent: tuple[float, float, float, float], unit: str) -> None:
    left, right, bottom, top = extent
    length = _round_length(0.3 * (right - left))
    x, y = left + 0.03 * (right - left), bottom + 0.03 * (top - bottom)
    ax.plot([x, x + length], [y, y], color=INK, lw=2, solid_capstyle="butt", zorder=5)
    text = f"{1e3 * length:g} mm" if unit == "m" else f"{length:g} {unit}"
    ax.text(x, y + 0.018 * (top - bottom), text, fontsize=8.5, color=INK, va="bottom", zorder=5)
