"""What the network is for: bodies of which something nearer hides a part, by networks alone and before the exact fit.

    python benchmarks/occlusion.py [--bodies 500] [--models FILE ...]

Images are those of benchmarks/single_body.py: the thesis' 8 bit ones, and pinhole images through a sensor (sigma =
1.5 mm z^2, millimetres), each with 0 to 40 % of the silhouette behind a nearer half plane or disc; the mask is given
and holds what is visible.  Every method gets the same images through the whole recovery.  IoU is the volume IoU on 64^3
points.  The last column is the difference of ``auto`` (network and surface fit) and ``symmetry`` (the same fit without
it), image by image, with twice its standard error.
"""

from __future__ import annotations

from pathlib import Path

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

from typing import Any

import numpy as np
import single_body
from common import report

from sq_perception.fitting.fit import Status
from sq_perception.geometry import Superquadric, metrics
from sq_perception.learning import checkpoint
from sq_perception.recovery.recoverer import Recoverer, RecoveryOptions

SEED = 7400
SHARES = (0.0, 0.1, 0.2, 0.3, 0.4)
KINDS = ("thesis", "sensor")


def images(kind: str, share: float, count: int) -> list[tuple[Superquadric, single_body.Image]]:
    """Bodies in the optical frame and their images; the same bodies for every share."""
    draw = single_body.cube_bodies if kind == "thesis" else single_body.pinhole_bodies
    bodies = draw(count, np.random.default_rng([SEED, KINDS.index(kind)]))
    made = []
    for k, body in enumerate(bodies):
        rng = np.random.default_rng([SEED, KINDS.index(kind), k])
        image = single_body.orthographic(body) if kind == "thesis" else single_body.sensor(body, rng)
        made.append((body, single_body.occluded(image, rng, share) if share else image))
    return made


def recovered(
    recoverer: Recoverer, method: str, made: list[tuple[Superquadric, single_body.Image]]
) -> dict[str, np.ndarray]:
    """IoU and milliseconds of each image; what failed counts as IoU 0."""
    recoverer.warm_up(made[0][1].camera)
    options = RecoveryOptions(method=method)
    iou, times = np.zeros(len(made)), np.zeros(len(made))
    for k, (truth, image) in enumerate(made):
        frame = recoverer.recover(image.depth, image.camera, image.mask.astype(np.int32), options)
        times[k] = frame.milliseconds["total"]
        if frame.bodies and frame.bodies[0].status != Status.FAILED:
            iou[k] = metrics.volume_iou(frame.bodies[0].superquadric, truth)
    return {"iou": iou, "milliseconds": times}


def cell(figures: dict[str, np.ndarray]) -> str:
    """Mean IoU, share over 85 %, median milliseconds."""
    iou, times = figures["iou"], figures["milliseconds"]
    return f"{100 * iou.mean():.2f} / {100 * (iou > 0.85).mean():.1f} / {np.median(times):.1f}"


def main() -> None:
    parser = report.parser(__doc__)
    parser.add_argument("--bodies", type=int, default=500)
    shipped = list(checkpoint.shipped_regressors().values())
    parser.add_argument("--models", type=Path, nargs="*", default=shipped, help="default: all shipped weights")
    options = parser.parse_args()
    networks = {path.stem: Recoverer(path, method="network") for path in options.models}
    default = Recoverer(method="auto")
    result: dict[str, Any] = {}
    rows = []
    for kind in KINDS:
        for share in SHARES:
            made = images(kind, share, options.bodies)
            found = {f"network {name}": recovered(one, "network", made) for name, one in networks.items()}
            found |= {method: recovered(default, method, made) for method in ("classic", "symmetry", "auto")}
            gain = 100 * (found["auto"]["iou"] - found["symmetry"]["iou"])
            doubt = 2 * gain.std() / np.sqrt(len(gain))
            name = f"{kind}, {100 * share:.0f} % hidden"
            result[name] = {
                method: {key: report.spread(values) for key, values in figures.items()}
                for method, figures in found.items()
            }
            rows.append([name, *map(cell, found.values()), f"{gain.mean():+.2f} +- {doubt:.2f}"])
            header = ["IoU % / over 85 % / ms", *found, "auto - symmetry"]
    facts = {"bodies": options.bodies, "seed": SEED, "default_model": checkpoint.DEFAULT}
    report.write("occlusion", {**facts, "rows": result}, report.table(header, rows))


if __name__ == "__main__":
    main()
