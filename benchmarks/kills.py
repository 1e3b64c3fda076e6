"""kill -9 of camera, node and viewer in any order: does the rest go on, how soon is the killed one back at work?

    python benchmarks/kills.py [--kills 50] [--seed 0] [--rate 30] [--objects 1]

A supervisor starts the killed process again at once, as a launch file with ``respawn`` does.  The time goes from that
start to the first result that needs the process: of an image that was taken after it.  Meanwhile the others must not
fall silent: results where the viewer was killed, camera_infos where the node was, diagnoses where the camera was.
A process that does not come back within 30 s counts as never back (the reasons: test/helpers/respawned_nodes.py).
"""

from __future__ import annotations

import sys
import time
from dataclasses import asdict

import numpy as np
from common import (
    own_domain,  # noqa: F401
    report,
)
from respawned_nodes import CAMERA, MEMBERS, NODE, VIEWER, Kill, Robot
from running_nodes import Peer

ASKED = 5.0
"""Seconds to the first result after a restart."""
_GAP = {CAMERA: 2.0, NODE: 0.5, VIEWER: 1.0}
"""Seconds of silence that the kill of a process may cause in what does not need it; diagnoses come once a second."""
_CALM = (0.5, 2.0)
"""Seconds between two kills."""


def main() -> None:
    parser = report.parser(__doc__, "kills")
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rate", type=float, default=30.0)
    parser.add_argument("--objects", type=int, default=1)
    parser.add_argument("--node", choices=("recover_node", "fitter_node"), default="recover_node")
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    # An equal share of each, in a random order.
    order = rng.permutation(np.resize(MEMBERS, options.kills))
    kills: list[Kill] = []
    with (
        Peer() as peer,
        Robot(
            peer,
            camera=(f"rate:={options.rate}", f"objects:={options.objects}", "hold:=15"),
            node=options.node,
        ) as robot,
    ):
        for member in order:
            time.sleep(rng.uniform(*_CALM))
            kills.append(robot.kill(str(member)))
            print(kills[-1], flush=True)
    left = robot.left()
    rows = []
    for member in MEMBERS:
        chosen = [kill for kill in kills if kill.member == member]
        if not chosen:
            continue
        back, silence = (np.array([getattr(kill, what) for kill in chosen]) for what in ("back", "silence"))
        good = back.max() < ASKED and silence.max() < _GAP[member]
        rows.append(
            {
                "killed": member,
                "times": str(len(chosen)),
                f"back after s, median / max (< {ASKED:g})": f"{np.median(back):.2f} / {back.max():.2f}",
                "others silent s, median / max": f"{np.median(silence):.2f} / {silence.max():.2f}",
                "<": f"{_GAP[member]:g}",
                "met": "yes" if good else "NO",
            }
        )
    result = {
        "options": vars(options),
        "kills": [{**asdict(kill), "back": kill.back if np.isfinite(kill.back) else None} for kill in kills],
        "processes_left": left,
    }
    report.write(options.name, result, f"{report.table_of(rows)}\n\nProcesses left: {len(left)}.")
    sys.exit(0 if not left and all(row["met"] == "yes" for row in rows) else 1)


if __name__ == "__main__":
    main()
