"""The camera of a point cloud that lies in another frame: z up, as of a robot or a table, or y up, as of graphics.

With R, t the pose of the camera's optical frame (x right, y down, z forward) in the cloud's frame, p_optical =
R^T (p - t), metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.tracking.state import parse_pose

_AXES = {
    "link": (0.5, -0.5, 0.5, -0.5),
    "graphics": (1.0, 0.0, 0.0, 0.0),
}
"""Rotations, x y z w, of the optical frame in frames with the same origin: x forward, z up; and y up, z backward."""
EXPECTED = (
    "expected where the camera stood in the frame of the cloud, X,Y,Z (it looks at the middle of the points) or "
    "X,Y,Z,QX,QY,QZ,QW (its optical frame), or the axes of a cloud around the camera: link (x forward, z up) or "
    "graphics (y up, z backward)"
)


@dataclass(frozen=True)
class CloudFrame:
    """Where the camera is in the frame of a cloud: its place, and its rotation where that is known."""

    place: tuple[float, ...]
    quaternion: tuple[float, ...] | None

    @classmethod
    def parse(cls, text: str) -> CloudFrame:
        """The frame that a user names, as EXPECTED says.  Raises ValueError for anything else."""
        if text in _AXES:
            return cls((0.0, 0.0, 0.0), _AXES[text])
        try:
            numbers = [float(part) for part in text.split(",")]
            if len(numbers) not in (3, 7):
                raise ValueError
            turn, place = parse_pose((numbers[3:] or [0.0, 0.0, 0.0, 1.0], numbers[:3]))
        except ValueError:
            raise ValueError(f"{EXPECTED}; got {text!r}") from None
        return cls(tuple(place.tolist()), tuple(turn.tolist()) if len(numbers) == 7 else None)

    def pose(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """R (3, 3) and t (3,) of the camera before these points (..., 3)."""
        place = np.array(self.place)
        if self.quaternion is not None:
            return quaternions.to_matrix(np.array(self.quaternion)), place
        forward = np.median(points[np.isfinite(points).all(axis=-1)], axis=0) - place
        right = np.cross(forward, [0.0, 0.0, 1.0])
        if np.linalg.norm(right) < 1e-6 * np.linalg.norm(forward):  # straight down or up: any direction is right
            right = np.array([1.0, 0.0, 0.0])
        columns = np.stack([right, np.cross(forward, right), forward], axis=1)
        lengths = np.linalg.norm(columns, axis=0)
        if not lengths.min() > 0:
            raise ValueError("expected points somewhere else than in the camera")
        return columns / lengths, place

    def optical(self, points: np.ndarray) -> tuple[np.ndarray, str]:
        """Points (..., 3) in the camera's optical frame, and what to say of it."""
        rotation, place = self.pose(points)
        turn = quaternions.from_matrix(rotation)
        said = f"results are in the frame of a camera at {_numbers(place)}, turned {_numbers(turn)} (x y z w)"
        return moved(points, rotation.T, -rotation.T @ place), said


def moved(points: np.ndarray, rotation: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """R p + t of points (..., 3); NaN where nothing was measured, which is NaN or (0, 0, 0) before."""
    there = points.any(axis=-1, keepdims=True)
    return np.where(there, points @ rotation.T + shift, np.nan).astype(points.dtype)


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.6g}" for value in values)
