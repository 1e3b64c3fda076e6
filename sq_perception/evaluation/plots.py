"""Parts of all pictures: figures and colours, the depth image, masks, reprojected outlines, grasps.

Figures are made with the object interface and the Agg canvas, so that nothing here touches a display or a global state.
Images are in pixels with centres at integers, bodies in the optical frame.  Edges are solid where the camera sees them:
on a convex body, where the normal points towards the camera.
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
from matplotlib.patheffects import withStroke

from sq_perception.files import output_file
from sq_perception.geometry.mesh import COLOURS, outline
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
Window = tuple[float, float, float, float]
"""Left, right, top, bottom of a part of an image."""


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
