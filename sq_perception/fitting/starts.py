"""Where a search begins: boxes around the measured points, and bodies completed by central symmetry.

Boxes lie along the points' principal axes, or stand on a support plane.  The oriented box of the visible points is a
lower bound of the body in every direction; on a plane, its height is exact as far as the top is seen.

Central symmetry: a superquadric is its own reflection through its centre C.

Under orthographic projection the hidden half is the visible half reflected, and the silhouette's centre is the
centre's projection.  With p(u) the point seen at pixel u and u' the pixel opposite to u about the silhouette's centre,
the ray of u enters the body at p(u) and leaves it near 2 C - p(u').  So, for every pair,

    midpoint    m = (p(u) - p(u')) / 2                  (relative to C)
    half chord  h = C - (p(u) + p(u')) / 2              (must point away from the camera)

which bounds the centre's depth: z_C >= (z(u) + z(u')) / 2, with equality at the outline.  The largest of these is z_C,
and the chords together are the whole body: its second moments are M = sum |h| (m m^T + h h^T / 3) / sum |h|.

The principal axes of M are the axes of the body, up to their order: which one is z is not known, so each is tried.  A
half size is sqrt(M_kk / 0.27): the share is 0.2 for an ellipsoid, 1/3 for a box.  For pinhole cameras all this holds
approximately, the better the smaller the body against its distance; an iteration only starts from it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import cv2
import numpy as np

from sq_perception.fitting.cost import PARAMETERS
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.observation import Observation, span
from sq_perception.fitting.options import MIN_PIXELS
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric

_BOX_EXPONENT = 0.3
"""Exponents of a start from a box, nearer to a box than to an ellipsoid; a few steps find the rest."""
MOMENT_SHARE = 0.27
START_EXPONENT = 0.5
"""Moment over squared half size, and exponents, of a start: between ellipsoid (0.2, 1) and box (1/3, 0)."""
EIGHTH_TURNS = quaternions.to_matrix(quaternions.from_rotation_vector(np.eye(3) * math.pi / 4))
"""Rotations (3, 3, 3) by 45 degrees about each axis."""
ORDERS = np.array([[1, 2, 0], [2, 0, 1], [0, 1, 2]])
"""Which of three right-handed axes are x, y and z, so that each is z once."""


def enclosing_box(points: np.ndarray, footprint: float) -> Superquadric:
    """A valid box-like body around any points (n >= 1, 3): the best that is known when no fit is possible."""
    centre = points.mean(axis=0)
    axes = principal_axes(_scatter(points))
    local = (points - centre) @ axes
    low, high = local.min(axis=0), local.max(axis=0)
    size = np.maximum((high - low) / 2, max(footprint, 1e-6))
    return Superquadric(size, np.array([0.2, 0.2]), centre + axes @ ((low + high) / 2), quaternions.from_matrix(axes))


def reason_to_fail(points: np.ndarray, count: int, of: str) -> str:
    """Why no body can be fitted to points (n >= 1, 3), ``count`` ``of`` what was measured; empty if one can."""
    if count < MIN_PIXELS:
        return f"{count} {of}; a fit needs {MIN_PIXELS}"
    spread = np.linalg.eigvalsh(_scatter(points))
    return "the measured points lie on one line" if spread[1] <= 1e-6 * spread[2] else ""


def principal(points: np.ndarray) -> list[State]:
    """Boxes along the principal axes of the points, for each choice of z."""
    axes = principal_axes(_scatter(points))
    low, high = span(points, axes.T).T
    return boxes(low, high, axes)


def on_plane(points: np.ndarray, plane: np.ndarray) -> list[State]:
    """Boxes that stand on the plane: smallest rectangle around the footprint of the points, down to the plane."""
    axes = standing_axes(points, plane[:3])
    low, high = span(points, axes.T).T
    low[2] = min(float(-plane[3] * plane[:3] @ axes[:, 2]), high[2] - 1e-4)
    return boxes(low, high, axes)


def standing_axes(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Columns (3, 3): the sides of the smallest rectangle around the footprint of the points, and the unit normal."""
    x, y, z = normal
    first = np.array([y, -x, 0.0] if abs(z) < 0.9 else [0.0, z, -y])  # across z, or across x
    first /= np.linalg.norm(first)
    second = quaternions.cross(normal, first)
    _, _, angle = cv2.minAreaRect((points @ np.column_stack([first, second])).astype(np.float32))
    c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    return np.column_stack([c * first + s * second, -s * first + c * second, normal])


def three_orders(axes: np.ndarray) -> list[np.ndarray]:
    """The rotations (3, 3) with these axes (columns, right-handed) whose z axis is each of them in turn."""
    return [np.ascontiguousarray(axes[:, order]) for order in ORDERS]


def principal_axes(moments: np.ndarray) -> np.ndarray:
    """Right-handed eigenvectors (3, 3), as columns."""
    _, axes = np.linalg.eigh(moments)
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    return axes


def _scatter(points: np.ndarray) -> np.ndarray:
    centred = points - points.mean(axis=0)
    return np.asarray(centred.T @ centred)


