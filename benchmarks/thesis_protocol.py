"""The thesis' protocol: clean 8 bit images of one body, every method of the recovery on the same images.

    python benchmarks/thesis_protocol.py [--bodies 1000] [--seed 2020]

Bodies: a in [25, 75], e in [0.1, 1], centre 128 +- 40, uniform rotations, 256 x 256 pixels, floor of z (thesis, 5.1).
IoU on the thesis' grid of 64^3 points of the cube (5.1).  Times are the whole recovery of one image, segmentation to
score, each stage on one thread; with ``auto`` the network computes beside the fit.  The thesis' own figures stand in
the last column, measured there on its own images and machine.
"""

from __future__ import annotations

import argparse
import os

for variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import numpy as np  # noqa: E402
import report  # noqa: E402
import torch  # noqa: E402

from sq_perception import metrics  # noqa: E402
from sq_perception.geometry import Superquadric  # noqa: E402
from sq_perception.imaging import raycast, unit_cube  # noqa: E402
from sq_perception.imaging.scene import thesis_bodies  # noqa: E402
from sq_perception.recovery import Recoverer, RecoveryOptions  # noqa: E402

THESIS = {"network": "94.62 +- 3.18, 2.88 ms (GPU)", "classic": "84.51 +- 8.89, 690 ms"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--bodies", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=2020)
    options = parser.parse_args()
    torch.set_num_threads(1)
    truth = thesis_bodies(options.bodies, np.random.default_rng(options.seed))
    camera = unit_cube.camera()
    images = []
    for body in truth:
        depth, _ = raycast.render(unit_cube.optical_from_cube(body), camera)
        images.append(unit_cube.depth_from_grey(unit_cube.grey_from_depth(depth)))
    result, rows = {}, []
    for method in ("auto", "symmetry", "network", "classic"):
        recoverer = Recoverer(method=method)
        recoverer.warm_up(camera)
        settings = RecoveryOptions(method=method)
        bodies, times, missing = [], [], 0
        for image in images:
            frame = recoverer.recover(image, camera, options=settings)
            times.append(frame.milliseconds["total"])
            if frame.bodies:
                bodies.append(unit_cube.cube_from_optical(frame.bodies[0].superquadric))
            else:
                missing += 1
                bodies.append(Superquadric(np.full(3, 1e-3), np.ones(2), np.full(3, -1.0), np.array([0, 0, 0, 1.0])))
        found = Superquadric.stack(bodies)
        iou = 100 * metrics.thesis_iou(found, truth)
        time = report.spread(np.array(times))
        row = {
            "iou": report.spread(iou),
            "over_85": float((iou > 85).mean() * 100),
            "milliseconds": time,
            "no_body": missing,
            "delta_a": float(100 * metrics.volume_error(found, truth).mean()),
            "delta_e": float(100 * metrics.shape_error(found, truth).mean()),
            "delta_t": (100 * metrics.translation_error(found, truth).mean(axis=0)).tolist(),
            "worst": [int(k) for k in np.argsort(iou)[:5]],
        }
        result[method] = row
        rows.append(
            [
                method,
                f"{iou.mean():.2f} +- {iou.std():.2f}",
                f"{iou.min():.1f}",
                f"{row['over_85']:.1f}",
                f"{row['delta_a']:+.2f}",
                f"{row['delta_e']:+.2f}",
                " ".join(f"{x:+.2f}" for x in row["delta_t"]),
                f"{time['median']:.1f} / {time['p95']:.1f}",
                THESIS.get(method, "-"),
            ]
        )
    header = ["method", "IoU %", "min", "> 85 %", "dA %", "dE %", "dT %", "ms median / p95", "thesis"]
    report.write("thesis_protocol", {"options": vars(options), "methods": result}, report.table(header, rows))


if __name__ == "__main__":
    main()
