"""Whole frames of the project's own tables: 2 to 12 bodies that touch and hide each other, seen by a stereo camera.

    python benchmarks/synthetic_tabletop.py [--scenes 60] [--sensors realsense_d435 ...] [--name synthetic_tabletop]

Scenes: those of :mod:`sq_perception.simulation.scenes`, 640 x 480 pixels, from 0.5 to 1.2 m, scene k from
the seed (``SEED``, k) alone.  Sensors: those of sq_perception.simulation.sensor_noise,
and ``plain``: sigma = 1.5 mm z^2 for each
pixel by itself, then millimetres.

    matched IoU   volume IoU (64^3 points) of the best one-to-one assignment of recovered to true bodies, mean over the
                  true bodies that are at least half visible; 0 for those that nothing was assigned to
    seen IoU      the same for masks: true pixels against labels of the matched body
    false         recovered bodies a frame that are left over, or whose IoU with every true body is below ``FALSE``

``own`` are the program's masks, ``own, no repair`` those before segments are parted and joined, ``true``
those of the renderer: the difference is what the segmentation costs.  Failed bodies count as not recovered.  Times are
medians of one pinned thread.
"""

from __future__ import annotations

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from common import report
from scipy.optimize import linear_sum_assignment

from sq_perception.geometry import Superquadric, metrics
from sq_perception.imaging import raycast
from sq_perception.recovery.recoverer import FrameRecovery, Recoverer, RecoveryOptions
from sq_perception.simulation import sensor_noise
from sq_perception.simulation.scenes import Scene, draw_crowd

SEED = 7500
BODIES = (2, 12)
IOU_GOAL, FALSE_GOAL = 0.92, 0.1
HALF = 0.5
FALSE = 0.2
PLAIN = "plain"
STAGES = ("segmentation", "network", "fit", "score", "total")
SETTINGS: dict[str, tuple[bool, RecoveryOptions]] = {
    "own": (False, RecoveryOptions()),
    "own, no repair": (False, RecoveryOptions(repair=False)),
    "true": (True, RecoveryOptions()),
    "own, classic": (False, RecoveryOptions(method="classic")),
    "true, classic": (True, RecoveryOptions(method="classic")),
}
"""Whether the true masks are given, and how bodies are recovered."""


@dataclass(frozen=True, eq=False)
class SensedScene:
    """A scene as the sensor sees it.

    Attributes
    ----------
    depth, labels : (height, width)
        Measured depth; the true body of each measured pixel, from 1.
    visible : (n,)
        Share of each body's silhouette that nothing hides.
    """

    scene: Scene
    depth: np.ndarray
    labels: np.ndarray
    visible: np.ndarray


@dataclass(frozen=True)
class FrameScore:
    """One frame: IoU of each true body that is half visible, of its mask, and what was invented."""

    ious: tuple[float, ...]
    masks: tuple[float, ...]
    false: int
    milliseconds: dict[str, float]


def frame(number: int, sensor: str) -> SensedScene:
    """Scene ``number`` through a sensor."""
    rng = np.random.default_rng([SEED, number])
    return sensed(draw_crowd(rng, int(rng.integers(BODIES[0], BODIES[1] + 1))), sensor, rng)


def sensed(scene: Scene, sensor: str, rng: np.random.Generator) -> SensedScene:
    """A scene through a sensor."""
    depth, labels = scene.render()
    visible = visible_shares(scene, labels)
    if sensor == PLAIN:
        depth = np.round(1e3 * (depth + 1.5e-3 * depth**2 * rng.standard_normal(depth.shape))) / 1e3
    else:
        depth = sensor_noise.preset(sensor).measure(depth, scene.camera, rng)
    depth = depth.astype(np.float32)
    return SensedScene(scene, depth, np.where(np.isfinite(depth), labels, 0), visible)


def visible_shares(scene: Scene, labels: np.ndarray) -> np.ndarray:
    """Share (n,) of each body's silhouette that nothing hides, by the labels (height, width) of the scene."""
    whole = [np.count_nonzero(raycast.render(body, scene.camera)[1] >= 0) for body in scene.bodies]
    return np.bincount(labels.ravel(), minlength=len(whole) + 1)[1:] / np.maximum(whole, 1)


