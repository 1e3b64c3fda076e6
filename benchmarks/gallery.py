"""The pictures of docs/gallery.md, and that page itself: synthetic scenes, what was recovered, and how far off it is.

    python benchmarks/gallery.py [--only can bottles] [--docs docs]

Every scene is household things (:mod:`mesh_things`) at given places on a table, through a simulated sensor.  Left,
what the sensor saw; in the middle, the program's own masks with the outlines of the recovered bodies; right, these
bodies from another place, with the true things as thin lines.  All numbers of the page are measured here, so that text
and pictures agree; ``--only`` draws some pictures and leaves the page as it is.

Edges are full ones, descending, those of a thing and those of its body; deviations belong to edges, so that they are
twice those of half sizes.  IoU is that of volumes with the thing's convex hull.  A body belongs to the thing with which
the sum of all IoU is largest.
"""

from __future__ import annotations

import textwrap

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import mesh_things, report, tabletop
from common.gallery_figures import MatchedThing, matched, scene_figure, write_picture
from common.gallery_scenes import Stood, bottle, can, carton, kitchen, viewed
from common.scene_verdict import recoverer

from sq_perception.fitting.fit import Status
from sq_perception.recovery.recoverer import FrameRecovery


@dataclass(frozen=True)
class Entry:
    """A part of the page: a scene, what is said of it, and how it is looked at; of one thing every edge is listed."""

    title: str
    things: tuple[Stood, ...]
    text: str
    sensor: str = "realsense_d435"
    azimuth: float = 35.0
    edges_of: str = ""
    down: float = 40.0
    """Degrees by which the camera looks down."""
    distance: float = 0.75
    """Metres to the middle of the table."""


def drawn(entry: Entry, path: Path) -> str:
    """Write the picture; returns the text below it."""
    view = viewed(entry.things, entry.sensor, entry.down, entry.distance)
    frame = recoverer().recover(view.depth, view.camera)
    found = matched(view, frame)
    write_picture(scene_figure(view, frame, entry.azimuth), path)
    detail = [edges(one) for one in found if one.placed.thing.name == entry.edges_of]
    text = " ".join([entry.text, measured(found, frame), *detail])
    return textwrap.fill(text, 120, break_long_words=False, break_on_hyphens=False)


def measured(found: Sequence[MatchedThing], frame: FrameRecovery) -> str:
    """What was found of the things, and how far off it is."""
    bodies = {one.placed.thing.name: one.body for one in found}
    errors = [
        2e3 * np.sort(one.body.superquadric.size) - 1e3 * one.placed.thing.edges
        for one in found
        if one.body is not None
    ]
    missed = ", ".join(name for name, body in bodies.items() if body is None)
    wrong = len(frame.recovered) - len(errors)
    return (
        f"{f'Missed: {missed}. ' * bool(missed)}{f'{wrong} false positives. ' * bool(wrong)}Mean IoU "
        f"{100 * np.mean([one.iou for one in found]):.0f} %, mean edge error {np.mean(errors):+.1f} mm."
    )


def edges(one: MatchedThing) -> str:
    """Those of a thing and of its body, and how sure they are."""
    name = f"The {one.placed.thing.name}, {100 * one.placed.visible_share:.0f} % visible"
    if one.body is None:
        return f"{name}: no body."
    order = np.argsort(-one.body.superquadric.size)
    seen, sigma = 100 * one.body.seen[order], 2e3 * one.body.sigma_size[order]
    sizes, true = 2e3 * one.body.superquadric.size[order], 1e3 * one.placed.thing.edges[::-1]
    parts = [f"edge {seen[k]:.0f} % visible, {sizes[k]:.0f} ± {sigma[k]:.0f} mm, true {true[k]:.0f}" for k in range(3)]
    return (
        f"{name}: {'; '.join(parts)} (`seen`, `sigma_size`). Status `{Status(one.body.status).name}`, message: "
        f"{one.body.message}."
    )


ENTRIES = {
    "can": Entry(
        "One can",
        (Stood("can", can(75, 110), (0.0, 0.0)),),
        "The silhouette and the curvature of the front determine its back, the table its foot.",
        distance=0.6,
    ),
    "household_stereo": Entry(
        "Stereo",
        kitchen(),
        "Six objects that occlude each other; stereo widens near ones by some pixels.",
        distance=0.85,
    ),
    "household_structured_light": Entry(
        "Structured light",
        kitchen(),
        "The same table with less noise.",
        sensor="kinect_v1",
        distance=0.85,
    ),
    "touching": Entry(
        "Touching objects",
        (
            Stood("high box", carton(80, 60, 130), (-0.07, 0.03)),
            Stood("low box", carton(100, 80, 60), (0.0201, 0.02)),
            Stood("flat box", carton(90, 60, 35), (-0.045, -0.0562), 8),
            Stood("can", can(66, 100), (0.1035, 0.02)),
        ),
        "Three boxes and a can, separated at depth folds and by lines of sight between them.",
        distance=0.65,
    ),
    "bottles": Entry(
        "Bottles",
        (
            Stood("bottle 1", bottle(1), (-0.13, 0.02)),
            Stood("bottle 2", bottle(4), (0.0, 0.08)),
            Stood("bottle 3", bottle(9), (0.1, -0.06), 35, mesh_things.ON_X),
        ),
        "No superquadric has a shoulder and a neck: a body omits the neck, or the bottle becomes two bodies.",
        down=32.0,
    ),
    "half_hidden": Entry(
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
}

INTRODUCTION = """
Simulated [sensors](sensors.md), own masks, default options: `python benchmarks/gallery.py` ({facts}).
[Figures over many scenes](../README.md#accuracy-and-speed).

Left: depth, black has no reading. Middle: masks and outlines. Right: bodies, true objects as thin lines. Edges are full
lengths ± one sigma; IoU is with the true convex hull. Unless noted, all objects are found, and nothing else.
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
        entry = ENTRIES[name]
        text = drawn(entry, path)
        parts.append(f"## {entry.title}\n\n![{entry.title}](gallery/{path.name})\n\n{text}\n")
        print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB\n{text}\n", flush=True)
    if not options.only:
        (options.docs / "gallery.md").write_text("\n".join(parts), encoding="utf-8")


if __name__ == "__main__":
    main()
