"""The picture of the demonstration: what the camera saw, what was made of it, and how that lies in space.

Above, the depth image and the recovered outlines on it.  Below, the bodies of both methods from another place, with the
true bodies as wires.  Bodies are given in the optical frame.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from sq_perception.evaluation import plots
from sq_perception.evaluation.body_pictures import draw_bodies_3d
from sq_perception.geometry.mesh import outline
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.camera import Camera

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
    figure = plots.new_figure(15.0, 8.5)
    wires = [line for body in truth for line in outline(body, 64)]
    figure.text(0.02, 0.958, heading, fontsize=15, weight="bold", color=plots.INK)
    if truth:
        figure.text(0.98, 0.958, "wires: the true bodies", fontsize=11, color=plots.WIRE, ha="right")
    rows = figure.add_gridspec(2, 1, left=0.02, right=0.98, top=0.905, bottom=0.02, hspace=0.12)
    above, below = rows[0].subgridspec(1, 3, wspace=0.03), rows[1].subgridspec(1, 4, wspace=0.02)

    window = plots.window_of([body for _, bodies, _ in methods for body in bodies], camera)
    limits = plots.span_within(depth, window)
    ax = figure.add_subplot(above[0])
    plots.draw_depth(ax, depth, limits)
    left, right, top, bottom = window
    ax.add_patch(Rectangle((left, top), right - left, bottom - top, fill=False, edgecolor=plots.FAINT, lw=1.0, ls="--"))
    plots.heading_of(ax, "Depth image", f"{camera.width} x {camera.height}, {limits[0]:.2f} to {limits[1]:.2f} {unit}")
    for k, (name, bodies, remark) in enumerate(methods):
        ax = figure.add_subplot(above[1 + k])
        plots.draw_depth(ax, depth, limits, window)
        plots.draw_outlines(ax, bodies, camera, width=1.8)
        plots.heading_of(ax, name, remark)
    for k, (name, bodies, _) in enumerate(methods):
        for i, (elevation, azimuth, direction) in enumerate(_VIEWS):
            ax = figure.add_subplot(below[2 * k + i])
            draw_bodies_3d(ax, list(bodies), plane=plane, elevation=elevation, azimuth=azimuth, unit=unit, wires=wires)
            plots.heading_of(ax, name if i == 0 else "", direction)
    return figure
