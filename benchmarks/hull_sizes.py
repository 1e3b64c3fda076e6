"""Networks of hulls side by side, on simulated views that none of them was trained on.

    python benchmarks/hull_sizes.py [--models NAME_OR_FILE ...] [--views 1000] [--seed 8260] [--name hull_sizes]

All see the same views (:mod:`sq_perception.simulation.thing_views`): as the sensor measures them, through random
cameras, and of things of which an occluder hides 30 to 85 %.  Errors are of the support function, the mean of 42
directions, in sides of the view, where a view and its mirror image are one prediction as in recovery; changes are
paired with the first network, with their standard errors.  The far side is the direction along the line of sight,
positive where it is predicted too far.  Time is the processor's for a thing by :mod:`sq_perception.learning.forward`,
as a multiple of the first network's; the networks take turns, and the least of all rounds counts.
"""

from __future__ import annotations

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from camera_stages import FAR, NONE, errors_of, views_of, with_ranges
from common import report

from sq_perception.learning import checkpoint
from sq_perception.learning.inference import ThingPredictor, load_things
from sq_perception.learning.network_config import ThingConfig
from sq_perception.simulation import thing_views
from sq_perception.simulation.camera_stages import RANGES
from sq_perception.simulation.thing_views import ThingViews

HIDDEN = (0.3, 0.85)
ROUNDS, AT_ONCE = 20, 10


def weights_of(model: str) -> int:
    """How many numbers a network learned."""
    weights = checkpoint.read(ThingConfig, model)[1]
    return sum(array.size for name, array in weights.items() if "running" not in name)


def occluded(depth: np.ndarray, seen: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Image and mask with a straight edge before the thing, from the sides or from below."""
    if not seen.any():
        return depth, seen
    rows, columns = np.indices(depth.shape)
    way = rng.uniform(0, np.pi)
    reach = np.cos(way) * columns + np.sin(way) * rows
    before = reach > np.quantile(reach[seen], 1 - rng.uniform(*HIDDEN))
    near = depth[seen].min() * rng.uniform(0.7, 0.98)
    return np.where(before, np.minimum(near, depth), depth), seen & ~before


def seconds_a_thing(networks: Sequence[ThingPredictor], views: ThingViews) -> np.ndarray:
    """Processor time of each network for a thing, in turns."""
    shown = views.images[:AT_ONCE], views.planes[:AT_ONCE], views.extents[:AT_ONCE]
    took = np.full((ROUNDS, len(networks)), np.inf)
    for times in took:
        for k, network in enumerate(networks):
            began = time.process_time()
            network.predict(*shown)
            times[k] = (time.process_time() - began) / AT_ONCE
    return np.asarray(took.min(axis=0))


def main() -> None:
    parser = report.parser(__doc__, "hull_sizes")
    parser.add_argument("--models", nargs="+", default=["things"], help="names of shipped weights, or files")
    parser.add_argument("--views", type=int, default=1000, help="number of views of a column")
    parser.add_argument("--seed", type=int, default=8260, help="of the views")
    options = parser.parse_args()
    networks = [load_things(checkpoint.resolve(model)) for model in options.models]
    sensors, cameras = with_ranges(NONE), with_ranges(RANGES)
    views = {"no stage": views_of(sensors, options.views, options.seed)}
    views["random cameras"] = views_of(cameras, options.views, options.seed + 1)
    with patch.object(thing_views, "_something_before", occluded):
        views["occluded"] = views_of(cameras, options.views, options.seed + 2)
    times = seconds_a_thing(networks, views["no stage"])
    first: dict[str, np.ndarray] = {}
    rows: list[dict[str, Any]] = []
    for model, network, took in zip(options.models, networks, times / times[0], strict=True):
        row: dict[str, Any] = {"network": Path(model).stem, "weights, M": f"{weights_of(model) / 1e6:.1f}"}
        for name, shown in views.items():
            millimetres, ratio = errors_of(network, shown)
            error = np.abs(millimetres / (1e3 * shown.extents[:, None])).mean(axis=1)
            change = error - first.setdefault(name, error)
            spread = change.std() / np.sqrt(len(change))
            row[f"{name}: error, %"] = f"{100 * error.mean():.2f} ({100 * change.mean():+.2f} +- {100 * spread:.2f})"
            row[f"{name}: far side, mm"] = f"{millimetres[:, FAR].mean():+.1f}"
            row[f"{name}: error / sigma"] = f"{np.sqrt(np.mean(ratio**2)):.2f}"
        rows.append({**row, "time": f"{took:.2f}"})
    report.write(options.name, {"views": options.views, "seed": options.seed, "rows": rows}, report.table_of(rows))


if __name__ == "__main__":
    main()
