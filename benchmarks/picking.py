"""Things taken from a table, in physics: how often a grasp holds and how much of the table is cleared.

    python benchmarks/picking.py [--scenes 20] [--kinds packed,pile] [--contestants ours,...] [--each FILE]
        [--contact-graspnet COMMAND]

The protocol of VGN and GIGA: scenes of :mod:`picking_scenes`, five things each; every round one image, one recovery
with our own masks, one grasp, the most probable one, in the physics of :mod:`picking_world`; until the table is empty,
no grasp is found, or two have failed in a row.

    GSR = held / tried        DR = taken / all things

Contestants are those of :mod:`picking_contestants`.  "At any score" is for the calibration of scores (``--first 34000
--contestants "ours,ours at any score" --name picking_scores``: no scene that a constant is from) and goes on whatever
fails.

| failure | |
| --- | --- |
| collision | with the table or another thing on the way |
| wrong size | with the thing itself: the fingers do not pass it |
| missed | nothing between the pads once they closed |
| slipped | held, but not any more after lift and shake |
| unreachable | things for which there was no grasp when the scene ended |

Intervals are Wilson's, 95 %; picks of one scene are not independent, so that they are somewhat too narrow.  Those of
differences are from 2000 draws of scenes.  ``--each`` is a file of lines, one a scene and contestant: the same command
goes on where it was interrupted.  Who was not tried keeps the row of the results before.  Rows that are not of the
commit of the results name theirs.

Published for orientation only, other things and another simulator: GIGA (HR) 87.9 / 86.0 packed, 69.8 / 51.1 pile; VGN
74.5 / 79.2, 60.7 / 44.0; GPD 35.4 / 30.7, 17.7 / 9.2 (GSR / DR).  Physics: mujoco, the extra ``picking``.
"""

from __future__ import annotations

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
from common import picking_scenes, report
from common.picking_contestants import CONTESTANTS, PEERS, WITH_PARTS, ContactGraspNet, Seen, recoverer_of
from common.picking_scenes import KINDS, TABLE_CAMERA, THINGS, Scene
from common.picking_world import Pick, World
from scipy.stats import binomtest

from sq_perception.grasping.plan import Grasp
from sq_perception.recovery.recoverer import Recoverer, RecoveryOptions

MOST_ROUNDS = 12
BOTH = "both"
ASKED = {"packed": (93, 92), "pile": (80, 70)}
RIVALS = ("ours without sigma", "ours without the hull", "true bodies", "classic", "cgn in masks", "cgn")
BINS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
_DRAWS = 2000
_FIRST_SEED = 5000
"""Chosen before the first run."""


@dataclass(frozen=True, eq=False)
class Round:
    """What was seen, which grasp was tried at which thing, and what came of it."""

    seen: Seen
    grasp: Grasp
    aim: int
    pick: Pick


def rounds(
    scene: Scene, contestant: str, recoverer: Recoverer, peer: ContactGraspNet | None = None, world: World | None = None
) -> Iterator[Round]:
    """Image, grasp, pick, until the table is empty or no grasp is found."""
    world = world or scene.world()
    options = RecoveryOptions(parts=True) if contestant == WITH_PARTS else None
    rng, chance = np.random.default_rng([scene.seed, 1]), np.random.default_rng([scene.seed, 3])
    for _ in range(MOST_ROUNDS):
        if not world.left:
            return
        depth = picking_scenes.observed(world, scene.sensor, rng)
        seen = Seen(depth, recoverer.recover(depth, TABLE_CAMERA, options=options), world, peer, chance.uniform())
        found = CONTESTANTS[contestant](seen)
        if not found:
            return
        position, rotation = scene.carried_out(found[0].position, found[0].rotation)
        aim = _aimed_at(world, position)
        yield Round(seen, found[0], aim, world.pick(position, rotation, found[0].opening))


def cleared(scene: Scene, contestant: str, recoverer: Recoverer, peer: ContactGraspNet | None) -> dict[str, Any]:
    """One scene by one contestant, round by round."""
    world = scene.world()
    picks: list[dict[str, Any]] = []
    failed, end = 0, ""
    for one in rounds(scene, contestant, recoverer, peer, world):
        picks.append(
            {
                **asdict(one.pick),
                "score": one.grasp.score,
                "weakest": one.grasp.weakest,
                "aim": one.aim,
            }
        )
        failed = 0 if one.pick.held >= 0 else failed + 1
        if failed == 2 and contestant != "ours at any score":
            end = "two failures"
            break
    if not end:
        end = "empty" if not world.left else "no grasp" if len(picks) < MOST_ROUNDS else "rounds"
    return {
        "kind": scene.kind,
        "seed": scene.seed,
        "contestant": contestant,
        "picks": picks,
        "taken": sum(pick["held"] >= 0 for pick in picks),
        "end": end,
        "left": [scene.things[k].name for k in world.left],
    }


