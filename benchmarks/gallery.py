"""The pictures of docs/gallery.md, and that page itself: synthetic scenes, what was recovered, and how far off it is.

    python benchmarks/gallery.py [--only can bottles] [--docs docs]

Every scene is household things (:mod:`mesh_things`) at given places on a table, through a simulated sensor; the moving
camera is that of :mod:`tracking`.  Left, what the sensor saw; in the middle, the program's own masks with the outlines
of the recovered bodies; right, these bodies from another place, with the true things as thin lines.  All numbers of the
page are measured here, so that text and pictures agree; ``--only`` draws some pictures and leaves the page as it is.

Edges are full ones, descending, those of a thing and those of its body; deviations belong to edges, so that they are
twice those of half sizes.  IoU is that of volumes with the thing's convex hull.  A body belongs to the thing with which
the sum of all IoU is largest.
"""

from __future__ import annotations

import textwrap

if __name__ == "__main__":
    import one_thread  # noqa: F401

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mesh_things
import numpy as np
import report
import tabletop
import tracking
from gallery_figures import MatchedThing, empty_figure, matched, scene_figure, write_picture
from gallery_scenes import Stood, bottle, can, carton, kitchen, viewed
from matplotlib.axes import Axes
from scene_verdict import recoverer

from sq_perception.evaluation.plots import FAINT, WIRE, colour, draw_depth, draw_outlines, heading_of, new_figure
from sq_perception.fitting.fit import Status
from sq_perception.recovery.recoverer import FrameRecovery
from sq_perception.simulation import sensor_noise
from sq_perception.tracking.session import Followed

TRACKED = (1, 10, 30)
TRACKED_SCENE = 2
TRACKED_WINDOW = (70.0, 550.0, 40.0, 440.0)
"""Left, right, top, bottom of what is shown of these frames, pixels."""
WRAPPED: dict[str, Any] = {"break_long_words": False, "break_on_hyphens": False}


# The page


@dataclass(frozen=True)
class Entry:
    """A part of the page: what stands above the picture, and below it."""

    title: str
    text: str


def of_scene(
    title: str,
    things: Sequence[Stood],
    text: str,
    sensor: str = "realsense_d435",
    azimuth: float = 35.0,
    edges_of: str = "",
    **where: float,
) -> Callable[[Path], Entry]:
    """A picture of three panels, and how good the bodies are; of one thing every edge."""

    def draw(path: Path) -> Entry:
        view = viewed(things, sensor, **where)
        frame = recoverer().recover(view.depth, view.camera)
        found = matched(view, frame)
        write_picture(scene_figure(view, frame, azimuth), path)
        detail = [edges(one) for one in found if one.placed.thing.name == edges_of]
        return Entry(title, " ".join([text, measured(found, frame), *detail]))

    return draw


def measured(found: Sequence[MatchedThing], frame: FrameRecovery) -> str:
    """What was found of the things, and how far off it is."""
    bodies = {one.placed.thing.name: one.body for one in found}
    errors = [
        2e3 * np.sort(one.body.superquadric.size) - 1e3 * one.placed.thing.edges
        for one in found
        if one.body is not None
    ]
    missed = ", ".join(name for name, body in bodies.items() if body is None)
    return (
        f"{len(errors)} of {len(found)} things found{f' (missed: {missed})' * bool(missed)}, "
        f"{len(frame.recovered) - len(errors)} bodies too many. Mean IoU "
        f"{100 * np.mean([one.iou for one in found]):.0f} %, edges off by {np.mean(errors):+.1f} mm in the mean."
    )


def edges(one: MatchedThing) -> str:
    """Those of a thing and of its body, and how sure they are."""
    name = f"The {one.placed.thing.name}, {100 * one.placed.visible_share:.0f} % visible"
    if one.body is None:
        return f"{name}: no body."
    order = np.argsort(-one.body.superquadric.size)
    seen, sigma = 100 * one.body.seen[order], 2e3 * one.body.sigma_size[order]
    sizes, true = 2e3 * one.body.superquadric.size[order], 1e3 * one.placed.thing.edges[::-1]
    parts = [
        f"edge {seen[k]:.0f} % measured, {sizes[k]:.0f} ± {sigma[k]:.0f} mm, truly {true[k]:.0f}" for k in range(3)
    ]
    return (
        f"{name}: {'; '.join(parts)} (`seen`, `sigma_size`). Status `{Status(one.body.status).name}`, message: "
        f"{one.body.message}."
    )


