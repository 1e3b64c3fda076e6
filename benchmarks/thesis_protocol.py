"""The thesis' protocol: clean 8 bit images of one body, every method of the recovery on the same images.

    python benchmarks/thesis_protocol.py [--bodies 1000] [--seed 2020]

Bodies, images and seeds are those of ``sq-perception evaluate`` (:mod:`sq_perception.evaluation.thesis_images`), and
so is what is counted; IoU is that on the thesis' grid (equation 5.1).  Times are the whole recovery of one image,
segmentation to score, each stage on one thread; with ``auto`` the network computes beside the fit.  The network alone
is timed on its first 300 images.  The thesis' own figures stand in the last column, measured there on its own images
and machine.
"""

from __future__ import annotations

import argparse
import os

if __name__ == "__main__":  # as a script only: a process that imports this has threads already
    for variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(variable, "1")

import numpy as np
import report
import torch

from sq_perception.evaluation.contest import compare
from sq_perception.evaluation.contestants import FittingMethod, Network
from sq_perception.evaluation.thesis_images import ThesisImages
from sq_perception.learning.checkpoint import resolve

THESIS = {"network": "94.62 +- 3.18, 2.88 ms (GPU)", "classic": "84.51 +- 8.89, 690 ms"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--bodies", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=2020)
    options = parser.parse_args()
    torch.set_num_threads(1)
    methods = [
        FittingMethod.of("auto"),
        FittingMethod.of("symmetry"),
        Network.read(resolve("supervised"), "network"),
        FittingMethod.of("classic"),
    ]
    result, rows = {}, []
    for outcome in compare([(one, options.bodies) for one in methods], ThesisImages(options.bodies, options.seed)):
        method, figures, summary = outcome.contestant.name, outcome.figures, outcome.figures.summary()
        iou, time = 100 * figures.iou, figures.milliseconds[np.isfinite(figures.milliseconds)]
        result[method] = {
            "iou": report.spread(iou),
            "over_85": 100 * summary.over_85,
            "milliseconds": report.spread(time),
            "no_body": summary.bodies - summary.recovered,
            "delta_a": 100 * summary.delta_a,
            "delta_e": 100 * summary.delta_e,
            "delta_t": [100 * value for value in summary.delta_t],
            "worst": [int(k) for k in np.argsort(iou)[:5]],
        }
        rows.append(
            [
                method,
                f"{iou.mean():.2f} +- {iou.std():.2f}",
                f"{iou.min():.1f}",
                f"{100 * summary.over_85:.1f}",
                f"{100 * summary.delta_a:+.2f}",
                f"{100 * summary.delta_e:+.2f}",
                " ".join(f"{100 * value:+.2f}" for value in summary.delta_t),
                f"{summary.milliseconds_median:.1f} / {summary.milliseconds_p95:.1f}",
                THESIS.get(method, "-"),
            ]
        )
    header = ["method", "IoU %", "min", "> 85 %", "dA %", "dE %", "dT %", "ms median / p95", "thesis"]
    report.write("thesis_protocol", {"options": vars(options), "methods": result}, report.table(header, rows))


if __name__ == "__main__":
    main()
