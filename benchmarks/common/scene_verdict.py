"""What each method makes of one scene of household things, held against the truth.

| method | masks | what |
| --- | --- | --- |
| given | true | `Recoverer().recover(depth, camera, labels)` |
| own | its own | `Recoverer().recover(depth, camera)`; the body of the mask that agrees, or none |
| classic | true, eroded | Solina and Bajcsy's fit of the measured points |
| oriented box | true, eroded | the smallest box around the measured points |

Masks agree with an IoU of at least 0.5 among the pixels that have a reading.  Eroded by 3 pixels, since those of a
sensor's edge lie on what is behind: neither of these two would survive them.

Volume IoU is with the convex hull of the thing, 0 where there is no body or a failed one.  Errors of size are those of
full edges, both lists ascending (which is the order of axes with the least sum), and their mean over the three; a body
that failed or was missed has none.  ``excess`` is by how much the body is longer than the hull along the table's
directions: to the right, away from the camera, up.

Metres.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache

import cv2
import numpy as np
import trimesh

from common.tabletop import Placed, Tabletop
from sq_perception.fitting import solina_bajcsy
from sq_perception.fitting.fit import Status
from sq_perception.geometry import Superquadric
from sq_perception.geometry import rotation as quaternions
from sq_perception.recovery.recoverer import FrameRecovery, Recoverer

METHODS = ("given", "own", "classic", "oriented box")
HALF, FEWEST_PIXELS = 0.5, 200
"""Visible share and size of the things that are counted."""
FEWEST_POINTS = 30
EROSION = 3
MATCH = 0.5
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
    """

    seed: int
    sensor: str
    things: tuple[ThingVerdict, ...]
    tiny: int
    milliseconds: dict[str, float]
    false_bodies: int


@cache
def recoverer() -> Recoverer:
    return Recoverer()


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
    taken = set(known.values())
    return SceneVerdict(
        scene.seed,
        scene.sensor,
        tuple(things),
        len(scene.placed) - len(things),
        {name: frame.milliseconds["total"] for name, frame in frames.items()},
        sum(body.label not in taken for body in frames["own"].recovered),
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
    excess = body.support(scene.table.T) + body.support(-scene.table.T) - np.ptp(hull @ scene.table, axis=0)
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
    return scene.camera.points(scene.depth)[mask & np.isfinite(scene.depth)]


def _simple(points: np.ndarray, placed: Placed, scene: Tabletop) -> dict[str, Answer]:
    """What the methods without masks' edges, free space and networks make of a thing's points."""
    if len(points) < FEWEST_POINTS:
        return {name: Answer(status="failed", message="too few points") for name in ("classic", "oriented box")}
    answers = {"oriented box": _answer(smallest_box(points), placed, scene)}
    classic = solina_bajcsy.fit(points)
    if classic.status == Status.FAILED:
        answers["classic"] = Answer(status="failed", message=classic.message)
    else:
        answers["classic"] = _answer(classic.superquadric, placed, scene)
    return answers


def smallest_box(points: np.ndarray) -> Superquadric:
    """The smallest box around points (n, 3), as a sharp superquadric."""
    box_from_points, edges = trimesh.bounds.oriented_bounds(points)
    turn = box_from_points[:3, :3].T
    half = np.maximum(edges, _THINNEST) / 2
    return Superquadric(half, np.full(2, _SHARP), -turn @ box_from_points[:3, 3], quaternions.from_matrix(turn))