def empty(path: Path) -> Entry:
    """A table with nothing on it through every sensor."""
    views = [viewed((), name) for name in sensor_noise.PRESETS]
    frames = [recoverer().recover(view.depth, view.camera) for view in views]
    write_picture(empty_figure(views, frames), path)
    number = sum(len(frame.bodies) for frame in frames)
    reasons = " / ".join(sorted({frame.message for frame in frames if frame.message}))
    return Entry(
        "An empty table",
        f"Bodies found through {len(views)} sensors together: {number}. `FrameRecovery.message`: {reasons or 'empty'}.",
    )


def tracked(path: Path) -> Entry:
    """Sizes of tracked bodies and their deviations over 30 frames of a camera that goes about a table."""
    *_, shown = tracking.scenes(TRACKED_SCENE + 1, 1)
    row = tracking.Row(sensor_noise.preset("realsense_d435"), tracking.ARC)
    record = tracking.Record(TRACKED[-1])
    kept: dict[int, tuple[tracking.View, tuple[Followed, ...]]] = {}
    for k, view in enumerate(tracking.views(shown, row, TRACKED[-1], np.random.default_rng(5))):
        followed = record.follow(k, view, recoverer().recover(view.depth, view.scene.camera))
        if k + 1 in TRACKED:
            kept[k + 1] = view, followed
    error, sigma, single = (2e3 * each * shown.bodies.size for each in (record.fused, record.sigma, record.single))
    # The body whose first view determines least.
    chosen = int(np.nanargmax(np.where(np.isfinite(sigma[0]).all(axis=-1), sigma[0].max(axis=-1), np.nan)))
    axis = int(sigma[0, chosen].argmax())
    figure = new_figure(11.62, 2.62)
    grid = figure.add_gridspec(
        1, 2, width_ratios=[3, 1.02], wspace=0.075, left=0.004, right=0.99, top=0.905, bottom=0.085
    )
    axes = grid[0].subgridspec(1, len(kept), wspace=0.015).subplots()
    for ax, (k, (view, followed)) in zip(axes, kept.items(), strict=True):
        draw_depth(ax, view.depth, window=TRACKED_WINDOW)
        bodies = [one.superquadric for one in followed]
        draw_outlines(ax, bodies, view.scene.camera, [colour(one.id - 1) for one in followed], width=1.5)
        heading_of(ax, f"Frame {k}", f"camera at {tracking.ARC * (k - 1) / (TRACKED[-1] - 1):.0f}°")
    course = figure.add_subplot(grid[1])
    _draw_course(course, error[:, chosen, axis], sigma[:, chosen, axis], single[:, chosen, axis])
    write_picture(figure, path)
    steps = ", ".join(f"{error[k - 1, chosen, axis]:+.1f} ± {sigma[k - 1, chosen, axis]:.1f}" for k in TRACKED)
    return Entry(
        "Thirty frames of a moving camera",
        f"{tracking.BODIES} bodies, a stereo camera that goes {tracking.ARC:.0f} degrees about the table, its pose "
        f"known; ids given: {record.session.tally.births}. Right, the edge of which the first frame knows least: its "
        f"error is {steps} mm after frames "
        f"{', '.join(map(str, TRACKED))} (line: fused; dots: each frame by itself).",
    )


def _draw_course(ax: Axes, error: np.ndarray, sigma: np.ndarray, single: np.ndarray) -> None:
    frames = np.arange(1, len(error) + 1)
    ax.fill_between(frames, error - 2 * sigma, error + 2 * sigma, color="#2e86e4", alpha=0.15, lw=0)
    ax.fill_between(frames, error - sigma, error + sigma, color="#2e86e4", alpha=0.25, lw=0)
    ax.plot(frames, error, color="#2e86e4", lw=1.8)
    ax.plot(frames, single, ".", color=FAINT, ms=4)
    ax.axhline(0, color=WIRE, lw=1.0)
    ax.set_xlim(1, len(error))
    ax.set_xticks(TRACKED)
    ax.tick_params(labelsize=8, colors=FAINT, length=2, pad=2)
    ax.spines[:].set_color("#cfd7de")
    heading_of(ax, "Error, mm", "± 1 and ± 2 deviations")


