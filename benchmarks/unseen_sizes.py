"""What each piece of knowledge about the unseen side is worth: household scenes, masks given, without one at a time.

Scenes of :mod:`tabletop`, the same for every row; figures as in `real_scenes.py`, for things at least half visible.
Each row switches one thing off, by an option of the recovery where there is one and otherwise by its constant.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import Any
from unittest import mock

if __name__ == "__main__":  # as a script only: a process that imports this has threads already
    for variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(variable, "1")

import numpy as np
import report
import scene_verdict
import tabletop
from rich.progress import track
from scene_verdict import Answer

from sq_perception.fitting import problem, revolution
from sq_perception.fitting.observation import Observation
from sq_perception.recovery import seen_object
from sq_perception.recovery.recoverer import RecoveryOptions

HALF = 0.5
Switch = Callable[[], AbstractContextManager[Any]]


@dataclass(frozen=True)
class Setting:
    """A row: options, and what is replaced while it runs."""

    options: RecoveryOptions = field(default_factory=RecoveryOptions)
    switch: Switch = nullcontext


def constant(module: Any, name: str, value: Any) -> Switch:
    """A switch that sets a module's constant."""
    return lambda: mock.patch.object(module, name, value)


def _no_rays(seen: Observation, count: int, offset: float = 0.5) -> np.ndarray:
    return seen.free_rays_of(seen.free[:0], 1, offset)


SETTINGS = {
    "all of it": Setting(),
    "without the network": Setting(RecoveryOptions(method="symmetry")),
    "network shown all pixels of the mask": Setting(
        switch=constant(seen_object, "core", lambda one, depth, camera: one.mask)
    ),
    "without bodies of revolution": Setting(switch=constant(revolution, "ODDS", 1e-300)),
    "bodies may hover": Setting(switch=constant(problem, "GAP_SIGMA", np.inf)),
    "without the plane": Setting(RecoveryOptions(use_plane=False)),
    "without free space": Setting(switch=constant(Observation, "free_rays", _no_rays)),
}


def answers(setting: Setting, scene: tabletop.Tabletop) -> list[tuple[str, Answer]]:
    """Kind and answer of each thing that is half visible."""
    with setting.switch():
        frame = scene_verdict.recoverer().recover(scene.depth, scene.camera, scene.labels, setting.options)
    return [
        (placed.thing.kind, scene_verdict.of_frame(frame, placed.label, placed, scene))
        for placed in scene.placed
        if placed.pixels >= scene_verdict.FEWEST_PIXELS and placed.visible_share >= HALF
    ]


def figures(found: list[tuple[str, Answer]]) -> dict[str, Any]:
    """Of all things, and the mean IoU of each kind."""
    iou = 100 * np.array([answer.iou for _, answer in found])
    errors = 1e3 * np.array([answer.size_error for _, answer in found])
    kinds = np.array([kind for kind, _ in found])
    return {
        "iou": report.spread(iou),
        "size_error": report.spread(errors[np.isfinite(errors)]),
        "two_sigma": float(100 * np.nanmean([answer.covered for _, answer in found])),
        "kinds": {str(kind): float(iou[kinds == kind].mean()) for kind in np.unique(kinds)},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--scenes", type=int, default=150)
    parser.add_argument("--first", type=int, default=0, help="seed of the first scene")
    parser.add_argument("--name", default="unseen_sizes", help="name of the result files")
    options = parser.parse_args()
    scans = report.shared_data("ycb_meshes")
    found: dict[str, list[tuple[str, Answer]]] = {name: [] for name in SETTINGS}
    for seed in track(range(options.first, options.first + options.scenes), description="scenes"):
        scene = tabletop.scene(seed, None, scans)
        for name, setting in SETTINGS.items():
            found[name] += answers(setting, scene)
    result = {name: figures(each) for name, each in found.items()}
    kinds = sorted(result["all of it"]["kinds"])
    rows = [
        [
            name,
            str(len(found[name])),
            f"{group['iou']['mean']:.1f} +- {group['iou']['std']:.1f}",
            f"{group['size_error']['median']:.1f} / {group['size_error']['mean']:.1f}",
            f"{group['two_sigma']:.0f}",
            *(f"{group['kinds'][kind]:.1f}" for kind in kinds),
        ]
        for name, group in result.items()
    ]
    header = ["", "things", "IoU %", "size error mm median / mean", "2 sigma %", *kinds]
    report.write(options.name, {"options": vars(options), **result}, report.table(header, rows))


if __name__ == "__main__":
    main()
