"""The pictures of docs/points.md: parts that are found in clouds of household things, and before a simulated D435.

    python benchmarks/point_pictures.py docs/points.png docs/parts.png

Of the depth images the upper row shows the outline of the one body, the lower one the parts, shaded by depth.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from common import report
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from parts import WITH_PARTS, seen_scene
from point_clouds import of_thing

from sq_perception.evaluation.plots import colour, new_figure, save
from sq_perception.fitting.decomposition import decompose
from sq_perception.geometry.mesh import triangles
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.raycast import render
from sq_perception.recovery.recoverer import Recoverer
from sq_perception.simulation.household import KINDS as KINDS_OF_THINGS
from sq_perception.simulation.household import draw_thing

KINDS = ("bottle", "vessel", "tool", "union")
SEED = 12
SEEN = {"tool": 7, "bottle": 3, "union": 9, "round": 13}
"""Kinds and seeds of the things that are seen by a camera."""


def draw_seen_parts(output: Path) -> None:
    """The picture of depth images."""
    figure = new_figure(10.0, 5.0)
    figure.subplots_adjust(left=0, right=1, bottom=0, top=1, wspace=0.02, hspace=0.02)
    recoverer = Recoverer(threads=1)
    for column, (kind, seed) in enumerate(SEEN.items()):
        made = seen_scene([kind], 1, [KINDS_OF_THINGS.index(kind), seed])
        assert made is not None
        truth, depth = made
        (body,) = recoverer.recover(depth, truth.camera, truth.labels, WITH_PARTS).bodies
        v, u = np.nonzero(truth.labels)
        reach = int(0.7 * max(np.ptp(v), np.ptp(u)))
        middles = [(each.min() + each.max()) // 2 for each in (v, u)]
        window = tuple(slice(max(0, middle - reach), middle + reach) for middle in middles)
        for row, solids in enumerate(([body.superquadric], body.solids)):
            axes = figure.add_subplot(2, len(SEEN), row * len(SEEN) + column + 1)
            axes.imshow(depth[window], cmap="gray_r")
            _, index = render(Superquadric.stack(list(solids)), truth.camera)
            for k in range(len(solids)):
                shown = (index == k)[window]
                if row:
                    axes.imshow(np.dstack([*(np.full(shown.shape, c) for c in colour(k)), 0.6 * shown]))
                axes.contour(shown, [0.5], colors=[colour(k)], linewidths=1.5)
            axes.set_axis_off()
    save(figure, output)


def main() -> None:
    parser = report.parser(__doc__)
    parser.add_argument("output", type=Path)
    parser.add_argument("seen", type=Path)
    options = parser.parse_args()
    draw_seen_parts(options.seen)
    draw_parts_of_clouds(options.output)


def draw_parts_of_clouds(output: Path) -> None:
    """The picture of clouds."""
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
