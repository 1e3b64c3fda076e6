"""Grasps of every body, best first, each with the probability that it holds.

    P = product over k of Phi(m_k / sigma_k)

Every margin m_k is what may be lost before the grasp fails, sigma_k how sure it is:

| margin | of what | sigma |
| --- | --- | --- |
| opening | pads to the body's side, on either side, as the open fingers come | of the side, and the model |
| engagement | fingers' ends beyond the body's near end | of the near end |
| palm | the body's near end before the palm | of the near end |
| friction | atan(mu) less the angle between pads and surface | of the surface's turn |
| weight | friction of both pads against gravity, as a force and as a torque about the closing line | of the mass |
| table, bodies, points | the gripper's least distance | of the obstacle |
| unseen | share of the fingers in space that nobody has seen | a share of it is taken |

The opening is the body's width and, on either side, a clearance and twice the sigma of that side; less where the
gripper opens no wider.  A side that was not seen is uncertain, so that a body of unknown depth is taken by its known
sides.  Margins are taken for independent of each other.

Metres, newtons, kilograms; the pose of a grasp is that of the TCP (:mod:`sq_perception.grasping.gripper`) in the frame
of the bodies.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from scipy.special import ndtr

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.grasping import clearance, closing
from sq_perception.grasping.gripper import PANDA, Gripper
from sq_perception.grasping.surroundings import Surroundings

FRICTION = 0.5
"""Of rubber pads on cartons and plastics, at the least; the benchmark draws 0.5 to 1."""
DENSITY = 500.0
"""kg/m^3, between empty and full packages; a mass is thought to be known to half of it."""
PER_BODY = 8
"""Grasps a body that are told at most."""
_GRAVITY, _LIFT = 9.81, 2.0
"""m/s^2; of the lift beside gravity."""
_CLEARANCE, _ABOVE_TABLE = 0.005, 0.004
"""Metres on either side of the body and before the palm; above the table."""
_ENGAGED = 0.012
"""Metres of finger beyond the near end that a shallow grasp has."""
_LEAST_ENGAGED = 0.004
_PAD_RADIUS = 0.006
"""Mean arm of the friction of a pad of some 18 mm, metres."""
_SQUARE = np.deg2rad(8.0)
"""How sure normals are."""
_TABLE_SIGMA, _POINT_SIGMA, _BODY_SIGMA = 0.002, 0.002, 0.004
_POINT_INSIDE = 0.004
"""Metres that a point counts for which is inside the gripper: of its depth there the point says nothing."""
_HIDDEN = 0.15
"""Probability that space which nobody has seen beside a body is taken."""
_SWINGS = np.deg2rad([0.0, 25.0, -25.0, 50.0, -50.0, 80.0, -80.0])
"""Of the approach about the closing line, away from the steepest one."""
_SLIDES = np.array([0.0, 0.4, -0.4, 0.8, -0.8])
"""Along the third axis, shares of the way to where the finger's width is no more wholly on the body."""
_CHECKED, _CHECKED_CLOSELY = 60, 20
"""Grasps a body whose distance to the other bodies is looked at, and of the best of these that to measured points."""
_LEAST = 0.05
"""Grasps less probable than that are not told."""
_MARGINS = ("opening", "engagement", "palm", "friction", "weight", "table", "other bodies", "measured points", "unseen")


@dataclass(frozen=True, eq=False)
class Grasp:
    """One grasp.

    Attributes
    ----------
    body
        Position of its body in the batch.
    position, rotation : (3,), (4,)
        Of the TCP, a quaternion x y z w, in the frame of the bodies.
    opening
        Of the fingers before they close.
    width
        Of the body between them.
    score
        Probability that it holds.
    weakest
        The margin that takes most from the score.
    """

    body: int
    position: np.ndarray
    rotation: np.ndarray
    opening: float
    width: float
    score: float
    weakest: str

    @property
    def approach(self) -> np.ndarray:
        """The unit vector (3,) along which the gripper comes."""
        return np.asarray(quaternions.to_matrix(self.rotation))[:, 2]

    def placed(self, points: np.ndarray) -> np.ndarray:
        """Points (j, 3) of the TCP's frame in the frame of the bodies."""
        return points @ np.asarray(quaternions.to_matrix(self.rotation)).T + self.position


