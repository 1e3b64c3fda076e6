"""What each processing stage of a camera does to the predicted hull, without a fit.

    python benchmarks/camera_stages.py [--views 500] [--seed 6160] [--model FILE] [--name camera_stages]

The same random views (:mod:`sq_perception.simulation.thing_views`) pass through random sensors and then one stage of
:mod:`sq_perception.simulation.camera_stages` with random parameters, through none, or through those that a random
camera of the training has.  Errors are of the support function, the mean of 42 directions, in millimetres; the far
side is the direction along the line of sight, positive where it is predicted too far; changes are paired with the
views of no stage, with their standard errors; sigma is that of the prediction.
"""

from __future__ import annotations

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any, get_args
from unittest.mock import patch

import numpy as np
from common import report

from sq_perception.geometry.union import DIRECTIONS
from sq_perception.learning.inference import ThingPredictor, load_things
from sq_perception.simulation import thing_views
from sq_perception.simulation.camera_stages import RANGES, Filling, StageRanges, Stages, draw_stages
from sq_perception.simulation.thing_views import ThingViews, draw_thing_views

SHARES = ("temporal", "decimation", "spatial", "ring", "filling", "alignment", "bend", "median", "rounding", "blocks")
NONE = replace(RANGES, **dict.fromkeys(SHARES, 0.0))
FAR = int(np.argmin(DIRECTIONS[:, 2]))
Draw = Callable[[np.random.Generator], Stages]


def with_ranges(ranges: StageRanges, **changes: Any) -> Draw:
    """Draw stages that cost the views' generator one number, whatever they are."""
    return lambda rng: replace(draw_stages(np.random.default_rng(rng.integers(2**62)), ranges), **changes)


def cameras() -> dict[str, Draw]:
    """How the stages of each row are drawn."""
    rows = {"none": with_ranges(NONE)}
    rows |= {name: with_ranges(replace(NONE, **{name: 1.0})) for name in SHARES if name not in ("ring", "filling")}
    rows["ring at steps"] = with_ranges(replace(NONE, ring=1.0, foot=0.0))
    rows["ring around the object"] = with_ranges(replace(NONE, ring=1.0, foot=1.0))
    rows |= {f"filled, {rule}": with_ranges(NONE, filling=rule) for rule in get_args(Filling)}
    return rows | {"random cameras": with_ranges(RANGES)}


def views_of(draw: Draw, count: int, seed: int) -> ThingViews:
    """Draw views, each from a generator of its own: what one takes changes no other."""
    with patch.multiple(thing_views, draw_stages=draw, PROCESSED=1.0):
        drawn = [draw_thing_views(1, np.random.default_rng([seed, k])) for k in range(count)]
    names = [field.name for field in fields(ThingViews)]
    return ThingViews(*(np.concatenate([getattr(one, name) for one in drawn]) for name in names))


def errors_of(network: ThingPredictor, views: ThingViews) -> tuple[np.ndarray, np.ndarray]:
    """Errors (n, 42) of the support function in mm, and the same over sigma."""
    found = network.predict(views.images, views.planes, views.extents)
    share = found.freedom / (found.freedom - 2)
    deviation = np.sqrt(share * np.diagonal(found.covariance, axis1=1, axis2=2))
    error = found.support - views.support
    return 1e3 * views.extents[:, None] * error, error / deviation


def main() -> None:
    parser = report.parser(__doc__, "camera_stages")
    parser.add_argument("--views", type=int, default=500, help="number of views of a row")
    parser.add_argument("--seed", type=int, default=6160, help="of the views")
    parser.add_argument("--model", help="weights of a network of hulls (by default the shipped one)")
    options = parser.parse_args()
    network = load_things(options.model)
    rows: dict[str, dict[str, float]] = {}
    none = np.empty(0)
    for name, draw in cameras().items():
        error, ratio = errors_of(network, views_of(draw, options.views, options.seed))
        mean = np.abs(error).mean(axis=1)
        none = none if len(none) else mean
        change = mean - none
        rows[name] = {
            "error": mean.mean(),
            "median": float(np.median(mean)),
            "change": change.mean(),
            "change_error": change.std() / np.sqrt(len(change)),
            "far": error[:, FAR].mean(),
            "ratio": float(np.sqrt(np.mean(ratio**2))),
        }
    rows = {name: {key: float(value) for key, value in row.items()} for name, row in rows.items()}
    table = report.table_of(
        [
            {
                "stage": name,
                "error, mm: mean (median)": f"{row['error']:.1f} ({row['median']:.1f})",
                "change": f"{row['change']:+.1f} +- {row['change_error']:.1f}",
                "far side": f"{row['far']:+.1f}",
                "error / sigma": f"{row['ratio']:.2f}",
            }
            for name, row in rows.items()
        ]
    )
    report.write(options.name, {"views": options.views, "seed": options.seed, "rows": rows}, table)


if __name__ == "__main__":
    main()
