"""Pictures of an evaluation: IoU and angles as histograms, examples, the inside-outside function, training curves.

Like :mod:`sq_perception.evaluation.plots`: figures of the Agg canvas, no global state.  True bodies are wires,
predicted ones shaded.  Examples are chosen by their rank in IoU and by nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator

from sq_perception.evaluation.contest import Outcome
from sq_perception.evaluation.figures_of_merit import GOOD_IOU
from sq_perception.evaluation.plots import (
    INK,
    WIRE,
    colour,
    draw_bodies_3d,
    draw_depth,
    new_figure,
    picture_axes,
)
from sq_perception.evaluation.thesis_images import ThesisImages
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast, unit_cube

_FAINT = "#6b7885"
_BAR = "#7f97aa"
_GRID = "#dfe5ea"
_ELEVATION, _AZIMUTH = 22.0, 55.0
_EACH = 3
_F_RANGE = (1e-3, 1e3)
_ARC_BINS = np.linspace(0, 360, 121)
_ANGLE_BINS = np.linspace(0, 100, 101)
_IOU_BINS = np.linspace(0, 100, 101)
_CLOSE_IOU_BINS = np.linspace(95, 100, 101)
"""Where every body is this good."""

INSIDE_OUTSIDE_BODY = Superquadric([0.32, 0.22, 0.26], [0.3, 0.8], [0.5, 0.5, 0.5], [0.35, 0.15, 0.1, 0.92])
"""Shown in the picture of the inside-outside function; cube frame."""


def iou_overview(outcomes: Sequence[Outcome]) -> Figure:
    """Histograms of all contestants below each other, one scale of IoU."""
    rows = len(outcomes)
    figure = new_figure(10.0, 0.9 + 0.85 * rows)
    bottom, top = 0.55 / (0.9 + 0.85 * rows), 1 - 0.35 / (0.9 + 0.85 * rows)
    grid = figure.add_gridspec(rows, 1, left=0.17, right=0.83, bottom=bottom, top=top, hspace=0.25)
    for row, outcome in enumerate(outcomes):
        ax = figure.add_subplot(grid[row])
        _histogram(ax, 100 * outcome.figures.iou, _IOU_BINS)
        summary = outcome.figures.summary()
        ax.axvline(100 * summary.iou_mean, color=WIRE, lw=1.2)
        ax.set_yticks([])
        ax.spines["left"].set_visible(False)
        ax.tick_params(labelbottom=row == rows - 1)
        ax.text(-0.02, 0.3, outcome.contestant.name, transform=ax.transAxes, ha="right", fontsize=10, color=INK)
        text = f"{100 * summary.iou_mean:.2f} ± {100 * summary.iou_std:.2f}"
        ax.text(1.02, 0.42, text, transform=ax.transAxes, fontsize=10, color=INK)
        ax.text(1.02, 0.05, f"{summary.bodies} bodies", transform=ax.transAxes, fontsize=8.5, color=_FAINT)
        if row == 0:
            _heading(ax, "IoU, thesis equation 5.1", "line: the mean; heights of each row for itself")
    ax.set_xlabel("IoU, per cent", fontsize=9, color=INK)
    return figure


def distributions(outcome: Outcome) -> Figure:
    """IoU (as figures 6.6, 7.3, 7.7), shortest arc (figure 6.3) and the angle that is a property of the bodies."""
    figure = new_figure(14.0, 3.5)
    grid = figure.add_gridspec(1, 3, left=0.045, right=0.985, bottom=0.15, top=0.88, wspace=0.17)
    figures, summary = outcome.figures, outcome.figures.summary()

    ax = figure.add_subplot(grid[0])
    _histogram(ax, 100 * figures.iou, _CLOSE_IOU_BINS if summary.iou_min > 0.01 * _CLOSE_IOU_BINS[0] else _IOU_BINS)
    ax.axvline(100 * summary.iou_mean, color=WIRE, lw=1.2)
    low, high = (100 * (summary.iou_mean + side * summary.iou_std) for side in (-1, 1))
    ax.axvspan(max(low, 0.0), min(high, 100.0), color="#fbeaf3", lw=0, zorder=0)
    ax.set_xlabel("IoU, per cent", fontsize=9, color=INK)
    ax.set_ylabel("bodies", fontsize=9, color=INK)
    _heading(ax, "IoU", f"{100 * summary.over_85:.1f} % over {100 * GOOD_IOU:.0f} %; line, band: mean ± std")

    ax = figure.add_subplot(grid[1])
    _histogram(ax, np.rad2deg(figures.shortest_arc), _ARC_BINS)
    ax.set_xticks(np.arange(0, 361, 90), ["0", "π/2", "π", "3π/2", "2π"])
    ax.set_xlabel("radians", fontsize=9, color=INK)
    _heading(ax, "Shortest arc to the label (figure 6.3)", f"{100 * summary.quarter_turns:.0f} % quarter turns")

    ax = figure.add_subplot(grid[2])
    _histogram(ax, np.rad2deg(figures.symmetric_angle), _ANGLE_BINS)
    free = np.rad2deg(figures.any_order_angle)
    ax.hist(free[np.isfinite(free)], bins=_ANGLE_BINS.tolist(), color=WIRE, lw=1.1, histtype="step")
    ax.set_xlabel("degrees", fontsize=9, color=INK)
    if summary.recovered:
        medians = np.rad2deg([summary.symmetric_angle_median, summary.any_order_angle_median])
        names = (f"8 parameter vectors, median {medians[0]:.1f}", f"any order of axes, median {medians[1]:.1f}")
        keys = [Patch(color=_BAR), Line2D([], [], color=WIRE, lw=1.1)]
        ax.legend(keys, names, frameon=False, fontsize=8.5, labelcolor=INK, loc="upper center")
    _heading(ax, "Angle, symmetries aside", "" if summary.recovered else "no body recovered")
    return figure


def ranked(outcome: Outcome, each: int = _EACH) -> dict[str, list[int]]:
    """Numbers of the best, median and worst bodies by IoU, best first; no body stands in two of the groups."""
    order = np.argsort(-outcome.figures.iou, kind="stable")
    each = min(each, max(1, len(order) // 3))
    middle = max(each, len(order) // 2 - each // 2)
    groups = {"best": order[:each], "median": order[middle : middle + each], "worst": order[each:][-each:]}
    taken: set[int] = set()
    chosen: dict[str, list[int]] = {}
    for name, numbers in groups.items():
        chosen[name] = [int(number) for number in numbers if int(number) not in taken]
        taken.update(chosen[name])
    return chosen


def examples(outcome: Outcome, images: ThesisImages) -> Figure:
    """Best, median and worst bodies: what was seen, what the prediction looks like from there, and both from aside."""
    groups = ranked(outcome)
    figure = new_figure(15.0, 6.1)
    rows = figure.add_gridspec(3, _EACH, left=0.045, right=0.995, bottom=0.01, top=0.955, wspace=0.05, hspace=0.14)
    for row, (name, numbers) in enumerate(groups.items()):
        figure.text(0.012, 0.83 - 0.325 * row, name, fontsize=12, weight="bold", color=INK, rotation=90, va="center")
        for column, number in enumerate(numbers):
            tiles = rows[row, column].subgridspec(1, 3, wspace=0.03)
            axes = [figure.add_subplot(tiles[k]) for k in range(3)]
            _draw_example(axes, outcome, images, number)
            if row == 0:
                for ax, text in zip(axes[1:], ("predicted", "wires: true"), strict=True):
                    ax.set_title(text, loc="right", fontsize=8.5, color=_FAINT, pad=3)
    return figure


def inside_outside(body: Superquadric = INSIDE_OUTSIDE_BODY, points: int = 22) -> Figure:
    """Figure 3.4: wires, shaded body, and the inside-outside function F at points of a grid of ``points``^3.

    Points inside (F <= 1) are opaque, those outside have an opacity of 15 %.
    """
    figure = new_figure(13.0, 4.6)
    grid = figure.add_gridspec(1, 3, left=0.01, right=0.925, bottom=0.02, top=0.91, wspace=0.05)
    seen = unit_cube.optical_from_cube(body)
    view = picture_axes(_ELEVATION, _AZIMUTH)
    centre = view @ seen.translation
    half = 1.5 * body.size
    reach = float(np.linalg.norm(half)) * 0.95

    ax = figure.add_subplot(grid[0])
    segments = _parameter_lines(seen)
    away = (seen.normals(segments.mean(axis=1)) @ view.T)[:, 2] > 0
    for hidden, opacity in ((True, 0.18), (False, 0.8)):
        lines = LineCollection(
            list((segments[away == hidden] @ view.T)[..., :2]), colors=[WIRE], linewidths=0.7, alpha=opacity
        )
        ax.add_collection(lines, autolim=False)
    _square(ax, centre, 0.65 * reach)
    _heading(ax, "(a) wires: true bodies", "")

    ax = figure.add_subplot(grid[1])
    draw_bodies_3d(ax, [seen], unit="of the cube", elevation=_ELEVATION, azimuth=_AZIMUTH)
    _square(ax, centre, 0.65 * reach)
    _heading(ax, "(b) shaded: predicted bodies", "")

    ax = figure.add_subplot(grid[2])
    steps = np.linspace(-1, 1, points)
    local = half * np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    places = seen.to_parent(local)
    value = np.clip(seen.inside_outside(places), *_F_RANGE)
    drawn = places @ view.T
    order = np.argsort(-drawn[:, 2])
    inside = value <= 1
    scale = LogNorm(*_F_RANGE)
    for part, opacity in ((~inside, 0.15), (inside, 1.0)):
        chosen = order[part[order]]
        x, y, _ = drawn[chosen].T
        ax.scatter(x, y, c=value[chosen], norm=scale, cmap="viridis", s=13, alpha=opacity, linewidths=0)
    _square(ax, centre, 0.9 * reach)
    _heading(ax, "(c) inside-outside function F", "opaque: inside, F ≤ 1")
    bar = figure.colorbar(ScalarMappable(scale, "viridis"), cax=figure.add_axes((0.94, 0.12, 0.011, 0.68)))
    bar.outline.set_visible(False)
    bar.ax.tick_params(which="both", labelsize=8.5, colors=_FAINT)
    return figure


def training_curves(records: Sequence[Mapping[str, float]]) -> Figure:
    """Loss and validation IoU over the steps of a training, from the records of its log.jsonl."""
    figure = new_figure(10.0, 3.2)
    grid = figure.add_gridspec(1, 2, left=0.075, right=0.985, bottom=0.16, top=0.87, wspace=0.2)
    steps = [record["step"] for record in records]
    ax = figure.add_subplot(grid[0])
    ax.plot(steps, [record["loss"] for record in records], color=INK, lw=1.4, marker="o", ms=2.5)
    ax.set_yscale("log")
    _axes_style(ax)
    for formatted in (ax.yaxis.set_major_formatter, ax.yaxis.set_minor_formatter):
        formatted(FuncFormatter(lambda value, _: f"{value:.2g}"))
    ax.yaxis.set_minor_locator(LogLocator(subs=[2.0, 3.0, 5.0]))
    _heading(ax, "Loss, mean since the last validation", "")
    ax.set_xlabel("steps", fontsize=9, color=INK)
    ax = figure.add_subplot(grid[1])
    for key, label, shade in (("iou", "orthographic", INK), ("iou_pinhole", "pinhole", WIRE)):
        if all(key in record for record in records):
            values = [100 * record[key] for record in records]
            ax.plot(steps, values, color=shade, lw=1.4, marker="o", ms=2.5, label=label)
    _axes_style(ax)
    ax.legend(frameon=False, fontsize=8.5, labelcolor=INK, loc="lower right")
    _heading(ax, "Validation, IoU in per cent", f"last: {100 * records[-1]['iou']:.2f} at step {steps[-1]:.0f}")
    ax.set_xlabel("steps", fontsize=9, color=INK)
    return figure


def _draw_example(axes: Sequence[Axes], outcome: Outcome, images: ThesisImages, number: int) -> None:
    depth = images.image(number)
    middle = float(np.nanmean(depth)) if np.isfinite(depth).any() else 0.5
    spread = max(float(np.nanmax(depth) - np.nanmin(depth)), 0.05) if np.isfinite(depth).any() else 0.5
    limits = (middle - 0.6 * spread, middle + 0.6 * spread)
    draw_depth(axes[0], depth, limits)
    axes[0].set_title(f"{100 * outcome.figures.iou[number]:.1f} %", loc="left", fontsize=10, color=INK, pad=3)
    axes[0].set_title(f"body {number}", loc="right", fontsize=8.5, color=_FAINT, pad=3)
    true = unit_cube.optical_from_cube(outcome.labels[number])
    if np.isfinite(outcome.figures.delta_a[number]):
        predicted = unit_cube.optical_from_cube(outcome.bodies[number])
        rendered, _ = raycast.render(predicted, images.camera)
        draw_depth(axes[1], rendered, limits)
        _crop(axes[:2], np.isfinite(depth) | np.isfinite(rendered))
        draw_bodies_3d(
            axes[2],
            [predicted],
            unit="",
            pixels=300,
            colours=[colour(0)],
            wires=[true],
            elevation=_ELEVATION,
            azimuth=_AZIMUTH,
        )
    else:
        _crop(axes[:1], np.isfinite(depth))
        axes[2].set_axis_off()
        axes[1].set_axis_off()
        axes[1].text(0.5, 0.5, "no body", transform=axes[1].transAxes, ha="center", fontsize=9, color=_FAINT)


def _crop(axes: Sequence[Axes], shown: np.ndarray) -> None:
    """Show the square around the pixels (height, width) that are True, kept within the image."""
    rows, columns = np.nonzero(shown)
    if rows.size == 0:
        return
    size = np.array(shown.shape[::-1], dtype=float)
    low, high = (np.array([of(columns), of(rows)], dtype=float) for of in (np.min, np.max))
    half = min(0.62 * float((high - low + 1).max()), 0.5 * float(size.min()))
    middle = np.clip(0.5 * (low + high), half - 0.5, size - 0.5 - half)
    for ax in axes:
        ax.set_xlim(middle[0] - half, middle[0] + half)
        ax.set_ylim(middle[1] + half, middle[1] - half)


def _parameter_lines(body: Superquadric, rings: int = 15, meridians: int = 28, fineness: int = 96) -> np.ndarray:
    """Segments (j, 2, 3) of the lines of constant eta and of constant omega (thesis, equation 3.6)."""
    around = np.linspace(-np.pi, np.pi, fineness + 1)
    along = np.linspace(-0.5 * np.pi, 0.5 * np.pi, fineness // 2 + 1)
    curves = [(np.full_like(around, eta), around) for eta in np.linspace(-0.5 * np.pi, 0.5 * np.pi, rings + 2)[1:-1]]
    curves += [(along, np.full_like(along, omega)) for omega in np.linspace(-np.pi, np.pi, meridians, endpoint=False)]
    segments = []
    for eta, omega in curves:
        points = body.parametric_points(eta, omega)
        segments.append(np.stack([points[:-1], points[1:]], axis=1))
    return np.concatenate(segments)


def _histogram(ax: Axes, values: np.ndarray, bins: np.ndarray) -> None:
    ax.hist(values[np.isfinite(values)], bins=bins.tolist(), color=_BAR, lw=0)
    ax.set_xlim(bins[0], bins[-1])
    _axes_style(ax)


def _axes_style(ax: Axes) -> None:
    ax.set_axisbelow(True)
    ax.grid(axis="x", color=_GRID, lw=0.8)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        ax.spines[side].set_color(_GRID)
    ax.tick_params(which="both", labelsize=8.5, colors=_FAINT, length=0)


def _square(ax: Axes, centre: np.ndarray, reach: float) -> None:
    ax.set_axis_off()
    ax.set_aspect("equal")
    ax.set_xlim(centre[0] - reach, centre[0] + reach)
    ax.set_ylim(centre[1] + reach, centre[1] - reach)


def _heading(ax: Axes, text: str, detail: str) -> None:
    ax.set_title(text, loc="left", fontsize=10.5, color=INK, pad=5)
    ax.set_title(detail, loc="right", fontsize=8.5, color=_FAINT, pad=5)
