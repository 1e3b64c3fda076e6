"""The picture of the demonstration: the image and its true bodies, and what each method made of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from sq_perception.evaluation import plots
from sq_perception.evaluation.body_pictures import draw_bodies_3d
from sq_perception.geometry.mesh import outline
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.camera import Camera
from sq_perception.segmentation.segments import segment

_GREY = np.array([[0.62, 0.66, 0.7]])


def demo_figure(
    depth: np.ndarray,
    camera: Camera,
    truth: Sequence[Superquadric],
    methods: Mapping[str, Sequence[Superquadric]],
) -> Figure:
    """A column for the image and its true bodies, and one a method: outlines above, bodies in space below.

    Parameters
    ----------
    depth : (height, width)
        Metres, NaN for no reading.
    truth, methods
        Single bodies in the optical frame, those of the methods by title.
    """
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
        look = {"wires": wires} if k else {"colours": _GREY}
        draw_bodies_3d(below, bodies, plane=plane, elevation=25, azimuth=40, **look)
        plots.heading_of(below, title, "wires: the true bodies" if k else "seen from the side")
    return figure
