"""What each method makes of one scene of household things, held against the truth.

| method | masks | what |
| --- | --- | --- |
| given | true | `Recoverer().recover(depth, camera, labels)` |
| own | its own | `Recoverer().recover(depth, camera)`; the body of the mask that agrees, or none |
| classic | true, eroded | Solina and Bajcsy's fit of the measured points |
| oriented box | true, eroded | the smallest box around the measured points |
| standing box | true, eroded | from the true table to the highest of them, over the smallest rectangle around all |

Masks agree with an IoU of at least 0.5 among the pixels that have a reading.  Eroded by 3 pixels, since those of a
sensor's edge lie on what is behind: none of these three would survive them.

Volume IoU is with the convex hull of the thing, 0 where there is no body or a failed one.  Errors of size are those of
full edges, both lists ascending (which is the order of axes with the least sum), and their mean over the three; a body
that failed or was missed has none.  ``excess`` is by how much the body is longer than the hull along the table's
directions: to the right, away from the camera, up.

Metres.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import tabletop
import trimesh
from both_fits import measured_points
from mesh_scene import about_z
from real_frames import below_table
from tabletop import Placed, Tabletop

from sq_perception.fitting import solina_bajcsy
from sq_perception.fitting.fit import Status
from sq_perception.geometry import Superquadric
from sq_perception.geometry import rotation as quaternions
from sq_perception.recovery.recoverer import FrameRecovery, Recoverer

METHODS = ("given", "own", "classic", "oriented box", "standing box")
FEWEST_PIXELS = 200
FEWEST_POINTS = 30
EROSION = 3
MATCH = 0.5
EXPLAINED = 0.010
SAMPLED = 7
"""Every so many-th pixel's distance to the surface is kept."""
_SHARP = 0.02
_THINNEST = 1e-3


@dataclass(frozen=True, eq=False)
class Answer:
    """One method's body of one thing.

    Attributes
    ----------
    iou
        0 to 1.
    edge_errors : (3,)
        Of full edges, ascending, with sign, metres; NaN without a body.
    excess : (3,)
        Along the table's directions, metres; NaN without a body.
    covered : (3,)
        Half sizes within two reported deviations of half the hull's extent along the same axis; NaN where none are
        reported.
    status, message
        "none" for a thing that was missed.
    body : (11,)
        Flat, in the optical frame.
    """

    iou: float = 0.0
    edge_errors: np.ndarray = field(default_factory=lambda: np.full(3, np.nan))
    excess: np.ndarray = field(default_factory=lambda: np.full(3, np.nan))
    covered: np.ndarray = field(default_factory=lambda: np.full(3, np.nan))
    status: str = "none"
    message: str = "no mask matches"
    body: np.ndarray = field(default_factory=lambda: np.full(11, np.nan))

    @property
    def size_error(self) -> float:
        """Mean over the three edges, metres."""
        return float(np.abs(self.edge_errors).mean())


@dataclass(frozen=True, eq=False)
class ThingVerdict:
    """One thing of one scene and every method's answer; figures of its sight as in :class:`tabletop.Placed`."""

    seed: int
    sensor: str
    kind: str
    name: str
    rest: str
    label: int
    pixels: int
    measured: int
    visible_share: float
    edges: np.ndarray
    answers: dict[str, Answer]


@dataclass(frozen=True, eq=False)
class SceneVerdict:
    """One scene.

    Attributes
    ----------
    things
        Every thing with enough pixels.
    tiny
        How many had too few.
    milliseconds
        Of whole frames, by method.
    false_bodies
        Own bodies whose mask is none of a thing.
    distances : (n,)
        From some measured pixels of things to the nearest body of the own masks, metres; inf where there is none.
    below : (m,)
        How far each body of the own masks reaches below the true table, millimetres.
    plane_error : (2,)
        Of the table found: degrees, and metres at the point looked at; NaN without one.
    """

    seed: int
    sensor: str
    things: tuple[ThingVerdict, ...]
    tiny: int
    milliseconds: dict[str, float]
    false_bodies: int
    distances: np.ndarray
    below: np.ndarray
    plane_error: np.ndarray


@cache
def recoverer() -> Recoverer:
    return Recoverer()


def verdict(seed: int, scans: Path | None, sensor: str | None) -> SceneVerdict:
    """Make the scene of a seed and evaluate every method on it."""
    return evaluated(tabletop.scene(seed, scans, sensor))


def evaluated(scene: Tabletop) -> SceneVerdict:
    """Every method on one scene."""
    depth, camera, labels = scene.depth, scene.camera, scene.labels
    frames = {
        "given": recoverer().recover(depth, camera, labels),
        "own": recoverer().recover(depth, camera),
    }
    known = matches(frames["own"].labels, labels, depth)
    things = []
    for placed in scene.placed:
        if placed.pixels < FEWEST_PIXELS:
            continue
        measured = int(((labels == placed.label) & np.isfinite(depth)).sum())
        answers = {
            "given": of_frame(frames["given"], placed.label, placed, scene),
            "own": of_frame(frames["own"], known.get(placed.label, 0), placed, scene),
            **_simple(_inner_points(placed.label, scene), placed, scene),
        }
        things.append(
            ThingVerdict(
                scene.seed,
                scene.sensor,
                placed.thing.kind,
                placed.thing.name,
                placed.rest,
                placed.label,
                placed.pixels,
                measured,
                placed.visible_share,
                placed.thing.edges,
                {name: answers[name] for name in METHODS},
            )
        )
    own = frames["own"]
    taken = set(known.values())
    plane_error = np.full(2, np.nan)
    if own.plane is not None:
        found = own.plane / np.linalg.norm(own.plane[:3])
        middle = np.array([0, 0, -scene.plane[3] / scene.plane[2]])
        plane_error[0] = np.degrees(np.arccos(np.clip(found[:3] @ scene.plane[:3], -1, 1)))
        plane_error[1] = found[:3] @ middle + found[3]
    return SceneVerdict(
        scene.seed,
        scene.sensor,
        tuple(things),
        len(scene.placed) - len(things),
        {name: frame.milliseconds["total"] for name, frame in frames.items()},
        sum(body.label not in taken for body in own.recovered),
        _distances(own, scene),
        np.array([below_table(body.superquadric, scene.plane) for body in own.recovered]),
        plane_error,
    )


