"""The pictures of docs/gallery.md, and that page itself: synthetic scenes, what was recovered, and how far off it is.

    python benchmarks/gallery.py [--only can bottles] [--docs docs]

Every scene is household things (:mod:`household`) at given places on a table, through a simulated sensor; the moving
camera is that of :mod:`tracking`.  Left, what the sensor saw; in the middle, the program's own masks with the outlines
of the recovered bodies; right, these bodies from another place, with the true things as thin lines.  All numbers of the
page are measured here, so that text and pictures agree; ``--only`` draws some pictures and leaves the page as it is.

Edges are full ones, descending, those of a thing and those of its body; deviations belong to edges, so that they are
twice those of half sizes.  IoU is that of volumes with the thing's convex hull.  A body belongs to the thing with which
the sum of all IoU is largest.
"""

from __future__ import annotations

import argparse
import os
import textwrap

if __name__ == "__main__":  # as a script only: a process that imports this has threads already
    for variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(variable, "1")

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import household
import mesh_scene
import numpy as np
import report
import tabletop
import tracking
from household import Thing
from hull_oracle import Columns
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from PIL import Image
from scipy.optimize import linear_sum_assignment

from sq_perception.evaluation.plots import (
    INK,
    WIRE,
    colour,
    draw_bodies_3d,
    draw_depth,
    draw_masks,
    draw_outlines,
    new_figure,
    picture_axes,
    save,
)
from sq_perception.fitting.fit import Status
from sq_perception.geometry import Superquadric
from sq_perception.geometry import rotation as quaternions
from sq_perception.imaging import sensor_noise
from sq_perception.imaging.camera import Camera
from sq_perception.imaging.scene import plane_depth
from sq_perception.recovery import FrameRecovery, Recoverer, Recovery
from sq_perception.tracking.session import Followed, TrackingSession

SENSORS = {"realsense_d435": "stereo, RealSense D435", "kinect_v1": "structured light, Kinect v1"}
DOTS = 100
COLOURS = 224
ASPECT = 1.28
"""Width over height of a panel with an image."""
TRACKED = (1, 10, 30)
TRACKED_SCENE = 2
TRACKED_WINDOW = (70.0, 550.0, 40.0, 440.0)
"""Left, right, top, bottom of what is shown of these frames, pixels."""
WRAPPED: dict[str, Any] = {"break_long_words": False, "break_on_hyphens": False}
_FAINT = "#6b7885"
_MARGIN = 30
_BEFORE, _BEHIND = 0.05, 0.08
_SEGMENTS = 64
_CONTACT = 3e-4


# Scenes


@dataclass(frozen=True, eq=False)
class Stood:
    """A thing on a table: its middle there (to the right, away from the camera), metres, and its heading, degrees."""

    name: str
    thing: Thing
    place: tuple[float, float]
    heading: float = 0.0
    turn: np.ndarray = field(default_factory=lambda: household.UPRIGHT)


@dataclass(frozen=True, eq=False)
class View:
    """A composed scene through a sensor.

    Attributes
    ----------
    depth, labels : (height, width)
        As measured; true things from 1, 0 elsewhere.
    plane : (4,)
        The true table.
    things
        Name and thing, in the order of labels.
    poses
        Rotation (3, 3) and translation (3,), camera from thing.
    visible
        Share of each thing's pixels that nothing hides.
    """

    camera: Camera
    sensor: str
    depth: np.ndarray
    labels: np.ndarray
    plane: np.ndarray
    things: tuple[Stood, ...]
    poses: tuple[tuple[np.ndarray, np.ndarray], ...]
    visible: np.ndarray

    def hull(self, k: int) -> np.ndarray:
        rotation, translation = self.poses[k]
        return self.things[k].thing.hull @ rotation.T + translation


