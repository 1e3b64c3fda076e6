"""Five bodies on a table followed over 300 frames: ids, and how size errors go down.

    python benchmarks/tracking.py [--scenes 2] [--frames 300] [--seed 1] [--name tracking]

Scenes of :func:`sq_perception.simulation.scenes.table_scene`, all bodies 0.6 to 1.0 m away, 640 x 480 pixels, 30
frames a second.
The camera goes 90 degrees about the table's normal through the point it looks at, its pose known, or stands
still.  Rows:

    moving    sensor_noise's realsense_d435
    still     the same camera, standing still
    unbiased  the moving camera again with Gaussian noise alone, sigma = 1 mm: no widened edges
    given     the true masks; own: the program's own segmentation

A body belongs to the segment that overlaps it most, with an IoU above 0.5.  Half sizes are compared along the body's
axes whatever their names: in the one of a cube's 24 turns that comes nearest to the true rotation; the error of a body
is the mean of |a / a_true - 1| over its three.

    frame k       mean error over the bodies seen in that frame; "single" is that of the recoveries alone, the mean
                  over all frames
    2 sigma       share of half sizes within two reported standard deviations, of the tracks in all frames
    switches      a body that is more than 60 % visible has another id than in its frame before; "split" counts those
                  in frames where the segmentation cut the body in pieces or had in the frame before
    births, lost  ids given beyond one for each body; frames in which a body more than 60 % visible was not followed
    ms            processor time of one update, median / 95th percentile, one pinned thread

Goals: no switch, and after 30 frames at most half of the error of the first frame.
"""

from __future__ import annotations

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from common import report
from synthetic_tabletop import visible_shares

from sq_perception.geometry import Superquadric
from sq_perception.geometry import rotation as quaternions
from sq_perception.recovery.recoverer import FrameRecovery, Recoverer
from sq_perception.simulation.scenes import Scene, table_scene
from sq_perception.simulation.sensor_noise import Ideal, SensorNoise, preset
from sq_perception.tracking.association import TURNS
from sq_perception.tracking.session import Followed, TrackingSession

BODIES = 5
RANGE = (0.6, 1.0)
ARC = 90.0
RATE = 30.0
SHOWN = (1, 5, 10, 30, 100, 300)
VISIBLE = 0.6
_MATCH = 0.5
_PIECE = 0.1
_QUATERNIONS = quaternions.from_matrix(TURNS)


@dataclass(frozen=True)
class Row:
    """How the camera moves and what it is like."""

    sensor: SensorNoise
    arc: float


ROWS = {
    "moving": Row(preset("realsense_d435"), ARC),
    "still": Row(preset("realsense_d435"), 0.0),
    "unbiased": Row(Ideal(0.001), ARC),
}
MASKS = ("given", "own")


@dataclass(frozen=True, eq=False)
class View:
    """One frame: the scene in its optical frame, what it shows, and the camera's pose in the first frame's."""

    scene: Scene
    depth: np.ndarray
    labels: np.ndarray
    visible: np.ndarray
    pose: tuple[np.ndarray, np.ndarray]


class Record:
    """What is kept of one scene: arrays (frames, bodies, 3) with NaN where a body has no segment, and counts."""

    def __init__(self, frames: int) -> None:
        self.fused, self.sigma, self.single = np.full((3, frames, BODIES, 3), np.nan)
        self.switches = self.split = self.lost = 0
        self.milliseconds: list[float] = []
        self.session = TrackingSession()
        self._ids: dict[int, int] = {}
        self._cut: set[int] = set()

    @property
    def births(self) -> int:
        return self.session.tally.births - BODIES

    def follow(self, k: int, view: View, found: FrameRecovery) -> tuple[Followed, ...]:
        """Track one frame, and keep its figures."""
        started = time.process_time()
        followed = self.session.follow(found.recovered, k / RATE, view.pose, camera=view.scene.camera, depth=view.depth)
        self.milliseconds.append(1e3 * (time.process_time() - started))
        owner, cut = owners(view.labels, found)
        for j in range(BODIES):
            if j not in owner:
                self.lost += bool(view.visible[j] > VISIBLE)
                continue
            one, raw, truth = followed[owner[j]], found.recovered[owner[j]], view.scene.bodies[j]
            self.fused[k, j], order = size_errors(one.superquadric, truth)
            self.sigma[k, j] = one.sigma_size[order] / truth.size
            self.single[k, j], _ = size_errors(raw.superquadric, truth)
            if view.visible[j] > VISIBLE and self._ids.get(j, one.id) != one.id:
                self.switches += 1
                self.split += j in self._cut | cut
            self._ids[j] = one.id
        self._cut = cut
        return followed


def scenes(count: int, seed: int) -> Iterator[Scene]:
    """Tables whose bodies stay within RANGE and the image on the whole arc."""
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        while True:
            shown = table_scene(rng, BODIES)
            seen = [moved(shown, angle)[0] for angle in np.linspace(0, ARC, 7)]
            if all(_fits(one) for one in seen):
                yield shown
                break


def moved(shown: Scene, degrees: float) -> tuple[Scene, tuple[np.ndarray, np.ndarray]]:
    """The scene as seen after the camera went about the table, and the camera's pose."""
    normal, offset = shown.plane[:3], shown.plane[3]
    middle = np.array([0, 0, -offset / normal[2]])
    turn = quaternions.from_rotation_vector(np.deg2rad(degrees) * normal)
    position = middle - quaternions.to_matrix(turn) @ middle
    back = quaternions.conjugate(turn)
    matrix = quaternions.to_matrix(back)
    plane = np.append(matrix @ normal, offset + normal @ position)
    return Scene(shown.bodies.transformed(back, -matrix @ position), shown.camera, plane), (turn, position)


