"""Pictures of a recovered frame, and of the demonstration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import shorten

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from sq_perception.evaluation import plots
from sq_perception.fitting.fit import Status
from sq_perception.fitting.quality import undetermined
from sq_perception.geometry.mesh import outline
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.camera import Camera
from sq_perception.recovery.recovery import FrameRecovery, Recovery, edges_as_text
from sq_perception.segmentation.segments import segment


def demo_figure(
    depth: np.ndarray, camera: Camera, truth: Sequence[Superquadric], methods: Mapping[str, Sequence[Superquadric]]
) -> Figure:
    """Draw a column for the image (height, width), metres, and its true bodies, and one a method: outlines above,
    bodies in space below.  Bodies are single ones in the optical frame."""
    columns = {"true bodies": truth, **methods}
    figure = plots.new_figure(5.0 * len(columns), 8.6)
    wires = [line for body in truth for line in outline(body, 64)]
    figure.text(
        0.015, 0.955, "Superquadrics recovered from one depth image", fontsize=15, weight="bold", color=plots.INK
    )
    grid = figure.add_gridspec(2, len(columns), left=0.015, right=0.985, top=0.9, bottom=0.01, wspace=0.05, hspace=0.1)
    window = plots.window_of(truth, camera)
    limits, plane = plots.span_within(depth, window), segment(depth, camera).plane
    for k, (title, bodies) in enumerate(columns.items()):
        above, below = figure.add_subplot(grid[0, k]), figure.add_subplot(grid[1, k])
        plots.draw_depth(above, depth, limits, window)
        if k:
            plots.draw_outlines(above, bodies, camera, width=1.8)
        plots.heading_of(above, title if k else "depth image", "" if k else f"{limits[0]:.2f} to {limits[1]:.2f} m")
        look = {"wires": wires} if k else {"colours": np.array([[0.62, 0.66, 0.7]])}
        plots.draw_bodies_3d(below, bodies, plane=plane, elevation=25, azimuth=40, **look)
        plots.heading_of(below, title, "wires: the true bodies" if k else "seen from the side")
    return figure


def recovery_figure(depth: np.ndarray, camera: Camera, recovery: FrameRecovery, title: str = "") -> Figure:
    """Draw input and masks, outlines on the depth image, views from two sides, and the numbers of the bodies.

    A body has the same number, its place in ``recovery.bodies``, wherever it is drawn.  Lengths are metres, or sides of
    the unit cube, which an orthographic camera sees.
    """
    unit = "m" if camera.is_pinhole else "of the cube"
    shown = [(k, body) for k, body in enumerate(recovery.bodies) if body.status != Status.FAILED]
    bodies = [body.superquadric for _, body in shown]
    shades = [plots.colour(k) for k, _ in shown]
    figure = plots.new_figure(14.4, 10.4)
    edges = {"left": 0.02, "right": 0.985, "top": 0.925, "bottom": 0.03}
    rows = figure.add_gridspec(2, 1, height_ratios=(1.25, 1), hspace=0.16, **edges)
    top = rows[0].subgridspec(1, 2, wspace=0.04)
    bottom = rows[1].subgridspec(1, 3, wspace=0.02, width_ratios=(1, 1, 1.05))
    look = {"fontsize": 15, "weight": "bold", "color": plots.INK}
    figure.text(0.02, 0.968, title or "Recovered superquadrics", look, parse_math=False)  # a file may be called $1$

    pixels = np.argwhere(np.isin(recovery.labels, [body.label for body in recovery.bodies]))[:, ::-1].astype(float)
    window = plots.window_of(bodies, camera, pixels)
    limits = plots.span_within(depth, window)
    left = figure.add_subplot(top[0])
    plots.draw_depth(left, depth, limits)
    _depth_bar(left, limits, unit)
    plots.draw_masks(left, recovery.labels, [body.label for body in recovery.bodies])
    plots.heading_of(left, "Depth and masks", f"{camera.width} x {camera.height}")
    right = figure.add_subplot(top[1])
    plots.draw_depth(right, depth, limits, window)
    plots.draw_outlines(right, bodies, camera, shades)
    for k, body in shown:
        _draw_open_axes(right, body, camera)
        _number(right, camera.project(body.superquadric.translation), k)
    plots.heading_of(right, "Recovered outlines", "dashed: hidden edges; red axis: size hardly seen")

    points = camera.points(depth)
    clouds = [points[(recovery.labels == body.label) & np.isfinite(depth)] for _, body in shown]
    for k, (elevation, azimuth, name) in enumerate(((24, 28, "From the camera's side"), (12, 90, "From the right"))):
        ax = figure.add_subplot(bottom[k])
        plots.draw_bodies_3d(
            ax, bodies, clouds, recovery.plane, shades, elevation=elevation, azimuth=azimuth, unit=unit
        )
        plots.heading_of(ax, name, "")
    _draw_numbers(figure.add_subplot(bottom[2]), recovery, unit)
    return figure


def _draw_numbers(ax: Axes, recovery: FrameRecovery, unit: str) -> None:
    """The bodies' full edges with their deviations, exponents, score and verdict as text."""
    most = 8
    longest = 68  # characters of a verdict that fit in a line
    ax.set_axis_off()
    ax.set(xlim=(0, 1), ylim=(0, 1))
    total = recovery.milliseconds.get("total", float("nan"))
    ax.text(0, 0.95, "Full edges, exponents, score", fontsize=10.5, color=plots.INK)
    ax.text(1, 0.95, f"{total:.0f} ms", fontsize=9.5, color=plots.FAINT, ha="right")
    if not recovery.bodies:
        ax.text(0, 0.86, recovery.message or "no object", fontsize=9.5, color=plots.FAINT)
    for k, body in enumerate(recovery.bodies[:most]):
        y = 0.85 - 0.108 * k
        ax.add_patch(Rectangle((0.0, y - 0.032), 0.035, 0.064, color=plots.colour(k), lw=0))
        _number(ax, (0.0175, y), k)
        if body.status == Status.FAILED:
            ax.text(0.06, y, shorten(f"failed: {body.message}", longest), fontsize=9, color=plots.FAINT, va="center")
            continue
        e1, e2 = body.superquadric.shape
        text = edges_as_text(body.superquadric.size, body.sigma_size, unit != "m").replace(" of the cube", "")
        look = {"fontsize": 9 if unit == "m" else 8, "color": plots.INK, "va": "center"}
        ax.text(0.06, y + 0.018, text, look)
        ax.text(1, y + 0.018, f"e {e1:.2f} {e2:.2f}  {body.score:.2f}", look, ha="right")
        verdict = f"{body.status.name.lower()}: {body.message}" if body.status == Status.WEAK else body.message
        ax.text(0.06, y - 0.032, shorten(verdict, longest), fontsize=8, color=plots.FAINT, va="center")
    if len(recovery.bodies) > most:
        ax.text(0, 0.0, f"and {len(recovery.bodies) - most} more", fontsize=9, color=plots.FAINT)


