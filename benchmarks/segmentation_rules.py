"""What each rule of the segmentation is worth: each switched off by itself, on scenes of every kind.

    python benchmarks/segmentation_rules.py [--scenes 135] [--first 0] [--kinds flat heap ...] [--rules ...]
                                            [--each FILE] [--name segmentation_rules]
    python benchmarks/segmentation_rules.py --unlabelled FOLDER --name segmentation_unlabelled

Scenes are those of :mod:`common.segmentation_scenes`, ``--scenes`` of each kind; each is drawn once and segmented
once a rule, by the geometry and the network of masks as ``Recoverer.recover`` does.  Recorded frames with human masks
(../shared/data/mosd_learn) are one more kind where they are there.

    found     things with a segment of an IoU of at least 0.5, one to one (Hungarian), over measured pixels; things
              of at least 200 pixels of a VGA image count
    nothing   segments most of whose pixels show no thing
    pieces    other segments that no thing is matched with
    IoU       mean over all things, 0 for a thing that is not matched

A row gives what the rule gains: the figure with it less the figure without it, in per cent of the things, or segments
in 100 scenes; with the standard error of the sum of the scenes' differences.  A rule that gains less than two standard
errors has no place in the package.  results/segmentation_rules_before.md has those of the first trial,
results/segmentation_rules_removed.md those that went since, and why some came back.  ``--each`` names a file of JSON
lines, one a scene, that a run adds to: a run that was stopped goes on, and one of more scenes or other seeds counts
them together.

``--unlabelled`` takes recorded frames (NPZ with depth, K and, in words, ``source``) without masks: how many of them a
rule changes, and the segments with it, and without it, that no other one overlaps by an IoU of 0.8.
"""

from __future__ import annotations

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import astuple, dataclass
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
from common import report, segmentation_scenes
from scipy.optimize import linear_sum_assignment
from segmentation import frames

from sq_perception.imaging.camera import Camera
from sq_perception.learning import inference
from sq_perception.recordings.frame_file import read as read_frame
from sq_perception.recovery.own_segments import SegmentNetwork
from sq_perception.segmentation import segments
from sq_perception.segmentation.options import SegmentationOptions

MOST = 128
_FEWEST, _VGA = 200, 640 * 480
_MATCH, _ALIKE = 0.5, 0.8
FIGURES = ("found", "nothing", "pieces", "iou")


_S = "sq_perception.segmentation"
_OWN = "sq_perception.recovery.own_segments"
RULES: dict[str, dict[str, Any]] = {
    "plane: things are near above it (_TYPICAL_HEIGHT)": {f"{_S}.support_plane._FAR": 1.0},
    "the silhouette of a single thing": {f"{_S}.segments._is_silhouette": lambda *_: False},
    "level tops (level_faces)": {f"{_S}.level_faces.find_faces": lambda *_: {}},
    "walls of containers (container_walls)": {f"{_S}.container_walls.walls": lambda *_: set()},
    "bodies: grazing sides (_GAP)": {f"{_S}.segments._GAP": 0.0},
    "bodies: feet and rims (_GROWN)": {f"{_S}.segments._GROWN": 0},
    "pieces: of all": {f"{_S}.convex_parts._pieces": lambda *_: []},
    "pieces: as large near by (_CLOSE)": {f"{_S}.convex_parts._CLOSE": 1e-6},
    "pieces: nearest first (_METRIC)": {f"{_S}.convex_parts._METRIC": 0.0},
    "pieces: a step of 5 mm (_LEAST_GAP)": {f"{_S}.line_of_sight.SampledImage.__init__.__defaults__": (0.0,)},
    "behind something nearer (_ALONG)": {f"{_S}.convex_parts._ALONG": 1.0},
    "network: a probability that it is a thing (LEAST)": {f"{_S}.objectness.LEAST": 0.0},
    "network: parts": {f"{_OWN}.SegmentNetwork._part": lambda *_: []},
    "network: a part claims itself (_ITSELF)": {f"{_OWN}._ITSELF": 0.0},
    "network: joins": {f"{_OWN}._ONE": (0.5, -np.inf)},
    "network: all of it": {f"{_OWN}.SegmentNetwork.improve": lambda self, found: found},
}
"""What is put in the place of each rule; a rule that is gone from the package is gone from here."""


@contextmanager
def without(rule: str | None) -> Iterator[None]:
    """The segmentation without a rule."""
    with ExitStack() as stack:
        for name, value in RULES[rule].items() if rule else ():
            stack.enter_context(mock.patch(name, value))
        yield


@dataclass(frozen=True, eq=False)
class Verdict:
    """What the segments of one scene are worth: counts, and the sum of the things' IoU."""

    things: int
    found: int
    nothing: int
    pieces: int
    iou: float


masks = cache(inference.load_masks)


