"""Whether recorded depth lies within what simulated cameras make: edges, gaps and residuals of planes.

    python benchmarks/camera_spread.py [--scenes 60] [--first 70000] [--name camera_spread]

Recorded are the frames of mosd_learn (Kinect v1) and frames (RealSense, Kinect) with masks of people; simulated are
scenes of :mod:`things_on_table`, each through a random sensor and random stages of
:mod:`sq_perception.simulation.camera_stages`.  Of each image, over its things:

| figure | what |
| --- | --- |
| gaps beside | missing readings within 8 pixels around masks, % |
| gaps on | missing readings within masks, 3 pixels from their borders and more, % |
| smear | measured pixels of a row between 15 and 85 % of a step in depth of 50 mm and more, at borders of masks |
| lost edge | missing pixels of a row there |
| correlation 1, 4 | of the residuals of planes through 16 x 16 pixels beside things, one and four columns apart |

A step is taken between the pixels 8 before and 8 behind the border.
"""

from __future__ import annotations

if __name__ == "__main__":
    from common import one_thread  # noqa: F401

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from common import report

from sq_perception.simulation.camera_stages import draw_stages
from sq_perception.simulation.thing_views import measure_by_any
from sq_perception.simulation.things_on_table import things_on_table

FIGURES = ("gaps beside", "gaps on", "smear", "lost edge", "correlation 1", "correlation 4")
FOLDERS = ("mosd_learn", "frames")
SPREAD = (5, 50, 95)
REACH, STEP, WINDOW = 8, 0.05, 16
INNER, OUTER = 0.15, 0.85


def figures(depth: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """The figures (6,) of an image, in the order of FIGURES; NaN where nothing shows one."""
    missing, thing = np.isnan(depth), labels > 0
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * REACH + 1, 2 * REACH + 1))
    beside = (cv2.dilate(thing.view(np.uint8), disc) > 0) & ~thing
    on = cv2.erode(thing.view(np.uint8), np.ones((7, 7), np.uint8)) > 0
    return np.array(
        [100 * _mean(missing[beside]), 100 * _mean(missing[on]), *_edges(depth, labels), *_planes(depth, labels)]
    )


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if values.size else np.nan


def _edges(depth: np.ndarray, labels: np.ndarray) -> tuple[float, float]:
    """Mean numbers of pixels between both sides of steps at borders, and of missing ones."""
    rows, columns = np.nonzero((labels[:, 1:] == 0) != (labels[:, :-1] == 0))
    inside = (columns >= REACH) & (columns + REACH + 1 < depth.shape[1])
    rows, columns = rows[inside], columns[inside]
    across = depth[rows[:, None], columns[:, None] + np.arange(1 - REACH, REACH + 1)]
    near, far = across[:, :1], across[:, -1:]
    stepped = (np.abs(far - near) > STEP)[:, 0]  # NaN is no step
    share = (across[stepped] - near[stepped]) / (far - near)[stepped]
    between = (share > INNER) & (share < OUTER)
    return _mean(between.sum(axis=1)), _mean(np.isnan(share).sum(axis=1))


def _planes(depth: np.ndarray, labels: np.ndarray) -> tuple[float, float]:
    """Correlations of residuals one and four columns apart."""
    down, across = np.mgrid[:WINDOW, :WINDOW].reshape(2, -1)
    basis = np.linalg.qr(np.column_stack([np.ones(WINDOW * WINDOW), down, across]))[0]
    found = []
    for v in range(0, depth.shape[0] - WINDOW, WINDOW):
        for u in range(0, depth.shape[1] - WINDOW, WINDOW):
            window = np.s_[v : v + WINDOW, u : u + WINDOW]
            if labels[window].any() or np.isnan(depth[window]).any():
                continue
            w = 1 / depth[window].astype(float).ravel()
            rest = (w - basis @ (basis.T @ w)).reshape(WINDOW, WINDOW)
            variance = np.mean(rest**2)
            if 1e-7 < np.sqrt(variance) < 0.01:  # no plane without noise, and no edge
                found.append([np.mean(rest[:, k:] * rest[:, :-k]) / variance for k in (1, 4)])
    one, four = np.median(found, axis=0) if found else (np.nan, np.nan)
    return float(one), float(four)


def simulated(seeds: range) -> Iterator[np.ndarray]:
    for seed in seeds:
        rng = np.random.default_rng(seed)
        scene = things_on_table(rng)
        depth = measure_by_any(scene.depth, scene.labels > 0, scene.camera, draw_stages(rng), rng)
        yield figures(depth, scene.labels)


def recorded() -> Iterator[tuple[str, np.ndarray]]:
    for folder in FOLDERS:
        path = report.shared_data(folder)
        for file in sorted(path.glob("*.npz")) if path is not None else ():
            frame = np.load(file)
            source = "mosd" if folder == "mosd_learn" else file.stem.partition("_")[0]
            yield source, figures(frame["depth"], frame["labels"].astype(np.int32))


def main() -> None:
    parser = report.parser(__doc__, "camera_spread")
    parser.add_argument("--scenes", type=int, default=60, help="number of simulated scenes")
    parser.add_argument("--first", type=int, default=70000, help="seed of the first one")
    options = parser.parse_args()
    made = np.array(list(simulated(range(options.first, options.first + options.scenes))))
    real = list(recorded())
    sources = sorted({source for source, _ in real})
    by_source = {source: np.array([each for name, each in real if name == source]) for source in sources}
    low, middle, high = np.nanpercentile(made, SPREAD, axis=0)
    result: dict[str, Any] = {}
    rows = []
    for k, name in enumerate(FIGURES):
        inside = _mean(
            np.concatenate([(each[:, k] >= low[k]) & (each[:, k] <= high[k]) for each in by_source.values()])
        )
        medians = {source: float(np.nanmedian(each[:, k])) for source, each in by_source.items()}
        result[name] = {"simulated": [low[k], middle[k], high[k]], **medians, "within": inside}
        shown = {f"{source} ({len(by_source[source])})": f"{value:.2f}" for source, value in medians.items()}
        spread = f"{low[k]:.2f} / {middle[k]:.2f} / {high[k]:.2f}"
        rows.append(
            {"figure": name, "simulated, 5 / 50 / 95 %": spread, **shown, "frames within, %": f"{100 * inside:.0f}"}
        )
    report.write(options.name, {"scenes": options.scenes, "first": options.first, **result}, report.table_of(rows))


if __name__ == "__main__":
    main()
