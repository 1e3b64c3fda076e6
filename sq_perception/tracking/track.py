"""A track: what is known of one body between frames, its prediction, and what a consumer gets of it.

Metres, radians, seconds; world frame; state and covariance as in :mod:`~sq_perception.tracking.state`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.tracking import state as states
from sq_perception.tracking.fusion import Estimate
from sq_perception.tracking.state import CENTRE, HAND, LENGTH, POSE, TURN

DRIFT = states.diagonal(0.0, 0.0, 0.001, 0.01)
"""Random walk of a body at rest in a second: a millimetre, and 0.6 degrees.  Chosen."""
CONFIRM_AFTER = 3  # observations until a track is confirmed: one more than may disagree by chance.  Chosen.


class TrackState(Enum):
    """How far a track is known."""

    TENTATIVE = "tentative"  # observed in this frame, not often yet
    CONFIRMED = "confirmed"  # observed in this frame, and often enough
    LOST = "lost"  # not observed in this frame: hidden, missed or gone


@dataclass(frozen=True, eq=False)
class Track:
    """One body as known after a frame."""

    id: int
    """Never used for another body."""
    superquadric: Superquadric
    """A single body in the world frame, in the same one of its forms as long as the track lives."""
    sigma_size: np.ndarray
    """Standard deviations (3,) of the half sizes, metres."""
    covariance: np.ndarray
    """(11, 11), of a1 a2 a3 e1 e2 t1 t2 t3 (world) and the rotation vector in the object frame, metres and radians."""
    velocity: np.ndarray
    """(3,), metres per second in the world frame; zero for bodies at rest."""
    seen: int
    """Number of observations."""
    state: TrackState
    observation: int | None
    """Index of this frame's observation; None if there is none."""
    follows: bool
    """Whether the body is as this frame observed it: not where its centre or rotation is elsewhere and the track does
    not believe it yet, nor where its sizes or exponents disagree for more than one frame."""


@dataclass(frozen=True, eq=False)
class Body:
    """What is kept of one track."""

    id: int
    estimate: Estimate
    last: float
    agreed: float  # last and agreed: stamps of the last observation, and of the last one that the centre follows
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))
    seen: int = 1
    missed: int = 0  # frames in a row, since the last observation, that should have shown it
    disagreed: int = 0
    last_error: np.ndarray = field(default_factory=lambda: np.zeros(LENGTH))
    """disagreed and last_error: (11,), observations in a row that disagreed, and the error of the last one if it
    did."""
    jumps: int = 0  # observations in a row that were found elsewhere
    observation: int | None = None  # as in :class:`Track`, and so are id, velocity and seen
    follows: bool = True  # whether the state is as the last observation has it
    at_rest: np.ndarray | None = None  # its covariance if it has not moved, while it may be anywhere within reach

    @property
    def is_moving(self) -> bool:
        return bool(self.velocity.any())

    def predict(self, elapsed: float, stamp: float) -> Body:
        """The body at a stamp, ``elapsed`` seconds after the frame before; not observed."""
        variance, estimate = np.diag(DRIFT) * elapsed, self.estimate
        state, velocity = estimate.state.copy(), self.velocity
        # Seconds that an unseen body is taken to go on as it was seen to move. Chosen.
        if stamp - self.last > 1.0:
            velocity = np.zeros(3)
        if velocity.any():
            step = velocity * elapsed
            state[5:8] += step
            variance[CENTRE] += step @ step  # hands speed up and stop
            variance[TURN] += HAND**2 * min(elapsed, 1.0)
        at_rest = None
        # Seconds without observation until a body may be anywhere within reach. Chosen.
        if stamp - self.last > 5.0:
            at_rest = (estimate.covariance if self.at_rest is None else self.at_rest) + np.diag(variance)
            # Once: however many frames pass meanwhile, it cannot be forgotten more.
            variance[POSE] += np.maximum(HAND**2 - np.diag(estimate.covariance)[POSE], 0.0)
        return replace(
            self, estimate=estimate._replace(state=state, covariance=estimate.covariance + np.diag(variance)),
            velocity=velocity, observation=None, at_rest=at_rest,
        )

    def see_again(self, index: int, stamp: float) -> Body:
        """The body after an old answer, the observation of this index."""
        agreed = stamp if self.follows else self.agreed
        estimate = self.estimate if self.at_rest is None else self.estimate._replace(covariance=self.at_rest)
        return replace(
            self, estimate=estimate, seen=self.seen + 1, missed=0, last=stamp, agreed=agreed, observation=index
        )

    def publish(self) -> Track:
        """What a consumer gets."""
        covariance = self.estimate.total
        known = TrackState.CONFIRMED if self.seen >= CONFIRM_AFTER else TrackState.TENTATIVE
        return Track(
            id=self.id, superquadric=Superquadric.from_flat(self.estimate.state.copy()),
            sigma_size=np.sqrt(np.diag(covariance)[0:3]), covariance=covariance, velocity=self.velocity.copy(),
            seen=self.seen, state=known if self.observation is not None else TrackState.LOST,
            observation=self.observation, follows=self.follows and self.observation is not None,
        )


def stack(some: Sequence[Body]) -> tuple[np.ndarray, np.ndarray]:
    """States (n, 12) and covariances P (n, 11, 11)."""
    return (
        np.array([body.estimate.state for body in some]).reshape(-1, 12),
        np.array([body.estimate.covariance for body in some]).reshape(-1, LENGTH, LENGTH),
    )
