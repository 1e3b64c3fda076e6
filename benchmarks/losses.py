"""What a training of minutes reaches with each loss: the same small network, views, steps and seed for all.

    python benchmarks/losses.py [--steps 1000] [--batch 64] [--pixels 32] [--losses occupancy render ...]

Volume IoU with bodies that the network has not seen, the thesis' clean orthographic ones (a new seed), cropped to
the body.  Where a loss is given some of the numbers, those are the truth's in the comparison too, as in the thesis:
such a row does not compare with the others.  So short a run shows how fast the losses learn, not where they end: the
shipped networks were trained for hours (docs/models.md).
"""

from __future__ import annotations

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from common import report

from sq_perception.learning.choices import LOSSES, UNSUPERVISED
from sq_perception.learning.dataset import ViewSource, draw_views
from sq_perception.learning.losses import Objective
from sq_perception.learning.train import train, validate
from sq_perception.learning.training_config import TrainingConfig

SEED = 7300
GIVEN = {"occupancy_rotation": "size, shape, centre", "mse": "rotation"}


def reached(config: TrainingConfig, bodies: int) -> dict[str, Any]:
    """Train and look at fresh bodies."""
    with tempfile.TemporaryDirectory() as folder:
        network = train(config, Path(folder))
    source = ViewSource(config.pixels, framing=network.config.framing)
    views, truth = draw_views(bodies, np.random.default_rng(SEED), source)
    iou = validate(network, views, truth, Objective(config.loss))
    return {"steps": config.steps, "batch": config.batch, "pixels": config.pixels, "iou": report.spread(iou)}


def line(loss: str, row: dict[str, Any]) -> dict[str, str]:
    """A row of the table."""
    return {
        "loss": loss,
        "learns from": "the view" if loss in UNSUPERVISED else "labels",
        "given": GIVEN.get(loss, ""),
        "IoU %, mean +- std": f"{100 * row['iou']['mean']:.1f} +- {100 * row['iou']['std']:.1f}",
        "median": f"{100 * row['iou']['median']:.1f}",
    }


def main() -> None:
    parser = report.parser(__doc__, "losses")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--pixels", type=int, default=32)
    parser.add_argument("--bodies", type=int, default=1000)
    parser.add_argument("--losses", nargs="+", choices=LOSSES, default=LOSSES)
    options = parser.parse_args()
    rows = {}
    for loss in options.losses:
        config = TrainingConfig(
            loss=loss,
            steps=options.steps,
            batch=options.batch,
            pixels=options.pixels,
            warm_up=options.steps // 10,
            average=0.99,
            validation=options.steps,
            threads=1,
        )
        rows[loss] = reached(config, options.bodies)
        print(" | ".join(line(loss, rows[loss]).values()), flush=True)
    table = report.table_of([line(*row) for row in rows.items()])
    report.write(options.name, {"options": vars(options), "rows": rows}, table)


if __name__ == "__main__":
    main()
