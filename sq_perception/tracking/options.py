"""How a tracker judges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sq_perception.tracking.state import diagonal


@dataclass(frozen=True)
class TrackerOptions:
    """How a tracker judges.  Defaults are for a depth camera at some frames per second and household objects.

    Attributes
    ----------
    common_share, lasting_share
        rho and gamma, the shares of an observation's covariance that all views from one direction, and all views from
        anywhere, have in common; at least 0, below 1 together.
    view_angle
        Views closer than this share it, radians.
    views
        How many directions are remembered for each body.
    least_log_size, least_shape, least_centre, least_turn
        Standard deviations of the least common error of a view: F.
    unknown_log_size, unknown_shape, unknown_centre, unknown_turn
        Standard deviations taken for observations without covariance; the centre's as a share of the mean half size.
    drift_centre, drift_turn
        Random walk of a body at rest, metres and radians per root of a second.
    gate
        Probability that an observation of the tracked body is taken for one.
    patience
        After so many disagreeing observations in a row the track gives way.
    exchange
        Largest |e1 - e2| for which z may change places with x or y.
    fastest
        Metres per second: how far a body may have been moved between two frames.
    confirm_after, publish_after
        Observations until a track is confirmed, and until it is returned at all.
    misses
        A confirmed track dies in the so-manieth frame in a row that should have shown it; a tentative one in the
        second.
    forget_pose_after, forget_after
        Seconds without observation until a body may be anywhere within reach, and until it is given up, hidden or not.
    most
        Tracks that are kept; beyond them those die first that were not observed for longest.

    Raises
    ------
    ValueError
        For a value outside its range.
    """

    common_share: float = 0.25
    lasting_share: float = 0.25
    view_angle: float = 0.25
    views: int = 16
    least_log_size: float = 0.01
    least_shape: float = 0.02
    least_centre: float = 0.001
    least_turn: float = 0.01
    unknown_log_size: float = 0.15
    unknown_shape: float = 0.2
    unknown_centre: float = 0.15
    unknown_turn: float = 0.2
    drift_centre: float = 0.001
    drift_turn: float = 0.01
    gate: float = 0.999
    patience: int = 2
    exchange: float = 0.3
    fastest: float = 1.0
    confirm_after: int = 3
    publish_after: int = 1
    misses: int = 5
    forget_pose_after: float = 5.0
    forget_after: float = 30.0
    most: int = 100

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not np.isfinite(value) or value < 0:
                raise ValueError(f"{name}: expected a finite number of at least 0, got {value}")
        for name in ("views", "patience", "confirm_after", "publish_after", "misses", "most"):
            if getattr(self, name) != int(getattr(self, name)) or getattr(self, name) < 1:
                raise ValueError(f"{name}: expected a whole number of at least 1, got {getattr(self, name)}")
        if not self.common_share + self.lasting_share < 1:
            shares = f"{self.common_share} and {self.lasting_share}"
            raise ValueError(f"common_share, lasting_share: expected a sum below 1, got {shares}")
        if not 0 < self.gate < 1:
            raise ValueError(f"gate: expected a probability between 0 and 1, got {self.gate}")
        if not 0 < self.view_angle < np.pi:
            raise ValueError(f"view_angle: expected an angle between 0 and pi, got {self.view_angle}")
        for name in ("unknown_log_size", "unknown_shape", "unknown_centre", "unknown_turn"):
            if getattr(self, name) == 0:
                raise ValueError(f"{name}: expected a positive number, got 0")

    def least(self) -> np.ndarray:
        """F, (11, 11)."""
        return diagonal(self.least_log_size, self.least_shape, self.least_centre, self.least_turn)
