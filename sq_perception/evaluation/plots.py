"""Pictures of recoveries: the depth image, masks, reprojected outlines, and the bodies in 3D.

Drawing functions take a Matplotlib axes; figures are made with the object interface and the Agg canvas, so that
nothing here touches a display or a global state.  Images are in pixels with centres at integers, bodies in the optical
frame.  3D views are rendered by the same ray casting as depth images, upright along the support plane's normal where
one is known.

The silhouette of a body is drawn exactly, from its rendering.  Its edges (:func:`sq_perception.geometry.mesh.outline`)
are solid where the camera sees them: on a convex body, where the normal points towards the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from scipy.spatial import ConvexHull

from sq_perception.fitting.covariance import undetermined
from sq_perception.fitting.fit import Status
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.mesh import COLOURS, mesh, outline
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera
from sq_perception.recovery import wording
from sq_perception.recovery.recovery import FrameRecovery, Recovery

INK = "#22303c"
WIRE = "#d1006c"
NOTHING = "#1b2129"
FAINT = "#8a97a3"
_DEPTH_MAP = LinearSegmentedColormap.from_list("depth", ["#f4f6f7", "#c3ced6", "#8b9dab", "#566a7b", "#36475a"])
_CONTOUR_PIXELS = 1280
_MOST_POINTS = 1500
_LIGHT = np.array([-0.48, -0.72, -0.5]) / np.linalg.norm([-0.48, -0.72, -0.5])
"""Towards the light, in the frame of the picture: from the upper left, in front."""


def colour(k: int) -> np.ndarray:
    """Red, green, blue of the k-th body, as in the meshes."""
    return COLOURS[k % len(COLOURS)]


def draw_depth(ax: Axes, depth: np.ndarray, limits: tuple[float, float] | None = None) -> None:
    """A depth image (height, width): near is light, far is dark, nothing measured is black.

    ``limits`` are the nearest and farthest depth of the scale; the middle 96 % of the image by default.
    """
    finite = np.where(np.isfinite(depth), depth, np.nan)
    if limits is None:
        seen = finite[np.isfinite(finite)]
        near, far = np.quantile(seen, (0.02, 0.98)) if seen.size else (0.0, 1.0)
        limits = (float(near), float(far))
    shades = _DEPTH_MAP.with_extremes(bad=NOTHING)
    span = max(limits[1] - limits[0], 1e-6)
    ax.imshow(finite, cmap=shades, vmin=limits[0], vmax=limits[0] + span, interpolation="nearest")
    ax.set_xticks([])
    ax.set_yticks([])
    for side in ax.spines.values():
        side.set_visible(False)


def draw_masks(ax: Axes, labels: np.ndarray, ids: Sequence[int], opacity: float = 0.55) -> None:
    """Tint the pixels of each object, in the colour of its body."""
    tint = np.zeros((*labels.shape, 4))
    for k, label in enumerate(ids):
        tint[labels == label] = (*colour(k), opacity)
    ax.imshow(tint, interpolation="nearest")


def draw_outlines(
    ax: Axes,
    bodies: Sequence[Superquadric],
    camera: Camera,
    colours: Sequence[Any] | None = None,
    width: float = 2.2,
    edges: bool = True,
    style: str = "-",
) -> None:
    """Reproject bodies: silhouettes in ``style``, visible edges thin, hidden edges dotted."""
    for k, body in enumerate(bodies):
        shade = colour(k) if colours is None else colours[k % len(colours)]
        for loop in silhouettes(body, camera):
            ax.plot(*np.vstack([loop, loop[:1]]).T, color="white", lw=width + 1.6, alpha=0.75, solid_joinstyle="round")
            ax.plot(*np.vstack([loop, loop[:1]]).T, color=shade, lw=width, ls=style, solid_joinstyle="round")
        if not edges:
            continue
        segments = outline(body, 64)
        pixels = camera.project(segments)
        inside = np.isfinite(pixels).all(axis=(1, 2))
        seen = _faces_camera(body, segments.mean(axis=1), camera)
        solid = LineCollection(pixels[inside & seen], colors=[shade], linewidths=0.55 * width)
        faint = LineCollection(pixels[inside & ~seen][::2], colors=[shade], linewidths=0.4 * width, alpha=0.6)
        for lines in (solid, faint):
            ax.add_collection(lines, autolim=False)


def silhouettes(body: Superquadric, camera: Camera) -> list[np.ndarray]:
    """Closed outlines (n, 2) of a body in the image, in pixels; cut at the image's border, empty if out of sight."""
    k = max(1, _CONTOUR_PIXELS // max(camera.width, camera.height))
    fine = Camera(
        camera.width * k,
        camera.height * k,
        camera.fx * k,
        camera.fy * k,
        (camera.cx + 0.5) * k - 0.5,
        (camera.cy + 0.5) * k - 0.5,
        camera.projection,
    )
    _, index = raycast.render(body, fine)
    contours, _ = cv2.findContours((index >= 0).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return [(contour[:, 0, :] + 0.5) / k - 0.5 for contour in contours if len(contour) > 2]


def draw_bodies_3d(
    ax: Axes,
    bodies: Sequence[Superquadric],
    points: Sequence[np.ndarray] | None = None,
    plane: np.ndarray | None = None,
    colours: Sequence[Any] | None = None,
    *,
    elevation: float = 20.0,
    azimuth: float = 30.0,
    unit: str = "m",
    pixels: int = 560,
    wires: Sequence[Superquadric] = (),
    enclosed: Sequence[Superquadric] = (),
) -> None:
    """Shaded picture of bodies of the optical frame from another place, exact as the depth images are.

    Parameters
    ----------
    ax : Axes
        Plain 2D axes.
    bodies
        Single bodies.
    points
        Measured points (n, 3) per body, drawn as dots where no body hides them.
    plane : (4,), optional
        Support plane: up is along its normal, and it is drawn as a grid with the bodies' footprints.
    colours
        One per body.
    elevation, azimuth
        Where one looks from, degrees: 0, 0 is the camera's side, azimuth 90 the right.
    unit
        Name of the unit at the scale bar.
    pixels
        Width and height of the picture.
    wires
        Other bodies, the true ones for instance, drawn as edges in front of everything.
    enclosed
        Bodies that the picture has room for without drawing them, so that the pictures of a film do not jump.
    """
    ax.set_axis_off()
    if not bodies:
        return
    upright = _upright(plane)
    view = picture_axes(elevation, azimuth, plane)
    turn = quaternions.from_matrix(view)
    turned = [body.transformed(turn, np.zeros(3)) for body in bodies]
    shades = [np.asarray(colour(k) if colours is None else colours[k % len(colours)]) for k in range(len(bodies))]
    clouds = [np.asarray(cloud) @ view.T for cloud in points or []]
    cages = [body.transformed(turn, np.zeros(3)) for body in wires]
    shown = turned + cages + [body.transformed(turn, np.zeros(3)) for body in enclosed]
    low, high = (np.array(corner) for corner in zip(*(body.bounding_box() for body in shown), strict=True))
    middle = 0.5 * (low.min(axis=0) + high.max(axis=0))
    half = 0.62 * float((high.max(axis=0) - low.min(axis=0))[:2].max())
    finer = 2
    scale = finer * pixels / (2 * half)
    centre = finer * pixels / 2 - 0.5
    camera = Camera(
        finer * pixels,
        finer * pixels,
        scale,
        scale,
        centre - scale * middle[0],
        centre - scale * middle[1],
        "orthographic",
    )
    depth, index = raycast.render(Superquadric.stack(turned), camera)
    extent = (middle[0] - half, middle[0] + half, middle[1] + half, middle[1] - half)
    picture = _shaded(depth, index, turned, shades, camera)
    ax.imshow(cv2.resize(picture, (pixels, pixels), interpolation=cv2.INTER_AREA), extent=extent, zorder=2)
    ax.set_xlim(extent[0], extent[1])
    ax.set_ylim(extent[2], extent[3])
    if plane is not None:
        _draw_ground(ax, bodies, np.asarray(plane, dtype=float), view, upright, half)
    forward = np.array([0.0, 0.0, 1.0])
    for body, shade in zip(turned, shades, strict=True):
        segments = outline(body, 64)
        centres = segments.mean(axis=1)
        seen = (body.normals(centres) @ forward < 0) & ~_hidden(centres, depth, camera, 0.01 * half)
        lines = LineCollection(segments[seen][..., :2], colors=[0.35 * shade], linewidths=0.9, zorder=3)
        ax.add_collection(lines, autolim=False)
    for cloud, shade in zip(clouds, shades, strict=False):
        cloud = cloud[:: max(1, len(cloud) // _MOST_POINTS)]
        cloud = cloud[~_hidden(cloud, depth, camera, 0.02 * half)]
        ax.scatter(cloud[:, 0], cloud[:, 1], s=1.6, color=[0.25 * shade], alpha=0.55, linewidths=0, zorder=4)
    for cage in cages:
        edges = LineCollection(list(outline(cage, 64)[..., :2]), colors=[WIRE], linewidths=1.0, zorder=5)
        ax.add_collection(edges, autolim=False)
    _scale_bar(ax, extent, unit)


def picture_axes(elevation: float, azimuth: float, plane: np.ndarray | None = None) -> np.ndarray:
    """Rows: right, down, forward of a picture of :func:`draw_bodies_3d`, in the optical frame."""
    return _view_matrix(elevation, azimuth) @ _upright(plane)


def recovery_figure(
    depth: np.ndarray, camera: Camera, recovery: FrameRecovery, title: str = "", unit: str = "m"
) -> Figure:
    """The whole story of one frame: input and masks, outlines on the depth picture, two 3D views, numbers.

    A body has the same number, its place in ``recovery.bodies``, wherever it is drawn.
    """
    shown = [(k, body) for k, body in enumerate(recovery.bodies) if body.status != Status.FAILED]
    bodies = [body.superquadric for _, body in shown]
    shades = [colour(k) for k, _ in shown]
    figure = new_figure(14.4, 10.4)
    edges = {"left": 0.02, "right": 0.985, "top": 0.925, "bottom": 0.03}
    rows = figure.add_gridspec(2, 1, height_ratios=(1.25, 1), hspace=0.16, **edges)
    top = rows[0].subgridspec(1, 2, wspace=0.04)
    bottom = rows[1].subgridspec(1, 3, wspace=0.02, width_ratios=(1, 1, 1.05))
    figure.text(0.02, 0.968, title or "Recovered superquadrics", fontsize=15, weight="bold", color=INK)

    pixels = np.argwhere(np.isin(recovery.labels, [body.label for body in recovery.bodies]))[:, ::-1].astype(float)
    window = window_of(bodies, camera, pixels)
    limits = span_within(depth, window)
    left = figure.add_subplot(top[0])
    draw_depth(left, depth, limits)
    _depth_bar(left, limits, unit)
    draw_masks(left, recovery.labels, [body.label for body in recovery.bodies])
    heading_of(left, "Depth and masks", f"{camera.width} x {camera.height}")
    right = figure.add_subplot(top[1])
    draw_depth(right, depth, limits)
    draw_outlines(right, bodies, camera, shades)
    right.set_xlim(window[0], window[1])
    right.set_ylim(window[3], window[2])
    for k, body in shown:
        _draw_open_axes(right, body, camera)
        _number(right, camera.project(body.superquadric.translation), k)
    heading_of(right, "Recovered outlines", "faint: hidden edges; axes: what the view leaves open")

    clouds = [_cloud(depth, recovery.labels == body.label, camera) for _, body in shown]
    for k, (elevation, azimuth, name) in enumerate(((24, 28, "From the camera's side"), (12, 90, "From the right"))):
        ax = figure.add_subplot(bottom[k])
        draw_bodies_3d(ax, bodies, clouds, recovery.plane, shades, elevation=elevation, azimuth=azimuth, unit=unit)
        heading_of(ax, name, "")
    draw_numbers(figure.add_subplot(bottom[2]), recovery, unit)
    return figure


def draw_numbers(ax: Axes, recovery: FrameRecovery, unit: str = "m", most: int = 8) -> None:
    """The bodies' full edges with their deviations, exponents, score and verdict as text."""
    ax.set_axis_off()
    ax.set_xlim(0, 1)
    ax.set_ylim(0, 1)
    total = recovery.milliseconds.get("total", float("nan"))
    ax.text(0, 0.95, "Full edges, exponents, score", fontsize=10.5, color=INK)
    ax.text(1, 0.95, f"{total:.0f} ms", fontsize=9.5, color=FAINT, ha="right")
    if not recovery.bodies:
        ax.text(0, 0.86, recovery.message or "no object", fontsize=9.5, color=FAINT)
    for k, body in enumerate(recovery.bodies[:most]):
        y = 0.85 - 0.108 * k
        ax.add_patch(Rectangle((0.0, y - 0.032), 0.035, 0.064, color=colour(k), lw=0))
        _number(ax, (0.0175, y), k)
        if body.status == Status.FAILED:
            ax.text(0.06, y, f"failed: {body.message}"[:70], fontsize=9, color=FAINT, va="center")
            continue
        e1, e2 = body.superquadric.shape
        said = wording.edges(body.superquadric.size, body.sigma_size, unit != "m")
        ax.text(0.06, y + 0.018, said, fontsize=9, color=INK, va="center")
        ax.text(1, y + 0.018, f"e {e1:.2f} {e2:.2f}  {body.score:.2f}", fontsize=9, color=INK, ha="right", va="center")
        verdict = f"{body.status.name.lower()}: {body.message}" if body.status == Status.WEAK else body.message
        ax.text(0.06, y - 0.032, verdict[:76], fontsize=8, color=FAINT, va="center")
    if len(recovery.bodies) > most:
        ax.text(0, 0.0, f"and {len(recovery.bodies) - most} more", fontsize=9, color=FAINT)


def new_figure(width: float, height: float) -> Figure:
    """An empty white figure, inches, with its own Agg canvas."""
    figure = Figure(figsize=(width, height), facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, path: str | Path, dots_per_inch: int = 110) -> Path:
    """Write a figure as PNG."""
    path = Path(path)
    figure.savefig(path, dpi=dots_per_inch)
    return path


def heading_of(ax: Axes, text: str, detail: str) -> None:
    """The title of a picture, and a remark at its right."""
    ax.set_title(text, loc="left", fontsize=11, color=INK, pad=5)
    ax.set_title(detail, loc="right", fontsize=9, color=FAINT, pad=5)


def _depth_bar(ax: Axes, limits: tuple[float, float], unit: str) -> None:
    """The scale of the depth picture, under it."""
    bar = ax.inset_axes((0.0, -0.055, 1.0, 0.025))
    bar.imshow(np.linspace(0.0, 1.0, 256)[None], cmap=_DEPTH_MAP, aspect="auto", extent=(*limits, 0.0, 1.0))
    bar.set_yticks([])
    bar.set_xticks(limits, [f"{limit:.2f} {unit}" for limit in limits])
    bar.tick_params(length=0, labelsize=8.5, labelcolor=FAINT, pad=2)
    near, far = bar.get_xticklabels()
    near.set_horizontalalignment("left")
    far.set_horizontalalignment("right")
    bar.spines[:].set_visible(False)


def _number(ax: Axes, at: Sequence[float] | np.ndarray, k: int) -> None:
    """The number of the k-th body, dark on a light disc."""
    disc = {"boxstyle": "circle,pad=0.2", "facecolor": "white", "edgecolor": colour(k), "linewidth": 1.5}
    ax.text(at[0], at[1], str(k), fontsize=8.5, color=INK, ha="center", va="center", bbox=disc, zorder=6, clip_on=True)


def _draw_open_axes(ax: Axes, body: Recovery, camera: Camera) -> None:
    """The axes of a body whose half sizes its message calls undetermined, with their letters."""
    if body.status != Status.WEAK or not np.isfinite(body.sigma_size).all():
        return
    shape = body.superquadric
    for k in np.flatnonzero(undetermined(body.covariance, shape.size)):
        reach = shape.size[k] * shape.rotation_matrix[:, k]
        ends = camera.project(shape.translation + np.array([-1.0, 1.0])[:, None] * reach)
        if np.isfinite(ends).all():
            ax.plot(*ends.T, color=WIRE, lw=1.4, solid_capstyle="round", zorder=5)
            ax.text(ends[1, 0], ends[1, 1], "xyz"[k], fontsize=9, color=WIRE, weight="bold", zorder=6, clip_on=True)


def _faces_camera(body: Superquadric, points: np.ndarray, camera: Camera) -> np.ndarray:
    direction = points if camera.is_pinhole else np.array([0.0, 0.0, 1.0])
    return np.sum(body.normals(points) * direction, axis=-1) < 0


def _cloud(depth: np.ndarray, mask: np.ndarray, camera: Camera) -> np.ndarray:
    rows, columns = np.nonzero(mask & np.isfinite(depth))
    step = max(1, rows.size // _MOST_POINTS)
    rows, columns = rows[::step], columns[::step]
    return camera.unproject(columns, rows, depth[rows, columns])


def window_of(
    bodies: Sequence[Superquadric], camera: Camera, pixels: np.ndarray | None = None
) -> tuple[float, float, float, float]:
    """Left, right, top, bottom of the part of the image with bodies and pixels (n, 2), in the image's proportions."""
    size = np.array([camera.width, camera.height], dtype=float)
    spots = [loop for body in bodies for loop in silhouettes(body, camera)]
    spots += [] if pixels is None or not len(pixels) else [pixels]
    half, middle = size / 2, size / 2 - 0.5
    if spots:
        low, high = np.vstack(spots).min(axis=0), np.vstack(spots).max(axis=0)
        half = min(max(1.25 * np.max((high - low) / size), 0.25), 1.0) * size / 2
        middle = np.clip((low + high) / 2, half - 0.5, size - half - 0.5)
    return middle[0] - half[0], middle[0] + half[0], middle[1] - half[1], middle[1] + half[1]


def span_within(depth: np.ndarray, window: tuple[float, float, float, float]) -> tuple[float, float]:
    """Nearest and farthest depth of the scale: those of the window, a few stray readings left out."""
    left, right, top, bottom = (max(0, round(value)) for value in window)
    part = depth[top : bottom + 1, left : right + 1]
    seen = part[np.isfinite(part)]
    if seen.size == 0:
        return 0.0, 1.0
    near, far = np.quantile(seen, (0.01, 0.97))
    return float(near), float(max(far, near + 1e-3))


def _upright(plane: np.ndarray | None) -> np.ndarray:
    """Rows: right, away, up, in the optical frame."""
    up = np.array([0.0, -1.0, 0.0]) if plane is None else np.asarray(plane[:3]) / np.linalg.norm(plane[:3])
    forward = np.array([0.0, 0.0, 1.0])
    if abs(up @ forward) > 0.98:
        forward = np.array([0.0, -1.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right), up])


def _view_matrix(elevation: float, azimuth: float) -> np.ndarray:
    """Rows: right, down, forward of the picture, in (right, away, up)."""
    tilt, turn = np.radians([elevation, azimuth])
    forward = np.array([-np.sin(turn) * np.cos(tilt), np.cos(turn) * np.cos(tilt), -np.sin(tilt)])
    right = np.array([np.cos(turn), np.sin(turn), 0.0])
    return np.stack([right, np.cross(forward, right), forward])


def _shaded(
    depth: np.ndarray, index: np.ndarray, bodies: Sequence[Superquadric], shades: Sequence[np.ndarray], camera: Camera
) -> np.ndarray:
    """RGBA float picture (h, w, 4): matt bodies in front of nothing."""
    picture = np.ones((*depth.shape, 4), dtype=np.float32)
    picture[..., 3] = index >= 0
    for k, body in enumerate(bodies):
        rows, columns = np.nonzero(index == k)
        if rows.size == 0:
            continue
        normals = body.normals(camera.unproject(columns, rows, depth[rows, columns]))
        diffuse = np.clip(normals @ _LIGHT, 0, 1)
        facing = np.clip(-normals[:, 2], 0, 1)
        brightness = 0.62 + 0.34 * diffuse + 0.14 * facing
        gloss = 0.22 * diffuse[:, None] ** 6
        picture[rows, columns, :3] = np.clip(shades[k] * brightness[:, None] * (1 - gloss) + gloss, 0, 1)
    return picture


def _hidden(points: np.ndarray, depth: np.ndarray, camera: Camera, tolerance: float) -> np.ndarray:
    """Which points (n, 3) lie behind the rendered surface."""
    if len(points) == 0:
        return np.zeros(0, bool)
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

    def drawn(corners: np.ndarray) -> np.ndarray:
        raised = np.concatenate([corners, np.full((*corners.shape[:-1], 1), level)], axis=-1)
        return (raised @ (view @ upright.T).T)[..., :2]

    lines = []
    for x in np.arange(low[0], high[0] + 0.5 * step, step):
        lines.append([(x, low[1]), (x, high[1])])
    for y in np.arange(low[1], high[1] + 0.5 * step, step):
        lines.append([(low[0], y), (high[0], y)])
    frame = np.array([(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])])
    ax.add_patch(Polygon(drawn(frame), closed=True, facecolor="#eef1f4", edgecolor="none", zorder=0))
    grid = LineCollection(list(drawn(np.array(lines))), colors="#cfd7de", linewidths=0.8, zorder=0.5)
    ax.add_collection(grid, autolim=False)
    for footprint in prints:
        ax.add_patch(Polygon(drawn(footprint), closed=True, facecolor="#5d6b78", alpha=0.35, lw=0, zorder=1))


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
