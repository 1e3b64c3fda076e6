"""Clearance of a gripper from other bodies, the table and measured points.

The distance of two convex sets is at least the gap along any direction n,

    gap(n) = n.(c_body - c_box) - h_body(-n) - h_box(n),

with the support functions h of body and box in closed form.  The greatest gap over some directions is a lower bound of
the distance: towards the body's centre from the box's nearest point, and along the axes of both.  It is negative if no
direction separates them: a collision, or at worst a near miss.  Likewise the distance of a point inside a box is
negative: how far it would have to move to leave it.

Boxes are those of :meth:`Gripper.boxes`.  Metres.
"""

from __future__ import annotations

import math

import numpy as np

from sq_perception.geometry.kernels import inline_kernel, kernel, support

FAR, NEAR = 0.05, 0.02
"""Largest gap to a body and distance to a point, metres; larger ones are cut off, as nothing depends on them."""
_STRAY = 3  # number of nearest points that are ignored as flying pixels


@kernel
def gaps_to_bodies(
    frames: np.ndarray, boxes: np.ndarray, owner: np.ndarray, flat: np.ndarray, turns: np.ndarray, whole: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return each gripper's least gap (k,) to other bodies, that body's index (-1: none within reach), and n.

    The unit vector n (k, 3) points to the body, in the frame of the bodies; 0 for none.

    frames: (k, 3, 4), axes of the TCP as columns, and its position.
    boxes: (k, m, 6), centres and half sizes in the frame of the TCP.
    owner: int (k,), the body that each is to grasp.
    flat, turns: (n, 14), (n, 3, 3), parameters with tapers, and rotation matrices of the bodies.
    whole: int (n,), the body that each is a part of, itself if of none; -1 for a body of parts, in whose place these
        are.
    """
    least = np.full(len(frames), FAR)
    which = np.full(len(frames), -1)
    ways = np.zeros((len(frames), 3))
    centre, axes, reach, way = np.empty(3), np.empty((3, 3)), np.empty(3), np.empty(3)
    for k in range(len(frames)):
        frame = frames[k]
        for body in range(len(flat)):
            if body == owner[k] or whole[body] == owner[k] or whole[body] < 0:
                continue
            size = _half(flat[body])
            radius = math.sqrt(size[0] ** 2 + size[1] ** 2 + size[2] ** 2)
            _into(frame, flat[body, 5:8], centre)
            turned = False
            for box in range(boxes.shape[1]):
                if _distance(centre, boxes[k, box]) >= radius + least[k]:
                    continue
                if not turned:  # the body's axes in the gripper's frame, and its reach along the gripper's
                    turned = True
                    for i in range(3):
                        for j in range(3):
                            axes[i, j] = 0.0
                            for m in range(3):
                                axes[i, j] += frame[m, i] * turns[body, m, j]
                    for i in range(3):
                        reach[i] = _reach(axes[i], flat[body])
                gap = _gap(boxes[k, box], centre, axes, reach, flat[body], least[k], way)
                if gap < least[k]:
                    least[k], which[k] = gap, body
                    for i in range(3):
                        ways[k, i] = frame[i, 0] * way[0] + frame[i, 1] * way[1] + frame[i, 2] * way[2]
    return least, which, ways


@kernel
def _gap(
    box: np.ndarray, centre: np.ndarray, axes: np.ndarray, reach: np.ndarray, body: np.ndarray, enough: float,
    way: np.ndarray,
) -> float:
    """Return the gap of a box to a body, in the box's frame, along ``way`` (3,); any that is ``enough`` will do."""
    best = -1.0
    for i in range(3):
        gap = abs(centre[i] - box[i]) - box[3 + i] - reach[i]
        if gap > best:
            best = gap
            way[:] = 0.0
            way[i] = 1.0 if centre[i] > box[i] else -1.0
    own = _half(body)
    for j in range(3):
        along, half = 0.0, 0.0
        for i in range(3):
            along += axes[i, j] * (centre[i] - box[i])
            half += abs(axes[i, j]) * box[3 + i]
        gap = abs(along) - half - own[j]
        if gap > best:
            best = gap
            for i in range(3):
                way[i] = axes[i, j] if along > 0 else -axes[i, j]
    distance = _distance(centre, box)
    if best >= enough or distance < 1e-9:
        return best
    straight, local = np.empty(3), np.empty(3)
    along, half = 0.0, 0.0
    for i in range(3):
        away = centre[i] - box[i]
        straight[i] = (away - min(max(away, -box[3 + i]), box[3 + i])) / distance
        along += straight[i] * away
        half += abs(straight[i]) * box[3 + i]
    for j in range(3):
        local[j] = straight[0] * axes[0, j] + straight[1] * axes[1, j] + straight[2] * axes[2, j]
    gap = along - half - _reach(local, body)
    if gap > best:
        best = gap
        way[:] = straight
    return best


@inline_kernel
def _reach(m: np.ndarray, body: np.ndarray) -> float:
    """Return the support function of a body (14,) along m (3,) in its own frame, or along -m if that is more."""
    a1, a2, a3, e1, e2, k1, k2 = body[0], body[1], body[2], body[3], body[4], body[12], body[13]
    ahead = support(m[0], m[1], m[2], a1, a2, a3, e1, e2, k1, k2)
    if k1 == 0.0 and k2 == 0.0:
        return ahead
    return max(ahead, support(-m[0], -m[1], -m[2], a1, a2, a3, e1, e2, k1, k2))


@inline_kernel
def _half(body: np.ndarray) -> tuple[float, float, float]:
    """Return the half sizes of the box around a body (14,) along its axes."""
    return body[0] * (1.0 + abs(body[12])), body[1] * (1.0 + abs(body[13])), body[2]


@inline_kernel
def _distance(place: np.ndarray, box: np.ndarray) -> float:
    """Return the distance of a place (3,) to a box (6,) in the same frame; negative inside."""
    square, deep = 0.0, -np.inf
    for i in range(3):
        beyond = abs(place[i] - box[i]) - box[3 + i]
        square += max(beyond, 0.0) ** 2
        deep = max(deep, beyond)
    return math.sqrt(square) + min(deep, 0.0)


def gaps_to_points(frames: np.ndarray, boxes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return each gripper's distance (k,) to the points (j, 3), but for the few nearest; negative inside."""
    side = 0.03  # of the cubes that group points, metres
    cell = np.floor(points / side)
    key = cell @ [1.0, 1e4, 1e8]
    order = np.argsort(key)
    starts = np.flatnonzero(np.diff(key[order], prepend=np.nan, append=np.nan) != 0)
    middles = (cell[order[starts[:-1]]] + 0.5) * side
    return _gaps_to_cells(frames, boxes, points[order].T.copy(), middles.T.copy(), starts, 0.5 * math.sqrt(3.0) * side)


@kernel
def _gaps_to_cells(
    frames: np.ndarray, boxes: np.ndarray, points: np.ndarray, middles: np.ndarray, starts: np.ndarray,
    across: float,
) -> np.ndarray:
    """Do as :func:`gaps_to_points`, for points (3, j) sorted by cells, those of cell c from ``starts[c]`` on.  They are
    within ``across`` metres of their ``middles`` (3, c): cells that are out of reach are passed over."""
    found = np.empty(len(frames))
    of_cells, of_points = np.empty(middles.shape[1]), np.empty(points.shape[1])
    for k in range(len(frames)):
        nearest = np.full(_STRAY + 1, NEAR)
        _distances(frames[k], boxes[k], middles, of_cells)
        for c in range(len(of_cells)):
            if of_cells[c] > nearest[_STRAY] + across:
                continue
            inside = slice(starts[c], starts[c + 1])
            _distances(frames[k], boxes[k], points[:, inside], of_points[inside])
            for p in range(starts[c], starts[c + 1]):
                slot = _STRAY
                if of_points[p] < nearest[slot]:
                    while slot > 0 and nearest[slot - 1] > of_points[p]:
                        nearest[slot] = nearest[slot - 1]
                        slot -= 1
                    nearest[slot] = of_points[p]
        found[k] = nearest[_STRAY]
    return found


@inline_kernel
def _distances(frame: np.ndarray, boxes: np.ndarray, places: np.ndarray, least: np.ndarray) -> None:
    """Write the distances of places (3, j) to the nearest box (m, 6) of a gripper's frame to ``least``.  One loop over
    all places for each box, without a branch, so that it becomes vector code."""
    least[:] = np.inf
    for box in range(len(boxes)):
        x, y, z, long, wide, high = boxes[box]
        for p in range(len(least)):
            u, v, w = places[0, p] - frame[0, 3], places[1, p] - frame[1, 3], places[2, p] - frame[2, 3]
            i = abs(frame[0, 0] * u + frame[1, 0] * v + frame[2, 0] * w - x) - long
            j = abs(frame[0, 1] * u + frame[1, 1] * v + frame[2, 1] * w - y) - wide
            k = abs(frame[0, 2] * u + frame[1, 2] * v + frame[2, 2] * w - z) - high
            square = max(i, 0.0) ** 2 + max(j, 0.0) ** 2 + max(k, 0.0) ** 2
            least[p] = min(least[p], square - min(max(i, j, k), 0.0) ** 2)
    for p in range(len(least)):
        least[p] = math.copysign(math.sqrt(abs(least[p])), least[p])


@inline_kernel
def _into(frame: np.ndarray, place: np.ndarray, at: np.ndarray) -> None:
    """Write a place (3,) in a gripper's frame (3, 4) to ``at``."""
    for i in range(3):
        at[i] = 0.0
        for j in range(3):
            at[i] += frame[j, i] * (place[j] - frame[j, 3])


@kernel
def heights_above(plane: np.ndarray, frames: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Return the height (k,) of the lowest corner of each gripper's boxes above a plane n.p + d = 0."""
    height = np.full(len(frames), np.inf)
    up = np.empty(3)
    for k in range(len(frames)):
        origin = plane[3]
        for i in range(3):
            origin += plane[i] * frames[k, i, 3]
            up[i] = plane[0] * frames[k, 0, i] + plane[1] * frames[k, 1, i] + plane[2] * frames[k, 2, i]
        for box in range(boxes.shape[1]):
            low = origin
            for i in range(3):
                low += up[i] * boxes[k, box, i] - abs(up[i]) * boxes[k, box, 3 + i]
            height[k] = min(height[k], low)
    return height
