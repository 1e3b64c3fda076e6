"""How far a gripper stays from everything: other bodies, the table, measured points.

Two convex sets are apart by at least the gap along any direction n,

    gap(n) = n.(c_body - c_box) - h_body(-n) - h_box(n),

with the support functions h of body and box in closed form.  The greatest gap over some directions is a lower bound of
their distance: towards the body's centre from the box's nearest point, and along the axes of both.  It is negative
where none of them parts the two: a collision, or at worst a near miss that is taken for one.

Boxes are those of :meth:`Gripper.boxes`.  Metres.
"""

from __future__ import annotations

import math

import numpy as np

from sq_perception.geometry.kernels import kernel, support

FAR = 0.05
"""Gaps are cut off there: nothing depends on larger ones."""
_STRAY = 3
"""Nearest points that a gap is not told by: flying pixels."""


@kernel
def gaps_to_bodies(
    frames: np.ndarray, boxes: np.ndarray, owner: np.ndarray, flat: np.ndarray, turns: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Least gap (k,) of each gripper to all bodies but its own, and which body that is, -1 for none within reach.

    Parameters
    ----------
    frames : (k, 3, 4)
        Axes of the TCP as columns, and its position.
    boxes : (k, m, 6)
        Centres and half sizes in the frame of the TCP.
    owner : int (k,)
        The body that each is to grasp.
    flat, turns : (n, 12), (n, 3, 3)
        Flat parameters and rotation matrices of the bodies.
    """
    least = np.full(len(frames), FAR)
    which = np.full(len(frames), -1)
    for k in range(len(frames)):
        for body in range(len(flat)):
            if body == owner[k]:
                continue
            for box in range(boxes.shape[1]):
                gap = _gap(frames[k], boxes[k, box], flat[body], turns[body])
                if gap < least[k]:
                    least[k], which[k] = gap, body
    return least, which


@kernel
def _gap(frame: np.ndarray, box: np.ndarray, body: np.ndarray, turn: np.ndarray) -> float:
    """The gap of one box to one body, cut off at FAR."""
    # The body's centre in the box's frame, and the way to it from the box's nearest point.
    centre, way = np.empty(3), np.empty(3)
    for i in range(3):
        centre[i] = -box[i]
        for j in range(3):
            centre[i] += frame[j, i] * (body[5 + j] - frame[j, 3])
        way[i] = centre[i] - min(max(centre[i], -box[3 + i]), box[3 + i])
    distance = math.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2)
    if distance > math.sqrt(body[0] ** 2 + body[1] ** 2 + body[2] ** 2) + FAR:
        return FAR
    best = -1.0
    for trial in range(7):
        n = np.zeros(3)
        if trial == 0:
            if distance < 1e-9:
                continue
            for i in range(3):
                n[i] = way[i] / distance
        elif trial < 4:
            n[trial - 1] = 1.0
        else:
            for i in range(3):
                for j in range(3):
                    n[i] += frame[j, i] * turn[j, trial - 4]
        along = n[0] * centre[0] + n[1] * centre[1] + n[2] * centre[2]
        reach = abs(n[0]) * box[3] + abs(n[1]) * box[4] + abs(n[2]) * box[5]
        m = np.zeros(3)
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    m[i] += turn[k, i] * frame[k, j] * n[j]
        gap = abs(along) - reach - support(m[0], m[1], m[2], body[0], body[1], body[2], body[3], body[4])
        best = max(best, gap)
        if best >= FAR:
            break
    return min(best, FAR)


@kernel
def gaps_to_points(frames: np.ndarray, boxes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distance (k,) of each gripper to the points (j, 3), but for the few nearest; 0 where they are inside."""
    found = np.full(len(frames), FAR)
    for k in range(len(frames)):
        nearest = np.full(_STRAY + 1, FAR * FAR)
        frame = frames[k]
        for p in range(len(points)):
            dx, dy, dz = points[p, 0] - frame[0, 3], points[p, 1] - frame[1, 3], points[p, 2] - frame[2, 3]
            x = frame[0, 0] * dx + frame[1, 0] * dy + frame[2, 0] * dz
            y = frame[0, 1] * dx + frame[1, 1] * dy + frame[2, 1] * dz
            z = frame[0, 2] * dx + frame[1, 2] * dy + frame[2, 2] * dz
            square = FAR * FAR
            for box in range(boxes.shape[1]):
                b = boxes[k, box]
                u = max(abs(x - b[0]) - b[3], 0.0)
                v = max(abs(y - b[1]) - b[4], 0.0)
                w = max(abs(z - b[2]) - b[5], 0.0)
                square = min(square, u * u + v * v + w * w)
            slot = _STRAY
            if square < nearest[slot]:
                while slot > 0 and nearest[slot - 1] > square:
                    nearest[slot] = nearest[slot - 1]
                    slot -= 1
                nearest[slot] = square
        found[k] = math.sqrt(nearest[_STRAY])
    return found


def heights_above(plane: np.ndarray, frames: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Height (k,) of the lowest corner of each gripper's boxes above a plane n.p + d = 0."""
    normal = frames[:, :, :3].transpose(0, 2, 1) @ plane[:3]
    origin = frames[:, :, 3] @ plane[:3] + plane[3]
    below = (boxes[..., :3] @ normal[..., None])[..., 0] - (boxes[..., 3:] @ np.abs(normal)[..., None])[..., 0]
    return np.asarray((origin[:, None] + below).min(axis=1))