def viewed(things: Sequence[Stood], sensor: str, down: float = 40.0, distance: float = 0.75, seed: int = 0) -> View:
    """Things on a table whose middle is ``distance`` metres away, looked down on by ``down`` degrees.

    Raises
    ------
    ValueError
        If two things are in one place, as seen from above.
    """
    camera, angle = mesh_scene.CAMERA, np.deg2rad(down)
    table = np.array([[1.0, 0, 0], [0, -np.sin(angle), -np.cos(angle)], [0, np.cos(angle), -np.sin(angle)]])
    origin = np.array([0.0, 0.0, distance])
    plane = np.append(table[:, 2], -table[:, 2] @ origin)
    depth = plane_depth(plane, camera)
    labels = np.zeros(depth.shape, np.int32)
    poses, alone = [], []
    outlines: list[np.ndarray] = []
    for k, each in enumerate(things):
        c, s = np.cos(np.deg2rad(each.heading)), np.sin(np.deg2rad(each.heading))
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]) @ each.turn
        corners = each.thing.hull @ turn.T
        low, high = corners.min(axis=0), corners.max(axis=0)
        place = np.append(each.place, 0.0) - np.append((low + high)[:2] / 2, low[2])
        outlines.append(tabletop.outline(corners + place))
        if any(tabletop.gap(outlines[-1], other) < -_CONTACT for other in outlines[:-1]):
            raise ValueError(f"{each.name}: stands where another thing is")
        rotation, translation = table @ turn, table @ place + origin
        vertices = each.thing.mesh.vertices @ rotation.T + translation
        own = mesh_scene.render(vertices, np.asarray(each.thing.mesh.faces), camera)
        nearer = own < depth
        depth, labels = np.where(nearer, own, depth), np.where(nearer, np.int32(k + 1), labels)
        poses.append((rotation, translation))
        alone.append(np.isfinite(own).sum())
    visible = np.bincount(labels.ravel(), minlength=len(things) + 1)[1:] / np.maximum(alone, 1)
    measured = sensor_noise.preset(sensor).measured(depth, camera, np.random.default_rng(seed))
    return View(camera, sensor, measured, labels, plane, tuple(things), tuple(poses), visible)


def carton(width: float, depth: float, height: float) -> Thing:
    """A box with these edges along x, y and z, millimetres, rounded by 2 mm; none need be the shortest."""
    return household.rounded_box(np.array([width, depth, height]) / 1e3, 0.002)


def can(diameter: float, height: float) -> Thing:
    return household.cylinder(diameter / 1e3, height / 1e3, 0.002)


def bottle(number: int) -> Thing:
    return household.bottle(np.random.default_rng(number))


def kitchen() -> tuple[Stood, ...]:
    """Six things that hide each other."""
    return (
        Stood("cereal box", carton(190, 60, 270), (-0.06, 0.19), 12),
        Stood("can", can(75, 110), (-0.11, 0.06)),
        Stood("small box", carton(85, 60, 45), (0.0, -0.05), 35),
        Stood("tall can", can(66, 160), (0.115, 0.09)),
        Stood("carton", carton(70, 95, 120), (0.2, 0.2), -20),
        Stood("lying can", can(66, 115), (-0.22, -0.06), 60, household.ON_X),
    )


# Pictures


@dataclass(frozen=True, eq=False)
class Found:
    """A thing and its body; None where nothing was recovered of it.  ``labels`` is the frame's true label image."""

    stood: Stood
    labels: np.ndarray
    visible: float
    body: Recovery | None
    iou: float


@cache
def recoverer() -> Recoverer:
    return Recoverer()


def matched(view: View, frame: FrameRecovery) -> list[Found]:
    """Each thing with its body."""
    iou = np.zeros((len(view.things), len(frame.recovered)))
    for k in range(len(view.things)):
        columns = Columns.of(view.hull(k))
        iou[k] = [columns.iou(body.superquadric) for body in frame.recovered]
    rows, chosen = linear_sum_assignment(-iou)
    pairs = {k: j for k, j in zip(rows, chosen, strict=True) if iou[k, j] > 0}
    return [
        Found(
            stood,
            view.labels,
            float(view.visible[k]),
            frame.recovered[pairs[k]] if k in pairs else None,
            float(iou[k, pairs[k]]) if k in pairs else 0.0,
        )
        for k, stood in enumerate(view.things)
    ]


