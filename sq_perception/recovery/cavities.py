"""Cavities of open vessels: an opening that the camera sees into, with its rim and its depth.

A body is convex and closed, so that a cavity is what readings say against its top.  In the frame of a body, z along
one of its axes, a pixel's line of sight crosses the level of the rim at a point q, and its reading lies d below:

    d = h_rim - z(reading),        rho = ((q_x / a1)^(2/e2) + (q_y / a2)^(2/e2))^(e2/2).

There is a cavity if many lines that cross within the opening, rho < 0.7, end well below it (seen at an angle, some meet
the far wall), and if readings at the level of the rim surround it: most sectors around the axis have one at rho 0.7 to
1.2.  The level is the median of the sectors' highest readings there.  A lid, a dome or a flat top has its readings
at or above that level, and a thing that is no convex body, such as a bend, has sectors without a rim.

The depth is that of the deepest readings, so at least as deep is the cavity; where these lie apart from the wall they
are those of the floor, or of what is in the vessel.

Metres, optical frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sq_perception.fitting.fit import Fit, Status

if TYPE_CHECKING:
    from sq_perception.recovery.seen_object import SeenObject

_OPENING, _OUTERMOST = 0.7, 1.2
"""rho up to which a line of sight passes the opening, and of the outermost reading of a rim."""
_SECTORS = 24


@dataclass(frozen=True, eq=False)
class Cavity:
    """The cavity of an open vessel.

    Attributes
    ----------
    rim : (3,)
        Centre of the opening at the level of the rim.
    axis : (3,)
        Unit vector out of the opening.
    half_widths : (2,)
        Half of the outer widths of the rim, the narrower first.
    depth
        From the rim to the deepest readings.
    sees_floor
        Whether these are of the floor, or of what is in the vessel; otherwise the cavity may be deeper.
    """

    rim: np.ndarray
    axis: np.ndarray
    half_widths: np.ndarray
    depth: float
    sees_floor: bool


def find_cavity(obj: SeenObject, fits: Sequence[Fit]) -> Cavity | None:
    """Find the cavity of an object whose body, or whose parts, are given; the widest one, None where none is seen."""
    camera, mask = obj.camera_crop, obj.mask_crop & np.isfinite(obj.depth_crop)
    if not camera.is_pinhole:
        return None
    rows, columns = np.nonzero(mask)
    points = camera.unproject(columns, rows, obj.depth_crop[rows, columns].astype(float))
    some = [each for fit in fits if fit.status != Status.FAILED for each in _cavities(fit, points)]
    return max(some, key=lambda each: float(each.half_widths[0]), default=None)


def _cavities(fit: Fit, points: np.ndarray) -> Iterator[Cavity]:
    """Yield the cavities of one body at those of its ends that face the camera."""
    body = fit.superquadric
    for axis in range(3):
        order = [(axis + 1) % 3, (axis + 2) % 3, axis]
        turn = body.rotation_matrix[:, order]
        if turn[:, 2] @ body.translation > 0:  # towards the camera, at the origin
            turn = turn * [1.0, -1.0, -1.0]
        # Cosine between the axis and the way to the camera from which on it sees into an opening.
        if -(turn[:, 2] @ body.translation) > 0.15 * np.linalg.norm(body.translation):
            e2 = body.shape[1] if axis == 2 else body.shape[0]
            found = _at_end(points, body.translation, turn, body.size[order], float(e2), fit.noise)
            if found is not None:
                yield found


def _at_end(
    points: np.ndarray, centre: np.ndarray, turn: np.ndarray, size: np.ndarray, e2: float, noise: float
) -> Cavity | None:
    """The cavity at the end of a body along the third axis of ``turn``, half sizes in the order of these axes."""
    eye, seen = -centre @ turn, (points - centre) @ turn
    noise = noise if math.isfinite(noise) else 0.0
    spread = 0.005 + noise  # metres by which the heights of readings of one rim differ

    def place(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        u, v = at[:, 0] / size[0], at[:, 1] / size[1]
        rho = (np.abs(u) ** (2 / e2) + np.abs(v) ** (2 / e2)) ** (e2 / 2)
        return rho, ((np.arctan2(v, u) / (2 * math.pi) + 0.5) * _SECTORS).astype(int) % _SECTORS

    rho, sector = place(seen)
    is_rim = (rho > _OPENING) & (rho < _OUTERMOST)
    highest = np.full(_SECTORS, -np.inf)
    np.maximum.at(highest, sector[is_rim], seen[is_rim, 2])
    if not np.isfinite(highest).any():
        return None
    level = float(np.median(highest[np.isfinite(highest)]))
    # There is a rim in most of the sectors.
    if np.mean(np.abs(highest - level) < spread) < 0.7 or eye[2] <= level:
        return None
    along = (eye[2] - level) / np.maximum(eye[2] - seen[:, 2], 1e-9)
    through, _ = place(eye + along[:, None] * (seen - eye))
    passes = through < _OPENING
    below = level - seen[passes, 2]
    least = max(0.008, 0.15 * float(size[:2].min())) + noise  # metres that are well below a rim
    if len(below) < 12 or np.mean(below > least) < 0.3:
        return None
    deepest = below >= np.quantile(below, 1 - 0.1)
    return Cavity(
        rim=centre + level * turn[:, 2], axis=turn[:, 2].copy(), half_widths=np.sort(size[:2]),
        depth=float(np.median(below[deepest])), sees_floor=bool(np.median(rho[passes][deepest]) < 0.75),
    )
