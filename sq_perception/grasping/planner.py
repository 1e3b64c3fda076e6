"""Grasps of every body or its parts, best first, each with the probability that it holds.

    P = product over k of Phi(m_k / sigma_k)

Every margin m_k is a distance or angle to failure, sigma_k its standard deviation:

| margin | of what | sigma |
| --- | --- | --- |
| opening | pads to the body's side, on either side, as far as the open fingers come | of that side, the hand |
| engagement | fingers' ends beyond the body's near end | of the near end, the hand |
| palm | the body's near end before the palm | the same |
| friction | the cone's half angle less that between pads and surface | of mu, of the surface's turn |
| weight | friction of both pads against gravity, as a force and as a torque about the closing line | of the mass |
| table, bodies, points | the gripper's least distance | of the obstacle where it is nearest, the hand |
| unseen | share of the fingers in unobserved space | a share of it is taken as occupied |

Vessels without a safe grasp are also tried by their rims (:mod:`sq_perception.grasping.rims`).

The opening is the body's width plus, on either side, a clearance and twice the sigma of that side, limited by the
gripper.  The hand keeps farther from the less certain side; a body of unknown depth is gripped by its known sides.
Where the image shows that the place of a pad, or of the palm between the fingers, is empty, there is no body: sides and
near end count by the hidden share of that place, and the distance of measured points covers the rest.  Margins are
treated as independent, except that of measured points: only what it adds to opening, palm and other bodies counts.

Metres, newtons, kilograms; the pose of a grasp is that of the TCP (:mod:`sq_perception.grasping.gripper`) in the frame
of the bodies.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Protocol

import numpy as np

from sq_perception.fitting.fit import Fit
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.grasping import approaches, clearance
from sq_perception.grasping import trials as margins
from sq_perception.grasping.approaches import Closings
from sq_perception.grasping.closing import KnownBodies
from sq_perception.grasping.gripper import PANDA, Gripper
from sq_perception.grasping.plan import Grasp, GraspPlan
from sq_perception.grasping.rims import rim_grasps
from sq_perception.grasping.surroundings import Surroundings
from sq_perception.grasping.trials import Trials
from sq_perception.imaging.camera import Camera

FRICTION = 0.5  # smallest friction coefficient of rubber pads on cartons and plastics; the benchmark draws 0.5 to 1
PER_BODY = 8  # maximum number of grasps returned per body
PLACEMENT = 0.002
"""Standard deviation of the hand's position along each axis, metres: a careful calibration of camera and arm."""


class FittedObject(Protocol):
    """What a plan needs of an object, as a :class:`~sq_perception.recovery.recovery.Recovery` has it."""

    @property
    def fit(self) -> Fit: ...

    @property
    def parts(self) -> Iterable[Fit] | None: ...


def grasps_of(objects: Sequence[FittedObject], gripper: Gripper, around: Surroundings, **more: Any) -> GraspPlan:
    """Plan as :func:`grasps` for the objects of a frame that did not fail, by their parts too if they have any."""
    fits = [one.fit for one in objects] + [fit for one in objects for fit in one.parts or ()]
    owner = [k for k, one in enumerate(objects) for _ in one.parts or ()]
    things = np.array([*range(len(objects)), *owner], dtype=int)
    bodies = Superquadric.stack([fit.superquadric for fit in fits])
    covariance = np.array([fit.covariance for fit in fits]).reshape(-1, 11, 11)
    return grasps(bodies, gripper, covariance, around, things=things, **more)