@dataclass(frozen=True, eq=False)
class GraspPlan:
    """Grasps of all bodies, the most probable first, and why bodies have none.

    Attributes
    ----------
    grasps
        At most :data:`PER_BODY` a body.
    reasons
        One a body, empty for those with a grasp.
    """

    grasps: tuple[Grasp, ...] = ()
    reasons: tuple[str, ...] = ()

    def of(self, body: int) -> tuple[Grasp, ...]:
        """The grasps of one body, best first."""
        return tuple(grasp for grasp in self.grasps if grasp.body == body)


@dataclass(frozen=True, eq=False)
class _Trials:
    """Grasps under trial, k of them, and the logarithm of the probability of each margin so far."""

    owner: np.ndarray
    frames: np.ndarray
    opening: np.ndarray
    width: np.ndarray
    logs: np.ndarray

    def at(self, which: np.ndarray) -> _Trials:
        return _Trials(self.owner[which], self.frames[which], self.opening[which], self.width[which], self.logs[which])

    @property
    def weakest(self) -> np.ndarray:
        """Which margin takes most from each."""
        return np.asarray(np.argmin(self.logs, axis=1))

    def first(self, count: int) -> _Trials:
        """The most probable ones of each body, each body's in order."""
        order = np.lexsort((-self.logs.sum(axis=1), self.owner))
        owner = self.owner[order]
        rank = np.arange(len(owner)) - np.searchsorted(owner, owner)
        return self.at(order[rank < count])


@dataclass(frozen=True, eq=False)
class _Closings:
    """Directions (k, 3) in which a body ``owner`` may be closed upon, with their reaches and sigmas (k,)."""

    owner: np.ndarray
    along: np.ndarray
    reach: np.ndarray
    sigma: np.ndarray = field(repr=False)


def grasps(
    bodies: Superquadric,
    gripper: Gripper,
    covariance: np.ndarray | None = None,
    around: Surroundings | None = None,
    friction: float = FRICTION,
) -> GraspPlan:
    """Plan grasps of some bodies; those that have none come with the reason.

    Parameters
    ----------
    bodies : Superquadric
        A NumPy batch (n,), all in one frame.
    covariance : (n, 11, 11), optional
        As in :class:`sq_perception.fitting.fit.Fit`; a body whose covariance is not finite is taken for one of 10 %.
    around
        Table, measured points and what was seen; nothing but the bodies if not given.
    friction
        mu between pads and bodies.

    Raises
    ------
    ValueError
        If the bodies are no batch, arrays do not belong to them, or the friction is not positive.
    """
    if len(bodies.batch_shape) != 1:
        raise ValueError(f"bodies: expected a batch (n,), got {bodies.batch_shape}")
    if not (np.isfinite(friction) and friction > 0):
        raise ValueError(f"friction: expected a positive number, got {friction}")
    if not len(bodies):
        return GraspPlan()
    around = around or Surroundings()
    spread = closing.known(bodies, covariance)
    reasons = np.array(
        [f"wider than the opening of {1e3 * gripper.opening:.0f} mm in every direction"] * len(bodies), dtype=object
    )
    closings = _closings(bodies, spread, gripper, friction)
    trials = _trials(bodies, spread, closings, gripper, around, friction)
    reasons[np.unique(closings.owner)] = "no way for the fingers to come with the table and the palm in their way"
    trials = _probable(trials, _CHECKED, reasons, "nothing holds")
    if not len(trials.owner):
        return GraspPlan((), tuple(reasons))
    trials = _among_others(bodies, spread, trials, gripper, around)
    trials = _probable(trials, PER_BODY, reasons, "in the way")
    reasons[trials.owner] = ""
    return GraspPlan(tuple(_as_grasps(trials)), tuple(reasons))


def _probable(trials: _Trials, count: int, reasons: np.ndarray, why: str) -> _Trials:
    """The ``count`` best of each body that has any; what the best of the others suffer from is their reason."""
    found = trials.at(trials.logs.sum(axis=1) > np.log(_LEAST)).first(count)
    without = trials.at(~np.isin(trials.owner, found.owner)).first(1)
    for k, weakest in zip(without.owner, without.weakest, strict=True):
        reasons[k] = f"{why}: {_MARGINS[weakest]}"
    return found


