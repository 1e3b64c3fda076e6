"""From image stamp to received result, with real processes: synthetic_depth_node -> recover_node -> this program.

    python benchmarks/node_latency.py [--seconds 60] [--rate 30]

Cases: thesis images (mono8, 256 x 256, orthographic) and table-tops with one and five objects (32FC1, 640 x 480,
pinhole), the latter by a simulated D435, also at three times the rate, where frames are dropped.
The stamp is the clock at the camera's publish call, so the latency holds no rendering, but both transports, the whole
recovery and the way to a subscriber.  A new scene comes twice a second.  A real camera takes next to no processor time:
this one runs at low priority on one thread, and what the D435 measures, 20 ms a frame, is simulated before the clock
starts and replayed, ``SCENES`` scenes over and over.  The trend (latency of the last third minus that of the first)
shows whether a queue grows; the counters of /diagnostics show whether every frame was answered or counted.
"""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import report

from sq_perception.commands import children
from sq_perception.recordings import frame_source

os.environ.setdefault("ROS_DOMAIN_ID", "77")
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

HOLD = 15
"""Frames that a scene stays."""
SCENES = 20
"""Of the frames that are replayed: 370 MB."""
CASES: dict[str, dict[str, list[str]]] = {
    "thesis 256 x 256": {
        "camera": ["scene:=thesis", f"hold:={HOLD}"],
        "recovery": ["projection:=orthographic"],
    },
    "table 640 x 480, one object": {
        "camera": ["scene:=table", "objects:=1", f"hold:={HOLD}"],
        "recovery": [],
    },
    "table 640 x 480, five objects": {
        "camera": ["scene:=replay", "hold:=1"],
        "recovery": [],
    },
}
OFFERED = {"five objects, 3 times the rate": ("table 640 x 480, five objects", 3.0)}


def node(name: str, parameters: list[str], *, background: bool = False) -> subprocess.Popen[bytes]:
    """A node of this package in a process of its own; in the background: one thread, and last in the queue."""
    arguments = [argument for parameter in parameters for argument in ("-p", parameter)]
    command = children.command(name, ["--ros-args", "--log-level", "warn", *arguments])
    if not background:
        return subprocess.Popen(command)
    return subprocess.Popen(["nice", "-n", "10", *command], env={**os.environ, "NUMBA_NUM_THREADS": "1"})


def record(folder: Path) -> None:
    """Write what a simulated D435 measures of five objects on a table, ``HOLD`` frames of each of ``SCENES`` scenes."""
    made = frame_source.generated("table", 0, objects=5, calibration=None, with_labels=False)
    source = frame_source.FrameSource(made, SCENES, seed=0, hold=HOLD, loop=False)
    number = 0
    while (frame := source.next(0.0, "realsense_d435")) is not None:
        np.savez(folder / f"{number:05d}.npz", depth=frame.depth.astype(np.float32), K=frame.camera.matrix)
        number += 1


def megabytes(process: int) -> float:
    """What a process holds in memory."""
    return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def measure(camera: list[str], recovery: list[str], rate: float, seconds: float) -> dict[str, Any]:
    """Latencies (seconds since the start, milliseconds) and the recovery node's own counters."""
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from rclpy.time import Time
    from sensor_msgs.msg import PointCloud2

    rclpy.init()
    listener = rclpy.create_node("latency")
    latencies: list[tuple[float, float]] = []
    counters: dict[str, str] = {}
    bodies: Counter[int] = Counter()

    def result(message: PointCloud2) -> None:
        age = (listener.get_clock().now() - Time.from_msg(message.header.stamp)).nanoseconds * 1e-6
        latencies.append((time.monotonic(), age))
        bodies[message.width * message.height] += 1

    def diagnosis(message: DiagnosticArray) -> None:
        for status in message.status:
            if "recover" in status.name:
                counters.update({value.key: value.value for value in status.values})

    listener.create_subscription(PointCloud2, "/recover_node/superquadrics", result, 100)
    listener.create_subscription(DiagnosticArray, "/diagnostics", diagnosis, 10)
    processes = [node("recover_node", recovery)]
    try:
        processes.append(node("synthetic_depth_node", [*camera, f"rate:={rate}"], background=True))
        deadline = time.monotonic() + 120
        while len(latencies) < 2 * rate and time.monotonic() < deadline:
            rclpy.spin_once(listener, timeout_sec=0.1)
        latencies.clear()
        bodies.clear()
        resident = [megabytes(processes[0].pid)]
        began = time.monotonic()
        while time.monotonic() < began + seconds:
            rclpy.spin_once(listener, timeout_sec=0.1)
        taken = list(latencies)
        resident.append(megabytes(processes[0].pid))
        end = time.monotonic() + 2.5
        processes.pop().send_signal(signal.SIGINT)
        while time.monotonic() < end:
            rclpy.spin_once(listener, timeout_sec=0.1)
    finally:
        for process in processes:
            process.send_signal(signal.SIGINT)
        for process in processes:
            process.wait(timeout=20)
        listener.destroy_node()
        rclpy.shutdown()
    if not taken:
        raise RuntimeError("no result arrived within two minutes")
    when, age = np.array(taken).T
    third = len(age) // 3
    return {
        "milliseconds": report.spread(age),
        "trend_ms": float(np.median(age[-third:]) - np.median(age[:third])),
        "results_per_second": len(age) / seconds,
        "longest_gap_ms": float(np.diff(when).max() * 1e3),
        "bodies_per_frame": {str(k): v for k, v in sorted(bodies.items())},
        "resident_megabytes": resident,
        "diagnostics": counters,
    }


def main() -> None:
    parser = report.parser(__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=30.0)
    options = parser.parse_args()
    result, rows = {}, []
    cases = {name: (name, 1.0) for name in CASES} | OFFERED
    with tempfile.TemporaryDirectory() as folder:
        record(Path(folder))
        for name, (kind, times) in cases.items():
            camera, recovery = CASES[kind]["camera"], CASES[kind]["recovery"]
            if "scene:=replay" in camera:
                camera = [*camera, f"path:={folder}"]
            row = result[name] = measure(camera, recovery, times * options.rate, options.seconds)
            ms = row["milliseconds"]
            rows.append(
                [
                    name,
                    f"{ms['median']:.1f} / {ms['p95']:.1f} / {ms['max']:.1f}",
                    f"{row['results_per_second']:.1f}",
                    f"{row['trend_ms']:+.1f}",
                    f"{row['longest_gap_ms']:.0f}",
                    f"{row['resident_megabytes'][0]:.0f} / {row['resident_megabytes'][1]:.0f}",
                ]
            )
    header = ["frame", "ms median / p95 / max", "results / s", "trend ms", "longest gap ms", "node, MB at start / end"]
    report.write("node_latency", {"options": vars(options), "cases": result}, report.table(header, rows))


if __name__ == "__main__":
    main()
