"""The picture of docs/points.md: clouds of household things, and the parts that are found in them.

python benchmarks/point_pictures.py docs/points.png
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from common import report
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from point_clouds import of_thing

from sq_perception.evaluation.plots import colour, new_figure, save
from sq_perception.fitting.decomposition import decompose
from sq_perception.geometry.mesh import triangles
from sq_perception.simulation.household import draw_thing

KINDS = ("bottle", "vessel", "tool", "union")
SEED = 12


def main() -> None:
    parser = report.parser(__doc__)
    parser.add_argument("output", type=Path)
    output = parser.parse_args().output
    rng = np.random.default_rng(SEED)
    figure = new_figure(10.0, 5.0)
    figure.subplots_adjust(left=0, right=1, bottom=0, top=1, wspace=0, hspace=0)
    for column, kind in enumerate(KINDS):
        cloud = of_thing(draw_thing(rng, [kind]), rng)
        above = figure.add_subplot(2, len(KINDS), column + 1, projection="3d")
        below = figure.add_subplot(2, len(KINDS), len(KINDS) + column + 1, projection="3d")
        above.scatter(*cloud.T, s=0.6, c="0.35", depthshade=False)
        for k, fit in enumerate(decompose(cloud)):
            vertices, faces = triangles(fit.superquadric)
            below.add_collection3d(
                Poly3DCollection(vertices[faces], facecolors=[(*colour(k), 0.75)], linewidths=0, shade=True)
            )
        middle, reach = cloud.mean(axis=0), 0.42 * np.ptp(cloud, axis=0).max()
        for axes in (above, below):
            axes.set_xlim(middle[0] - reach, middle[0] + reach)
            axes.set_ylim(middle[1] - reach, middle[1] + reach)
            axes.set_zlim(middle[2] - reach, middle[2] + reach)
            axes.set_box_aspect((1, 1, 1))
            axes.view_init(20, -60)
            axes.set_axis_off()
    save(figure, output)


if __name__ == "__main__":
    main()
