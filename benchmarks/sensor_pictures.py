"""The picture of docs/sensors.md: one table as every sensor of sensor_noise measures it, and how far each is off.

python benchmarks/sensor_pictures.py docs/sensors.png
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from common import report
from common.gallery_figures import write_picture
from matplotlib import colormaps

from sq_perception.evaluation.plots import INK, NOTHING, draw_depth, new_figure
from sq_perception.simulation import sensor_noise
from sq_perception.simulation.scenes import table_scene

SEED = 3
BODIES = 4
WINDOW = (slice(110, 390), slice(90, 450))
SCALE = 6.0
"""Millimetres at the ends of the colours."""


def main() -> None:
    parser = report.parser(__doc__)
    parser.add_argument("output", type=Path)
    output = parser.parse_args().output
    scene = table_scene(np.random.default_rng(SEED), BODIES)
    true, _ = scene.render()
    models = {"truth": sensor_noise.Ideal(), **sensor_noise.PRESETS}
    part = true[WINDOW]
    limits = (float(np.nanquantile(part, 0.01)), float(np.nanquantile(part, 0.99)))
    colours = colormaps["RdBu_r"].with_extremes(bad=NOTHING)
    figure = new_figure(15.0, 4.9)
    grid = figure.subplots(2, len(models), gridspec_kw={"wspace": 0.02, "hspace": 0.03})
    figure.subplots_adjust(left=0.005, right=0.995, top=0.935, bottom=0.01)
    for (above, below), (name, model) in zip(grid.T, models.items(), strict=True):
        measured = model.measure(true, scene.camera, np.random.default_rng(1))[WINDOW]
        draw_depth(above, measured, limits)
        above.set_title(name, fontsize=11, color=INK, pad=4)
        below.set_axis_off()
        if name == "truth":
            continue
        below.set_facecolor(NOTHING)
        image = below.imshow(1e3 * (measured - part), cmap=colours, vmin=-SCALE, vmax=SCALE, interpolation="nearest")
    text = grid[1, 0].text
    text(0.98, 0.78, "measured minus true depth", transform=grid[1, 0].transAxes, ha="right", fontsize=10, color=INK)
    text(0.98, 0.68, "black: nothing measured", transform=grid[1, 0].transAxes, ha="right", fontsize=10, color=INK)
    bar = figure.colorbar(image, cax=grid[1, 0].inset_axes([0.2, 0.42, 0.75, 0.06]), orientation="horizontal")
    bar.set_label("mm", fontsize=9, color=INK)
    bar.ax.tick_params(labelsize=9)
    write_picture(figure, output)


if __name__ == "__main__":
    main()
