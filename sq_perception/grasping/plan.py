"""Grasps and plans of grasps.

The pose of a grasp is that of the TCP (:mod:`sq_perception.grasping.gripper`) in the frame of the bodies; metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sq_perception.geometry import rotation as quaternions


@dataclass(frozen=True, eq=False)
class Grasp:
    """A grasp."""

    body: int
    """Position of its body in the batch, or the number of its thing where bodies are parts of things."""
    position: np.ndarray
    """(3,), of the TCP in the frame of the bodies."""
    rotation: np.ndarray
    """(4,), quaternion x y z w."""
    opening: float
    """Distance between the fingers before they close."""
    width: float
    """Width of the body between them."""
    score: float
    """Probability that it holds."""
    weakest: str
    """The margin that takes most from the score."""

    def to_body_frame(self, points: np.ndarray) -> np.ndarray:
        """Transform points (j, 3) from the TCP's frame to the frame of the bodies."""
        return points @ np.asarray(quaternions.to_matrix(self.rotation)).T + self.position


@dataclass(frozen=True, eq=False)
class GraspPlan:
    """Grasps of all bodies, the most probable first, and why bodies have none."""

    grasps: tuple[Grasp, ...] = ()
    """At most :data:`sq_perception.grasping.planner.PER_BODY` a body."""
    reasons: tuple[str, ...] = ()
    """One a body, empty for those with a grasp."""

    def of(self, body: int) -> tuple[Grasp, ...]:
        """Return the grasps of one body, best first."""
        return tuple(grasp for grasp in self.grasps if grasp.body == body)