def _depth_bar(ax: Axes, limits: tuple[float, float], unit: str) -> None:
    """The scale of the depth picture, under it."""
    bar = ax.inset_axes((0.0, -0.055, 1.0, 0.025))
    bar.imshow(np.linspace(0.0, 1.0, 256)[None], cmap=plots.DEPTH_MAP, aspect="auto", extent=(*limits, 0.0, 1.0))
    bar.set_yticks([])
    bar.set_xticks(limits, [f"{limit:.2f} {unit}" for limit in limits])
    bar.tick_params(length=0, labelsize=8.5, labelcolor=plots.FAINT, pad=2)
    near, far = bar.get_xticklabels()
    near.set_horizontalalignment("left")
    far.set_horizontalalignment("right")
    bar.spines[:].set_visible(False)


def _number(ax: Axes, at: Sequence[float] | np.ndarray, k: int) -> None:
    """The number of the k-th body, dark on a light disc."""
    disc = {"boxstyle": "circle,pad=0.2", "facecolor": "white", "edgecolor": plots.colour(k), "linewidth": 1.5}
    look = {"fontsize": 8.5, "color": plots.INK, "ha": "center", "va": "center", "bbox": disc}
    ax.text(at[0], at[1], str(k), look, zorder=6, clip_on=True)


def _draw_open_axes(ax: Axes, body: Recovery, camera: Camera) -> None:
    """The axes of a body whose half sizes its message calls undetermined, with their letters."""
    if body.status != Status.WEAK or not np.isfinite(body.sigma_size).all():
        return
    shape = body.superquadric
    for k in np.flatnonzero(undetermined(body.covariance, shape.size)):
        reach = shape.size[k] * shape.rotation_matrix[:, k]
        ends = camera.project(shape.translation + np.array([-1.0, 1.0])[:, None] * reach)
        if np.isfinite(ends).all():
            ax.plot(*ends.T, color=plots.WIRE, lw=1.4, solid_capstyle="round", zorder=5)
            look = {"fontsize": 9, "color": plots.WIRE, "weight": "bold"}
            ax.text(ends[1, 0], ends[1, 1], "xyz"[k], look, zorder=6, clip_on=True)
