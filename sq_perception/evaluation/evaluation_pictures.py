"""Pictures of an evaluation: IoU and angles as histograms, and examples.

True bodies are wires, predicted ones shaded.  Examples are chosen by their rank in IoU and by nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from sq_perception.evaluation import plots
from sq_perception.evaluation.contest import CAMERA, Outcome, ThesisImages
from sq_perception.evaluation.figures_of_merit import GOOD_IOU
from sq_perception.geometry.mesh import outline
from sq_perception.imaging import raycast, unit_cube

_BAR = "#7f97aa"
_GRID = "#dfe5ea"
_EACH = 3


def distributions(outcome: Outcome) -> Figure:
    """IoU (as figures 6.6, 7.3, 7.7), shortest arc (figure 6.3) and the angle that is a property of the bodies."""
    bins_of_100 = np.linspace(0, 100, 101)  # edges of bins for IoU in per cent and for angles in degrees
    close = np.linspace(95, 100, 101)  # where every body is this good
    figure = plots.new_figure(14.0, 3.5)
    grid = figure.add_gridspec(1, 3, left=0.045, right=0.985, bottom=0.15, top=0.88, wspace=0.17)
    figures, summary = outcome.figures, outcome.figures.summary()

    bins = close if summary["iou_min"] > 0.01 * close[0] else bins_of_100
    ax = _histogram(figure.add_subplot(grid[0]), 100 * figures.iou, bins, "IoU, per cent")
    ax.axvline(100 * summary["iou_mean"], color=plots.WIRE, lw=1.2)
    low, high = (100 * (summary["iou_mean"] + side * summary["iou_std"]) for side in (-1, 1))
    ax.axvspan(max(low, 0.0), min(high, 100.0), color="#fbeaf3", lw=0, zorder=0)
    ax.set_ylabel("bodies", fontsize=9, color=plots.INK)
    plots.heading_of(ax, "IoU", f"{100 * summary['over_85']:.1f} % over {100 * GOOD_IOU:.0f} %; line, band: mean ± std")

    ax = _histogram(figure.add_subplot(grid[1]), np.rad2deg(figures.shortest_arc), np.linspace(0, 360, 121), "radians")
    ax.set_xticks(np.arange(0, 361, 90), ["0", "π/2", "π", "3π/2", "2π"])
    turned = f"{100 * summary['quarter_turns']:.0f} % quarter turns"
    plots.heading_of(ax, "Arc to the label (figure 6.3)", turned)

    ax = _histogram(figure.add_subplot(grid[2]), np.rad2deg(figures.symmetric_angle), bins_of_100, "degrees")
    free = np.rad2deg(figures.any_order_angle)
    ax.hist(free[np.isfinite(free)], bins=bins_of_100.tolist(), color=plots.WIRE, lw=1.1, histtype="step")
    if summary["recovered"]:
        medians = np.rad2deg([summary["symmetric_angle_median"], summary["any_order_angle_median"]])
        names = (f"8 parameter vectors, median {medians[0]:.1f}", f"any order of axes, median {medians[1]:.1f}")
        keys = [Patch(color=_BAR), Line2D([], [], color=plots.WIRE, lw=1.1)]
        ax.legend(keys, names, frameon=False, fontsize=8.5, labelcolor=plots.INK, loc="upper center")
    plots.heading_of(ax, "Angle, symmetries aside", "" if summary["recovered"] else "no body recovered")
    return figure


def rank(outcome: Outcome) -> dict[str, list[int]]:
    """Numbers of the best, median and worst bodies by IoU, best first; no body stands in two of the groups."""
    order = np.argsort(-outcome.figures.iou, kind="stable")
    each = min(_EACH, max(1, len(order) // 3))
    middle = max(each, len(order) // 2 - each // 2)
    after = middle + each
    return {
        "best": order[:each].tolist(),
        "median": order[middle:after].tolist(),
        "worst": order[after:][-each:].tolist(),
    }


def examples(outcome: Outcome, images: ThesisImages) -> Figure:
    """Best, median and worst bodies: the image, the prediction rendered from the same place, and both from the side."""
    groups = rank(outcome)
    figure = plots.new_figure(15.0, 6.1)
    rows = figure.add_gridspec(3, _EACH, left=0.045, right=0.995, bottom=0.01, top=0.955, wspace=0.05, hspace=0.14)
    for row, (name, numbers) in enumerate(groups.items()):
        look = {"fontsize": 12, "weight": "bold", "color": plots.INK, "rotation": 90, "va": "center"}
        figure.text(0.012, 0.83 - 0.325 * row, name, look)
        for column, number in enumerate(numbers):
            tiles = rows[row, column].subgridspec(1, 3, wspace=0.03)
            axes = [figure.add_subplot(tiles[k]) for k in range(3)]
            _draw_example(axes, outcome, images, number)
            if row == 0:
                for ax, text in zip(axes[1:], ("predicted", "wires: true"), strict=True):
                    ax.set_title(text, loc="right", fontsize=8.5, color=plots.FAINT, pad=3)
    return figure


def _draw_example(axes: Sequence[Axes], outcome: Outcome, images: ThesisImages, number: int) -> None:
    depth = images.image(number)
    is_recovered = bool(np.isfinite(outcome.figures.delta_a[number]))
    predicted = unit_cube.optical_from_cube(outcome.bodies[number])
    rendered = raycast.render(predicted, CAMERA)[0] if is_recovered else np.full_like(depth, np.nan)
    shown = np.argwhere(np.isfinite(depth) | np.isfinite(rendered))[:, ::-1].astype(float)
    window = plots.window_of([], CAMERA, shown)
    limits = plots.span_within(depth, window)
    for ax, image in zip(axes, (depth, rendered), strict=False):
        plots.draw_depth(ax, image, limits, window)
    axes[0].set_title(f"{100 * outcome.figures.iou[number]:.1f} %", loc="left", fontsize=10, color=plots.INK, pad=3)
    axes[0].set_title(f"body {number}", loc="right", fontsize=8.5, color=plots.FAINT, pad=3)
    if is_recovered:
        true = outline(unit_cube.optical_from_cube(outcome.labels[number]), 64)
        plots.draw_bodies_3d(axes[2], [predicted], wires=list(true), elevation=22.0, azimuth=55.0, unit="", pixels=300)
    else:
        axes[2].set_axis_off()
        axes[2].text(0.5, 0.5, "no body", transform=axes[2].transAxes, ha="center", fontsize=9, color=plots.FAINT)


def _histogram(ax: Axes, values: np.ndarray, bins: np.ndarray, unit: str) -> Axes:
    ax.hist(values[np.isfinite(values)], bins=bins.tolist(), color=_BAR, lw=0)
    ax.set_xlim(bins[0], bins[-1])
    ax.set_xlabel(unit, fontsize=9, color=plots.INK)
    ax.set_axisbelow(True)
    ax.grid(axis="x", color=_GRID, lw=0.8)
    ax.spines[["top", "right"]].set_visible(False)
    ax.spines[["left", "bottom"]].set_color(_GRID)
    ax.tick_params(which="both", labelsize=8.5, colors=plots.FAINT, length=0)
    return ax
