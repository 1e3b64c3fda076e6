"""What a tracker knows of one body after a frame."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from sq_perception.geometry.superquadric import Superquadric


class TrackState(Enum):
    """How far a track is known."""

    TENTATIVE = "tentative"
    """Observed in this frame, not often yet."""
    CONFIRMED = "confirmed"
    """Observed in this frame, and often enough."""
    LOST = "lost"
    """Not observed in this frame: hidden, missed or gone."""


@dataclass(frozen=True, eq=False)
class Track:
    """One body as known after a frame.

    Attributes
    ----------
    id
        Never used for another body.
    superquadric : Superquadric
        A single body in the world frame, in the same one of its forms as long as the track lives.
    sigma_size : (3,)
        Standard deviations of the half sizes, metres.
    covariance : (11, 11)
        Of a1 a2 a3 e1 e2 t1 t2 t3 (world frame) and the rotation vector in the object frame, metres and radians.
    velocity : (3,)
        Metres per second in the world frame; zero for bodies at rest.
    seen
        Number of observations.
    state : TrackState
    observation
        Index of this frame's observation; None if there is none.
    follows
        Whether the body is as this frame observed it.  False where there is none, for one whose centre or
        rotation is elsewhere and which the track does not believe yet, and for one of other sizes or exponents if it is
        not the first in a row.
    """

    id: int
    superquadric: Superquadric
    sigma_size: np.ndarray
    covariance: np.ndarray
    velocity: np.ndarray
    seen: int
    state: TrackState
    observation: int | None
    follows: bool
