"""A picture of a scene of household things: depth, true hulls and recovered bodies from the camera and from above.

Green outlines are true hulls, red ones bodies with the masks given, blue ones bodies with the program's own.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import scene_verdict
from matplotlib.axes import Axes
from tabletop import Tabletop

from sq_perception.evaluation.plots import draw_depth, new_figure, save
from sq_perception.geometry import Superquadric
from sq_perception.geometry.mesh import mesh

TRUTH, GIVEN, OWN = "#3fd34a", "#e4572e", "#2e86e4"
_RESOLUTION = 24
_BESIDE = 25
"""Pixels beside the things."""
_DEEPER = 0.1


def save_picture(scene: Tabletop, folder: Path) -> Path:
    """Recover the scene with given and own masks and draw both; the file's name is the seed."""
    folder.mkdir(parents=True, exist_ok=True)
    recoverer = scene_verdict.recoverer()
    given = recoverer.recover(scene.depth, scene.camera, scene.labels)
    own = recoverer.recover(scene.depth, scene.camera)
    verdict = scene_verdict.judge(scene)
    rows, columns = np.nonzero(scene.labels)
    top, bottom, left, right = rows.min(), rows.max(), columns.min(), columns.max()
    shown = scene.true_depth[rows, columns]
    limits = (float(shown.min()), float(shown.max()) + _DEEPER)
    figure = new_figure(18.0, 7.4)
    axes = figure.subplots(1, 3, gridspec_kw={"wspace": 0.03, "width_ratios": [640, 640, 420]})
    figure.subplots_adjust(left=0.005, right=0.995, top=0.93, bottom=0.01)
    for ax, frame, colour, title in zip(axes, (given, own), (GIVEN, OWN), ("masks given", "own masks"), strict=False):
        draw_depth(ax, scene.depth, limits)
        ax.set_xlim(left - _BESIDE, right + _BESIDE)
        ax.set_ylim(bottom + _BESIDE, top - _BESIDE)
        ax.set_title(f"{scene.seed}, {scene.sensor}: {title}", loc="left", fontsize=11)
        for placed in scene.placed:
            _outline(ax, scene.camera.project(placed.hull), TRUTH)
        for body in frame.recovered:
            _outline(ax, scene.camera.project(_corners(body.superquadric)), colour)
    _above(axes[2], scene, [body.superquadric for body in given.recovered], verdict)
    return save(figure, folder / f"{scene.seed:04d}.png", 80)


def _above(ax: Axes, scene: Tabletop, bodies: list[Superquadric], verdict: scene_verdict.SceneVerdict) -> None:
    """Outlines on the table, seen from above, the camera below."""
    answers = {one.label: one.answers["given"] for one in verdict.judged}
    v, u = np.nonzero((scene.labels > 0) & np.isfinite(scene.depth))
    points = scene.camera.unproject(u[::5], v[::5], scene.depth[v[::5], u[::5]]) @ scene.table
    ax.scatter(points[:, 0], points[:, 1], s=0.4, color="#999999")
    for placed in scene.placed:
        flat = placed.hull @ scene.table
        _outline(ax, flat[:, :2], "black")
        answer = answers.get(placed.label)
        score = "tiny" if answer is None else f"{100 * answer.iou:.0f}"
        text = f"{placed.label} {placed.thing.name} {score}\n{100 * placed.visible_share:.0f} % visible"
        x, y = flat[:, :2].mean(axis=0)
        ax.text(x, y, text, fontsize=8, ha="center", va="center")
    for body in bodies:
        _outline(ax, (_corners(body) @ scene.table)[:, :2], GIVEN)
    hulls = np.vstack([placed.hull for placed in scene.placed]) @ scene.table
    low, high = hulls.min(axis=0) - _DEEPER / 3, hulls.max(axis=0) + _DEEPER / 3
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(low[1], high[1])
    ax.set_aspect("equal")
    ax.set_axis_off()


def _corners(body: Superquadric) -> np.ndarray:
    return np.asarray(mesh(body, _RESOLUTION).vertices)


def _outline(ax: Axes, points: np.ndarray, colour: str) -> None:
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 3:
        return
    corners = cv2.convexHull(points.astype(np.float32))[:, 0]
    ax.plot(*np.vstack([corners, corners[:1]]).T, color=colour, linewidth=1.2)
