"""Household things on a table through a depth sensor: how close the recovered bodies come to the true hulls.

    python benchmarks/real_scenes.py [--scenes 1000] [--first 0] [--jobs 1] [--sensor stereo]
                                     [--each FILE] [--name real_scenes]

Scenes are those of :mod:`tabletop`, methods and measures those of :mod:`scene_verdict`, figures
those of :mod:`scene_tables`.  Counted are things at least
half visible; things with under 200 pixels are left out and numbered.

Goals, things at least half visible: IoU 85 % with masks given, 80 % with the program's own; error of full edges, mean
of three: median 5 mm, mean 9 mm.
"""

from __future__ import annotations

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

from functools import partial
from pathlib import Path

from common import mesh_things, report, scene_tables, scene_verdict, tabletop
from common.scene_verdict import HALF, SceneVerdict, ThingVerdict

GOALS = {"given": "85", "own": "80"}


def verdict(seed: int, scans: Path | None, sensor: str | None) -> SceneVerdict:
    """Make the scene of a seed and evaluate every method on it."""
    return scene_verdict.evaluated(tabletop.scene(seed, scans, sensor))


def groups(everything: list[ThingVerdict]) -> dict[str, list[ThingVerdict]]:
    """The rows of the table, all first."""
    half = [one for one in everything if one.visible_share >= HALF]
    rows: dict[str, list[ThingVerdict]] = {scene_tables.ALL: half}
    for kind in mesh_things.KINDS:
        rows[kind] = chosen = [one for one in half if one.kind == kind]
        rows |= {f"{kind}, {rest}": [one for one in chosen if one.rest == rest] for rest in ("upright", "lying")}
    return rows | scene_tables.by_sensor_and_share(everything)


def main() -> None:
    options = scene_tables.arguments(__doc__, "real_scenes").parse_args()
    scans = report.shared_data("ycb_meshes")
    scene_tables.run(partial(verdict, scans=scans, sensor=options.sensor), options, groups, GOALS)


if __name__ == "__main__":
    main()