def views(shown: Scene, row: Row, frames: int, rng: np.random.Generator) -> Iterator[View]:
    """The frames of a row."""
    for k in range(frames):
        here, pose = moved(shown, row.arc * k / max(frames - 1, 1))
        depth, labels = here.render()
        yield View(here, row.sensor.measure(depth, here.camera, rng), labels, visible_shares(here, labels), pose)


def size_errors(body: Superquadric, truth: Superquadric) -> tuple[np.ndarray, np.ndarray]:
    """a / a_true - 1 (3,) along the true axes, and which axis of the body each of them is."""
    turned = quaternions.multiply(body.rotation, _QUATERNIONS)
    best = int(np.argmin(quaternions.geodesic_angle(turned, truth.rotation)))
    order = np.argmax(np.abs(TURNS[best]), axis=0)
    return body.size[order] / truth.size - 1, order


def figures(records: list[Record]) -> dict[str, Any]:
    """Figures of a row, over its scenes."""
    fused, sigma, single = (
        np.concatenate([getattr(one, name) for one in records], axis=1) for name in ("fused", "sigma", "single")
    )
    known = np.isfinite(fused) & np.isfinite(sigma)
    error = np.nanmean(np.abs(fused), axis=(1, 2))
    result: dict[str, Any] = {
        "error": {str(k): float(error[k - 1]) for k in SHOWN if k <= len(error)},
        "single": float(np.nanmean(np.abs(single))),
        "bias": float(np.abs(np.nanmean(single, axis=0)).mean()),
        "within_2_sigma": float(np.mean(np.abs(fused[known]) <= 2 * sigma[known])),
        "within_2_sigma_last": float(np.mean((np.abs(fused) <= 2 * sigma)[-1][known[-1]])),
        "milliseconds": report.spread(np.concatenate([one.milliseconds for one in records])),
    }
    for name in ("switches", "split", "births", "lost"):
        result[name] = sum(getattr(one, name) for one in records)
    return result


def line(name: str, row: dict[str, Any]) -> dict[str, str]:
    """A row of the table."""
    errors, ms = row["error"], row["milliseconds"]
    return {
        "row": name,
        **{f"frame {k}, %": f"{100 * errors[str(k)]:.2f}" if str(k) in errors else "" for k in SHOWN},
        "single, %": f"{100 * row['single']:.2f}",
        "its bias, %": f"{100 * row['bias']:.2f}",
        "2 sigma, % all / last frame": f"{100 * row['within_2_sigma']:.0f} / {100 * row['within_2_sigma_last']:.0f}",
        "switches (split)": f"{row['switches']} ({row['split']})",
        "births": str(row["births"]),
        "lost": str(row["lost"]),
        "ms": f"{ms['median']:.1f} / {ms['p95']:.1f}",
    }


def run(row: Row, count: int, frames: int, seed: int) -> dict[str, list[Record]]:
    """All scenes of a row, with both kinds of masks."""
    recoverer = Recoverer()
    kept: dict[str, list[Record]] = {masks: [] for masks in MASKS}
    for number, shown in enumerate(scenes(count, seed)):
        recoverer.warm_up(shown.camera)
        records = {masks: Record(frames) for masks in MASKS}
        for k, view in enumerate(views(shown, row, frames, np.random.default_rng([seed, number, 1]))):
            for masks, record in records.items():
                labels = view.labels if masks == "given" else None
                record.follow(k, view, recoverer.recover(view.depth, shown.camera, labels))
        for masks in MASKS:
            kept[masks].append(records[masks])
    return kept


def _fits(shown: Scene) -> bool:
    """Whether all bodies are within RANGE and their middles well inside the image."""
    away = np.linalg.norm(shown.bodies.translation, axis=-1)
    pixels, margin = shown.camera.project(shown.bodies.translation), 60
    inside = (pixels > margin) & (pixels < [shown.camera.width - margin, shown.camera.height - margin])
    return bool((away > RANGE[0]).all() and (away < RANGE[1]).all() and inside.all())


def owners(labels: np.ndarray, found: FrameRecovery) -> tuple[dict[int, int], set[int]]:
    """For each body the recovery that is its own, and the bodies that two segments or more have a part of."""
    owner, best, pieces = {}, np.full(BODIES, _MATCH), np.zeros(BODIES, dtype=int)
    area = np.bincount(labels.ravel(), minlength=BODIES + 1)[1:]
    for index, one in enumerate(found.recovered):
        mask = found.labels == one.label
        shared = np.bincount(labels[mask], minlength=BODIES + 1)[1:]
        pieces += shared > _PIECE * area
        iou = shared / np.maximum(area + mask.sum() - shared, 1)
        j = int(iou.argmax())
        if iou[j] > best[j]:
            owner[j], best[j] = index, iou[j]
    return owner, set(np.flatnonzero(pieces > 1).tolist())


def main() -> None:
    parser = report.parser(__doc__, "tracking")
    parser.add_argument("--scenes", type=int, default=2)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rows", nargs="+", choices=tuple(ROWS), default=tuple(ROWS))
    options = parser.parse_args()
    report.pin()
    cv2.setNumThreads(1)
    known = report.previous(options.name, "rows") if len(options.rows) < len(ROWS) else {}
    for name in options.rows:
        for masks, records in run(ROWS[name], options.scenes, options.frames, options.seed).items():
            known[f"{name}, {masks}"] = figures(records)
            print(" | ".join(line(f"{name}, {masks}", known[f"{name}, {masks}"]).values()), flush=True)
    order = [f"{name}, {masks}" for name in ROWS for masks in MASKS]
    known = {name: known[name] for name in order if name in known}
    table = report.table_of([line(name, row) for name, row in known.items()])
    report.write(options.name, {"options": vars(options), "rows": known}, table)


if __name__ == "__main__":
    main()