def warm_up() -> None:
    """Compile or load every kernel."""
    two = np.array([[0.0, 0.0, 0.5], [0.1, 0.0, 0.5]])
    bodies = Superquadric(np.full((2, 3), 0.02), np.ones((2, 2)), two, np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)))
    grasps(bodies, PANDA, around=Surroundings(points=two + 0.3))


def _closings(bodies: Superquadric, spread: np.ndarray, gripper: Gripper, friction: float) -> _Closings:
    """Those of all bodies that are narrow enough and meet their surface squarely at its middle."""
    owner = np.repeat(np.arange(len(bodies)), len(closing.DIRECTIONS))
    local = np.tile(closing.DIRECTIONS, (len(bodies), 1))
    along = (local[:, None] @ bodies.rotation_matrix[owner].transpose(0, 2, 1))[:, 0]
    reach, sigma = closing.reaches(bodies, spread, owner, along)
    fits = (2 * reach < gripper.opening) & (closing.middle_angles(bodies, owner, along) < np.arctan(friction))
    return _Closings(owner[fits], along[fits], reach[fits], sigma[fits])


def _trials(
    bodies: Superquadric,
    spread: np.ndarray,
    closings: _Closings,
    gripper: Gripper,
    around: Surroundings,
    friction: float,
) -> _Trials:
    """Every closing from every side, at every depth and slide, with the margins that the body alone decides."""
    # From every side: z the approach, y the closing line, x the third.
    y = np.repeat(closings.along, len(_SWINGS), axis=0)
    owner = np.repeat(closings.owner, len(_SWINGS))
    half, side = np.repeat(closings.reach, len(_SWINGS)), np.repeat(closings.sigma, len(_SWINGS))
    down = around.down(bodies.translation[owner])
    steep = down - y * (y * down).sum(axis=1, keepdims=True)
    length = np.linalg.norm(steep, axis=1, keepdims=True)
    steep = steep / np.maximum(length, 1e-9)
    swing = np.tile(_SWINGS, len(closings.owner))[:, None]
    z = np.cos(swing) * steep + np.sin(swing) * np.cross(y, steep)
    possible = (length[:, 0] > 0.3) & ((z * down).sum(axis=1) > -0.1)
    owner, y, z, half, side = owner[possible], y[possible], z[possible], half[possible], side[possible]
    x = np.cross(y, z)
    near, near_sigma = closing.reaches(bodies, spread, owner, z)
    across, _ = closing.reaches(bodies, spread, owner, x)

    # At every depth: where the palm or the table stops the gripper or the middle is reached, shallow, and between.
    spare = np.minimum(0.5 * gripper.opening - half, _CLEARANCE + 2 * side)
    opening = 2 * (half + spare)
    boxes = gripper.boxes_at(opening)
    deepest = np.minimum(gripper.palm - _CLEARANCE - near, 0.0)
    centre = bodies.translation[owner]
    height = np.full(len(owner), np.inf)
    if around.plane is not None:
        frames = np.concatenate([np.stack([x, y, z], axis=2), centre[:, :, None]], axis=2)
        height = clearance.heights_above(around.plane, frames, boxes)
        sink = -(z @ around.plane[:3])
        low = np.where(sink > 1e-3, (height - _ABOVE_TABLE) / np.maximum(sink, 1e-3), np.inf)
        deepest = np.minimum(deepest, low)
    shallow = np.minimum(_ENGAGED - near - gripper.tip, deepest)
    reachable = deepest > _LEAST_ENGAGED - near - gripper.tip
    rows = np.flatnonzero(reachable)
    depth = np.stack([deepest, 0.5 * (deepest + shallow), shallow], axis=1)[rows]
    free = np.maximum(across[rows] - 0.5 * gripper.finger_width, 0.0)
    slide = free[:, None] * _SLIDES
    places = len(_SLIDES) * depth.shape[1]
    u = np.repeat(depth, len(_SLIDES), axis=1).ravel()
    v = np.tile(slide, (1, depth.shape[1])).ravel()
    at = np.repeat(rows, places)
    distinct = (np.abs(v) > 1e-3) | (np.tile(np.arange(places) % len(_SLIDES), len(rows)) == 0)
    u, v, at = u[distinct], v[distinct], at[distinct]

    owner, half, side, opening = owner[at], half[at], side[at], opening[at]
    near, near_sigma = near[at], near_sigma[at]
    offset = u[:, None] * z[at] + v[:, None] * x[at]
    # A pad touches where it overlaps the body, which may lie wholly beyond the TCP.
    touch = 0.5 * (np.maximum(u - gripper.tip, -near) + np.minimum(u + gripper.tip, near))
    ends, angle = closing.chords(bodies, owner, offset + (touch - u)[:, None] * z[at], y[at])
    aside = np.nan_to_num(0.5 * (ends[:, 0] - ends[:, 1]))
    position = bodies.translation[owner] + offset + aside[:, None] * y[at]
    frames = np.concatenate([np.stack([x[at], y[at], z[at]], axis=2), position[:, :, None]], axis=2)

    edge = np.hypot(side, closing.MODEL_ERROR)
    deep = np.hypot(near_sigma, closing.MODEL_ERROR)
    down = around.down(bodies.translation[owner])
    weight = DENSITY * bodies.volume()[owner] * _GRAVITY
    lever = np.abs((np.cross(offset + aside[:, None] * y[at], down) * y[at]).sum(axis=1))
    force = 2 * friction * gripper.force
    load = np.maximum(weight * (1 + _LIFT / _GRAVITY) / force, weight * lever / (force * _PAD_RADIUS))
    logs = np.zeros((len(owner), len(_MARGINS)))
    logs[:, 0] = _log(0.5 * opening - half - aside, edge) + _log(0.5 * opening - half + aside, edge)
    logs[:, 1] = _log(u + gripper.tip + near - _LEAST_ENGAGED, deep)
    logs[:, 2] = _log(gripper.palm - near - u, deep)
    logs[:, 3] = np.where(np.isfinite(angle), _log(np.arctan(friction) - np.nan_to_num(angle), _SQUARE), -np.inf)
    logs[:, 4] = _log(1 / np.maximum(load, 1e-9) - 1, 0.5)
    if around.plane is not None:  # moved without a turn, so that the lowest corner is the same
        logs[:, 5] = _log(height[at] + (offset + aside[:, None] * y[at]) @ around.plane[:3], _TABLE_SIGMA)
    return _Trials(owner, frames, opening, 2 * half, logs)


