"""A picture of what the fit loses: the worst thing of each kind of household scenes, with true masks.

    python benchmarks/household_things.py --scenes 200 --each runs/things.json
    python benchmarks/worst_things.py runs/things.json docs/unseen_worst.png

Depth of the surroundings of each; the recovered body in colour, the outline of the true hull as a thin line, both sets
of edges in millimetres.  Of things at least half visible and at least half measured: some stand nearer than a sensor
sees.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import household_things
import numpy as np
from common import report
from common.gallery_figures import write_picture
from common.scene_verdict import HALF
from matplotlib.axes import Axes
from scipy.spatial import ConvexHull

from sq_perception.evaluation.plots import WIRE, colour, draw_depth, draw_outlines, heading_of, new_figure
from sq_perception.geometry import Superquadric
from sq_perception.simulation.household import KINDS

METHOD = "given"
AROUND = 0.6
"""Of a thing's larger side in the image: what is shown beside it."""
COLUMNS, SIDE = 4, 2.9


def worst(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Of each kind the thing with the least IoU."""
    seen = [row for row in rows if row["visible_share"] >= HALF and row["measured"] >= HALF * row["pixels"]]
    of_kinds = [[row for row in seen if row["kind"] == kind] for kind in KINDS]
    return [min(some, key=lambda row: float(row["answers"][METHOD]["iou"])) for some in of_kinds if some]


def draw(ax: Axes, row: dict[str, Any]) -> None:
    """One thing."""
    scene = household_things.scene(row["seed"], row["sensor"])
    placed = next(one for one in scene.placed if one.label == row["label"])
    corners = scene.camera.project(placed.hull)
    outline = corners[ConvexHull(corners).vertices]
    low, high = outline.min(axis=0), outline.max(axis=0)
    middle, reach = (low + high) / 2, (0.5 + AROUND) * float((high - low).max())
    left, top = middle - reach
    right, bottom = middle + reach
    draw_depth(ax, scene.depth, window=(left, right, top, bottom))
    closed = np.vstack([outline, outline[:1]])
    ax.plot(*closed.T, color=WIRE, linewidth=1.0)
    answer = row["answers"][METHOD]
    edges = " x ".join(f"{1e3 * edge:.0f}" for edge in sorted(row["edges"]))
    text = "no body"
    if None not in answer["body"]:
        body = Superquadric.from_flat(np.array(answer["body"]))
        draw_outlines(ax, [body], scene.camera, [colour(0)], width=1.6)
        text = " x ".join(f"{2e3 * size:.0f}" for size in sorted(body.size))
    heading_of(ax, row["name"], f"IoU {100 * answer['iou']:.0f} %, {answer['status'].lower()}")
    ax.set_xlabel(f"{text}, true {edges} mm", fontsize=8)


def main() -> None:
    parser = report.parser(__doc__)
    parser.add_argument("each", type=Path, help="what household_things wrote with --each")
    parser.add_argument("picture", type=Path, help="PNG to write")
    options = parser.parse_args()
    chosen = worst(json.loads(options.each.read_text()))
    lines = -(-len(chosen) // COLUMNS)
    figure = new_figure(COLUMNS * SIDE, lines * (SIDE + 0.25))
    axes = figure.subplots(lines, COLUMNS, squeeze=False)
    figure.subplots_adjust(left=0.01, right=0.99, top=0.94, bottom=0.06, hspace=0.28, wspace=0.06)
    for ax in axes.flat[len(chosen) :]:
        ax.set_visible(False)
    for ax, row in zip(axes.flat, chosen, strict=False):
        draw(ax, row)
    print(write_picture(figure, options.picture))


if __name__ == "__main__":
    main()
