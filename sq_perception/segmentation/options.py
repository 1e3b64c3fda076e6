"""What counts as an object: the options of :func:`sq_perception.segmentation.segments.segment`, and their tests.

Metres, optical frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sq_perception.geometry import rotation
from sq_perception.segmentation.extent import LARGEST_THING, largest_edge

Box = tuple[float, float, float, float, float, float]
Pose = tuple[tuple[float, float, float, float], tuple[float, float, float]]
"""Quaternion x y z w and translation."""

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

    def is_small(self, points: np.ndarray, up: np.ndarray | None = None) -> bool:
        """Whether points (n, 3) are no larger than a thing."""
        return largest_edge(points, up) <= self.max_size

    def is_within(self, points: np.ndarray) -> bool:
        """Whether the middle of points (n, 3) lies in the workspace."""
        if self.workspace is None:
            return True
        if self.workspace_pose is not None:
            turn, place = self.workspace_pose
            points = points @ rotation.to_matrix(np.array(turn)).T + np.array(place)
        middle = np.median(points, axis=0)
        return bool((middle >= self.workspace[:3]).all() and (middle <= self.workspace[3:]).all())