def scene_figure(view: View, frame: FrameRecovery, azimuth: float = 35.0, elevation: float = 24.0) -> Figure:
    """The three panels of one scene."""
    figure = new_figure(11.8, 3.55)
    axes = figure.subplots(1, 3, gridspec_kw={"wspace": 0.028, "width_ratios": [ASPECT, ASPECT, 1.0]})
    figure.subplots_adjust(left=0.004, right=0.996, top=0.925, bottom=0.012)
    bodies = [body.superquadric for body in frame.recovered]
    shades = [colour(k) for k in range(len(bodies))]
    window = _window(view)
    limits = _limits(view)
    for ax in axes[:2]:
        draw_depth(ax, view.depth, limits)
    draw_masks(axes[1], frame.labels, [body.label for body in frame.recovered], 0.5)
    draw_outlines(axes[1], bodies, view.camera, shades, width=1.5)
    for ax in axes[:2]:
        ax.set_xlim(window[0], window[1])
        ax.set_ylim(window[3], window[2])
    _title(axes[0], "Depth", SENSORS[view.sensor])
    _title(axes[1], "Own masks, recovered outlines", f"{len(bodies)} bodies" if len(bodies) != 1 else "1 body")
    cages = [line for k in range(len(view.things)) for line in _cage(view, k)]
    around = [_box_around(view, k) for k in range(len(view.things))]
    draw_bodies_3d(
        axes[2], bodies, plane=view.plane, colours=shades, elevation=elevation, azimuth=azimuth, enclosed=around
    )
    _draw_lines(axes[2], cages, picture_axes(elevation, azimuth, view.plane))
    _title(axes[2], "From the right", "thin lines: the true things")
    return figure


def empty_figure(views: Sequence[View]) -> Figure:
    """What each sensor makes of a table with nothing on it."""
    figure = new_figure(11.62, 2.42)
    axes = figure.subplots(1, len(views), gridspec_kw={"wspace": 0.025})
    figure.subplots_adjust(left=0.004, right=0.996, top=0.9, bottom=0.012)
    for ax, view in zip(axes, views, strict=True):
        frame = recoverer().recover(view.depth, view.camera)
        draw_depth(ax, view.depth)
        draw_masks(ax, frame.labels, [body.label for body in frame.bodies])
        missing = 100 * (1 - np.isfinite(view.depth).mean())
        _title(ax, f"{view.sensor}: {len(frame.bodies)} bodies", f"{missing:.0f} % missing")
    return figure


def _window(view: View) -> tuple[float, float, float, float]:
    """Left, right, top, bottom of the part of the image with the things, in the proportions of a panel."""
    rows, columns = np.nonzero(view.labels)
    low = np.array([columns.min(), rows.min()], dtype=float) - _MARGIN
    high = np.array([columns.max(), rows.max()], dtype=float) + _MARGIN
    half = max((high - low)[1] / 2, (high - low)[0] / 2 / ASPECT) * np.array([ASPECT, 1.0])
    limit = np.array([view.camera.width, view.camera.height]) / 2
    half = half * min(1.0, float((limit / half).min()))
    middle = np.clip((low + high) / 2, half - 0.5, 2 * limit - 0.5 - half)
    return middle[0] - half[0], middle[0] + half[0], middle[1] - half[1], middle[1] + half[1]


def _limits(view: View) -> tuple[float, float]:
    """Nearest and farthest depth of the scale: those of the things, and a little behind them."""
    near, far = np.nanquantile(view.depth[view.labels > 0], (0.005, 0.995))
    return float(near) - _BEFORE, float(far) + _BEHIND


def _title(ax: Axes, text: str, detail: str) -> None:
    ax.set_title(text, loc="left", fontsize=10.5, color=INK, pad=4)
    ax.set_title(detail, loc="right", fontsize=8.5, color=_FAINT, pad=4)


def _box_around(view: View, k: int) -> Superquadric:
    """A thing's box in its own frame."""
    hull, (rotation, translation) = view.things[k].thing.hull, view.poses[k]
    low, high = hull.min(axis=0), hull.max(axis=0)
    middle = rotation @ ((low + high) / 2) + translation
    return Superquadric((high - low) / 2, np.full(2, 0.1), middle, quaternions.from_matrix(rotation))


def _cage(view: View, k: int) -> list[np.ndarray]:
    """Lines (n, 3) in the optical frame that show a thing: edges of a box, rims and sides of a body of revolution."""
    thing = view.things[k].thing
    rotation, translation = view.poses[k]
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
    return [line @ rotation.T + translation for line in lines]


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


