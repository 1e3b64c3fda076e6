"""The picture of the demonstration: what the camera saw, what was made of it, and how that lies in space.

Above, the depth image and the recovered outlines on it.  Below, the bodies of both methods from another place, with the
true bodies as wires.  Bodies are given in the optical frame.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sq_perception.evaluation.plots import INK, colour, draw_bodies_3d, draw_depth, draw_outlines, new_figure
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.camera import Camera

TRUTH_COLOUR = "#111827"
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
    figure = new_figure(15.0, 10.6)
    figure.text(0.02, 0.966, heading, fontsize=15, weight="bold", color=INK)
    rows = figure.add_gridspec(
        2, 1, height_ratios=(1.12, 1), left=0.02, right=0.985, top=0.915, bottom=0.025, hspace=0.13
    )
    above, below = rows[0].subgridspec(1, 3, wspace=0.03), rows[1].subgridspec(1, 4, wspace=0.02)

    ax = figure.add_subplot(above[0])
    limits = _limits(depth)
    draw_depth(ax, depth, limits)
    _title(ax, "Depth image", f"{camera.width} x {camera.height}, {limits[0]:.2f} to {limits[1]:.2f} {unit}")
    for k, (name, bodies, remark) in enumerate(methods):
        ax = figure.add_subplot(above[1 + k])
        draw_depth(ax, depth, limits)
        draw_outlines(ax, bodies, camera, [colour(i) for i in range(len(bodies))], width=1.8)
        _title(ax, name, remark)
    for k, (name, bodies, _) in enumerate(methods):
        for i, (elevation, azimuth, direction) in enumerate(_VIEWS):
            ax = figure.add_subplot(below[2 * k + i])
            draw_bodies_3d(
                ax, list(bodies), plane=plane, elevation=elevation, azimuth=azimuth, unit=unit, wires=list(truth)
            )
            _title(ax, name if i == 0 else "", direction + (", wires: truth" if truth else ""))
    return figure


def _title(ax: Axes, text: str, detail: str) -> None:
    ax.set_title(text, loc="left", fontsize=11, color=INK, pad=5)
    ax.set_title(detail, loc="right", fontsize=9, color=_FAINT, pad=5)


def _limits(depth: np.ndarray) -> tuple[float, float]:
    seen = depth[np.isfinite(depth)]
    if seen.size == 0:
        return 0.0, 1.0
    near, far = np.quantile(seen, (0.01, 0.97))
    return float(near), float(max(far, near + 1e-3))