def boxes(low: np.ndarray, high: np.ndarray, axes: np.ndarray, exponent: float = _BOX_EXPONENT) -> list[State]:
    """The box from ``low`` to ``high`` along the axes (columns), for each choice of z."""
    parameters = np.full((len(ORDERS), PARAMETERS), exponent)
    parameters[:, :3] = np.maximum((high - low) / 2, 1e-6)[ORDERS]
    parameters[:, 5:8] = axes @ ((low + high) / 2)
    parameters[:, 8:] = 0.0
    return [State(*each, math.inf, 0) for each in zip(parameters, three_orders(axes), strict=True)]


# Central symmetry


def groups(observation: Observation) -> Iterator[list[State]]:
    """Groups of starts in the order in which to try them: bodies completed by symmetry, if anything shows it, and boxes
    of the points."""
    if (completed := completed_moments(observation)) is not None:
        axes = principal_axes(completed[1])
        yield from (states(*completed, each) for each in (axes, *eighth_turns(axes)))
    yield principal(observation.points)


def completed_moments(observation: Observation) -> tuple[np.ndarray, np.ndarray] | None:
    """Centre (3,) and second moments (3, 3) about it of the completed body; None if no pixel has an opposite."""
    camera, depth = observation.camera, observation.depth
    silhouette = cv2.moments(observation.mask.view(np.uint8), binaryImage=True)
    middle = np.array([silhouette["m10"], silhouette["m01"]]) / silhouette["m00"]
    # Some 2500 pairs give second moments to 2 %.
    stride = max(1, round(math.sqrt(len(observation.pixels) / 2500)))
    seen = observation.mask & np.isfinite(depth)
    v, u = stride * np.array(np.nonzero(seen[::stride, ::stride]))
    opposite_u, opposite_v = np.floor(2 * middle[:, None] - (u, v) + 0.5).astype(int)
    within = (opposite_u >= 0) & (opposite_v >= 0) & (opposite_u < camera.width) & (opposite_v < camera.height)
    has_opposite = within & seen[opposite_v * within, opposite_u * within]
    if np.count_nonzero(has_opposite) < 3:
        return None
    u, v, opposite_u, opposite_v = (each[has_opposite] for each in (u, v, opposite_u, opposite_v))
    points = camera.unproject(u, v, depth[v, u])
    opposite = camera.unproject(opposite_u, opposite_v, depth[opposite_v, opposite_u])
    across, between = (points - opposite) / 2, (points + opposite) / 2
    # The centre's depth is the largest mean depth of a pair, but for some in case of stray pixels.
    rank = len(between) - 1 - min(max(4 // stride**2, int(0.002 * len(between))), len(between) - 1)
    centre = camera.unproject(middle[0], middle[1], np.partition(between[:, 2], rank)[rank])
    chord = centre - between
    weight = np.maximum(chord[:, 2:], observation.footprint / 2)
    moments = ((weight * across).T @ across + (weight * chord).T @ chord / 3) / weight.sum()
    return centre, moments


def eighth_turns(axes: np.ndarray) -> np.ndarray:
    """The axes turned by 45 degrees about each of themselves: where two moments are alike, their axes are arbitrary."""
    return np.asarray(axes @ EIGHTH_TURNS)


def states(centre: np.ndarray, moments: np.ndarray, axes: np.ndarray) -> list[State]:
    """The three bodies with these axes and moments, one for each choice of z."""
    found = []
    for rotation in three_orders(axes):
        spread = np.einsum("ji,jk,ki->i", rotation, moments, rotation)
        size = np.sqrt(np.maximum(spread, 1e-12) / MOMENT_SHARE)
        parameters = np.concatenate([size, [START_EXPONENT] * 2, centre, [0.0, 0.0]])
        found.append(State(parameters, rotation, math.inf, 0))
    return found


# Rivals of a body at hand


def turned(state: State) -> State:
    """The body turned by 45 degrees about its z: a square cross-section and a round one are hard to distinguish."""
    parameters = state.parameters.copy()
    parameters[:2] = math.sqrt(0.5 * (parameters[0] ** 2 + parameters[1] ** 2))
    parameters[4] = START_EXPONENT
    return State(parameters, np.ascontiguousarray(state.rotation @ EIGHTH_TURNS[2]), math.inf, state.iterations)


def other_orders(state: State, exponent: float = START_EXPONENT) -> list[State]:
    """Bodies of the same box with each of its other axes as z."""
    found = []
    for order in three_orders(np.eye(3))[:2]:
        parameters = state.parameters.copy()
        parameters[:3] = order.T @ parameters[:3]
        parameters[3:5] = exponent
        found.append(State(parameters, np.ascontiguousarray(state.rotation @ order), math.inf, state.iterations))
    return found


def resized(state: State, axis: int, size: float, end: float = 0.0) -> State:
    """The body with another half size along one of its axes: that ``end``, 1 or -1, moves; 0: the hidden one."""
    parameters = state.parameters.copy()
    direction = state.rotation[:, axis]
    away = end or math.copysign(1.0, direction @ parameters[5:8])
    parameters[5:8] += away * (size - parameters[axis]) * direction
    parameters[axis] = size
    return State(parameters, state.rotation, math.inf, state.iterations)
