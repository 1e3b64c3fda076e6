"""Grasps and plans of grasps.

The pose of a grasp is that of the TCP (:mod:`sq_perception.grasping.gripper`) in the frame of the bodies; metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sq_perception.geometry import rotation as quaternions


@dataclass(frozen=True, eq=False)
class Grasp:
    """A grasp.

    Attributes
    ----------
    body
        Position of its body in the batch, or the number of its thing where bodies are parts of things.
    position, rotation : (3,), (4,)
        Pose of the TCP in the frame of the bodies; the rotation is a quaternion x y z w.
    opening
        Distance between the fingers before they close.
    width
        Width of the body between them.
    score
        Probability that it holds.
    weakest
        The margin that takes most from the score.
    """

    body: int
    position: np.ndarray
    rotation: np.ndarray
    opening: float
    width: float
    score: float
    weakest: str

    def to_body_frame(self, points: np.ndarray) -> np.ndarray:
        """Transform points (j, 3) from the TCP's frame to the frame of the bodies."""
        return points @ np.asarray(quaternions.to_matrix(self.rotation)).T + self.position


@dataclass(frozen=True, eq=False)
class GraspPlan:
    """Grasps of all bodies, the most probable first, and why bodies have none.

    Attributes
    ----------
    grasps
        At most :data:`sq_perception.grasping.planner.PER_BODY` a body.
    reasons
        One a body, empty for those with a grasp.
    """

    grasps: tuple[Grasp, ...] = ()
    reasons: tuple[str, ...] = ()

    def of(self, body: int) -> tuple[Grasp, ...]:
        """Return the grasps of one body, best first."""
        return tuple(grasp for grasp in self.grasps if grasp.body == body)
