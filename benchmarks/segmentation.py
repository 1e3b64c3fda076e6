"""Instances found in recorded depth images against human masks, without colour.

    python benchmarks/segmentation.py [--frames N] [--repeats 5] [--name segmentation]

Data: ../shared/data/mosd_learn (Kinect v1, tables; see its README); skipped where it is missing.  Only pixels with a
depth count, as nothing else can be found in a depth image.  Segments are those that ``Recoverer.recover`` finds before
it fits bodies, parted and joined by the network of masks; one row has the geometry alone (``segments.segment``).

    matching  one to one, the sum of IoU is largest (Hungarian)
    IoU       mean over the matched pairs; "of all" counts a missed object as 0
    F1        2 TP / (objects + segments), TP a pair with IoU of at least 0.5
    cut       objects of which two segments or more each hold a tenth, and lie in it with more than half of themselves
    joined    segments that hold more than half of two objects or more

Every third frame was held out while constants were chosen.

Goals: IoU 0.85; F1 0.90 for boxes, stacks and round things, 0.80 for occluded; 15 ms of processor time,
one pinned thread.
"""

from __future__ import annotations

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from common import report
from scipy.optimize import linear_sum_assignment

from sq_perception.imaging.camera import Camera
from sq_perception.recordings import frame_file
from sq_perception.recovery.recoverer import Recoverer
from sq_perception.segmentation.evidence import FrameEvidence
from sq_perception.segmentation.segments import segment

IOU_GOAL = 0.85
F1_GOAL = {"boxes": 0.9, "stacked_boxes": 0.9, "cylindric": 0.9, "occluded": 0.8}
NAMES = {"boxes": "boxes", "stacked_boxes": "stacked boxes", "cylindric": "round things", "occluded": "occluded"}
HELD_OUT = 3
"""Every third frame, from the first, was not looked at while constants were chosen."""
_MATCH = 0.5
_PIECE = 0.1


@dataclass(frozen=True, eq=False)
class Instances:
    """A recorded frame with what a human found in it."""

    name: str
    category: str
    frame: frame_file.RecordedFrame
    truth: np.ndarray
    """int32 (height, width), objects 1..n, 0 where there is none or no depth."""
    held_out: bool


@dataclass(frozen=True)
class Score:
    """How the segments of one frame fit its objects."""

    ious: tuple[float, ...]
    """Of every object, 0 where no segment was left for it."""
    objects: int
    segments: int
    hits: int
    cut: int
    joined: int
    milliseconds: float


def score(truth: np.ndarray, found: np.ndarray, milliseconds: float = 0.0) -> Score:
    """Compare two label images (height, width), 0 for background, labels from 1 without gaps."""
    objects, segments = int(truth.max()), int(found.max())
    both = np.bincount((truth * (segments + 1) + found).ravel(), minlength=(objects + 1) * (segments + 1))
    both = both.reshape(objects + 1, segments + 1).astype(float)
    area, size = both.sum(1)[1:], both.sum(0)[1:]
    shared = both[1:, 1:]
    iou = shared / np.maximum(area[:, None] + size[None, :] - shared, 1)
    rows, columns = linear_sum_assignment(-iou)
    ious = np.zeros(objects)
    ious[rows] = iou[rows, columns]
    pieces = (shared > 0.5 * size) & (shared >= _PIECE * area[:, None])
    swallowed = shared > 0.5 * area[:, None]
    return Score(
        tuple(ious.tolist()),
        objects,
        segments,
        int(np.count_nonzero(ious >= _MATCH)),
        int(np.count_nonzero(pieces.sum(1) >= 2)),
        int(np.count_nonzero(swallowed.sum(0) >= 2)),
        milliseconds,
    )


def frames(folder: Path, most: int) -> list[Instances]:
    """Recorded frames with masks."""
    found = []
    for k, path in enumerate(sorted(folder.glob("*.npz"))[:most]):
        frame = frame_file.read(path)
        assert frame.labels is not None
        with np.load(path, allow_pickle=False) as archive:
            category = str(archive["category"])
        values = np.unique(frame.labels[frame.labels > 0])
        truth = np.searchsorted(values, frame.labels) + 1
        truth = np.where((frame.labels > 0) & np.isfinite(frame.depth), truth, 0)
        found.append(Instances(path.stem, category, frame, truth, k % HELD_OUT == 0))
    return found