def _draw_lines(ax: Axes, lines: Sequence[np.ndarray], view: np.ndarray) -> None:
    flat = [(line @ view.T)[:, :2] for line in lines]
    ax.add_collection(LineCollection(flat, colors=[WIRE], linewidths=0.7, zorder=6), autolim=False)


def write_picture(figure: Figure, path: Path) -> int:
    """Write a figure with few colours, since noise does not compress; returns its bytes."""
    save(figure, path, DOTS)
    Image.open(path).convert("RGB").quantize(COLOURS, kmeans=2, dither=Image.Dither.NONE).save(path, optimize=True)
    return path.stat().st_size


# Tables


HEADER = ["thing", "visible", "true edges, mm", "recovered, mm", "seen", "IoU", "score", "status"]


def table(found: Sequence[Found], frame: FrameRecovery) -> str:
    """A line for each thing, and for each body that belongs to none."""
    lines = [_line(one) for one in found]
    lines += [["none", "", "", *_numbers(body), "", *_verdict(body)] for body in _surplus(found, frame)]
    return report.table(HEADER, lines)


def _surplus(found: Sequence[Found], frame: FrameRecovery) -> list[Recovery]:
    taken = {one.body.label for one in found if one.body is not None}
    return [body for body in frame.recovered if body.label not in taken]


def _line(one: Found) -> list[str]:
    true = " x ".join(f"{1e3 * edge:.0f}" for edge in one.stood.thing.edges[::-1])
    start = [one.stood.name, f"{100 * one.visible:.0f} %", true]
    if one.body is None:
        return [*start, "nothing", "", "0 %", "", ""]
    return [*start, *_numbers(one.body), f"{100 * one.iou:.0f} %", *_verdict(one.body)]


def _numbers(body: Recovery) -> list[str]:
    order = np.argsort(-body.superquadric.size)
    edges, sigma = 2e3 * body.superquadric.size[order], 2e3 * body.sigma_size[order]
    return [
        " x ".join(f"{edge:.0f} ± {deviation:.0f}" for edge, deviation in zip(edges, sigma, strict=True)),
        " / ".join(f"{100 * share:.0f}" for share in body.seen[order]) + " %",
    ]


def _verdict(body: Recovery) -> list[str]:
    return [f"{body.score:.2f}", Status(body.status).name.lower()]


def mean_iou(found: Sequence[Found]) -> float:
    """Per cent."""
    return 100 * float(np.mean([one.iou for one in found]))


# The page


@dataclass(frozen=True)
class Entry:
    """A part of the page: what stands above the picture, in its place, and below."""

    title: str
    text: str
    below: str = ""


def of_scene(
    title: str,
    things: Sequence[Stood],
    text: Callable[[list[Found], FrameRecovery], str],
    sensor: str = "realsense_d435",
    azimuth: float = 35.0,
    **where: float,
) -> Callable[[Path], Entry]:
    """A picture of three panels with its table."""

    def draw(path: Path) -> Entry:
        view = viewed(things, sensor, **where)
        frame = recoverer().recover(view.depth, view.camera)
        found = matched(view, frame)
        write_picture(scene_figure(view, frame, azimuth), path)
        return Entry(title, text(found, frame), table(found, frame))

    return draw


def _can(found: list[Found], frame: FrameRecovery) -> str:
    (one,) = found
    return (
        f"A can of {_edges(one)} mm. The camera never sees its back: that comes from the silhouette and the curvature "
        f"of the front, the foot from the table. IoU with the true can {100 * one.iou:.0f} %."
    )


def _kitchen(found: list[Found], frame: FrameRecovery) -> str:
    hidden = min(found, key=lambda one: one.visible)
    return (
        f"Six things that stand before each other, the {hidden.stood.name} {100 * hidden.visible:.0f} % visible. "
        f"{_count(found, frame)} Mean IoU with the true hulls {mean_iou(found):.0f} %. Stereo matches windows, which "
        f"widens what is near by some pixels: edges are off by {_bias(found):+.1f} mm in the mean."
    )


def _kitchen_light(found: list[Found], frame: FrameRecovery) -> str:
    light, stereo = (1e3 * float(sensor_noise.preset(name).sigma(0.85)) for name in ("kinect_v1", "realsense_d435"))
    return (
        f"The same table through structured light, with a noise of {light:.1f} mm at 0.85 m where stereo has "
        f"{stereo:.1f}. {_count(found, frame)} Mean IoU {mean_iou(found):.0f} %, edges off by {_bias(found):+.1f} mm "
        f"in the mean."
    )


