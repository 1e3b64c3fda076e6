"""How long a whole frame takes: 1, 5 and 20 bodies on a table, three image sizes, two sensors, stage by stage.

    python benchmarks/frame_time.py [--scenes 3] [--repeats 5] [--name frame_time]

Superquadrics of 2 to 4 cm half size stand apart on a table, seen from 0.9 m at 45 to 55 degrees; scene k of n bodies
comes from the seed (``SEED``, n, k) alone and is the same in all images, which are 63 degrees wide.  Sensors: those of
sq_perception.simulation.sensor_noise.

    own       Recoverer().recover(depth, camera)
    given     Recoverer().recover(depth, camera, labels), the true masks
    classic   own masks, method="classic": Solina and Bajcsy's fit

Times are milliseconds of the clock on the wall, median and 95th percentile of all repetitions over all scenes, after a
warm-up of each camera; those of stages are medians, so that they do not add up exactly.  The process has all cores and
as many threads as the libraries take by themselves, as for a user.

``grasps`` is what follows for a gripper: what the image shows around the bodies, and the plan for all of them (Panda).

IoU is that of volumes, mean over the true bodies that are at least half visible, a missed one counts as 0
(synthetic_tabletop).

Goals for 640 x 480 on two cores: 15 ms with 1 body, 45 with 5, 140 with 20; 20 ms for the plan of 20 bodies.
"""

from __future__ import annotations

import os
import time
from typing import Any

import numba
import numpy as np
import torch
from common import report
from synthetic_tabletop import STAGES, SensedScene, scored, sensed

from sq_perception.geometry import Superquadric
from sq_perception.geometry import rotation as quaternions
from sq_perception.grasping.gripper import PANDA
from sq_perception.grasping.planner import grasps
from sq_perception.grasping.surroundings import Surroundings
from sq_perception.imaging.camera import Camera
from sq_perception.recovery.recoverer import FrameRecovery, Recoverer, RecoveryOptions
from sq_perception.simulation.scenes import Scene, inside_image

SEED = 8100
GOALS = {1: 15.0, 5: 45.0, 20: 140.0}
"""Bodies and milliseconds, for the first of the images."""
IMAGES = ((640, 480), (848, 480), (1280, 720))
SENSORS = ("realsense_d435", "kinect_v1")
FOCAL = 525 / 640
"""In widths of the image."""
SETTINGS = {
    "own": (False, RecoveryOptions()),
    "given": (True, RecoveryOptions()),
    "classic": (False, RecoveryOptions(method="classic")),
}
"""Whether the true masks are given, and how bodies are recovered."""
DISTANCE = 0.9
PITCH = (45.0, 55.0)
SIZE = (0.02, 0.04)
SHAPE = (0.1, 1.0)
GAP = 0.015
TABLE = (0.34, 0.28)
"""Half sizes of the part of the table that bodies stand on, to the right and away from the camera."""
_SPREAD = 0.45
_ATTEMPTS = 5000
_BORDER = 4.0


def camera(width: int, height: int) -> Camera:
    """One of the images; all are equally wide in degrees."""
    return Camera(width, height, FOCAL * width, FOCAL * width, (width - 1) / 2, (height - 1) / 2)


def bodies_on_a_table(count: int, number: int) -> tuple[Superquadric, np.ndarray]:
    """A batch (count,) of bodies in the optical frame, each seen whole by every camera, and the table (4,).

    Raises
    ------
    RuntimeError
        If there is no room for so many.
    """
    rng = np.random.default_rng([SEED, count, number])
    lowest = camera(*max(IMAGES, key=lambda image: image[0] / image[1]))
    pitch = np.deg2rad(rng.uniform(*PITCH))
    normal = -np.array([0.0, np.cos(pitch), np.sin(pitch)])
    away = np.array([0.0, -np.sin(pitch), np.cos(pitch)])
    table = np.stack([np.array([1.0, 0.0, 0.0]), away, normal], axis=1)
    # Few bodies stand in the middle, many need the whole table.
    reach = np.array(TABLE) * min(1.0, max(_SPREAD, np.sqrt(count / max(GOALS))))
    bodies: list[Superquadric] = []
    circles: list[np.ndarray] = []
    for _ in range(_ATTEMPTS):
        size, shape, yaw = np.sort(rng.uniform(*SIZE, 3))[::-1], rng.uniform(*SHAPE, 2), rng.uniform(0, 2 * np.pi)
        c, s = np.cos(yaw), np.sin(yaw)
        turn = quaternions.from_matrix(table @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]))
        height = Superquadric(size, shape, np.zeros(3), turn).support(normal[None])[0]
        place = rng.uniform(-reach, reach)
        centre = np.array([0, 0, DISTANCE]) + table @ np.append(place, height)
        circle = np.append(place, np.hypot(size[0], size[1]))
        apart = all(np.hypot(*(circle - other)[:2]) > circle[2] + other[2] + GAP for other in circles)
        body = Superquadric(size, shape, centre, turn)
        if apart and inside_image(body, lowest, _BORDER):
            bodies.append(body)
            circles.append(circle)
        if len(bodies) == count:
            return Superquadric.stack(bodies), np.append(normal, DISTANCE * np.sin(pitch))
    raise RuntimeError(f"no room for {count} bodies on the table")