def scored(seen: SensedScene, found: FrameRecovery) -> FrameScore:
    """Compare what was recovered with the truth."""
    truth, bodies = list(seen.scene.bodies), found.recovered
    iou, mask = np.zeros((2, len(truth), len(bodies)))
    for i, one in enumerate(truth):
        inside = seen.labels == i + 1
        for j, body in enumerate(bodies):
            iou[i, j] = _volume_iou(body.superquadric, one)
            label = found.labels == body.label
            mask[i, j] = np.count_nonzero(inside & label) / max(np.count_nonzero(inside | label), 1)
    rows, columns = linear_sum_assignment(-iou)
    best, seen_iou = np.zeros((2, len(truth)))
    best[rows], seen_iou[rows] = iou[rows, columns], mask[rows, columns]
    real = np.zeros(len(bodies), bool)
    real[columns] = iou[rows, columns] >= FALSE
    half = seen.visible >= HALF
    return FrameScore(
        tuple(best[half].tolist()), tuple(seen_iou[half].tolist()), int(np.count_nonzero(~real)), found.milliseconds
    )


def _volume_iou(body: Superquadric, truth: Superquadric) -> float:
    """0 for bodies that are far apart, without counting points."""
    if np.linalg.norm(body.translation - truth.translation) > np.linalg.norm(body.size) + np.linalg.norm(truth.size):
        return 0.0
    return float(metrics.volume_iou(body, truth))


def figures(scores: list[FrameScore]) -> dict[str, Any]:
    """Pooled over all bodies of all frames."""
    ious, masks = (np.concatenate([getattr(each, name) for each in scores]) for name in ("ious", "masks"))
    return {
        "iou": report.spread(ious),
        "mask_iou": report.spread(masks),
        "over_85": float((ious > 0.85).mean()),
        "missed": float((ious < FALSE).mean()),
        "false_per_frame": float(np.mean([each.false for each in scores])),
        "milliseconds": {
            stage: float(np.median([each.milliseconds.get(stage, 0.0) for each in scores])) for stage in STAGES
        },
        "each": [[round(iou, 3) for iou in each.ious] for each in scores],
    }


def line(sensor: str, name: str, group: dict[str, Any]) -> dict[str, str]:
    """A row of the table."""
    times = group["milliseconds"]
    return {
        "sensor": sensor,
        "masks": name,
        "bodies": str(group["iou"]["count"]).removesuffix(".0"),
        f"matched IoU % (goal {100 * IOU_GOAL:.0f})": f"{100 * group['iou']['mean']:.1f}",
        "median": f"{100 * group['iou']['median']:.1f}",
        "over 85 %": f"{100 * group['over_85']:.0f}",
        "missed %": f"{100 * group['missed']:.1f}",
        "masks' IoU %": f"{100 * group['mask_iou']['mean']:.1f}",
        f"false a frame (goal {FALSE_GOAL})": f"{group['false_per_frame']:.2f}",
        "ms: " + " / ".join(STAGES): " / ".join(f"{times[stage]:.0f}" for stage in STAGES),
    }


def main() -> None:
    parser = report.parser(__doc__, "synthetic_tabletop")
    parser.add_argument("--scenes", type=int, default=60)
    parser.add_argument("--first", type=int, default=0, help="number of the first scene")
    parser.add_argument("--sensors", nargs="*", default=["realsense_d435", PLAIN])
    parser.add_argument("--settings", nargs="*", default=list(SETTINGS), choices=list(SETTINGS))
    options = parser.parse_args()
    recoverer = Recoverer()
    result: dict[str, Any] = {}
    rows = []
    for sensor in options.sensors:
        scores: dict[str, list[FrameScore]] = {name: [] for name in options.settings}
        recoverer.warm_up(frame(0, sensor).scene.camera)
        for number in range(options.first, options.first + options.scenes):
            seen = frame(number, sensor)
            for name in options.settings:
                masks, how = SETTINGS[name]
                found = recoverer.recover(
                    seen.depth, seen.scene.camera, seen.labels if masks else None, replace(how, max_objects=20)
                )
                scores[name].append(scored(seen, found))
        result[sensor] = {name: figures(each) for name, each in scores.items()}
        rows += [line(sensor, name, group) for name, group in result[sensor].items()]
    facts = {"scenes": options.scenes, "first": options.first, "seed": SEED}
    report.write(options.name, {**facts, "rows": result}, report.table_of(rows))


if __name__ == "__main__":
    main()