def segmented(depth: np.ndarray, camera: Camera, rule: str, known: dict[bytes, np.ndarray]) -> np.ndarray:
    """Own masks (height, width), as a recoverer has them; the network's answers to the same segments are ``known``."""
    found = segments.propose(depth, camera)
    plane = b"" if found.plane is None else found.plane.tobytes()
    key = (rule if rule.startswith("network") else "").encode() + plane + found.labels.tobytes()
    if key not in known:
        network = SegmentNetwork(masks(), depth, camera, found.plane, lambda function, items: function(items))
        found = network.improve(found)
        known[key] = segments.limit(found, depth, camera, SegmentationOptions(max_objects=MOST)).labels
    return known[key]


def verdict(labels: np.ndarray, truth: np.ndarray, depth: np.ndarray) -> Verdict:
    """Compare masks with true ones where something was measured."""
    measured = np.isfinite(depth)
    own, true = (np.where(measured, each, 0) for each in (labels, truth))
    things, own_ids = np.unique(true, return_inverse=True)[1], np.unique(own, return_inverse=True)[1]
    names, numbers = np.unique(true), np.unique(own)
    both = np.zeros((len(names), len(numbers)))
    np.add.at(both, (things.ravel(), own_ids.ravel()), 1)
    row, column = int(names[0] == 0), int(numbers[0] == 0)
    shared, size, area = both[row:, column:], both.sum(0)[column:], both.sum(1)[row:]
    of_nothing = both[0, column:] > 0.5 * size if row else np.zeros(len(size), bool)
    iou = shared / np.maximum(area[:, None] + size - shared, 1)
    at = linear_sum_assignment(-iou)
    hit = iou[at] >= _MATCH
    counted = area >= _FEWEST * depth.size / _VGA
    best = np.zeros(len(area))
    best[at[0]] = iou[at]
    matched = np.zeros(len(size), bool)
    matched[at[1][hit]] = True
    return Verdict(
        int(counted.sum()),
        int((best[counted] >= _MATCH).sum()),
        int((of_nothing & ~matched).sum()),
        int((~of_nothing & ~matched).sum()),
        float(best[counted].sum()),
    )


def scenes(
    kinds: list[str], seeds: range, known: set[tuple[str, int]]
) -> Iterator[tuple[str, int, np.ndarray, np.ndarray, Camera]]:
    """Kind, number, depth, true masks and camera of what is not known; of all kinds in turn, recorded frames last."""
    for seed in seeds:
        for kind in kinds:
            if kind in segmentation_scenes.KINDS and (kind, seed) not in known:
                try:
                    made = segmentation_scenes.scene(kind, seed)
                except ValueError:  # no room in the image
                    continue
                yield kind, seed, made.depth, made.labels, made.camera
    folder = report.shared_data("mosd_learn") if "recorded" in kinds else None
    for number, each in enumerate(frames(folder, 1000) if folder else ()):
        if ("recorded", number) not in known:
            yield "recorded", number, each.frame.depth, each.truth, each.frame.camera


def unlabelled(folder: Path, rules: list[str]) -> tuple[dict[str, Any], str]:
    """What each rule changes in frames without masks."""
    changes: dict[str, list[tuple[int, int]]] = {rule: [] for rule in rules}
    count = 0
    sources = set()
    for path in sorted(folder.glob("*.npz")):
        frame = read_frame(path)
        with np.load(path) as file:
            sources |= {str(file["source"])} if "source" in file else set()
        answers: dict[bytes, np.ndarray] = {}
        base = segmented(frame.depth, frame.camera, "", answers)
        count += len(np.unique(base[base > 0]))
        for rule in rules:
            with without(rule):
                other = segmented(frame.depth, frame.camera, rule, answers)
            changes[rule].append((unlike(base, other), unlike(other, base)))
    found = {}
    for rule, each in changes.items():
        gone, new = np.sum(each, axis=0)
        found[rule] = {"frames": sum(map(any, each)), "only with": int(gone), "only without": int(new)}
    rows = [[rule, *map(str, one.values())] for rule, one in found.items()]
    frames_ = len(next(iter(changes.values())))
    table = report.table(["rule", "frames that differ", "segments only with it", "segments only without it"], rows)
    head = f"{frames_} frames, {count} segments. Sources: {', '.join(sorted(sources)) or 'unknown'}"
    result = {"frames": frames_, "segments": count, "sources": sorted(sources), "rules": found}
    return result, f"{head}\n\n{table}"


def unlike(labels: np.ndarray, others: np.ndarray) -> int:
    """How many segments overlap none of the others by an IoU of at least 0.8."""
    count = 0
    for label in np.unique(labels[labels > 0]):
        inside = labels == label
        names, shared = np.unique(others[inside], return_counts=True)
        best = [n / (inside.sum() + (others == k).sum() - n) for k, n in zip(names, shared, strict=True) if k > 0]
        count += max(best, default=0.0) < _ALIKE
    return count


