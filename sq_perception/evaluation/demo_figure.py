"""The picture of the demonstration: what the camera saw, what was made of it, and how that lies in space.

Above, the depth image and the recovered outlines on it.  Below, the bodies of both methods from another place, with the
true bodies as wires.  Bodies are given in the optical frame.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from sq_perception.evaluation.plots import (
    INK,
    WIRE,
    colour,
    draw_bodies_3d,
    draw_depth,
    draw_outlines,
    new_figure,
    silhouettes,
)
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.camera import Camera

_FAINT = "#6b7885"
_VIEWS = ((22, 32, "turned by 32 degrees"), (14, 90, "from the right"))


def demo_figure(
    depth: np.ndarray,
    camera: Camera,
    truth: Sequence[Superquadric],
    methods: Sequence[tuple[str, Sequence[Superquadric], str]],
    plane: np.ndarray | None,
    heading: str,
    unit: str = "m",
) -> Figure:
    """The figure.

    Parameters
    ----------
    depth : (height, width)
        Metres, NaN for no reading.
    truth
        Single bodies; empty for a recording.
    methods
        The two methods: title, bodies in the order of the truth where there is one, and a remark.
    plane : (4,), optional
        Support plane n.p + d = height.
    """
    figure = new_figure(15.0, 8.5)
    figure.text(0.02, 0.958, heading, fontsize=15, weight="bold", color=INK)
    if truth:
        figure.text(0.98, 0.958, "wires: the true bodies", fontsize=11, color=WIRE, ha="right")
    rows = figure.add_gridspec(2, 1, left=0.02, right=0.98, top=0.905, bottom=0.02, hspace=0.12)
    above, below = rows[0].subgridspec(1, 3, wspace=0.03), rows[1].subgridspec(1, 4, wspace=0.02)

    window = _window([body for _, bodies, _ in methods for body in bodies], camera)
    limits = _limits(depth, window)
    ax = figure.add_subplot(above[0])
    draw_depth(ax, depth, limits)
    left, right, top, bottom = window
    ax.add_patch(Rectangle((left, top), right - left, bottom - top, fill=False, edgecolor=_FAINT, lw=1.0, ls="--"))
    _title(ax, "Depth image", f"{camera.width} x {camera.height}, {limits[0]:.2f} to {limits[1]:.2f} {unit}")
    for k, (name, bodies, remark) in enumerate(methods):
        ax = figure.add_subplot(above[1 + k])
        draw_depth(ax, depth, limits)
        draw_outlines(ax, bodies, camera, [colour(i) for i in range(len(bodies))], width=1.8)
        ax.set_xlim(left, right)
        ax.set_ylim(bottom, top)
        _title(ax, name, remark)
    for k, (name, bodies, _) in enumerate(methods):
        for i, (elevation, azimuth, direction) in enumerate(_VIEWS):
            ax = figure.add_subplot(below[2 * k + i])
            draw_bodies_3d(
                ax, list(bodies), plane=plane, elevation=elevation, azimuth=azimuth, unit=unit, wires=list(truth)
            )
            _title(ax, name if i == 0 else "", direction)
    return figure


def _title(ax: Axes, text: str, detail: str) -> None:
    ax.set_title(text, loc="left", fontsize=11, color=INK, pad=5)
    ax.set_title(detail, loc="right", fontsize=9, color=_FAINT, pad=5)


def _window(bodies: Sequence[Superquadric], camera: Camera) -> tuple[float, float, float, float]:
    """Left, right, top, bottom of the part of the image with the bodies, in the image's own proportions."""
    size = np.array([camera.width, camera.height], dtype=float)
    loops = [loop for body in bodies for loop in silhouettes(body, camera)]
    half, middle = size / 2, size / 2 - 0.5
    if loops:
        low, high = np.vstack(loops).min(axis=0), np.vstack(loops).max(axis=0)
        share = min(max(1.3 * np.max((high - low) / size), 0.25), 1.0)
        half = share * size / 2
        middle = np.clip((low + high) / 2, half - 0.5, size - half - 0.5)
    return middle[0] - half[0], middle[0] + half[0], middle[1] - half[1], middle[1] + half[1]


def _limits(depth: np.ndarray, window: tuple[float, float, float, float]) -> tuple[float, float]:
    """Nearest and farthest depth of the scale: those of the window."""
    left, right, top, bottom = (max(0, round(edge)) for edge in window)
    part = depth[top : bottom + 1, left : right + 1]
    seen = part[np.isfinite(part)]
    if seen.size == 0:
        return 0.0, 1.0
    near, far = np.quantile(seen, (0.005, 0.995))
    return float(near), float(max(far, near + 1e-3))
