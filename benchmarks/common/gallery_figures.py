"""Figures of the gallery: what the sensor saw, what was recovered of each thing, and both in space.

A body belongs to the thing with which the sum of all IoU is largest.  True things are thin lines, recovered bodies
shaded; pictures are written with few colours, as noise does not compress.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from PIL import Image
from scipy.optimize import linear_sum_assignment

from common.hull_columns import Columns
from common.tabletop import Placed, Tabletop
from sq_perception.evaluation.plots import (
    colour,
    draw_bodies_3d,
    draw_depth,
    draw_masks,
    draw_outlines,
    heading_of,
    new_figure,
    save,
    window_of,
)
from sq_perception.recovery.recoverer import FrameRecovery, Recovery

SENSORS = {"realsense_d435": "stereo, RealSense D435", "kinect_v1": "structured light, Kinect v1"}
DOTS = 100
COLOURS = 224
_ELEVATION = 24.0
"""Degrees, of the pictures of bodies."""
_BEFORE, _BEHIND = 0.05, 0.08
"""Metres that the scale of depths is longer than the things."""
_SEGMENTS = 64


@dataclass(frozen=True, eq=False)
class MatchedThing:
    """A thing and its body; None where nothing was recovered of it."""

    placed: Placed
    body: Recovery | None
    iou: float


def matched(view: Tabletop, frame: FrameRecovery) -> list[MatchedThing]:
    """Each thing with its body."""
    iou = np.zeros((len(view.placed), len(frame.recovered)))
    for k, placed in enumerate(view.placed):
        columns = Columns.of(placed.hull)
        iou[k] = [columns.iou(body.superquadric) for body in frame.recovered]
    rows, chosen = linear_sum_assignment(-iou)
    pairs = {k: j for k, j in zip(rows, chosen, strict=True) if iou[k, j] > 0}
    return [
        MatchedThing(placed, frame.recovered[pairs[k]], float(iou[k, pairs[k]]))
        if k in pairs
        else MatchedThing(placed, None, 0.0)
        for k, placed in enumerate(view.placed)
    ]


def scene_figure(view: Tabletop, frame: FrameRecovery, azimuth: float) -> Figure:
    """The three panels of one scene."""
    figure = new_figure(12.15, 3.55)
    axes = figure.subplots(1, 3, gridspec_kw={"wspace": 0.028, "width_ratios": [4, 4, 3]})
    figure.subplots_adjust(left=0.004, right=0.996, top=0.925, bottom=0.012)
    bodies = [body.superquadric for body in frame.recovered]
    shades = [colour(k) for k in range(len(bodies))]
    window = window_of([], view.camera, np.argwhere(view.labels)[:, ::-1].astype(float))
    near, far = np.nanquantile(view.depth[view.labels > 0], (0.005, 0.995))
    for ax in axes[:2]:
        draw_depth(ax, view.depth, (near - _BEFORE, far + _BEHIND), window)
    draw_masks(axes[1], frame.labels, [body.label for body in frame.recovered], 0.5)
    draw_outlines(axes[1], bodies, view.camera, shades, width=1.5)
    heading_of(axes[0], "Depth", SENSORS[view.sensor])
    heading_of(axes[1], "Own masks, recovered outlines", f"{len(bodies)} bodies" if len(bodies) != 1 else "1 body")
    cages = [line for placed in view.placed for line in _cage(placed)]
    draw_bodies_3d(
        axes[2], bodies, plane=view.plane, colours=shades, elevation=_ELEVATION, azimuth=azimuth, wires=cages
    )
    heading_of(axes[2], "From the right", "thin lines: the true things")
    return figure


def _cage(placed: Placed) -> list[np.ndarray]:
    """Lines (n, 3) in the optical frame that show a thing: edges of a box, rims and sides of a body of revolution."""
    thing = placed.thing
    lines: list[np.ndarray] = []
    low, high = thing.hull.min(axis=0), thing.hull.max(axis=0)
    if thing.kind == "box":
        corners = np.array(list(product(*zip(low, high, strict=True))))
        lines = [corners[[i, j]] for i in range(8) for j in range(i) if np.isclose(corners[i], corners[j]).sum() == 2]
    else:
        vertices = np.asarray(thing.mesh.vertices)
        radius, height = np.hypot(vertices[:, 0], vertices[:, 1]), vertices[:, 2]
        outside = radius > 1e-6
        order = np.unique(np.round(np.stack([height, radius], 1)[outside], 6), axis=0)
        angle = np.linspace(0, 2 * np.pi, _SEGMENTS + 1)
        ring = np.stack([np.cos(angle), np.sin(angle)], 1)
        for z, r in _rims(order):
            lines.append(np.column_stack([r * ring, np.full(len(ring), z)]))
        for direction in ring[: -1 : _SEGMENTS // 4]:
            lines.append(np.column_stack([order[:, 1:] * direction, order[:, 0]]))
    return [line @ placed.rotation.T + placed.translation for line in lines]


def _rims(profile: np.ndarray) -> list[tuple[float, float]]:
    """Height and radius of the rims of a profile (n, 2) of both: below, above, and where the neck begins and ends."""
    height, radius = profile.T
    wide = radius > 0.99 * radius.max()
    rims = [(height.min(), radius[wide][0]), (height[wide].max(), radius.max())]
    if radius[-1] < 0.7 * radius.max():
        narrow = radius < 1.01 * radius[-1]
        rims += [(height[narrow & (height > height[wide].max())].min(), radius[-1])]
    rims.append((height.max(), radius[height > height.max() - 1e-3].max()))
    return [(float(z), float(r)) for z, r in rims]


def write_picture(figure: Figure, path: Path) -> int:
    """Write a figure with few colours, since noise does not compress; returns its bytes."""
    save(figure, path, DOTS)
    Image.open(path).convert("RGB").quantize(COLOURS, kmeans=2, dither=Image.Dither.NONE).save(path, optimize=True)
    return path.stat().st_size
