"""From image stamp to received result, with real processes: synthetic_depth_node -> recover_node -> this program.

    python benchmarks/node_latency.py [--seconds 60] [--rate 30]

Cases: thesis images (mono8, 256 x 256, orthographic) and table-tops with one and five objects (32FC1, 640 x 480,
pinhole), the latter by a simulated D435, also at three times the rate, where frames are dropped.
The stamp is the clock at the camera's publish call, so the latency holds no rendering, but both transports, the whole
recovery and the way to a subscriber. A new scene comes every ``HOLD`` frames. A real camera takes next to no processor
time: this one runs at low priority on one thread, and what the D435 measures, 20 ms a frame, is simulated before the
clock starts and replayed, ``SCENES`` scenes over and over. The trend (latency of the last third minus that of the
first) shows whether a queue grows; the counters of /diagnostics show whether every frame was answered or counted.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from common import (
    own_domain,  # noqa: F401
    report,
)
from common.process_usage import usage
from running_nodes import Peer, arguments, environment, until
from started_nodes import Children

from sq_perception.nodes import synthetic_depth_node as frame_source

NODE = "/recover_node"
QUIET = ["--log-level", "warn"]
ONE_THREAD = {"NUMBA_NUM_THREADS": "1"}
_PATIENCE = 120.0
_LAST_DIAGNOSIS = 2.5
"""Seconds after the last frame in which the node's account of it comes."""

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


def record(folder: Path) -> None:
    """Write what a simulated D435 measures of five objects on a table, ``HOLD`` frames of each of ``SCENES`` scenes."""
    made = frame_source.generate("table", 0, objects=5)
    source = frame_source.FrameSource(made, SCENES, seed=0, hold=HOLD, loop=False)
    number = 0
    while (frame := source.next(0.0, "realsense_d435")) is not None:
        np.savez(folder / f"{number:05d}.npz", depth=frame.depth.astype(np.float32), K=frame.camera.matrix)
        number += 1


def measure(camera: list[str], recovery: list[str], rate: float, seconds: float) -> dict[str, Any]:
    """Latencies and the recovery node's own counters, over some seconds from the first results on."""
    with Peer() as peer, Children(environment()) as nodes, Children(environment(**ONE_THREAD)) as cameras:
        answers, diagnoses = peer.answers(NODE), peer.diagnoses(NODE)
        node = nodes.start("recover_node", [*arguments(*recovery), *QUIET])
        source = cameras.start("synthetic_depth_node", [*arguments(*camera, f"rate:={rate}"), *QUIET])
        os.setpriority(os.PRIO_PROCESS, source.pid, 10)
        until(lambda: len(answers) >= 2 * rate, (node, source), _PATIENCE)
        first, resident = len(answers), [usage(node.pid).rss]
        time.sleep(seconds)
        taken = answers[first:]
        resident.append(usage(node.pid).rss)
        cameras.stop()
        time.sleep(_LAST_DIAGNOSIS)
        counters = diagnoses[-1].values
    when, age = np.array([(answer.time, answer.age) for answer in taken]).T
    bodies = Counter(answer.message.width * answer.message.height for answer in taken)
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
                {
                    "frame": name,
                    "ms median / p95 / max": f"{ms['median']:.1f} / {ms['p95']:.1f} / {ms['max']:.1f}",
                    "results / s": f"{row['results_per_second']:.1f}",
                    "trend ms": f"{row['trend_ms']:+.1f}",
                    "longest gap ms": f"{row['longest_gap_ms']:.0f}",
                    "node, MB at start / end": " / ".join(f"{rss:.0f}" for rss in row["resident_megabytes"]),
                }
            )

    report.write("node_latency", {"options": vars(options), "cases": result}, report.table_of(rows))


if __name__ == "__main__":
    main()
