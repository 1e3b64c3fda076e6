"""Hours in the life of a node: synthetic_depth_node -> recover_node -> this program, watched each second.

    python benchmarks/soak.py [--minutes 30] [--rate 30] [--objects 5] [--offered 90] [--node recover_node]

Three phases with the same node.  First the camera is slow, so that each frame is alone: the latency of one frame.  Then
it runs at ``rate`` for ``minutes``; memory, latency, services and diagnostics are evaluated here.  Then it offers more
than anybody could answer.  The camera shows the same scenes in all three, over and over; it runs at low priority on one
thread, as a real camera takes next to no processor time.

Latency goes from the stamp, the clock at the camera's publish call, to the arrival here.  Memory is resident memory;
its growth is a straight line fitted to all seconds after the first minute.
"""

from __future__ import annotations

import os
import sys
import time
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from common import (
    own_domain,  # noqa: F401
    report,
)
from common.process_usage import Usage, usage
from rcl_interfaces.srv import GetParameters
from running_nodes import Answer, Diagnosis, Peer, arguments, environment, until
from started_nodes import Children
from std_srvs.srv import SetBool

CAMERA_NODE = "synthetic_depth_node"
SCENES = 8
SCENE_SECONDS = 10.0
_ALONE_RATE, _ALONE_FRAMES = 3.0, 6
_WARM = 60.0
"""Seconds after which memory is measured."""
_SHORTEST_WARM = 0.25
"""Share of a run that is shorter than four minutes."""

ASKED = {"growth": 3.0, "p99 to median": 2.0, "services": 50.0, "drift": 10.0, "best rate": 0.9}
"""Per cent, ratio, milliseconds, per cent, share."""


@dataclass
class Phase:
    """What was seen while the camera ran at one rate."""

    rate: float
    began: float
    ended: float = 0.0
    answers: list[Answer] = field(default_factory=list)
    diagnoses: list[Diagnosis] = field(default_factory=list)
    usage: list[tuple[float, Usage]] = field(default_factory=list)
    calls: dict[str, list[float]] = field(default_factory=dict)

    @property
    def seconds(self) -> float:
        return self.ended - self.began


class Soak:
    """A node that stays, a camera that is started anew for each phase, and the peer that watches them."""

    def __init__(self, node: str, objects: int, peer: Peer, nodes: Children, cameras: Children) -> None:
        self.name, self.objects = f"/{node}", objects
        self.peer, self.cameras = peer, cameras
        self.answers, self.diagnoses = peer.answers(self.name), peer.diagnoses(self.name)
        self.node = nodes.start(node, ["--ros-args", "--log-level", "warn"])

    def phase(self, rate: float, seconds: float, hold: int, *, services: bool = True) -> Phase:
        """Run the camera at a rate and watch."""
        parameters = [f"rate:={rate}", f"objects:={self.objects}", f"hold:={hold}", f"scenes:={SCENES}"]
        camera = self.cameras.start(CAMERA_NODE, [*arguments(*parameters), "--log-level", "warn"])
        os.setpriority(os.PRIO_PROCESS, camera.pid, 15)
        seen = len(self.answers)
        until(lambda: len(self.answers) >= seen + 3, (self.node, camera))
        first, diagnosed = len(self.answers), len(self.diagnoses)
        phase = Phase(rate, time.monotonic())
        second = 0
        while time.monotonic() < phase.began + seconds:
            self._look(phase, services)
            second += 1
            time.sleep(max(0.0, phase.began + second - time.monotonic()))
        phase.ended = time.monotonic()
        phase.answers, phase.diagnoses = self.answers[first:], self.diagnoses[diagnosed:]
        self.cameras.stop()
        return phase

    def _look(self, phase: Phase, services: bool) -> None:
        phase.usage.append((time.monotonic() - phase.began, usage(self.node.pid)))
        if not services:
            return
        for name, kind, request in (
            ("get_parameters", GetParameters, GetParameters.Request(names=["s", "max_objects"])),
            ("enable", SetBool, SetBool.Request(data=True)),
        ):
            took = self.peer.call(kind, f"{self.name}/{name}", request, (self.node,)).milliseconds
            phase.calls.setdefault(name, []).append(took)

    def final(self) -> Diagnosis:
        """The node's own account after the last frame."""
        after = time.monotonic()
        until(lambda: self.diagnoses[-1].time > after + 2.0, (self.node,))
        return self.diagnoses[-1]