ENTRIES: dict[str, Callable[[Path], Entry]] = {
    "can": of_scene(
        "One can",
        (Stood("can", can(75, 110), (0.0, 0.0)),),
        "Its back comes from the silhouette and the curvature of the front, its foot from the table.",
        distance=0.6,
    ),
    "household_stereo": of_scene(
        "A table by stereo",
        kitchen(),
        "Six things that stand before each other. Stereo widens what is near by some pixels.",
        distance=0.85,
    ),
    "household_structured_light": of_scene(
        "The same table by structured light",
        kitchen(),
        "Less noise than stereo has.",
        sensor="kinect_v1",
        distance=0.85,
    ),
    "touching": of_scene(
        "Things that touch",
        (
            Stood("high box", carton(80, 60, 130), (-0.07, 0.03)),
            Stood("low box", carton(100, 80, 60), (0.0201, 0.02)),
            Stood("flat box", carton(90, 60, 35), (-0.045, -0.0562), 8),
            Stood("can", can(66, 100), (0.1035, 0.02)),
        ),
        "Three boxes and a can, parted at folds in the depth and by lines of sight between them.",
        distance=0.65,
    ),
    "bottles": of_scene(
        "Bottles",
        (
            Stood("bottle 1", bottle(1), (-0.13, 0.02)),
            Stood("bottle 2", bottle(4), (0.0, 0.08)),
            Stood("bottle 3", bottle(9), (0.1, -0.06), 35, mesh_things.ON_X),
        ),
        "No superquadric has a shoulder and a neck: one body leaves out the neck, or bottle and neck become two.",
        down=32.0,
        distance=0.75,
    ),
    "half_hidden": of_scene(
        "Half hidden",
        (
            Stood("box in front", carton(150, 50, 160), (-0.06, -0.04), 4),
            Stood("hidden box", carton(190, 70, 90), (0.02, 0.08), 8),
        ),
        "A box behind another one.",
        edges_of="hidden box",
        azimuth=50.0,
        down=30.0,
        distance=0.65,
    ),
    "tracking": tracked,
    "empty_table": empty,
}

INTRODUCTION = """
Synthetic scenes through simulated [sensors](sensors.md), own masks and default options, one run of `python
benchmarks/gallery.py` ({facts}); [figures over many scenes](../README.md#accuracy-and-speed).

Left the depth image, near is light, black is not measured; in the middle masks and recovered outlines, hidden edges
faint; right the recovered bodies, with the true things as thin lines. Edges are full lengths, ± one reported standard
deviation; IoU is with the true convex hull.
"""


def main() -> None:
    parser = report.parser(__doc__)
    parser.add_argument("--only", nargs="+", choices=list(ENTRIES), help="draw these pictures, leave the page as it is")
    parser.add_argument("--docs", type=Path, default=Path(__file__).resolve().parents[1] / "docs")
    options = parser.parse_args()
    pictures = options.docs / "gallery"
    pictures.mkdir(parents=True, exist_ok=True)
    recoverer().warm_up(tabletop.CAMERA)
    facts = report.environment()
    introduction = INTRODUCTION.format(facts=f"{facts['date']}, commit {facts['commit']}")
    parts = ["# Gallery\n" + introduction]
    for name in options.only or ENTRIES:
        path = pictures / f"{name}.png"
        entry = ENTRIES[name](path)
        text = textwrap.fill(entry.text, 120, **WRAPPED)
        parts.append(f"## {entry.title}\n\n![{entry.title}](gallery/{path.name})\n\n{text}\n")
        print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB\n{entry.text}\n", flush=True)
    if not options.only:
        (options.docs / "gallery.md").write_text("\n".join(parts), encoding="utf-8")


if __name__ == "__main__":
    main()
