"""Parts of all pictures: figures and colours, the depth image, masks, reprojected outlines, grasps, bodies from aside.

Figures are made with the object interface and the Agg canvas, so that nothing here touches a display or a global state.
Images are in pixels with centres at integers, bodies in the optical frame.  Edges are solid where the camera sees them:
on a convex body, where the normal points towards the camera.  From another place bodies are ray cast and shaded as
matt solids on their support plane.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.patheffects import withStroke
from scipy.spatial import ConvexHull

from sq_perception.files import output_file
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.mesh import COLOURS, mesh, outline
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera

if TYPE_CHECKING:
    from sq_perception.grasping.gripper import Gripper
    from sq_perception.grasping.plan import GraspPlan

INK = "#22303c"
WIRE = "#d1006c"
NOTHING = "#1b2129"
FAINT = "#8a97a3"
DEPTH_MAP = LinearSegmentedColormap.from_list("depth", ["#f4f6f7", "#c3ced6", "#8b9dab", "#566a7b", "#36475a"])
Window = tuple[float, float, float, float]  # left, right, top, bottom of a part of an image


def colour(k: int) -> np.ndarray:
    """Red, green, blue of the k-th body, as in the meshes."""
    return COLOURS[k % len(COLOURS)]


def draw_depth(
    ax: Axes, depth: np.ndarray, limits: tuple[float, float] | None = None, window: Window | None = None
) -> None:
    """A depth image (height, width), or its ``window``: near is light, far is dark, nothing measured is black.
    ``limits`` are the nearest and farthest depth of the scale; the middle 96 % of the image by default."""
    finite = np.where(np.isfinite(depth), depth, np.nan)
    if limits is None:
        seen = finite[np.isfinite(finite)]
        near, far = np.quantile(seen, (0.02, 0.98)) if seen.size else (0.0, 1.0)
        limits = (float(near), float(far))
    shades = DEPTH_MAP.with_extremes(bad=NOTHING)
    span = max(limits[1] - limits[0], 1e-6)
    ax.imshow(finite, cmap=shades, vmin=limits[0], vmax=limits[0] + span, interpolation="nearest")
    left, right, top, bottom = window or (-0.5, depth.shape[1] - 0.5, -0.5, depth.shape[0] - 0.5)
    ax.set(xlim=(left, right), ylim=(bottom, top), xticks=[], yticks=[])
    ax.spines[:].set_visible(False)


def draw_masks(ax: Axes, labels: np.ndarray, ids: Sequence[int], opacity: float = 0.55) -> None:
    """Tint the pixels of each object, in the colour of its body."""
    tint = np.zeros((*labels.shape, 4))
    for k, label in enumerate(ids):
        tint[labels == label] = (*colour(k), opacity)
    ax.imshow(tint, interpolation="nearest")


def draw_outlines(
    ax: Axes, bodies: Sequence[Superquadric], camera: Camera, colours: Sequence[Any] | None = None, width: float = 2.2,
    edges: bool = True,
) -> None:
    """Reproject bodies: silhouettes, visible edges thin, hidden edges dotted."""
    for k, body in enumerate(bodies):
        shade = colour(k) if colours is None else colours[k % len(colours)]
        for loop in silhouettes(body, camera):
            ax.plot(*np.vstack([loop, loop[:1]]).T, color="white", lw=width + 1.6, alpha=0.75, solid_joinstyle="round")
            ax.plot(*np.vstack([loop, loop[:1]]).T, color=shade, lw=width, solid_joinstyle="round")
        if not edges:
            continue
        segments = outline(body, 64)
        pixels = camera.project(segments)
        inside = np.isfinite(pixels).all(axis=(1, 2))
        middles = segments.mean(axis=1)
        sight = middles if camera.is_pinhole else np.array([0.0, 0.0, 1.0])
        seen = np.sum(body.normals(middles) * sight, axis=-1) < 0
        solid = LineCollection(pixels[inside & seen], colors=[shade], linewidths=0.55 * width)
        faint = LineCollection(pixels[inside & ~seen][::2], colors=[shade], linewidths=0.4 * width, alpha=0.6)
        for lines in (solid, faint):
            ax.add_collection(lines, autolim=False)


def draw_grasps(
    ax: Axes, depth: np.ndarray, camera: Camera, bodies: Sequence[Superquadric], plan: GraspPlan, hand: Gripper,
    numbers: Sequence[int] | None = None, window: Window | None = None,
) -> None:
    """A depth image, outlines of its bodies and, at the best grasp of each, the gripper with its probability, or why
    there is none.  What of a gripper lies beyond the image, or its ``window``, is shown up to a quarter of it away."""
    draw_depth(ax, depth)
    numbers = range(len(bodies)) if numbers is None else numbers
    draw_outlines(ax, bodies, camera, [colour(number) for number in numbers], edges=False, width=1.4)
    left, right, top, bottom = window or (-0.5, camera.width - 0.5, -0.5, camera.height - 0.5)
    spots = [np.array([[left, top], [right, bottom]])]
    border = 0.25 * (spots[0][1] - spots[0][0])
    room = 0.15 * border  # for a score at the end of a gripper
    for k, number in enumerate(numbers):
        reason = shorten(plan.reasons[k], 44) if k < len(plan.reasons) else ""
        where, words = camera.project(bodies[k].translation), f"{number}: {reason or 'no grasp'}"
        for grasp in plan.of(k)[:1]:
            for line in hand.wires(grasp.opening):
                pixels = camera.project(grasp.to_body_frame(line))
                ax.plot(*pixels.T, color="white", lw=5.0, solid_capstyle="round")
                ax.plot(*pixels.T, color=colour(number), lw=2.6, solid_capstyle="round")
                spots += [pixels - room, pixels + room]
            where, words = pixels[-1], f"{number}: {grasp.score:.2f}"
        # Beyond the left half of the picture words go to the right, else to the left: they stay within it.
        side = "left" if where[0] < (left + right) / 2 else "right"
        text = ax.text(
            where[0], where[1], f" {words} ", color=INK, fontsize=10, weight="bold", ha=side, va="center", clip_on=True
        )
        text.set_path_effects([withStroke(linewidth=3.0, foreground="white")])  # the picture may be as dark as INK
    shown = np.vstack(spots)
    shown = shown[np.isfinite(shown).all(axis=1)]
    low = np.maximum(shown.min(axis=0), spots[0][0] - border)
    high = np.minimum(shown.max(axis=0), spots[0][1] + border)
    ax.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]), facecolor="white", anchor="C")


def silhouettes(body: Superquadric, camera: Camera) -> list[np.ndarray]:
    """Closed outlines (n, 2) of a body in the image, in pixels; cut at the image's border, empty if out of sight."""
    k = max(1, 1280 // max(camera.width, camera.height))
    cx, cy = (camera.cx + 0.5) * k - 0.5, (camera.cy + 0.5) * k - 0.5
    fine = Camera(camera.width * k, camera.height * k, camera.fx * k, camera.fy * k, cx, cy, camera.projection)
    _, index = raycast.render(body, fine)
    contours, _ = cv2.findContours((index >= 0).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return [(contour[:, 0, :] + 0.5) / k - 0.5 for contour in contours if len(contour) > 2]


def new_figure(width: float, height: float) -> Figure:
    """An empty white figure, inches, with its own Agg canvas."""
    figure = Figure(figsize=(width, height), facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, path: str | Path, dots_per_inch: int = 110) -> Path:
    """Write a figure as PNG, whole or not at all; raises OSError as :func:`output_file.writing` does."""
    with output_file.writing(path) as partial:
        figure.savefig(partial, dpi=dots_per_inch)
    return Path(path)


def heading_of(ax: Axes, text: str, detail: str) -> None:
    """The title of a picture, and a remark at its right."""
    ax.set_title(text, loc="left", fontsize=11, color=INK, pad=5)
    ax.set_title(detail, loc="right", fontsize=9, color=FAINT, pad=5)


def window_of(bodies: Sequence[Superquadric], camera: Camera, pixels: np.ndarray | None = None) -> Window:
    """The part of the image with bodies and pixels (n, 2), in the image's proportions."""
    size = np.array([camera.width, camera.height], dtype=float)
    spots = [loop for body in bodies for loop in silhouettes(body, camera)]
    spots += [] if pixels is None or not len(pixels) else [pixels]
    half, middle = size / 2, size / 2 - 0.5
    if spots:
        low, high = np.vstack(spots).min(axis=0), np.vstack(spots).max(axis=0)
        half = min(max(1.25 * np.max((high - low) / size), 0.25), 1.0) * size / 2
        middle = np.clip((low + high) / 2, half - 0.5, size - half - 0.5)
    return middle[0] - half[0], middle[0] + half[0], middle[1] - half[1], middle[1] + half[1]


def span_within(depth: np.ndarray, window: Window) -> tuple[float, float]:
    """Nearest and farthest depth of the scale: those of the window, a few stray readings left out."""
    left, right, top, bottom = (max(0, round(value)) for value in window)
    part = depth[top : bottom + 1, left : right + 1]
    seen = part[np.isfinite(part)]
    if seen.size == 0:
        return 0.0, 1.0
    near, far = np.quantile(seen, (0.01, 0.97))
    return float(near), float(max(far, near + 1e-3))


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
