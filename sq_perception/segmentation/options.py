"""What counts as an object: the options of :func:`sq_perception.segmentation.segments.segment`, and their tests.

Sizes are edges of a box around what points show, as a ruler measures them.  Metres, optical frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sq_perception.geometry import rotation

Box = tuple[float, float, float, float, float, float]
Pose = tuple[tuple[float, float, float, float], tuple[float, float, float]]
"""Quaternion x y z w and translation."""

LARGEST_THING = 0.6
"""Metres: the largest edge of a thing, unless it is said otherwise."""
POINTS = 400
"""Points of a segment, evenly taken, for its size and its middle."""
TURNS = np.stack([np.cos(np.deg2rad(np.arange(0, 180, 10))), np.sin(np.deg2rad(np.arange(0, 180, 10)))], axis=1)
"""Directions (18, 2) in which edges are measured."""
EVERYTHING = (0.0, np.inf)
"""Range of all depths, metres."""


@dataclass(frozen=True, kw_only=True)
class SegmentationOptions:
    """What counts as an object.

    Attributes
    ----------
    depth_range
        Nearest and farthest depth that is looked at, metres.
    max_objects
        The largest ones are kept.
    max_size
        Largest edge of an object, metres; what is larger is furniture.  Not asked of labels from outside.
    workspace
        The middle of what is seen of an object lies in this box, metres: least x, y, z and greatest x, y, z.  None:
        anywhere.
    workspace_pose
        Quaternion x y z w and translation of the optical frame in the frame of the box; None: they are the same.
    """

    depth_range: tuple[float, float] = EVERYTHING
    max_objects: int = 20
    max_size: float = LARGEST_THING
    workspace: Box | None = None
    workspace_pose: Pose | None = None

    def __post_init__(self) -> None:
        near, far = self.depth_range
        if not (0 <= near < far):
            raise ValueError(f"depth_range: expected 0 <= nearest < farthest, got {self.depth_range}")
        if not (self.max_objects >= 1 and self.max_objects == int(self.max_objects)):
            raise ValueError(f"max_objects: expected a whole number, at least 1, got {self.max_objects}")
        if self.workspace is not None:
            box = tuple(self.workspace)
            if len(box) != 6 or not all(low < high for low, high in zip(box[:3], box[3:], strict=True)):
                raise ValueError(
                    f"workspace: expected least x, y, z and greater x, y, z in metres, got {self.workspace}"
                )
        if self.workspace_pose is not None:
            turn, place = (np.asarray(part, dtype=float) for part in self.workspace_pose)
            if turn.shape != (4,) or place.shape != (3,) or not np.isfinite([*turn, *place]).all() or not turn.any():
                raise ValueError(
                    f"workspace_pose: expected a quaternion and a translation in metres, got {self.workspace_pose}"
                )
        if not self.max_size > 0:
            raise ValueError(f"max_size: expected a positive number, got {self.max_size}")

    def is_within(self, points: np.ndarray) -> bool:
        """Whether the middle of points (n, 3) lies in the workspace."""
        if self.workspace is None:
            return True
        if self.workspace_pose is not None:
            turn, place = self.workspace_pose
            points = points @ rotation.to_matrix(np.array(turn)).T + np.array(place)
        middle = np.median(points, axis=0)
        return bool((middle >= self.workspace[:3]).all() and (middle <= self.workspace[3:]).all())


def across(normal: np.ndarray) -> np.ndarray:
    """Two axes (3, 2) at right angles to a normal."""
    x, y, z = normal.tolist()
    a, b, c = (z, 0.0, -x) if abs(z) > 0.5 else (-y, x, 0.0)
    axes = np.array([[a, y * c - z * b], [b, z * a - x * c], [c, x * b - y * a]])
    return axes / math.sqrt(a * a + b * b + c * c)


def largest_edge(points: np.ndarray, up: np.ndarray | None = None) -> float:
    """Largest edge of the box around points (n, 3) whose largest edge is least, metres: upright, or of principal axes.

    A hundredth of the points at either end may stick out.
    """
    points = points[:: 1 + len(points) // POINTS]
    if up is None:
        axes = np.linalg.eigh(np.cov(points.T))[1] if len(points) > 3 else np.eye(3)
        return float(_extents(axes.T @ points.T).max())
    edges = _extents(np.concatenate([TURNS @ across(up).T, up[None]]) @ points.T)
    # A quarter turn apart, the two edges of one rectangle.
    half = len(TURNS) // 2
    return float(max(np.maximum(edges[:half], edges[half:-1]).min(), edges[-1]))


def _extents(values: np.ndarray) -> np.ndarray:
    """The extent of the values of each row, without what sticks out."""
    ordered = np.sort(values, axis=1)
    out = values.shape[1] // 100
    return np.asarray(ordered[:, -1 - out] - ordered[:, out])