def _touching(found: list[Found], frame: FrameRecovery) -> str:
    return (
        f"Three boxes and a can, each touching another. {_count(found, frame)} What parts them are folds in the depth, "
        f"and lines of sight that pass through the empty space between them. Mean IoU {mean_iou(found):.0f} %."
    )


def _bottles(found: list[Found], frame: FrameRecovery) -> str:
    worst = min(found, key=lambda one: one.iou)
    return (
        f"Here we lose. A bottle is no superquadric: no exponents make a shoulder and a neck. One body leaves out the "
        f"neck, or bottle and neck become two. {_count(found, frame)} Mean IoU {mean_iou(found):.0f} %, the worst "
        f"{100 * worst.iou:.0f} % ({worst.stood.name})."
    )


def _hidden(found: list[Found], frame: FrameRecovery) -> str:
    one = next(each for each in found if each.stood.name == "hidden box")
    if one.body is None:
        return "A box behind another one. Nothing was recovered of the hidden one."
    order = np.argsort(-one.body.superquadric.size)
    seen, sigma = 100 * one.body.seen[order], 2e3 * one.body.sigma_size[order]
    edges, true = 2e3 * one.body.superquadric.size[order], 1e3 * one.stood.thing.edges[::-1]
    parts = [
        f"{name} edge {seen[k]:.0f} % measured, {edges[k]:.0f} ± {sigma[k]:.0f} mm, truly {true[k]:.0f}"
        for k, name in enumerate(("longest", "middle", "shortest"))
    ]
    return (
        f"A box of which another one hides {100 * (1 - one.visible):.0f} %. `Recovery.seen` says how much of each edge "
        f"was measured, the rest is inferred; `sigma_size` says how surely: {'; '.join(parts)}. Status "
        f"`{Status(one.body.status).name}`, message: {one.body.message}."
    )


def _edges(one: Found) -> str:
    return " x ".join(f"{1e3 * edge:.0f}" for edge in one.stood.thing.edges)


def _count(found: list[Found], frame: FrameRecovery) -> str:
    missed = [one.stood.name for one in found if one.body is None]
    matched_bodies = sum(one.body is not None for one in found)
    extra = len(frame.recovered) - matched_bodies
    text = f"{matched_bodies} of {len(found)} things have a body"
    text += f" (none: {', '.join(missed)})" if missed else ""
    return text + (f", and there are {extra} bodies too many{_where(found, frame)}." if extra else ", none too many.")


def _where(found: list[Found], frame: FrameRecovery) -> str:
    """What the surplus bodies are pieces of."""
    names = set()
    for body in _surplus(found, frame):
        pixels = np.bincount(found[0].labels[frame.labels == body.label], minlength=len(found) + 1)
        names.add(found[int(pixels[1:].argmax())].stood.name if pixels[1:].any() else "table")
    return f", pieces of {' and '.join(sorted(names))}" if names else ""


def _bias(found: list[Found]) -> float:
    """Recovered minus true edges, mean, millimetres."""
    errors = [
        2e3 * np.sort(one.body.superquadric.size) - 1e3 * one.stood.thing.edges for one in found if one.body is not None
    ]
    return float(np.mean(errors))


def empty(path: Path) -> Entry:
    """A table with nothing on it through every sensor."""
    views = [viewed((), name) for name in sensor_noise.PRESETS]
    frames = [recoverer().recover(view.depth, view.camera) for view in views]
    write_picture(empty_figure(views), path)
    number = sum(len(frame.bodies) for frame in frames)
    reasons = " / ".join(sorted({frame.message for frame in frames if frame.message}))
    return Entry(
        "An empty table",
        f"Nothing stands on it. Bodies found through {len(views)} sensors together: {number}. `FrameRecovery.message`: "
        f"{reasons or 'empty'}.",
    )