def frame(count: int, number: int, seen_by: Camera, sensor: str) -> SensedScene:
    """Scene ``number`` of ``count`` bodies through a sensor."""
    bodies, plane = bodies_on_a_table(count, number)
    return sensed(Scene(bodies, seen_by, plane), sensor, np.random.default_rng([SEED, count, number, 1]))


def measured(recoverer: Recoverer, frames: list[SensedScene], setting: str, repeats: int) -> dict[str, Any]:
    """Times and accuracy of one row."""
    masks, options = SETTINGS[setting]
    times: list[dict[str, float]] = []
    planning: list[tuple[float, float]] = []
    ious: list[float] = []
    false, found = 0, 0
    for each in frames:
        labels = each.labels if masks else None
        recoverer.recover(each.depth, each.scene.camera, labels, options)
        for _ in range(repeats):
            recovered = recoverer.recover(each.depth, each.scene.camera, labels, options)
            times.append(recovered.milliseconds)
            planning.append(planned(recovered, each))
        score = scored(each, recovered)
        ious += score.ious
        false += score.false
        found += len(recovered.recovered)
    return {
        "stages": {stage: report.spread(np.array([one.get(stage, 0.0) for one in times])) for stage in STAGES},
        "surroundings": report.spread(np.array(planning)[:, 0]),
        "plan": report.spread(np.array(planning)[:, 1]),
        "iou": report.spread(np.array(ious)),
        "recovered_per_frame": found / len(frames),
        "false_per_frame": false / len(frames),
    }


def planned(recovered: FrameRecovery, seen: SensedScene) -> tuple[float, float]:
    """Milliseconds that the surroundings and the plan of a frame's grasps take."""
    bodies = Superquadric.stack([body.superquadric for body in recovered.recovered])
    covariance = np.array([body.covariance for body in recovered.recovered]).reshape(-1, 11, 11)
    started = time.perf_counter()
    around = Surroundings.of_image(seen.depth, seen.scene.camera, recovered.plane)
    between = time.perf_counter()
    grasps(bodies, PANDA, covariance, around)
    return 1e3 * (between - started), 1e3 * (time.perf_counter() - between)


def line(sensor: str, image: tuple[int, int], count: int, setting: str, row: dict[str, Any]) -> dict[str, str]:
    """A row of the table."""
    stages = row["stages"]
    goal = GOALS[count] if image == IMAGES[0] else None
    return {
        "sensor": sensor,
        "image": f"{image[0]} x {image[1]}",
        "bodies": str(count),
        "masks, method": setting,
        "ms median / p95": f"{stages['total']['median']:.0f} / {stages['total']['p95']:.0f}",
        "goal": "" if goal is None else f"{goal:.0f}",
        "of which " + " / ".join(stage for stage in STAGES if stage != "total"): " / ".join(
            f"{stages[stage]['median']:.0f}" for stage in STAGES if stage != "total"
        ),
        "grasps: surroundings / plan": f"{row['surroundings']['median']:.0f} / {row['plan']['median']:.0f}",
        "IoU %": f"{100 * row['iou']['mean']:.1f}",
        "found": f"{row['recovered_per_frame']:.1f}",
        "false": f"{row['false_per_frame']:.2f}",
    }


def main() -> None:
    parser = report.parser(__doc__, "frame_time")
    parser.add_argument("--scenes", type=int, default=3)
    parser.add_argument("--repeats", type=int, default=5, help="of each scene")
    options = parser.parse_args()
    facts: dict[str, Any] = {
        "options": vars(options),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "threads": {"numba": numba.get_num_threads(), "torch": torch.get_num_threads()},
        "load_before": os.getloadavg(),
    }
    recoverer = Recoverer()
    rows: dict[str, dict[str, Any]] = {}
    lines = []
    for sensor in SENSORS:
        for image in IMAGES:
            recoverer.warm_up(camera(*image))
            for count in GOALS:
                frames = [frame(count, number, camera(*image), sensor) for number in range(options.scenes)]
                for setting in SETTINGS:
                    row = measured(recoverer, frames, setting, options.repeats)
                    rows[f"{sensor}, {image[0]} x {image[1]}, {count}, {setting}"] = row
                    lines.append(line(sensor, image, count, setting, row))
                    print(" | ".join(lines[-1].values()), flush=True)
    facts["load_after"] = os.getloadavg()
    text = report.table_of(lines)
    load = " to ".join(f"{facts[name][0]:.2f}" for name in ("load_before", "load_after"))
    text += (
        f"\n\n{facts['cores']} cores; threads: {facts['threads']}; load average of a minute {load}, this run included."
    )
    report.write(options.name, {**facts, "rows": rows}, text)


if __name__ == "__main__":
    main()