def grasps(
    bodies: Superquadric, gripper: Gripper, covariance: np.ndarray | None = None, around: Surroundings | None = None,
    friction: float = FRICTION, placement: float = PLACEMENT, things: np.ndarray | None = None,
) -> GraspPlan:
    """Plan grasps of some things, with the reason for those that have none.

    Parameters
    ----------
    bodies : Superquadric
        A NumPy batch (n,), all in one frame.
    covariance : (n, 11, 11), optional
        As in :class:`sq_perception.fitting.fit.Fit`; a value that is not finite counts as 10 % sigma.
    around
        Table, measured points and unseen space; only the bodies if not given.
    friction
        Smallest mu between pads and bodies: the friction cone is that of mu to twice mu, weights assume mu.
    placement
        Standard deviation of the hand's position along each axis, metres: calibration of arm and camera.
    things : int (n,), optional
        The thing, from 0, of each body; each is one if not given.  The first body of a thing is all of it, others are
        its parts.  A part is grasped like a body, clear of the other parts, with the weight of the whole thing; in the
        way of other grasps are the parts, not the body around them.

    Raises
    ------
    ValueError
        If the bodies are no batch, arrays do not belong to them, the friction is not positive, the placement is
        negative, or a thing has no body.
    """
    if len(bodies.batch_shape) != 1:
        raise ValueError(f"bodies: expected a batch (n,), got {bodies.batch_shape}")
    if not (np.isfinite(friction) and friction > 0):
        raise ValueError(f"friction: expected a positive number, got {friction}")
    if not (np.isfinite(placement) and placement >= 0):
        raise ValueError(f"placement: expected metres, not negative, got {placement}")
    if not len(bodies):
        return GraspPlan()
    around = around or Surroundings()
    known = KnownBodies.of(bodies, covariance)
    things = np.arange(len(bodies)) if things is None else np.asarray(things)
    count = len(np.unique(things))
    numbered = things.shape == (len(bodies),) and np.array_equal(np.unique(things), np.arange(count))
    if not numbered or things.dtype.kind not in "iu":
        raise ValueError(f"things: expected the thing of each of {len(bodies)} bodies, from 0 on, got {things}")
    reasons = np.full(count, f"wider than the opening of {1e3 * gripper.opening:.0f} mm in every direction", object)
    closings = approaches.closings(known, gripper, friction)
    whole = np.unique(things, return_index=True)[1][things]
    whole[np.setdiff1d(whole, np.flatnonzero(np.bincount(things)[things] == 1))] = -1
    trials = _trials(known, _loads(bodies, things, whole), closings, gripper, around, friction, placement)
    reasons[things[closings.owner]] = "no way for the fingers to come with the table and the palm in their way"
    if around.plane is not None:
        top, _ = known.reaches(np.arange(len(bodies)), np.tile(around.plane[:3], (len(bodies), 1)))
        is_behind = known.middle @ around.plane[:3] + top + around.plane[3] < 0
        reasons[np.setdiff1d(things, things[~is_behind])] = "behind the plane that bodies stand on"
    checked = 200  # grasps per body whose distance to other bodies is computed
    trials = _narrow_sides(known, trials.first(checked), gripper, placement)
    trials = _keep_probable(trials, things, checked, reasons, "nothing holds")
    trials = _add_surroundings(known, whole, trials, gripper, around, placement)
    doubtful = np.flatnonzero(~np.isin(things, things[trials.owner[trials.total > np.log(0.5)]]))
    if len(doubtful):
        rims = rim_grasps(bodies, doubtful, gripper, around, friction, placement)
        trials = trials.join(_add_surroundings(known, whole, rims, gripper, around, placement))
    trials = trials._replace(owner=things[trials.owner])
    trials = _keep_probable(trials, np.arange(count), PER_BODY, reasons, "in the way")
    reasons[trials.owner] = ""
    return GraspPlan(tuple(_to_grasps(trials)), tuple(reasons))


def _loads(bodies: Superquadric, things: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Return the mass of each body's thing and its centre of mass, (n, 4): a grasp of a part lifts it all."""
    mass = np.where(whole < 0, 0.0, margins.DENSITY * np.asarray(bodies.volume()))
    of_thing = np.bincount(things, mass)
    moment = np.stack([np.bincount(things, mass * along) for along in bodies.translation.T], axis=1)
    return np.column_stack([of_thing, moment / of_thing[:, None]])[things]


def _keep_probable(trials: Trials, things: np.ndarray, count: int, reasons: np.ndarray, why: str) -> Trials:
    """Return each body's ``count`` best grasps of 5 % and more; the weakest margin is why a thing has none."""
    found = trials.first(count, np.log(0.05))
    without = trials.at(~np.isin(things[trials.owner], things[found.owner]))
    without = without._replace(owner=things[without.owner]).first(1)
    for k, weakest in zip(without.owner, without.weakest, strict=True):
        reasons[k] = f"{why}: {margins.MARGINS[weakest]}"
    return found


def warm_up() -> None:
    """Compile or load every kernel."""
    two = np.array([[0.0, 0.0, 0.5], [0.1, 0.0, 0.5]])
    bodies = Superquadric(np.full((2, 3), 0.02), np.ones((2, 2)), two, np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)))
    camera = Camera(2, 2, 2.0, 2.0, 0.5, 0.5)
    grasps(bodies, PANDA, around=Surroundings(points=two + 0.3, depth=np.ones((2, 2)), camera=camera))


def _trials(
    bodies: KnownBodies, loads: np.ndarray, found: Closings, gripper: Gripper, around: Surroundings, friction: float,
    placement: float,
) -> Trials:
    """Return every closing from every side, at every depth and slide, with the margins of the body alone."""
    narrow, broad = np.arctan([friction, 2 * friction])
    cone, doubt = 0.5 * (narrow + broad), np.hypot(np.deg2rad(8.0), (broad - narrow) / np.sqrt(12))  # and of normals
    every = approaches.approach_from_every_side(bodies, found, gripper, around, placement)
    places = approaches.places(bodies, every, gripper, broad)
    ways, u, angle = every.at(places.of), places.ahead, places.angle
    owner, (turn, centre) = ways.owner, np.split(ways.frames, [3], axis=2)
    aside = np.nan_to_num(0.5 * (places.ends[:, 0] - places.ends[:, 1])) + ways.shift
    beside = bodies.middle[owner] + places.offset - loads[owner, 1:]
    lever = np.abs((beside * ways.tilting).sum(axis=1))
    offset = places.offset + aside[:, None] * turn[:, :, 1]
    frames = np.concatenate([turn, centre + offset[:, :, None]], axis=2)

    deep = np.hypot(ways.near_sigma, placement)
    room = 0.5 * ways.opening - ways.reach
    logs = np.zeros((len(owner), len(margins.MARGINS)))
    passes = [margins.log_passing(room + way * aside, ways.sigma[:, k], placement) for k, way in ((0, 1), (1, -1))]
    sides = np.stack(passes, axis=1)
    logs[:, 0] = sides[:, 0] + sides[:, 1]
    logs[:, 1] = margins.log_phi(u + gripper.tip + ways.near - margins.LEAST_ENGAGED, deep)
    logs[:, 2] = margins.log_phi(gripper.palm - ways.near - u, deep)
    logs[:, 3] = np.where(np.isfinite(angle), margins.log_phi(cone - angle, doubt), -np.inf)
    logs[:, 4] = margins.weight(loads[owner, 0], lever, 2 * friction * gripper.force)
    if around.plane is not None:  # moved without a turn, so that the lowest corner is the same
        logs[:, 5] = margins.log_phi(ways.height + offset @ around.plane[:3], np.hypot(margins.TABLE_SIGMA, placement))
    return Trials(owner, frames, ways.opening, 2 * ways.reach, logs, sides)


