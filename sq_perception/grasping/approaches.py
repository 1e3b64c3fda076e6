"""Approaches of a parallel gripper to a body, and the places of its pads along them.

A closing is a direction y along which a body is narrow enough and whose opposite surfaces the pads meet squarely.  The
hand approaches along z, perpendicular to y: as steeply as possible, or rotated about y.  With x the cross product of y
and z the TCP is at

    t + u z + v x,    t the body's centre, u the depth (deepest, shallow, between), v the slide along the body.

Metres, in the frame of the bodies.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sq_perception.geometry.kernels import kernel
from sq_perception.grasping import clearance
from sq_perception.grasping.closing import DIRECTIONS, KnownBodies
from sq_perception.grasping.gripper import Gripper
from sq_perception.grasping.surroundings import Surroundings
from sq_perception.grasping.trials import CLEARANCE, LEAST_ENGAGED


class Closings(NamedTuple):
    """k directions along which bodies may be gripped."""

    owner: np.ndarray  # int (k,), the bodies
    along: np.ndarray  # (k, 3), to the first side
    reach: np.ndarray  # (k,)
    sigma: np.ndarray  # (k, 2), of both sides


class Approaches(NamedTuple):
    """k closings, each with an approach direction; arrays (k,) where not told."""

    owner: np.ndarray
    reach: np.ndarray
    sigma: np.ndarray  # as of the closings
    frames: np.ndarray  # (k, 3, 4), the TCP's axes as columns, and the body's centre
    tilting: np.ndarray
    """(k, 3), horizontal, across the closing line: what lies off the centre along it turns the body in the hand."""
    near: np.ndarray  # distance from the centre to the near end
    near_sigma: np.ndarray
    across: np.ndarray  # distance from the centre to the end along x
    opening: np.ndarray  # of the fingers
    shift: np.ndarray  # of the hand, towards the side that is less sure
    deepest: np.ndarray  # u at which the palm or the table stops the hand, or the centre is reached
    height: np.ndarray  # of the lowest corner above the table with the TCP in the centre; inf without a table

    def at(self, which: np.ndarray) -> Approaches:
        return Approaches(*(part[which] for part in self))


class Places(NamedTuple):
    """k candidate positions of the TCP."""

    of: np.ndarray  # int (k,), indices of their approaches
    ahead: np.ndarray  # (k,), u
    offset: np.ndarray  # (k, 3), from the body's centre
    ends: np.ndarray
    """(k, 2), from the offset along the closing line to the body's surface on either side; NaN where it misses."""
    angle: np.ndarray
    """(k,), the larger one between that line and the normals there; NaN likewise, and where it is too large to hold."""


def closings(bodies: KnownBodies, gripper: Gripper, friction: float) -> Closings:
    """Find closings along which bodies fit and whose middle fingers meet squarely, for a friction mu."""
    owner = np.repeat(np.arange(len(bodies)), len(DIRECTIONS))
    along = (DIRECTIONS @ bodies.turns.transpose(0, 2, 1)).reshape(-1, 3)
    reach, there = bodies.reaches(owner, along)
    _, here = bodies.reaches(owner, -along)
    _, half = bodies.in_place().reaches(owner, along)
    fits = reach - 0.8 * half < 0.5 * gripper.opening  # else it fits less than once in five times
    fits &= bodies.middle_angles(owner, along) < np.arctan(friction)
    return Closings(owner[fits], along[fits], reach[fits], np.stack([there, here], axis=1)[fits])


