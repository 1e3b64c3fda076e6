"""Household things in and on furniture: cartons, stools, shelves, trays and bins.

    python benchmarks/furniture.py [--scenes 40] [--first 61000] [--name furniture]

Scenes are those of :mod:`sq_perception.simulation.furniture`, as are those that the network of masks has learnt from;
scene k of a kind follows from (``SEED``, kind, k) alone, and sensors alternate.  Figures are those of :mod:`cameras`.
A body of furniture is a false one, but for a carton, which is a thing that is not asked for.
"""

from __future__ import annotations

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

import cameras
import household_things
import numpy as np
from common import report, tabletop

from sq_perception.simulation.furniture import KINDS, things_in_furniture

SEED = 7802


def scene(name: str, seed: int) -> tabletop.Tabletop:
    """The scene of a seed."""
    rng = np.random.default_rng([SEED, KINDS.index(name), seed])
    seen = things_in_furniture(name, rng)
    return household_things.sensed(seen, seed, list(tabletop.SENSORS)[seed % len(tabletop.SENSORS)], rng)


def main() -> None:
    parser = report.parser(__doc__, "furniture")
    parser.add_argument("--scenes", type=int, default=40, help="number of scenes of each kind")
    parser.add_argument("--first", type=int, default=61000, help="seed of the first scene")
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.scenes)
    rows = {name: cameras.row([cameras.looked_at(scene(name, seed)) for seed in seeds]) for name in KINDS}
    facts = {"scenes": options.scenes, "first": options.first}
    report.write(options.name, {**facts, "rows": rows}, cameras.table("furniture", rows))


if __name__ == "__main__":
    main()
