"""Networks trained by each loss, alone, on bodies of the thesis' protocol that no training used.

    python benchmarks/losses.py [runs/render runs/least_squares ...]

Every folder is the output of one ``sq-perception train`` with its model.safetensors, whose header says what was
trained; without any, those in runs/ are taken.  Bodies are seen in their canonical views with depths of 255 steps
(thesis, chapter 5.1).  Volume IoU is that of whole bodies; thesis IoU is equation 5.1, in the cube the bodies were
drawn in; Delta A, E and T are equations 5.2 to 5.4, T in per cent of the cube.  Where size, shape and place are given,
they are taken from the truth.  A quarter turn is a rotation that differs from the label by 70 to 110 degrees, half
turns about the body's axes aside (figure 6.3).
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any

for variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import numpy as np  # noqa: E402
import report  # noqa: E402
import torch  # noqa: E402

from sq_perception import metrics  # noqa: E402
from sq_perception.geometry import Superquadric  # noqa: E402
from sq_perception.geometry import rotation as quaternions  # noqa: E402
from sq_perception.imaging.scene import thesis_bodies  # noqa: E402
from sq_perception.learning import checkpoint  # noqa: E402
from sq_perception.learning.dataset import ViewSource, draw_views  # noqa: E402
from sq_perception.learning.objective import Objective  # noqa: E402

THESIS = {
    "occupancy": "94.62 +- 3.18",
    "dual": "62.76 +- 11.34",
    "occupancy_rotation": "75.02",
    "least_squares": "74.82 +- 14.50",
    "render": "85.64 +- 5.72",
}
IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("runs", type=Path, nargs="*", default=sorted(Path("runs").glob("*")))
    parser.add_argument("--bodies", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=2020)
    options = parser.parse_args()
    if not options.runs:
        print("runs/ holds no trained network; see sq-perception train --help")
        return
    torch.set_num_threads(1)
    result, rows = {}, []
    for folder in options.runs:
        entry = evaluate(folder, options.bodies, options.seed)
        result[folder.name] = entry
        iou, cube = entry["iou"], entry["thesis_iou"]
        rows.append(
            [
                folder.name,
                f"{entry['steps']} / {entry['minutes']:.0f}",
                f"{100 * iou['mean']:.2f} +- {100 * iou['std']:.2f}",
                f"{100 * entry['over_85']:.1f}",
                f"{100 * cube['mean']:.2f} +- {100 * cube['std']:.2f}",
                f"{100 * entry['volume_error']:+.1f}",
                f"{100 * entry['shape_error']:+.1f}",
                ", ".join(f"{100 * value:+.2f}" for value in entry["translation_error"]),
                f"{100 * entry['quarter_turns']:.0f}",
                THESIS.get(entry["loss"], ""),
            ]
        )
    header = ["run", "steps / min", "IoU %", "over 85 %", "thesis IoU %", "dA %", "dE %", "dT %", "quarter turns %"]
    report.write("losses", {"bodies": options.bodies, "runs": result}, report.table([*header, "thesis: IoU %"], rows))


def evaluate(folder: Path, count: int, seed: int) -> dict[str, Any]:
    """Figures of one run."""
    model = checkpoint.load(folder / "model.safetensors")
    header = checkpoint.read_header(folder / "model.safetensors")
    training, last = json.loads(header["training"]), json.loads(header["metrics"])
    drawn = thesis_bodies(count, np.random.default_rng(seed))
    views, truth = draw_views(count, np.random.default_rng(seed), ViewSource(model.config.pixels))
    flats = [model.predict(views[i : i + 250]).to_flat() for i in range(0, count, 250)]
    found = Objective(training["loss"]).judged(Superquadric.from_flat(np.concatenate(flats)), truth)
    # The view is the cube moved and scaled; the way back follows from what it did to the true body.
    side = drawn.size[:, :1] / truth.size[:, :1]
    in_cube = found.transformed(IDENTITY, drawn.translation - side * truth.translation, side)
    iou = metrics.volume_iou(found, truth)
    turns = truth.equivalent_forms().rotation[:4]
    angle = quaternions.geodesic_angle(np.broadcast_to(found.rotation, turns.shape), turns).min(axis=0)
    return {
        "loss": training["loss"],
        "steps": last["step"],
        "minutes": last["seconds"] / 60,
        "training": training,
        "iou": report.spread(iou),
        "over_85": float((iou > 0.85).mean()),
        "thesis_iou": report.spread(metrics.thesis_iou(in_cube, drawn)),
        "volume_error": float(metrics.volume_error(found, truth).mean()),
        "shape_error": float(metrics.shape_error(found, truth).mean()),
        "translation_error": metrics.translation_error(in_cube, drawn).mean(axis=0).tolist(),
        "quarter_turns": float((np.abs(np.rad2deg(angle) - 90) < 20).mean()),
    }


if __name__ == "__main__":
    main()