def approach_from_every_side(
    bodies: KnownBodies, found: Closings, gripper: Gripper, around: Surroundings, placement: float
) -> Approaches:
    """Approach every closing from every side except below; ``placement`` is the hand's sigma, metres."""
    swings = np.deg2rad([0.0, 25.0, -25.0, 50.0, -50.0, 80.0, -80.0])  # about the closing line, from the steepest one
    owner, y, half, side = (np.repeat(numbers, len(swings), axis=0) for numbers in found)
    down = around.down(bodies.middle[owner])
    steep = down - y * (y * down).sum(axis=1, keepdims=True)
    length = np.linalg.norm(steep, axis=1, keepdims=True)
    steep = steep / np.maximum(length, 1e-9)
    swing = np.tile(swings, len(found.owner))[:, None]
    z = np.cos(swing) * steep + np.sin(swing) * np.cross(y, steep)
    possible = (length[:, 0] > 0.3) & ((z * down).sum(axis=1) > 0)  # the closing line is not nearly vertical
    owner, y, z, half, side = owner[possible], y[possible], z[possible], half[possible], side[possible]
    x, tilting = np.cross(y, z), np.cross(down[possible], y)
    near, near_sigma = bodies.reaches(owner, -z)
    across, _ = bodies.reaches(owner, x)

    wanted = CLEARANCE + 2 * np.hypot(side, placement)
    room = np.minimum(gripper.opening - 2 * half, wanted.sum(axis=1))
    # Each side has its share of the room: the hand is moved towards the side that is less sure.
    shift = 0.5 * np.maximum(room, 0.0) * (wanted[:, 0] - wanted[:, 1]) / wanted.sum(axis=1)
    opening = 2 * half + room
    frames = np.stack([x, y, z, bodies.middle[owner]], axis=2)
    deepest = np.minimum(gripper.palm - CLEARANCE - near, 0.0)
    height = np.full(len(owner), np.inf)
    if around.plane is not None:
        height = clearance.heights_above(around.plane, frames, gripper.boxes_at(opening))
        sink = -(z @ around.plane[:3])  # down to 4 mm above the table
        low = np.where(sink > 1e-3, (height - 0.004) / np.maximum(sink, 1e-3), np.inf)
        deepest = np.minimum(deepest, low)
    return Approaches(owner, half, side, frames, tilting, near, near_sigma, across, opening, shift, deepest, height)


def places(bodies: KnownBodies, every: Approaches, gripper: Gripper, steepest: float) -> Places:
    """Find the places of each approach, at all depths and slides, where the pads meet the body squarely, up to
    ``steepest`` radians from its normals; of a body without any, all of its places."""
    # Shares of the distance at which the finger's width leaves the body.
    slides = np.array([0.0, 0.4, -0.4, 0.8, -0.8])
    shallow = np.minimum(0.012 - every.near - gripper.tip, every.deepest)  # so much finger beyond the near end
    rows = np.flatnonzero(every.deepest > LEAST_ENGAGED - every.near - gripper.tip)
    depth = np.stack([every.deepest, 0.5 * (every.deepest + shallow), shallow], axis=1)[rows]
    slide = np.maximum(every.across[rows] - 0.5 * gripper.finger_width, 0.0)[:, None] * slides
    count = len(slides) * depth.shape[1]
    u = np.repeat(depth, len(slides), axis=1).ravel()
    v = np.tile(slide, (1, depth.shape[1])).ravel()
    of = np.repeat(rows, count)
    distinct = (v != 0) | (np.tile(np.arange(count) % len(slides), len(rows)) == 0)
    u, v, of = u[distinct], v[distinct], of[distinct]

    # A pad touches where it overlaps the body, which may lie wholly beyond the TCP.
    near, owner = every.near[of], every.owner[of]
    touch = 0.5 * (np.maximum(u - gripper.tip, -near) + np.minimum(u + gripper.tip, near))
    along = np.ascontiguousarray(every.frames[of, :, 1])  # kernels are compiled for one kind of array
    ends, angle = bodies.chords(owner, _offsets(every.frames, of, v, touch), along, steepest)
    squarely = np.isfinite(angle)  # two in five
    has_any = np.zeros(len(bodies), dtype=bool)
    has_any[owner[squarely]] = True
    rows = np.flatnonzero(squarely | ~has_any[owner])
    u, v, of = u[rows], v[rows], of[rows]
    return Places(of, u, _offsets(every.frames, of, v, u), ends[rows], angle[rows])


@kernel
def _offsets(frames: np.ndarray, at: np.ndarray, aside: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Return offsets (k, 3) along the first and third axis of frames ``at`` (k,)."""
    offset = np.empty((len(at), 3))
    for k in range(len(at)):
        for i in range(3):
            offset[k, i] = aside[k] * frames[at[k], i, 0] + ahead[k] * frames[at[k], i, 2]
    return offset