def _among_others(
    bodies: Superquadric, spread: np.ndarray, trials: _Trials, gripper: Gripper, around: Surroundings
) -> _Trials:
    """The same with the margins that the surroundings decide."""
    boxes = gripper.boxes_at(trials.opening)
    flat, turns = np.ascontiguousarray(bodies.to_flat(), dtype=float), np.ascontiguousarray(bodies.rotation_matrix)
    gap, other = clearance.gaps_to_bodies(trials.frames, boxes, trials.owner, flat, turns)
    vague = np.sqrt(np.diagonal(spread, axis1=1, axis2=2)[:, :6].mean(axis=1))
    trials.logs[:, 6] = np.where(other >= 0, _log(gap, np.hypot(_BODY_SIGMA, vague[other])), 0.0)
    trials = trials.first(_CHECKED_CLOSELY)
    boxes = gripper.boxes_at(trials.opening)
    if len(around.points):
        gap = clearance.gaps_to_points(trials.frames, boxes, around.points)
        trials.logs[:, 7] = _log(np.where(gap > 0, gap, -_POINT_INSIDE), _POINT_SIGMA)
    trials.logs[:, 8] = np.log1p(-_HIDDEN * around.unseen(trials.frames, boxes[:, :2]))
    return trials


def _log(margin: np.ndarray, sigma: np.ndarray | float) -> np.ndarray:
    """log Phi(m / sigma), never below log(1e-12)."""
    return np.asarray(np.log(np.maximum(ndtr(margin / sigma), 1e-12)))


def _as_grasps(trials: _Trials) -> Iterator[Grasp]:
    """All of them, the most probable first."""
    total = trials.logs.sum(axis=1)
    order = np.argsort(-total, kind="stable")
    turns = quaternions.from_matrix(trials.frames[:, :, :3])
    scores, weakest = np.exp(total), trials.weakest
    for k in order:
        yield Grasp(
            int(trials.owner[k]),
            trials.frames[k, :, 3],
            turns[k],
            float(trials.opening[k]),
            float(trials.width[k]),
            float(scores[k]),
            _MARGINS[weakest[k]],
        )