def tracked(path: Path) -> Entry:
    """Sizes of tracked bodies and their deviations over 30 frames of a camera that goes about a table."""
    *_, shown = tracking.scenes(TRACKED_SCENE + 1, 1)
    row = tracking.Row(sensor_noise.preset("realsense_d435"), tracking.ARC)
    session = TrackingSession()
    kept: dict[int, tuple[tracking.View, FrameRecovery, tuple[Followed, ...]]] = {}
    count = len(shown.bodies.size)
    error, sigma, single = np.full((3, TRACKED[-1], count, 3), np.nan)
    for k, view in enumerate(tracking.views(shown, row, TRACKED[-1], np.random.default_rng(5))):
        camera = view.scene.camera
        frame = recoverer().recover(view.depth, camera)
        followed = session.follow(frame.recovered, k / tracking.RATE, view.pose, camera=camera, depth=view.depth)
        owner, _ = tracking.owners(view.labels, frame)
        for j, index in owner.items():
            truth = view.scene.bodies[j]
            relative, order = tracking.size_errors(followed[index].superquadric, truth)
            error[k, j] = 2e3 * relative * truth.size
            sigma[k, j] = 2e3 * followed[index].sigma_size[order]
            single[k, j] = 2e3 * tracking.size_errors(frame.recovered[index].superquadric, truth)[0] * truth.size
        if k + 1 in TRACKED:
            kept[k + 1] = view, frame, followed
    # The body whose first view tells least.
    chosen = int(np.nanargmax(np.where(np.isfinite(sigma[0]).all(axis=-1), sigma[0].max(axis=-1), np.nan)))
    axis = int(sigma[0, chosen].argmax())
    figure = new_figure(11.62, 2.62)
    grid = figure.add_gridspec(
        1, 2, width_ratios=[3, 1.02], wspace=0.075, left=0.004, right=0.99, top=0.905, bottom=0.085
    )
    axes = grid[0].subgridspec(1, len(kept), wspace=0.015).subplots()
    for ax, (k, (view, _, followed)) in zip(axes, kept.items(), strict=True):
        camera = view.scene.camera
        draw_depth(ax, view.depth)
        bodies = [one.superquadric for one in followed]
        draw_outlines(ax, bodies, camera, [colour(one.id - 1) for one in followed], width=1.5)
        ax.set_xlim(TRACKED_WINDOW[0], TRACKED_WINDOW[1])
        ax.set_ylim(TRACKED_WINDOW[3], TRACKED_WINDOW[2])
        _title(ax, f"Frame {k}", f"camera at {tracking.ARC * (k - 1) / (TRACKED[-1] - 1):.0f}°")
    course = figure.add_subplot(grid[1])
    _draw_course(course, error[:, chosen, axis], sigma[:, chosen, axis], single[:, chosen, axis])
    write_picture(figure, path)
    header = ["after frame", "mean error of edges, mm", "mean reported deviation, mm", "within 2 deviations"]
    rows = []
    for k in TRACKED:
        known = np.isfinite(error[k - 1]) & np.isfinite(sigma[k - 1])
        within = np.abs(error[k - 1][known]) <= 2 * sigma[k - 1][known]
        rows.append(
            [
                str(k),
                f"{np.abs(error[k - 1][known]).mean():.1f}",
                f"{sigma[k - 1][known].mean():.1f}",
                f"{100 * within.mean():.0f} % of {known.sum()}",
            ]
        )
    births = session.tally.births
    steps = ", ".join(f"{error[k - 1, chosen, axis]:+.1f} ± {sigma[k - 1, chosen, axis]:.1f}" for k in TRACKED)
    return Entry(
        "Thirty frames of a moving camera",
        f"{count} bodies, a stereo camera that goes {tracking.ARC:.0f} degrees about the table, its pose known, own "
        f"masks; ids given: {births}. Right, the edge of which the first frame knows least: its error is {steps} mm "
        f"after frames {', '.join(map(str, TRACKED))} (line: fused; dots: each frame by itself). What all views "
        f"share, such as edges widened by stereo, is not taken out by any number of frames.",
        report.table(header, rows),
    )