def growth(phase: Phase, begin: float) -> dict[str, float]:
    """A straight line through the resident memory of all seconds after ``begin``: MB, and per hour."""
    when, memory = np.array([(when, one.rss) for when, one in phase.usage if when >= begin]).T
    (slope, offset), covariance = np.polyfit(when, memory, 1, cov=True)
    return {
        "mean": float(memory.mean()),
        "slope_per_hour": float(3600 * slope),
        "slope_error_per_hour": float(3600 * np.sqrt(covariance[0, 0])),
        "growth_percent": float(100 * slope * (when[-1] - when[0]) / (offset + slope * when[0])),
    }


def latencies(phase: Phase) -> dict[str, Any]:
    """Ages of the results, milliseconds, and how many came."""
    ages = np.array([answer.age for answer in phase.answers])
    third = max(len(ages) // 3, 1)
    first, last = np.median(ages[:third]), np.median(ages[-third:])
    return {
        "milliseconds": {**report.spread(ages), "p99": float(np.percentile(ages, 99))},
        "drift_percent": float(100 * (last - first) / first),
        "results_per_second": len(ages) / phase.seconds,
    }


def account(phase: Phase) -> dict[str, Any]:
    """Everything that is known of a phase, as JSON."""
    begin = min(_WARM, _SHORTEST_WARM * phase.seconds)
    reports = np.array([phase.began, *(one.time for one in phase.diagnoses), phase.ended])
    settled = next(one for when, one in phase.usage if when >= begin)
    return {
        "rate": phase.rate,
        "seconds": phase.seconds,
        "latency": latencies(phase),
        "memory": growth(phase, begin),
        "after_first_minute": asdict(settled),
        "at_the_end": asdict(phase.usage[-1][1]),
        "diagnoses": {"received": len(phase.diagnoses), "longest_gap_s": float(np.diff(reports).max())},
        "most_in_work": max((one.count("in work") for one in phase.diagnoses), default=0),
        "services": {
            name: {**report.spread(np.array(took)), "p99": float(np.percentile(took, 99))}
            for name, took in phase.calls.items()
        },
    }


def verdicts(
    alone: dict[str, Any], asked: dict[str, Any], offered: dict[str, Any] | None, final: Diagnosis
) -> list[list[str]]:
    """Rows: what, asked, reached, whether."""

    def row(what: str, wanted: str, reached: str, met: bool) -> list[str]:
        return [what, wanted, reached, "yes" if met else "NO"]

    latency, memory = asked["latency"], asked["memory"]
    ms = latency["milliseconds"]
    p99_to_median = ms["p99"] / ms["median"]
    before, after = asked["after_first_minute"], asked["at_the_end"]
    counts = {key: after[key] - before[key] for key in ("threads", "files", "segments")}
    diagnoses = asked["diagnoses"]
    rows = [
        row("resident memory after the first minute", f"+-{ASKED['growth']:g} %",
            f"{memory['growth_percent']:+.2f} % of {memory['mean']:.0f} MB ({memory['slope_per_hour']:+.1f} +- "
            f"{memory['slope_error_per_hour']:.1f} MB/h)", abs(memory["growth_percent"]) <= ASKED["growth"]),
        row("threads, open files, segments since then", "as many", ", ".join(f"{k} {v:+d}" for k, v in counts.items()),
            all(number <= 0 for number in counts.values())),
        row("latency p99 / median", f"<= {ASKED['p99 to median']:g}",
            f"{p99_to_median:.2f} ({ms['p99']:.0f} / {ms['median']:.0f} ms)", p99_to_median <= ASKED["p99 to median"]),
        row("latency, last third against first", f"< {ASKED['drift']:g} %", f"{latency['drift_percent']:+.1f} %",
            latency["drift_percent"] < ASKED["drift"]),
        row("frames in work", "<= 2", str(asked["most_in_work"]), asked["most_in_work"] <= 2),
        row("diagnoses", "one a second", f"{diagnoses['received']} in {asked['seconds']:.0f} s, longest gap "
            f"{diagnoses['longest_gap_s']:.2f} s", diagnoses["longest_gap_s"] < 1.5),
    ]  # fmt: skip
    for name, took in asked["services"].items():
        rows.append(
            row(f"{name} answers", f"p99 < {ASKED['services']:g} ms",
                f"{took['median']:.1f} / {took['p99']:.1f} / {took['max']:.1f} ms (median, p99, max)",
                took["p99"] < ASKED["services"])
        )  # fmt: skip
    counted = ", ".join(f"{key} {final.count(key)}" for key in ("received", "answered", "dropped", "refused", "lost"))
    rows.append(row("every frame has a verdict", "received = sum", counted, final.is_balanced))
    if offered is not None:
        best = asked["latency"]["results_per_second"]
        rate, period = offered["latency"]["results_per_second"], 1e3 / offered["rate"]
        least = ASKED["best rate"] * best
        rows.append(
            row(f"results / s at {offered['rate']:g} Hz offered", f">= {least:.1f}", f"{rate:.1f}", rate >= least)
        )
        single, many = (phase["latency"]["milliseconds"]["median"] for phase in (alone, offered))
        rows.append(
            row(f"latency at {offered['rate']:g} Hz, of one frame", "that of a frame alone + its period, within 25 %",
                f"{many:.0f} ms, alone {single:.0f} ms", many <= 1.25 * single + period)
        )  # fmt: skip
    return rows


def main() -> None:
    parser = report.parser(__doc__, "soak")
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--rate", type=float, default=30.0)
    parser.add_argument("--objects", type=int, default=5)
    parser.add_argument("--offered", type=float, default=90.0, help="Hz of the last phase; 0 leaves it out")
    parser.add_argument("--node", choices=("recover_node", "fitter_node"), default="recover_node")
    options = parser.parse_args()
    with (
        Peer() as peer,
        Children(environment()) as nodes,
        Children(environment(NUMBA_NUM_THREADS="1")) as cameras,
    ):
        soak = Soak(options.node, options.objects, peer, nodes, cameras)
        alone = soak.phase(_ALONE_RATE, SCENES * _ALONE_FRAMES / _ALONE_RATE, _ALONE_FRAMES, services=False)
        hold = round(SCENE_SECONDS * options.rate)
        asked = soak.phase(options.rate, 60 * options.minutes, hold)
        phases = {"alone": alone, "asked": asked}
        if options.offered:
            seconds = max(30.0, min(120.0, 10 * options.minutes))
            phases["offered"] = soak.phase(options.offered, seconds, round(options.offered * seconds / SCENES))
        final = soak.final()
        warnings = soak.node.last_lines()
        accounts = {name: account(phase) for name, phase in phases.items()}
    rows = verdicts(accounts["alone"], accounts["asked"], accounts.get("offered"), final)
    result = {
        "options": vars(options),
        "phases": accounts,
        "verdicts": rows,
        "final": final.values,
        "log": warnings,
    }
    table = report.table(["what", "asked", "reached", "met"], rows)
    report.write(options.name, result, f"{options.node}, {options.objects} objects, {options.rate:g} Hz for "
                 f"{options.minutes:g} minutes\n\n{table}")  # fmt: skip
    sys.exit(0 if all(row[-1] == "yes" for row in rows) else 1)


if __name__ == "__main__":
    main()