def _narrow_sides(bodies: KnownBodies, trials: Trials, gripper: Gripper, placement: float) -> Trials:
    """Return the trials with better margins where fingers end above the middle, so above the widest section."""
    y, z = trials.frames[:, :, 1], trials.frames[:, :, 2]
    beside = trials.frames[:, :, 3] + gripper.tip * z - bodies.middle[trials.owner]
    rows = np.flatnonzero((beside * z).sum(axis=1) < 0)
    owner, y, beside = trials.owner[rows], y[rows], beside[rows]
    across = 0.5 * gripper.finger_width * trials.frames[rows, :, 0]
    reached = np.fmax.reduce([bodies.chords(owner, beside + k * across, y)[0] for k in (-1, 0, 1)])
    aside = (beside * y).sum(axis=1)
    for end, way in ((0, 1), (1, -1)):
        reach, sigma = bodies.reaches(owner, way * y)
        gap = 0.5 * trials.opening[rows] - np.fmin(reached[:, end], reach - way * aside)
        trials.sides[rows, end] = margins.log_passing(gap, sigma, placement)
    trials.logs[rows, 0] = trials.sides[rows].sum(axis=1)
    return trials


def _add_surroundings(
    bodies: KnownBodies, whole: np.ndarray, trials: Trials, gripper: Gripper, around: Surroundings, placement: float,
) -> Trials:
    """Return the best trials with the margins of the surroundings."""
    if not len(trials.owner):
        return trials
    boxes = gripper.boxes_at(trials.opening)
    gap, other, way = clearance.gaps_to_bodies(trials.frames, boxes, trials.owner, bodies.flat, bodies.turns, whole)
    near = np.flatnonzero(other >= 0)
    _, sigma = bodies.reaches(other[near], -way[near])
    trials.logs[near, 6] = margins.log_passing(gap[near], sigma, placement)
    trials = trials.first(16)  # whose distance to points is computed
    boxes = gripper.boxes_at(trials.opening)
    gap = clearance.gaps_to_points(trials.frames, boxes, around.points)
    if around.camera is not None:
        _weight_hidden(trials, gap, gripper, around, placement)
    doubt = margins.log_phi(gap + margins.PASSES, np.hypot(margins.POINT_SIGMA, placement))
    trials.logs[:, 7] = np.minimum(doubt - trials.logs[:, [0, 2, 6]].sum(axis=1), 0.0)
    # Unseen space beside a body is occupied with a probability of 15 %.
    trials.logs[:, 8] = np.log1p(-0.15 * around.unseen(trials.frames, boxes[:, :2]))
    return trials


def _weight_hidden(trials: Trials, gap: np.ndarray, gripper: Gripper, around: Surroundings, placement: float) -> None:
    """Weight sides and near ends by the share that the image does not show to be empty; points tell the rest."""
    turn, position = trials.frames[:, :, :3], trials.frames[:, None, None, :, 3]
    hidden = around.hidden_share(gripper.faces_at(trials.opening) @ turn.transpose(0, 2, 1)[:, None] + position)
    passing = margins.log_phi(gap + margins.PASSES, np.hypot(margins.SIDE_SIGMA, placement))
    shown = (1 - hidden[:, :2].min(axis=1)) * np.expm1(passing)
    trials.logs[:, 0] = np.log1p(hidden[:, :2] * np.expm1(trials.sides)).sum(axis=1) + np.log1p(shown)
    trials.logs[:, 2] = np.log1p(hidden[:, 2] * np.expm1(trials.logs[:, 2]))


def _to_grasps(trials: Trials) -> Iterator[Grasp]:
    """Convert all trials to grasps, the most probable first."""
    total = trials.total
    order = np.argsort(-total, kind="stable")
    turns = quaternions.from_matrix(trials.frames[:, :, :3])
    scores, weakest = np.exp(total), trials.weakest
    for k in order:
        yield Grasp(
            int(trials.owner[k]), trials.frames[k, :, 3], turns[k], float(trials.opening[k]), float(trials.width[k]),
            float(scores[k]), margins.MARGINS[weakest[k]],
        )
