"""Household things that stand still before a still camera: what a frame costs that follows another, and how good it is.

    python benchmarks/still_scenes.py [--scenes 4] [--frames 16] [--sensor stereo] [--name still_scenes]

Scenes of 1, 5 and 8 things as in :mod:`household_things`, VGA, own masks; each frame has new noise.  After the first
one, each is recovered alone and by a StillScene, in turn, in one thread of one process, so that
what slows the machine slows both.

    alone, following  milliseconds of processor time a frame, medians, and the mean of the latter, which has the frames
                      in which a body is recovered anew
    ratio             of the means
    repeated          share of bodies that were taken from the frame before
    IoU               of volumes with the true hulls, of things at least half visible; a missed one counts as 0
"""

from __future__ import annotations

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

import time
from typing import Any

import household_things
import numpy as np
from common import report, scene_verdict, tabletop

from sq_perception.recovery.recoverer import FrameRecovery, Recoverer
from sq_perception.recovery.still_scene import StillScene
from sq_perception.simulation import sensor_noise

COUNTS = (1, 5, 8)


def ious(frame: FrameRecovery, scene: tabletop.Tabletop, depth: np.ndarray) -> list[float]:
    """Of the things that are at least half visible; ``depth`` is what the frame was recovered from."""
    labels = scene_verdict.matches(frame.labels, scene.labels, depth)
    half = [each for each in scene.placed if each.visible_share >= scene_verdict.HALF]
    return [scene_verdict.of_frame(frame, labels.get(each.label, 0), each, scene).iou for each in half]


def measured(recoverer: Recoverer, count: int, scenes: int, frames: int, sensor: str) -> dict[str, Any]:
    """The figures of scenes of so many things."""
    times: list[tuple[float, float]] = []
    quality: dict[str, list[float]] = {"alone": [], "following": []}
    repeated: list[bool] = []
    for seed in range(scenes):
        scene = household_things.scene(seed, sensor, count)
        noise, still = sensor_noise.preset(tabletop.SENSORS[sensor]), StillScene(recoverer)
        for number in range(frames):
            rng = np.random.default_rng([household_things.SEED, seed, count, number])
            depth = noise.measure(scene.true_depth, scene.camera, rng)
            moments = [time.process_time()]
            alone = recoverer.recover(depth, scene.camera)
            moments.append(time.process_time())
            following = still.recover(depth, scene.camera)
            moments.append(time.process_time())
            if number:
                spent = 1e3 * np.diff(moments)
                times.append((float(spent[0]), float(spent[1])))
                quality["alone"] += ious(alone, scene, depth)
                quality["following"] += ious(following, scene, depth)
                repeated += [body.repeats > 0 for body in following.bodies]
    alone_ms, following_ms = np.array(times).T
    return {
        "alone": report.spread(alone_ms),
        "following": report.spread(following_ms),
        "repeated": float(np.mean(repeated)),
        "iou": {name: report.spread(np.array(values)) for name, values in quality.items()},
    }


def line(count: int, row: dict[str, Any]) -> dict[str, str]:
    """A row of the table."""
    alone, following, iou = row["alone"], row["following"], row["iou"]
    return {
        "things": str(count),
        "alone ms": f"{alone['median']:.0f}",
        "following ms": f"{following['median']:.1f}",
        "mean": f"{following['mean']:.1f}",
        "ratio": f"{following['mean'] / alone['mean']:.2f}",
        "repeated %": f"{100 * row['repeated']:.0f}",
        "IoU % alone": f"{100 * iou['alone']['mean']:.1f}",
        "following": f"{100 * iou['following']['mean']:.1f}",
    }


def main() -> None:
    parser = report.parser(__doc__, "still_scenes")
    parser.add_argument("--scenes", type=int, default=4)
    parser.add_argument("--frames", type=int, default=16, help="of each scene")
    parser.add_argument("--sensor", choices=list(tabletop.SENSORS), default="stereo")
    options = parser.parse_args()
    recoverer = Recoverer(threads=1)
    recoverer.warm_up(household_things.scene(0, options.sensor, 1).camera)
    rows = {}
    for count in COUNTS:
        rows[str(count)] = measured(recoverer, count, options.scenes, options.frames, options.sensor)
        print(" | ".join(line(count, rows[str(count)]).values()), flush=True)
    table = report.table_of([line(int(count), row) for count, row in rows.items()])
    report.write(options.name, {"options": vars(options), "rows": rows}, table)


if __name__ == "__main__":
    main()
