"""Pictures of a walk down a loss, one a step, and the film of them.

From left to right: the depth image with the outlines of the body of the step and, dashed, of the true one; the body
from the right with the true one as a wire; loss and IoU so far.  Windows and axes hold the whole walk, so that films
stand still.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from sq_perception.evaluation import plots
from sq_perception.evaluation.body_pictures import draw_bodies_3d
from sq_perception.evaluation.gradient_search import Subject, Walk

_BODY = plots.colour(0)
_MILLISECONDS, _LAST_MILLISECONDS = 110, 2200


def walk_figure(subject: Subject, found: Walk, step: int, title: str = "") -> Figure:
    """The picture of one step; see the module."""
    optical = subject.view.from_canonical(found.bodies)
    truth = [] if subject.truth is None else [subject.view.from_canonical(subject.truth)]
    extremes = [optical[0], optical[len(found) // 4], optical[len(found) // 2], optical[-1]]
    figure = plots.new_figure(12.6, 4.5)
    figure.text(0.012, 0.935, title, fontsize=13, weight="bold", color=plots.INK)
    note = "pink: the true body" if truth else "the true body is not known"
    figure.text(0.988, 0.935, note, fontsize=11, color=plots.WIRE if truth else plots.INK, ha="right")

    image = figure.add_axes((0.012, 0.03, 0.305, 0.854))
    plots.draw_depth(image, subject.depth, window=plots.window_of([*extremes, *truth], subject.camera))
    plots.draw_outlines(image, [optical[step]], subject.camera, [_BODY], width=1.8)
    for body in truth:
        for loop in plots.silhouettes(body, subject.camera):
            image.plot(*np.vstack([loop, loop[:1]]).T, color=plots.WIRE, lw=1.4, ls=(0, (4, 2.5)))
    image.patch.set_facecolor(plots.NOTHING)

    space = figure.add_axes((0.325, 0.03, 0.305, 0.854))
    draw_bodies_3d(
        space,
        [optical[step]],
        colours=[_BODY],
        elevation=18,
        azimuth=52,
        unit="of the cube",
        wires=truth,
        enclosed=extremes,
    )
    _draw_curves(figure.add_axes((0.69, 0.14, 0.245, 0.68)), found, step)
    return figure


def _draw_curves(ax: Axes, found: Walk, step: int) -> None:
    """Loss and IoU so far, in axes that hold the whole walk."""
    steps = np.arange(len(found))
    lowest, highest = float(found.losses.min()), float(found.losses.max())
    floor = max(lowest, 1e-6 * highest)
    if lowest >= 0 and highest > 20 * max(floor, 1e-300):
        ax.set_yscale("log")
        ax.set_ylim(floor / 1.5, highest * 1.5)
    elif highest > lowest:
        ax.set_ylim(min(0.0, lowest), 1.05 * highest)
    ax.plot(steps[: step + 1], found.losses[: step + 1], color=plots.INK, lw=1.6)
    ax.plot(step, found.losses[step], "o", color=plots.INK, ms=5)
    ax.set_xlim(-0.5, max(len(found) - 0.5, 1))
    ax.set_xlabel("step", color=plots.INK)
    ax.set_ylabel("loss", color=plots.INK)
    ax.set_title(f"loss {found.losses[step]:.3g}", loc="left", fontsize=11, color=plots.INK)
    ax.grid(visible=True, color="#e4e8ec", lw=0.8)
    ax.set_axisbelow(True)
    ax.spines["top"].set_visible(False)
    if found.iou is None:
        ax.spines["right"].set_visible(False)
        return
    right = ax.twinx()
    shade = 0.85 * _BODY
    right.plot(steps[: step + 1], 100 * found.iou[: step + 1], color=shade, lw=1.6)
    right.plot(step, 100 * found.iou[step], "o", color=shade, ms=5)
    right.set_ylim(0, 102)
    right.set_ylabel("IoU %", color=shade)
    right.tick_params(axis="y", colors=shade)
    right.spines["top"].set_visible(False)
    right.set_title(f"IoU {100 * found.iou[step]:.1f} %", loc="right", fontsize=11, color=shade)


def picture(figure: Figure) -> Image.Image:
    """A figure as an RGB picture of some 1000 x 360 pixels."""
    figure.set_dpi(80)
    figure.canvas.draw()
    return Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3])  # type: ignore[attr-defined]


def save_film(pictures: Sequence[Image.Image], path: Path) -> None:
    """An endless animated GIF that rests on its last picture; one palette for all, so that nothing flickers."""
    palette = pictures[-1].quantize(128, dither=Image.Dither.NONE)
    frames = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    times = [_MILLISECONDS] * (len(frames) - 1) + [_LAST_MILLISECONDS]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=times, loop=0, optimize=False)
