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
from sq_perception.grasping import trials as margins
from sq_perception.grasping.gripper import Gripper
from sq_perception.grasping.surroundings import Surroundings
from sq_perception.grasping.trials import Trials


def rim_grasps(
    bodies: Superquadric, which: np.ndarray, gripper: Gripper, around: Surroundings, friction: float, placement: float
) -> Trials:
    """Find grasps of bodies ``which`` by their rims, with all margins but those of the surroundings."""
    found = [] if around.plane is None else [rim for k in which for rim in _rims(bodies[k], int(k), gripper, around)]
    insets = np.array([0.012, 0.02, 0.03])  # of the fingers' ends below the rim, metres
    owner = np.array([rim[0] for rim in found], dtype=int).repeat(len(insets))
    inset = np.tile(insets, len(found))
    width = np.array([rim[2] for rim in found]).repeat(len(insets))
    frames = np.array([rim[1] for rim in found]).reshape(-1, 3, 4).repeat(len(insets), axis=0)
    frames[:, :, 3] += (inset - gripper.tip)[:, None] * frames[:, :, 2]
    sigma = np.hypot(margins.POINT_SIGMA, placement)
    opening = np.minimum(width + 2 * (margins.CLEARANCE + 2 * sigma), gripper.opening)
    boxes = gripper.boxes_at(opening)
    middle = np.linalg.norm(frames[:, :, 3] - bodies.translation[owner], axis=1)
    mass = 0.3 * margins.DENSITY * bodies.volume()[owner]  # walls of 4 mm of a vessel 8 cm wide and 10 cm high
    logs = np.zeros((len(owner), len(margins.MARGINS)))
    sides = np.repeat(margins.log_phi(0.5 * (opening - width) + margins.PASSES, sigma)[:, None], 2, axis=1)
    logs[:, 0] = sides.sum(axis=1)
    logs[:, 1] = margins.log_phi(inset - margins.LEAST_ENGAGED, sigma)
    logs[:, 2] = margins.log_phi(gripper.palm + gripper.tip - inset, sigma)
    # In place of friction, as nothing tells how steep a wall is: nine in ten of the rims whose other margins
    # are sure hold in benchmarks/picking.py (not its reported scenes).
    logs[:, 3] = np.log(0.9)
    logs[:, 4] = margins.weight(mass, middle, 2 * friction * gripper.force, inset)
    if around.plane is not None:
        heights = clearance.heights_above(around.plane, frames, boxes)
        logs[:, 5] = margins.log_phi(heights, np.hypot(margins.TABLE_SIGMA, placement))
    trials = Trials(owner, frames, opening, width, logs, sides)
    is_free = clearance.gaps_to_points(frames, boxes, around.points) > 0
    return trials.at(np.flatnonzero(is_free & _is_open(trials, boxes[:, 1], around)))


def _rims(
    body: Superquadric, owner: int, gripper: Gripper, around: Surroundings
) -> Iterator[tuple[int, np.ndarray, float]]:
    """Return owner, frame (3, 4) on the rim, y outwards, and wall thickness of each bearing that has a rim.  A rim is 6
    mm high, up to 12 mm thick and up to 15 mm outside of the body."""
    assert around.plane is not None
    upwards = around.plane[:3] @ body.rotation_matrix
    axis = int(np.argmax(np.abs(upwards)))
    up, first = np.sign(upwards[axis]) * body.rotation_matrix[:, axis], body.rotation_matrix[:, axis - 1]
    bearings = np.arange(24) * np.pi / 12
    outwards = np.outer(np.cos(bearings), first) + np.outer(np.sin(bearings), np.cross(up, first))
    reach, high = body.support(outwards), float(body.support(up[None])[0])
    points = around.points - body.translation
    points = points[(np.abs(points @ up) < high + 0.015) & (np.linalg.norm(points, axis=1) < reach.max() + high)]
    height, away = points @ up, points @ outwards.T
    aside = np.abs(points @ np.cross(up, outwards).T)
    there = (aside < 0.5 * gripper.finger_width) & (away > 0.6 * reach) & (away < reach + 0.015)
    stray = 3  # from here on below the highest points: flying pixels may be above
    for k in np.flatnonzero(there.sum(axis=0) >= stray):
        top = np.sort(height[there[:, k]])[-stray]
        inner, outer = np.percentile(away[there[:, k] & (height > top - 0.006), k], [10, 90])
        if outer - inner <= 0.012:
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