def scored(each: Instances, repeats: int, find: Callable[[np.ndarray, Camera], FrameEvidence]) -> Score:
    """Segment one frame; the time is the shortest of some repeats."""
    times = []
    for _ in range(repeats):
        started = time.process_time()
        found = find(each.frame.depth, each.frame.camera)
        times.append(1e3 * (time.process_time() - started))
    labels = np.where(np.isfinite(each.frame.depth), found.labels, 0)
    return score(each.truth, labels, min(times))


def figures(scores: list[Score]) -> dict[str, Any]:
    """Figures of a group of frames, pooled over its objects."""
    ious = np.concatenate([each.ious for each in scores])
    hits, objects, segments = (sum(getattr(each, name) for each in scores) for name in ("hits", "objects", "segments"))
    return {
        "frames": len(scores),
        "objects": objects,
        "segments": segments,
        "iou": float(ious[ious > 0].mean()) if (ious > 0).any() else 0.0,
        "iou_of_all": float(ious.mean()),
        "precision": hits / max(segments, 1),
        "recall": hits / max(objects, 1),
        "f1": 2 * hits / max(objects + segments, 1),
        "cut": sum(each.cut for each in scores),
        "joined": sum(each.joined for each in scores),
        "milliseconds": report.spread(np.array([each.milliseconds for each in scores])),
    }


def line(name: str, group: dict[str, Any], goal: float | None) -> dict[str, str]:
    """A row of the table."""
    ms = group["milliseconds"]
    return {
        "frames of": name,
        "frames": str(group["frames"]),
        "objects": str(group["objects"]),
        f"IoU (goal {IOU_GOAL})": f"{group['iou']:.3f}",
        "of all": f"{group['iou_of_all']:.3f}",
        "precision": f"{group['precision']:.3f}",
        "recall": f"{group['recall']:.3f}",
        "F1": f"{group['f1']:.3f}",
        "goal": "" if goal is None else f"{goal:.2f}",
        "cut": str(group["cut"]),
        "joined": str(group["joined"]),
        "ms median / max": f"{ms['median']:.1f} / {ms['max']:.1f}",
    }


def summary(known: list[Instances], scores: list[Score], of_geometry: list[Score]) -> tuple[dict[str, Any], str]:
    """By category, for the held-out and the other part, overall, and overall by the geometry alone."""
    result: dict[str, Any] = {}
    rows = []
    both = list(zip(known, scores, strict=True))
    groups: list[tuple[str, list[Score], float | None]] = [
        (name, [s for each, s in both if each.category == key], F1_GOAL[key]) for key, name in NAMES.items()
    ]
    groups += [
        ("**all of these**", scores, None),
        ("held out", [s for each, s in both if each.held_out], None),
        ("looked at", [s for each, s in both if not each.held_out], None),
        ("all, without the network", of_geometry, None),
    ]
    for name, chosen, goal in groups:
        if chosen:
            result[name.strip("*")] = figures(chosen)
            rows.append(line(name, result[name.strip("*")], goal))
    result["each"] = {each.name: [round(x, 3) for x in s.ious] for each, s in both}
    worst = [
        [each.name, each.category, " ".join(f"{x:.2f}" for x in s.ious), str(s.segments), str(s.cut), str(s.joined)]
        for each, s in both
        if s.hits < max(s.objects, s.segments)
    ]
    text = report.table_of(rows)
    if worst:
        text += "\n\nFrames where something is missed or invented\n\n"
        text += report.table(["frame", "category", "IoU of each object", "segments", "cut", "joined"], worst)
    return result, text


def main() -> None:
    parser = report.parser(__doc__, "segmentation")
    parser.add_argument("--frames", type=int, default=1000, help="at most")
    parser.add_argument("--repeats", type=int, default=5, help="the time is the shortest of so many")
    options = parser.parse_args()
    folder = report.shared_data("mosd_learn")
    if folder is None:
        return
    report.pin()
    cv2.setNumThreads(1)
    known, recoverer = frames(folder, options.frames), Recoverer(threads=1)

    def find(depth: np.ndarray, camera: Camera) -> FrameEvidence:
        return recoverer.find_objects(recoverer.read(depth, camera)).segmentation

    scores, of_geometry = ([scored(each, options.repeats, way) for each in known] for way in (find, segment))
    result, text = summary(known, scores, of_geometry)
    report.write(options.name, {"options": vars(options), **result}, text)


if __name__ == "__main__":
    main()