def gains(rows: list[dict[str, Verdict]], rule: str) -> dict[str, dict[str, float]]:
    """What a rule gains, and the standard error of that, by figure."""
    things = max(sum(row["all"].things for row in rows), 1)
    answer = {}
    for name in FIGURES:
        difference = np.array([getattr(row["all"], name) - getattr(row[rule], name) for row in rows], dtype=float)
        scale = 100 / things if name in ("found", "iou") else 100 / len(rows)
        deviation = float(np.sqrt(len(rows)) * difference.std())
        answer[name] = {"gain": scale * float(difference.sum()), "error": scale * deviation}
    return answer


def level(rows: list[dict[str, Verdict]]) -> dict[str, float]:
    """The figures with all rules."""
    total = {name: sum(getattr(row["all"], name) for row in rows) for name in ("things", *FIGURES)}
    things = max(total["things"], 1)
    segmented_ = total["found"] + total["nothing"] + total["pieces"]
    return {
        "scenes": len(rows),
        "things": total["things"],
        "found": 100 * total["found"] / things,
        "nothing": 100 * total["nothing"] / len(rows),
        "pieces": 100 * total["pieces"] / len(rows),
        "iou": 100 * total["iou"] / things,
        "f1": 2 * total["found"] / max(total["things"] + segmented_, 1),
    }


def text(by_kind: dict[str, list[dict[str, Verdict]]], rules: list[str]) -> tuple[dict[str, Any], str]:
    """Figures, and two tables: by rule, and by kind with all rules."""
    everything = [row for rows in by_kind.values() for row in rows]
    levels = {kind: level(rows) for kind, rows in {"all": everything, **by_kind}.items()}
    worth = {rule: {k: gains(r, rule) for k, r in {"all": everything, **by_kind}.items()} for rule in rules}
    lines = []
    for rule, each in worth.items():
        cells = [f"{each['all'][name]['gain']:+.2f} +- {each['all'][name]['error']:.2f}" for name in FIGURES]
        kinds = [
            f"{kind} {one['found']['gain']:+.1f}"
            for kind, one in each.items()
            if kind != "all" and abs(one["found"]["gain"]) >= max(2 * one["found"]["error"], 0.5)
        ]
        lines.append([rule, *cells, ", ".join(kinds)])
    header = [
        "rule",
        "found %",
        "nothing / 100 scenes",
        "pieces / 100 scenes",
        "IoU %",
        "kinds: found %, beyond 2 errors",
    ]
    rows = [
        [kind, *(f"{one[name]:.{digits}f}" for name, digits in _LEVEL_DIGITS.items())] for kind, one in levels.items()
    ]
    below = report.table(["kind", *_LEVEL_DIGITS], rows)
    return {"levels": levels, "rules": worth}, f"{report.table(header, lines)}\n\nWith all rules:\n\n{below}"


_LEVEL_DIGITS = {"scenes": 0, "things": 0, "found": 1, "nothing": 1, "pieces": 1, "iou": 1, "f1": 3}


def main() -> None:
    parser = report.parser(__doc__, "segmentation_rules")
    kinds = [*segmentation_scenes.KINDS, "recorded"]
    parser.add_argument("--scenes", type=int, default=135, help="of each kind")
    parser.add_argument("--first", type=int, default=0, help="seed of the first scene of a kind")
    parser.add_argument("--kinds", nargs="+", default=kinds, choices=kinds)
    parser.add_argument("--rules", nargs="*", default=list(RULES), choices=list(RULES))
    parser.add_argument("--unlabelled", type=Path, metavar="FOLDER", help="of recorded frames without masks, instead")
    parser.add_argument("--each", type=Path, help="JSON lines, one a scene, that are added to")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    if options.unlabelled:
        result, table = unlabelled(options.unlabelled, options.rules)
        report.write(options.name, result, table)
        return
    lines = options.each.read_text().splitlines() if options.each and options.each.exists() else []
    by_kind: dict[str, list[dict[str, Verdict]]] = {}
    known = set()
    for kind, seed, row in map(json.loads, lines):
        known.add((kind, seed))
        by_kind.setdefault(kind, []).append({rule: Verdict(*numbers) for rule, numbers in row.items()})
    seeds = range(options.first, options.first + options.scenes)
    for kind, seed, depth, truth, camera in scenes(options.kinds, seeds, known):
        row, answers = {}, {}
        for rule in (None, *options.rules):
            with without(rule):
                row[rule or "all"] = verdict(segmented(depth, camera, rule or "", answers), truth, depth)
        by_kind.setdefault(kind, []).append(row)
        if options.each:
            with options.each.open("a") as file:
                file.write(json.dumps([kind, seed, {rule: astuple(one) for rule, one in row.items()}]) + "\n")
    result, table = text(by_kind, options.rules)
    report.write(options.name, {"options": vars(options) | {"each": None}, **result}, table)


if __name__ == "__main__":
    main()
