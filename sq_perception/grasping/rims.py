"""Grasps of open vessels by their rim: one finger inside, one outside, down along their upright axis.

Bodies are convex and have no cavity, so rims come from measured points.  At a bearing around a body the rim consists of
the points within some millimetres of the highest ones, if they are as thin as a wall.  There is a cavity behind it if
the image shows something beyond the place of the inner finger's end.

The margins are those of :mod:`sq_perception.grasping.planner` with the points' sigma.  Walls weigh a share of a full
body; the pads resist torque about the tangent by their overlap.

Metres, in the frame of the bodies.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.grasping import clearance
from sq_perception.grasping.gripper import Gripper
from sq_perception.grasping.surroundings import Surroundings
from sq_perception.grasping.trials import (
    CLEARANCE,
    DENSITY,
    LEAST_ENGAGED,
    MARGINS,
    PASSES,
    POINT_SIGMA,
    TABLE_SIGMA,
    Trials,
    log_phi,
    weight,
)

_BEARINGS = np.arange(24) * np.pi / 12
_INSETS = np.array([0.012, 0.02, 0.03])
"""Depths of the fingers' ends below the rim, metres."""
_BEYOND = 0.015
"""Distance outside of a body up to which points may be its rim, metres."""
_HIGH, _THIN = 0.006, 0.012
"""Height of the rim, and its largest thickness, metres."""
_STRAY = 3
"""Index of the point of a bearing, from the highest on, that is the top: flying pixels may be above it."""
_UPRIGHT = 0.9
"""Share of rims that held where all other margins were sure: 31 of 35 that scenes of benchmarks/picking.py from
seed 20000 on, none of which is reported, ended with.  In place of friction: how steep a wall is, is not looked at."""
_WALLS = 0.3
"""Share of the volume of a vessel that is solid: walls of 4 mm of one 8 cm wide and 10 cm high."""


def at_rims(
    bodies: Superquadric, which: np.ndarray, gripper: Gripper, around: Surroundings, friction: float, placement: float
) -> Trials:
    """Find grasps of bodies ``which`` by their rims, with all margins but those of the surroundings."""
    found = [] if around.plane is None else [rim for k in which for rim in _rims(bodies[k], int(k), gripper, around)]
    owner = np.array([rim[0] for rim in found], dtype=int).repeat(len(_INSETS))
    inset = np.tile(_INSETS, len(found))
    width = np.array([rim[2] for rim in found]).repeat(len(_INSETS))
    frames = np.array([rim[1] for rim in found]).reshape(-1, 3, 4).repeat(len(_INSETS), axis=0)
    frames[:, :, 3] += (inset - gripper.tip)[:, None] * frames[:, :, 2]
    sigma = np.hypot(POINT_SIGMA, placement)
    opening = np.minimum(width + 2 * (CLEARANCE + 2 * sigma), gripper.opening)
    boxes = gripper.boxes_at(opening)
    middle = np.linalg.norm(frames[:, :, 3] - bodies.translation[owner], axis=1)
    mass = _WALLS * DENSITY * bodies.volume()[owner]
    logs = np.zeros((len(owner), len(MARGINS)))
    sides = np.repeat(log_phi(0.5 * (opening - width) + PASSES, sigma)[:, None], 2, axis=1)
    logs[:, 0] = sides.sum(axis=1)
    logs[:, 1] = log_phi(inset - LEAST_ENGAGED, sigma)
    logs[:, 2] = log_phi(gripper.palm + gripper.tip - inset, sigma)
    logs[:, 3] = np.log(_UPRIGHT)
    logs[:, 4] = weight(mass, middle, 2 * friction * gripper.force, inset)
    if around.plane is not None:
        heights = clearance.heights_above(around.plane, frames, boxes)
        logs[:, 5] = log_phi(heights, np.hypot(TABLE_SIGMA, placement))
    trials = Trials(owner, frames, opening, width, logs, sides)
    is_free = clearance.gaps_to_points(frames, boxes, around.points) > 0
    return trials.at(np.flatnonzero(is_free & _is_open(trials, boxes[:, 1], around)))


def _rims(
    body: Superquadric, owner: int, gripper: Gripper, around: Surroundings
) -> Iterator[tuple[int, np.ndarray, float]]:
    """Return owner, frame (3, 4) on the rim, y outwards, and wall thickness of each bearing that has a rim."""
    assert around.plane is not None
    upwards = around.plane[:3] @ body.rotation_matrix
    axis = int(np.argmax(np.abs(upwards)))
    up, first = np.sign(upwards[axis]) * body.rotation_matrix[:, axis], body.rotation_matrix[:, axis - 1]
    outwards = np.outer(np.cos(_BEARINGS), first) + np.outer(np.sin(_BEARINGS), np.cross(up, first))
    reach, high = body.support(outwards), float(body.support(up[None])[0])
    points = around.points - body.translation
    points = points[(np.abs(points @ up) < high + _BEYOND) & (np.linalg.norm(points, axis=1) < reach.max() + high)]
    height, away = points @ up, points @ outwards.T
    aside = np.abs(points @ np.cross(up, outwards).T)
    there = (aside < 0.5 * gripper.finger_width) & (away > 0.6 * reach) & (away < reach + _BEYOND)
    for k in np.flatnonzero(there.sum(axis=0) >= _STRAY):
        top = np.sort(height[there[:, k]])[-_STRAY]
        inner, outer = np.percentile(away[there[:, k] & (height > top - _HIGH), k], [10, 90])
        if outer - inner <= _THIN:
            axes = np.stack([np.cross(up, outwards[k]), outwards[k], -up], axis=1)
            axes[:, 0] = np.cross(axes[:, 1], axes[:, 2])
            place = body.translation + 0.5 * (inner + outer) * outwards[k] + top * up
            yield owner, np.concatenate([axes, place[:, None]], axis=1), float(outer - inner)


def _is_open(trials: Trials, fingers: np.ndarray, around: Surroundings) -> np.ndarray:
    """Return whether the image shows something beyond most of the end of each finger (k, 6)."""
    grid = np.array([[x, y, 1.0] for x in (-0.8, 0.0, 0.8) for y in (-0.8, 0.0, 0.8)])
    local = fingers[:, None, :3] + grid * fingers[:, None, 3:]
    ends = local @ trials.frames[:, :, :3].transpose(0, 2, 1) + trials.frames[:, None, :, 3]
    return np.mean(around.beyond(ends) > 0, axis=1) > 0.7
