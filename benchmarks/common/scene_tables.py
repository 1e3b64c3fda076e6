"""Tables of household scenes: the options of a benchmark of them, its processes, and the figures of all things.

``2 sigma`` is the share of half sizes within two reported deviations of half the hull's extent along the same axis.
Millimetres; times are of one thread each, milliseconds.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from common import report, scene_verdict, tabletop
from common.scene_verdict import HALF, METHODS, SceneVerdict, ThingVerdict

Groups = Callable[[list[ThingVerdict]], dict[str, list[ThingVerdict]]]
"""Makes the rows of a table of all things; the first one, ALL, is what goals are for."""
ALL = "**all, at least half visible**"
MASKS = ("given", "own")
POOR = 0.7
SHARES = {"all visible (90 % and more)": (0.9, np.inf), "50 to 90 %": (0.5, 0.9), "under 50 %": (0.0, 0.5)}


def arguments(text: str | None, name: str) -> argparse.ArgumentParser:
    """Options of a benchmark of scenes that describes itself so."""
    parser = report.parser(text, name)
    parser.add_argument("--scenes", type=int, default=1000, help="number of scenes")
    parser.add_argument("--first", type=int, default=0, help="seed of the first scene")
    parser.add_argument("--sensor", choices=list(tabletop.SENSORS), help="one for all scenes; they alternate otherwise")
    parser.add_argument("--jobs", type=int, default=1, help="processes, each of one thread")
    parser.add_argument("--each", type=Path, help="write every thing's figures and bodies to this file, JSON")
    return parser


def run(
    evaluate: Callable[[int], SceneVerdict],
    options: argparse.Namespace,
    groups: Groups,
    goals: dict[str, str],
    **facts: Any,
) -> None:
    """Evaluate the scenes that were asked for, and write the results."""
    verdicts = list(verdicts_of(evaluate, range(options.first, options.first + options.scenes), options.jobs))
    if options.each is not None:
        everything = [asdict(one) for each in verdicts for one in each.things]
        options.each.write_text(json.dumps(everything, indent=1, default=_or_none) + "\n")
    result, text = tables(verdicts, groups, goals)
    given = {name: str(value) if isinstance(value, Path) else value for name, value in vars(options).items()}
    report.write(options.name, {**facts, "options": given, **result}, text)


def _or_none(values: np.ndarray) -> list[Any]:
    """An array for JSON, None for what is not known."""
    return list(np.where(np.isfinite(values), values, None))


def verdicts_of(evaluate: Callable[[int], SceneVerdict], seeds: range, jobs: int) -> Iterator[SceneVerdict]:
    """The verdicts of scenes in their order, with a line for each."""
    began = time.perf_counter()
    if jobs == 1:
        report.pin()
        warm_up()
        yield from map(partial(_reported, began=began), map(evaluate, seeds))
        return
    # Spawned: a fork of a process whose threads run may wait for a lock forever.
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"), initializer=warm_up) as pool:
        yield from map(partial(_reported, began=began), pool.map(evaluate, seeds))


def warm_up() -> None:
    """Nothing is compiled or loaded while the clock runs."""
    scene_verdict.recoverer().warm_up(tabletop.CAMERA)


def _reported(each: SceneVerdict, began: float) -> SceneVerdict:
    given = " ".join(f"{one.name} {100 * one.answers['given'].iou:.0f}" for one in each.things)
    own = " ".join(f"{100 * one.answers['own'].iou:.0f}" for one in each.things)
    passed = time.perf_counter() - began
    print(f"scene {each.seed} {each.sensor} | given: {given} | own: {own} | {passed:.0f} s", flush=True)
    return each


def by_sensor_and_share(counted: list[ThingVerdict]) -> dict[str, list[ThingVerdict]]:
    """Rows of things at least half visible by sensor, and of all by their visible share."""
    half = [one for one in counted if one.visible_share >= HALF]
    rows = {sensor: [one for one in half if one.sensor == sensor] for sensor in tabletop.SENSORS}
    for name, (low, high) in SHARES.items():
        rows[f"visible: {name}"] = [one for one in counted if low <= one.visible_share < high]
    return rows


def tables(verdicts: list[SceneVerdict], groups: Groups, goals: dict[str, str]) -> tuple[dict[str, Any], str]:
    """All figures, as numbers and as Markdown."""
    found = groups([one for each in verdicts for one in each.things])
    result: dict[str, Any] = {}
    rows = []
    for name, chosen in found.items():
        for method in METHODS if name == ALL else MASKS:
            if chosen:
                result[f"{name.strip('*')}: {method}"] = figures = summary(chosen, method)
                rows.append(line(name, method, figures, goals.get(method, "-") if name == ALL else ""))
    frame_figures, frame_text = frames(verdicts)
    return {**frame_figures, **result}, f"{report.table_of(rows)}\n\nWhole frames\n\n{frame_text}"


def summary(chosen: list[ThingVerdict], method: str) -> dict[str, Any]:
    """The figures of some things with one method."""
    answers = [one.answers[method] for one in chosen]
    iou = 100 * np.array([answer.iou for answer in answers])
    status = np.array([answer.status for answer in answers])
    errors = 1e3 * np.array([answer.size_error for answer in answers])
    excess = 1e3 * np.array([answer.excess for answer in answers])
    covered = np.array([answer.covered for answer in answers]).ravel()
    covered = covered[np.isfinite(covered)]
    known = np.isfinite(errors)
    return {
        "iou": report.spread(iou),
        "poor": float(100 * np.mean(iou < 100 * POOR)),
        "edge_error": report.spread(errors[known]) if known.any() else None,
        "excess": excess[known].mean(axis=0).tolist() if known.any() else None,
        "status": {name: float(100 * np.mean(status == name)) for name in ("converged", "weak", "failed", "none")},
        "within_2_sigma": float(100 * covered.mean()) if covered.size else None,
    }


def line(name: str, method: str, figures: dict[str, Any], goal: str) -> dict[str, str]:
    """A row of the table."""
    iou, errors, status, covered = (figures[key] for key in ("iou", "edge_error", "status", "within_2_sigma"))
    return {
        "things": name,
        "method": method,
        "count": f"{iou['count']:.0f}",
        "IoU % mean +- std": f"{iou['mean']:.1f} +- {iou['std']:.1f}",
        "median": f"{iou['median']:.1f}",
        "goal": goal,
        f"< {100 * POOR:.0f} % (%)": f"{figures['poor']:.0f}",
        "edge error mm median": "" if errors is None else f"{errors['median']:.1f}",
        "mean": "" if errors is None else f"{errors['mean']:.1f}",
        "along: right, away, up: mean excess mm": " ".join(f"{x:+.1f}" for x in figures["excess"] or ()),
        "weak / failed / missed %": " / ".join(f"{status[key]:.0f}" for key in ("weak", "failed", "none")),
        "2 sigma %": "" if covered is None else f"{covered:.0f}",
    }


def frames(verdicts: list[SceneVerdict]) -> tuple[dict[str, Any], str]:
    """Bodies of nothing, and what frames cost, by sensor."""
    result: dict[str, Any] = {}
    rows = []
    for sensor in (*tabletop.SENSORS, "all"):
        chosen = [each for each in verdicts if sensor in (each.sensor, "all")]
        if not chosen:
            continue
        things = sum(len(each.things) for each in chosen)
        times = {name: report.spread(np.array([each.milliseconds[name] for each in chosen])) for name in MASKS}
        figures: dict[str, Any] = {
            "scenes": len(chosen),
            "things": things,
            "under_200_pixels": sum(each.tiny for each in chosen),
            "false_bodies": sum(each.false_bodies for each in chosen),
            "milliseconds": times,
        }
        result[f"frames: {sensor}"] = figures
        rows.append(
            {
                "sensor": sensor,
                "scenes": str(figures["scenes"]),
                "things + under 200 pixels": f"{things} + {figures['under_200_pixels']}",
                "false bodies": str(figures["false_bodies"]),
                "ms a frame, given: median / p95": f"{times['given']['median']:.0f} / {times['given']['p95']:.0f}",
                "ms a frame, own": f"{times['own']['median']:.0f} / {times['own']['p95']:.0f}",
            }
        )
    return result, report.table_of(rows)