def _draw_course(ax: Axes, error: np.ndarray, sigma: np.ndarray, single: np.ndarray) -> None:
    frames = np.arange(1, len(error) + 1)
    ax.fill_between(frames, error - 2 * sigma, error + 2 * sigma, color="#2e86e4", alpha=0.15, lw=0)
    ax.fill_between(frames, error - sigma, error + sigma, color="#2e86e4", alpha=0.25, lw=0)
    ax.plot(frames, error, color="#2e86e4", lw=1.8)
    ax.plot(frames, single, ".", color=_FAINT, ms=4)
    ax.axhline(0, color=WIRE, lw=1.0)
    ax.set_xlim(1, len(error))
    ax.set_xticks(TRACKED)
    ax.tick_params(labelsize=8, colors=_FAINT, length=2, pad=2)
    for side in ("top", "right", "left", "bottom"):
        ax.spines[side].set_color("#cfd7de")
    _title(ax, "Error, mm", "± 1 and ± 2 deviations")


ENTRIES: dict[str, Callable[[Path], Entry]] = {
    "can": of_scene("One can", (Stood("can", can(75, 110), (0.0, 0.0)),), _can, distance=0.6),
    "household_stereo": of_scene("A table by stereo", kitchen(), _kitchen, distance=0.85),
    "household_structured_light": of_scene(
        "The same table by structured light", kitchen(), _kitchen_light, sensor="kinect_v1", distance=0.85
    ),
    "touching": of_scene(
        "Things that touch",
        (
            Stood("high box", carton(80, 60, 130), (-0.07, 0.03)),
            Stood("low box", carton(100, 80, 60), (0.0201, 0.02)),
            Stood("flat box", carton(90, 60, 35), (-0.045, -0.0562), 8),
            Stood("can", can(66, 100), (0.1035, 0.02)),
        ),
        _touching,
        distance=0.65,
    ),
    "bottles": of_scene(
        "Bottles",
        (
            Stood("bottle 1", bottle(1), (-0.13, 0.02)),
            Stood("bottle 2", bottle(4), (0.0, 0.08)),
            Stood("bottle 3", bottle(9), (0.1, -0.06), 35, household.ON_X),
        ),
        _bottles,
        down=32.0,
        distance=0.75,
    ),
    "half_hidden": of_scene(
        "Half hidden",
        (
            Stood("box in front", carton(150, 50, 160), (-0.06, -0.04), 4),
            Stood("hidden box", carton(190, 70, 90), (0.02, 0.08), 8),
        ),
        _hidden,
        azimuth=50.0,
        down=30.0,
        distance=0.65,
    ),
    "tracking": tracked,
    "empty_table": empty,
}

INTRODUCTION = """
Synthetic scenes with known truth, seen by simulated [sensors](sensors.md), and what
`Recoverer().recover(depth, camera)` makes of them: own masks, default options. Pictures, tables and numbers are those
of one run of `python benchmarks/gallery.py` ({facts}). The scenes were composed to show something;
for figures over many scenes see [the surface fit](surface_fit.md), [segmentation](segmentation.md) and
[tracking](tracking.md).

Left the depth image, near is light and black is nothing measured; in the middle masks and recovered outlines, hidden
edges faint; right the recovered bodies, and the true things as thin lines. Edges are full lengths, ± one reported
standard deviation. *Seen* is the share of each edge that the measured points span; the rest is inferred. IoU is that of
volumes with the true convex hull.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--only", nargs="+", choices=list(ENTRIES), help="draw these pictures, leave the page as it is")
    parser.add_argument("--docs", type=Path, default=Path(__file__).resolve().parents[1] / "docs")
    options = parser.parse_args()
    pictures = options.docs / "gallery"
    pictures.mkdir(parents=True, exist_ok=True)
    recoverer().warm_up(mesh_scene.CAMERA)
    facts = report.environment()
    introduction = INTRODUCTION.format(facts=f"{facts['date']}, commit {facts['commit']}")
    parts = ["# Gallery\n" + introduction]
    for name in options.only or ENTRIES:
        path = pictures / f"{name}.png"
        entry = ENTRIES[name](path)
        below = f"\n{entry.below}\n" if entry.below else ""
        text = textwrap.fill(entry.text, 120, **WRAPPED)
        parts.append(f"## {entry.title}\n\n![{entry.title}](gallery/{path.name})\n\n{text}\n{below}")
        print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB\n{entry.text}\n{entry.below}\n", flush=True)
    if not options.only:
        (options.docs / "gallery.md").write_text("\n".join(parts), encoding="utf-8")


if __name__ == "__main__":
    main()
