"""Other cameras than the one that everything was made with: fields of view, numbers of pixels, heights above the table.

    python benchmarks/cameras.py [--scenes 30] [--first 30400] [--name cameras]

Scenes of :mod:`household_things`, before each camera others, as things have to lie inside its image; scene k from the
seed (``household_things.SEED``, k) alone.  Counted are things at least half visible, with 200 pixels of an image of
640 x 480 and half of them measured.  IoU is with the convex hull, 0 where there is no body or a failed one, with its
standard error; ``missed`` the share of these things that no own segment agrees with, as in :mod:`scene_verdict`;
``false`` the own bodies a scene that are of no thing.
"""

from __future__ import annotations

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

from collections.abc import Sequence
from dataclasses import dataclass

import household_things
import numpy as np
from common import report, scene_verdict
from common.tabletop import Tabletop

from sq_perception.imaging.camera import Camera
from sq_perception.simulation.things_on_table import ELEVATION, TABLE_CAMERA


@dataclass(frozen=True)
class View:
    """A camera and the degrees above the table from which it looks."""

    camera: Camera
    elevation: tuple[float, float] = ELEVATION


def of_width(width: int, height: int, degrees: float, aside: float = 0.0) -> Camera:
    """A camera so many degrees wide, its principal point ``aside`` pixels off the middle both ways."""
    focal = width / (2 * np.tan(np.deg2rad(degrees) / 2))
    return Camera(width, height, focal, focal, (width - 1) / 2 + aside, (height - 1) / 2 + aside)


VIEWS = {
    "640 x 480, 60 degrees": View(TABLE_CAMERA),
    "1280 x 720, 90": View(of_width(1280, 720, 90.0)),
    "1920 x 1080, 70": View(of_width(1920, 1080, 70.0)),
    "848 x 480, 87": View(of_width(848, 480, 87.0)),
    "640 x 480, 30": View(of_width(640, 480, 30.0)),
    "640 x 480, 120": View(of_width(640, 480, 120.0)),
    "320 x 240, 60": View(of_width(320, 240, 60.0)),
    "160 x 120, 60": View(of_width(160, 120, 60.0)),
    "60, principal point 100 pixels off": View(of_width(640, 480, 60.0, 100.0)),
    "60, 80 to 90 degrees above": View(TABLE_CAMERA, (80.0, 90.0)),
    "60, 6 to 16 degrees above": View(TABLE_CAMERA, (6.0, 16.0)),
}


def looked_at(scene: Tabletop) -> tuple[np.ndarray, int]:
    """What became of the things (n, 3) of a scene, and how many own bodies are of none.

    Of a thing: IoU with its mask given, IoU without, and 1 where an own segment agrees with it.
    """
    given = scene_verdict.recoverer().recover(scene.depth, scene.camera, scene.labels)
    own = scene_verdict.recoverer().recover(scene.depth, scene.camera)
    of_thing = scene_verdict.matches(own.labels, scene.labels, scene.depth)
    found = [
        (
            scene_verdict.of_frame(given, one.label, one, scene).iou,
            scene_verdict.of_frame(own, of_thing.get(one.label, 0), one, scene).iou,
            one.label in of_thing,
        )
        for one in scene.placed
        if household_things.is_counted(one, scene)
    ]
    taken = set(of_thing.values())
    return np.array(found, dtype=float).reshape(-1, 3), sum(body.label not in taken for body in own.recovered)


def row(looked: Sequence[tuple[np.ndarray, int]]) -> dict[str, float]:
    """Figures of what :func:`looked_at` says of some scenes."""
    given, own, is_found = np.concatenate([found for found, _ in looked]).T
    figures: dict[str, float] = {
        "things": len(is_found),
        "missed": float(np.mean(is_found == 0)),
        "false": sum(others for _, others in looked) / len(looked),
    }
    for masks, iou in (("given", given), ("own", own)):
        figures |= {masks: float(iou.mean()), f"{masks} error": float(iou.std() / np.sqrt(len(iou)))}
    return figures


def table(what: str, rows: dict[str, dict[str, float]]) -> str:
    """The rows of :func:`row`, by name."""
    lines = []
    for name, figures in rows.items():
        shown = [f"{100 * figures[masks]:.1f} +- {100 * figures[f'{masks} error']:.1f}" for masks in ("given", "own")]
        lines.append([name, f"{figures['things']:.0f}", *shown, f"{100 * figures['missed']:.0f}"])
        lines[-1].append(f"{figures['false']:.2f}")
    return report.table([what, "things", "IoU %, masks given", "own masks", "missed %", "false"], lines)


def main() -> None:
    parser = report.parser(__doc__, "cameras")
    parser.add_argument("--scenes", type=int, default=30, help="number of scenes before each camera")
    parser.add_argument("--first", type=int, default=30400, help="seed of the first scene")
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.scenes)
    rows = {}
    for name, view in VIEWS.items():
        rows[name] = row(
            [
                looked_at(household_things.scene(seed, None, camera=view.camera, elevation=view.elevation))
                for seed in seeds
            ]
        )
        print(name, rows[name], flush=True)
    facts = {"scenes": options.scenes, "first": options.first}
    report.write(options.name, {**facts, "rows": rows}, table("camera", rows))


if __name__ == "__main__":
    main()