def of_frame(frame: FrameRecovery, label: int, placed: Placed, scene: Tabletop) -> Answer:
    """The answer that a frame gives for one of its labels; 0 is none."""
    for body in frame.bodies:
        if body.label == label:
            if body.status == Status.FAILED:
                return Answer(status="failed", message=body.message)
            return _answer(body.superquadric, placed, scene, body.sigma_size, body.status.name.lower(), body.message)
    return Answer()


def _answer(
    body: Superquadric,
    placed: Placed,
    scene: Tabletop,
    sigma: np.ndarray | None = None,
    status: str = "converged",
    message: str = "",
) -> Answer:
    hull = placed.hull
    turn, place = placed.rotation, placed.translation
    iou = placed.thing.columns.iou(body.transformed(quaternions.from_matrix(turn.T), -turn.T @ place))
    excess = 2 * body.support(scene.table.T) - np.ptp(hull @ scene.table, axis=0)
    covered = np.full(3, np.nan)
    if sigma is not None and np.isfinite(sigma).all():
        extent = np.ptp(hull @ body.rotation_matrix, axis=0) / 2
        covered = (np.abs(body.size - extent) <= 2 * sigma).astype(float)
    errors = np.sort(2 * body.size) - placed.thing.edges
    return Answer(iou, errors, excess, covered, status, message, np.array(body.to_flat(), dtype=float))


def matches(own: np.ndarray, true: np.ndarray, depth: np.ndarray) -> dict[int, int]:
    """The own label of each true one whose masks agree where something was measured."""
    own, true = own[np.isfinite(depth)], true[np.isfinite(depth)]
    found = {}
    for label in np.unique(true[true > 0]):
        inside = true == label
        candidates, common = np.unique(own[inside], return_counts=True)
        for candidate, shared in zip(candidates, common, strict=True):
            if candidate > 0 and shared >= MATCH * ((own == candidate) | inside).sum():
                found[int(label)] = int(candidate)
    return found


def _inner_points(label: int, scene: Tabletop) -> np.ndarray:
    """Measured points (n, 3) of a thing away from the edge of its mask."""
    mask = cv2.erode((scene.labels == label).astype(np.uint8), np.ones((2 * EROSION + 1,) * 2, np.uint8)) > 0
    return measured_points(scene.depth, mask, scene.camera)


def _simple(points: np.ndarray, placed: Placed, scene: Tabletop) -> dict[str, Answer]:
    """What the methods without masks' edges, free space and networks make of a thing's points."""
    names = ("classic", "oriented box", "standing box")
    if len(points) < FEWEST_POINTS:
        return {name: Answer(status="failed", message="too few points") for name in names}
    classic = solina_bajcsy.fit(points)
    bodies = classic.superquadric, _oriented_box(points), _standing_box(points, scene)
    answers = {name: _answer(body, placed, scene) for name, body in zip(names, bodies, strict=True)}
    if classic.status == Status.FAILED:
        answers["classic"] = Answer(status="failed", message=classic.message)
    return answers


def _oriented_box(points: np.ndarray) -> Superquadric:
    box_from_points, edges = trimesh.bounds.oriented_bounds(points)
    turn = box_from_points[:3, :3].T
    return _box(edges, -turn @ box_from_points[:3, 3], turn)


def _standing_box(points: np.ndarray, scene: Tabletop) -> Superquadric:
    flat = points @ scene.table
    height = points @ scene.plane[:3] + scene.plane[3]
    middle, edges, degrees = cv2.minAreaRect(flat[:, :2].astype(np.float32))
    top = max(float(height.max()), _THINNEST)
    centre = scene.table @ np.array([*middle, top / 2 - scene.plane[3]])
    return _box(np.array([*edges, top]), centre, scene.table @ about_z(np.deg2rad(degrees)))


def _box(edges: np.ndarray, centre: np.ndarray, turn: np.ndarray) -> Superquadric:
    half = np.maximum(np.asarray(edges), _THINNEST) / 2
    return Superquadric(half, np.full(2, _SHARP), centre, quaternions.from_matrix(turn))


def _distances(frame: FrameRecovery, scene: Tabletop) -> np.ndarray:
    points = measured_points(scene.depth, scene.labels > 0, scene.camera)[::SAMPLED]
    nearest = np.full(len(points), np.inf)
    for body in frame.recovered:
        nearest = np.minimum(nearest, np.abs(body.superquadric.sampson_distance(points)))
    return nearest