def _aimed_at(world: World, position: np.ndarray) -> int:
    """The thing whose parts the TCP is deepest in or nearest to."""
    gauge = {}
    for k in world.left:
        at, turn = world.pose(k)
        gauge[k] = float(world.things[k].parts.transformed(turn, at).gauge(position[None])[:, 0].min())
    return min(gauge, key=gauge.__getitem__)


FAILURES = ("collision", "wrong size", "missed", "slipped")


def failure(pick: dict[str, Any]) -> str:
    """Why a pick failed, empty if it did not; see the module."""
    if pick["held"] >= 0:
        return ""
    return "wrong size" if pick["how"] == "collision" and pick["touched"] == str(pick["aim"]) else str(pick["how"])


def wilson(good: int, count: int) -> tuple[float, float, float]:
    """Share and its 95 % interval, percent."""
    if not count:
        return float("nan"), float("nan"), float("nan")
    interval = binomtest(good, count).proportion_ci(method="wilson")
    return 100 * good / count, 100 * interval.low, 100 * interval.high


def summary(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """Rates, causes and calibration by kind and contestant."""
    found: dict[str, Any] = {}
    for kind in KINDS:
        for name in CONTESTANTS:
            runs = [line for line in lines if line["kind"] == kind and line["contestant"] == name]
            if not runs:
                continue
            picks = [pick for run in runs for pick in run["picks"]]
            held = [pick["held"] >= 0 for pick in picks]
            scores = np.array([pick["score"] for pick in picks])
            bins = []
            for low, high in pairwise(BINS):
                inside = (scores > low) & (scores <= high)
                count = int(inside.sum())
                bins.append(
                    [count, float(scores[inside].mean()), float(np.mean(np.array(held)[inside]))] if count else [0]
                )
            failed = [failure(pick) for pick in picks]
            causes = {cause: failed.count(cause) for cause in FAILURES}
            causes["unreachable"] = sum(len(run["left"]) for run in runs if run["end"] == "no grasp")
            causes["two failures"] = sum(run["end"] == "two failures" for run in runs)
            found[f"{kind}: {name}"] = {
                "scenes": len(runs),
                "tried": len(picks),
                "gsr": wilson(sum(held), len(picks)),
                "dr": wilson(sum(run["taken"] for run in runs), THINGS * len(runs)),
                "causes": causes,
                "bins": bins,
            }
            commits = {run["commit"] for run in runs if run.get("commit")}
            if commits - {report.commit()}:
                found[f"{kind}: {name}"]["commit"] = ", ".join(sorted(commits))
    return found


def table(found: dict[str, Any]) -> str:
    def rate(one: tuple[float, float, float]) -> str:
        return f"{one[0]:.0f} ({one[1]:.0f} to {one[2]:.0f})"

    rows = []
    for name, one in found.items():
        asked = ASKED[name.partition(":")[0]] if name.endswith(": ours") else ("", "")
        causes = one["causes"]
        rows.append(
            [
                _named(name, one),
                str(one["scenes"]),
                str(one["tried"]),
                rate(one["gsr"]),
                str(asked[0]),
                rate(one["dr"]),
                str(asked[1]),
                *(str(count) for count in causes.values()),
            ]
        )
    heads = ["scenes: contestant", "scenes", "tried", "GSR %", "asked", "DR %", "asked"]
    heads += [*FAILURES, "unreachable", "ended by two failures"]
    return report.table(heads, rows)


def _named(name: str, row: dict[str, Any]) -> str:
    return f"{name} (commit {row['commit']})" if "commit" in row else name


def gains_table(gains: dict[str, Any]) -> str:
    """Of pairs of contestants that tried the same scenes."""
    rows = [
        [
            _named(name, one),
            f"{one['scenes'][0]:.0f}",
            *("{:+.0f} ({:+.0f} to {:+.0f})".format(*one[rate]) for rate in ("gsr", "dr")),
        ]
        for name, one in gains.items()
        if one
    ]
    return report.table(["difference on the same scenes", "scenes", "GSR %", "DR %"], rows)


def gain(lines: list[dict[str, Any]], kind: str, name: str, other: str) -> dict[str, list[float]]:
    """By how many percent GSR and DR of one contestant are above another's on the same scenes, and 95 % intervals.

    ``kind`` is one, or "both", of which nothing is said where scenes of one were not tried.
    """
    asked = [run for run in lines if kind in (run["kind"], BOTH)]
    runs = {
        who: {(run["kind"], run["seed"]): run for run in asked if run["contestant"] == who} for who in (name, other)
    }
    seeds = sorted(set(runs[name]) & set(runs[other]))
    if {seed[0] for seed in seeds} != (set(KINDS) if kind == BOTH else {kind}):
        return {}
    counts = np.array(
        [[(runs[who][seed]["taken"], len(runs[who][seed]["picks"])) for seed in seeds] for who in (name, other)]
    )
    draws = np.random.default_rng(0).integers(len(seeds), size=(_DRAWS, len(seeds)))
    found = {}
    for rate in ("gsr", "dr"):
        values = []
        for chosen in (np.arange(len(seeds))[None], draws):
            taken, tried = counts[:, chosen].sum(axis=2).transpose(2, 0, 1)
            share = taken / np.maximum(tried, 1) if rate == "gsr" else taken / (THINGS * len(seeds))
            values.append(100 * (share[0] - share[1]))
        found[rate] = [float(values[0][0]), *np.percentile(values[1], [2.5, 97.5]).tolist()]
    return {"scenes": [len(seeds)], **found}


def _with_earlier(results: str, part: str, found: dict[str, Any]) -> dict[str, Any]:
    """What was found, and what of earlier results was not tried this time, with the commit that it was tried at."""
    made = report.previous(results, "environment").get("commit")
    earlier = {name: {"commit": made, **row} for name, row in report.previous(results, part).items() if row}
    mixed = earlier | {name: row for name, row in found.items() if row}
    places = {f"{kind}: {name}": k for k, (kind, name) in enumerate(product(KINDS, CONTESTANTS))}
    return dict(sorted(mixed.items(), key=lambda item: places.get(item[0], len(places))))


def main() -> None:
    parser = report.parser(__doc__)
    parser.add_argument("--scenes", type=int, default=20, help="of each kind")
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--things", default="", help="kinds or names, such as tool,mug,bottle; all if empty")
    parser.add_argument("--contestants", default=",".join(CONTESTANTS))
    parser.add_argument("--first", type=int, default=_FIRST_SEED)
    parser.add_argument("--each", type=Path, help="result lines; those that are there are not computed again")
    parser.add_argument("--contact-graspnet", metavar="COMMAND", help="that starts contact_graspnet.py")
    parser.add_argument("--name", default="picking", help="of the results; empty: none are written")
    arguments = parser.parse_args()
    contestants, things = arguments.contestants.split(","), list(filter(None, arguments.things.split(",")))
    if not set(contestants) <= {*CONTESTANTS, *PEERS}:
        parser.error(f"--contestants: expected some of {', '.join((*CONTESTANTS, *PEERS))}")
    peer = None
    if arguments.contact_graspnet:
        peer = ContactGraspNet(arguments.contact_graspnet)
    elif set(contestants) & set(PEERS):
        contestants = [name for name in contestants if name not in PEERS]
        print("no --contact-graspnet: cgn is left out")
    lines: list[dict[str, Any]] = []
    if arguments.each and arguments.each.exists():
        lines = [json.loads(line) for line in arguments.each.read_text().splitlines()]
    have = {(line["kind"], line["seed"], line["contestant"]) for line in lines}
    recoverers = {name: recoverer_of(name) for name in contestants}
    for seed in range(arguments.first, arguments.first + arguments.scenes):
        for kind in arguments.kinds.split(","):
            missing = [name for name in contestants if (kind, seed, name) not in have]
            if not missing:
                continue
            scene = picking_scenes.scene(kind, seed, things)
            for name in missing:
                line = {"commit": report.commit(), **cleared(scene, name, recoverers[name], peer)}
                lines.append(line)
                if arguments.each:
                    with arguments.each.open("a") as file:
                        file.write(json.dumps(line) + "\n")
                print(kind, seed, name, line["taken"], [pick["how"] for pick in line["picks"]], line["end"], flush=True)
    found = summary(lines)
    gains = {
        f"{kind}: {name} over {other}": gain(lines, kind, name, other)
        for kind in (*KINDS, BOTH)
        for name, other in (*(("ours", other) for other in RIVALS), (WITH_PARTS, "ours"))
    }
    if arguments.name:
        found, gains = _with_earlier(arguments.name, "rows", found), _with_earlier(arguments.name, "gains", gains)
    text = table(found) + (f"\n\n{gains_table(gains)}" if any(gains.values()) else "")
    if arguments.name:
        report.write(arguments.name, {"rows": found, "gains": gains}, text)
    else:
        print(text)


if __name__ == "__main__":
    main()
