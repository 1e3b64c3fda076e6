"""The result of a fit: the body, how well it explains the image, and how sure it is."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np

from sq_perception.geometry.superquadric import Superquadric

INLIER = 3.0
"""Noise levels up to which a pixel is an inlier: noise alone stays within for 99.7 % of the pixels."""
FAILED_SHARE = 0.25
"""Share of the smallest half size: a body that half of the points miss by more describes none of its faces."""
_COUNTED = 0.1
"""Share of an object from which on a part counts towards the status of the whole."""
CUT_SHORT = "cut short by the time budget"
"""Part of the message of a fit that the time budget ended before it was done."""


class Status(IntEnum):
    """How far a recovery can be trusted; the numbers travel in messages and never change."""

    CONVERGED = 0
    """Each half size is known to 15 % or better, as far as the fit determines it."""
    WEAK = 1
    """Converged, but the view does not determine every quantity, or part of a thing sticks out: see the message."""
    FAILED = 2
    """No body: too few points, no convergence, or a residual far above the noise."""


@dataclass(frozen=True, eq=False)
class Fit:
    """One fitted superquadric; NaN stands for what a method does not compute.

    Attributes
    ----------
    superquadric
        A single body in the optical frame of the camera, in its canonical form.
    residual
        Root mean square distance of the inlying object points to the surface, metres.
    status, message
        How far the body can be trusted, and why.
    noise
        Standard deviation of the depth noise, estimated or given, joined in squares by how far a thing may stray from a
        superquadric, metres.
    inlier_share
        Share of the object's pixels within three of these standard deviations of the surface, 0 to 1.
    seen
        (3,) share of each full size that the measured points span along its axis, 0 to 1: the rest is inferred, from
        free space, the support plane, symmetry and what bodies mostly are.
    covariance
        (11, 11) of a1 a2 a3 e1 e2 t1 t2 t3 and the rotation vector in the object frame; metres and radians.
    sigma_taper
        Standard deviations (2,) of the tapers; 0 where the body was not to taper.
    iterations, milliseconds
        What the fit cost.
    is_predicted
        Whether a predicted hull weighs in, which errs alike in all views of the thing.
    as_hull
        Whether no superquadric came near, so that the body was fitted to the convex hull of the object: space within
        the hull of the outline that the camera saw to be empty does not count.
    """

    superquadric: Superquadric
    residual: float
    status: Status
    message: str
    noise: float = math.nan
    inlier_share: float = math.nan
    seen: np.ndarray = field(default_factory=lambda: np.full(3, np.nan))
    covariance: np.ndarray = field(default_factory=lambda: np.full((11, 11), np.nan))
    sigma_taper: np.ndarray = field(default_factory=lambda: np.zeros(2))
    iterations: int = 0
    milliseconds: float = 0.0
    is_predicted: bool = False
    as_hull: bool = False

    @property
    def sigma_size(self) -> np.ndarray:
        """Standard deviations (3,) of the half sizes, metres; NaN where unknown."""
        return np.sqrt(np.diag(self.covariance)[:3])

    def signed_distance(self, points: np.ndarray, k_sigma: float = 0.0, *, gradient: bool = False) -> Any:
        """A lower bound of the signed distance of points (n, 3) to the body, less so many standard deviations of it.

        Shape (n,), metres, negative inside, and with ``gradient`` its gradient (n, 3) too, see
        :mod:`sq_perception.geometry.signed_distance`.  Raises ValueError for deviations of a body without any.
        """
        from sq_perception.geometry.signed_distance import signed_distance  # here: a status alone compiles nothing

        found = signed_distance(self.superquadric, points, self.covariance, k_sigma)
        return found if gradient else found[0]


@dataclass(frozen=True, eq=False)
class Parts:
    """An object as a union of superquadrics.

    Attributes
    ----------
    fits
        The parts, the one with the most points first, each with its covariance, status and reason.
    shares : (k,)
        Share of the points, or of the object's pixels, that each explains.
    status, message
        How far the whole can be trusted, and why: that of the parts with a tenth of the points or more.
    noise
        Standard deviation of the points about the union, metres.
    milliseconds
        What it cost.
    """

    fits: tuple[Fit, ...]
    shares: np.ndarray
    status: Status
    message: str
    noise: float
    milliseconds: float

    @classmethod
    def of(cls, fits: Sequence[Fit], shares: np.ndarray, noise: float, milliseconds: float) -> Parts:
        """Parts in order of their shares, with the status of the worst that has a tenth or more."""
        order = np.argsort(-shares, kind="stable")
        sorted_fits, shares = tuple(fits[k] for k in order), shares[order]
        counted = [fit for fit, share in zip(sorted_fits, shares, strict=True) if share >= _COUNTED] or sorted_fits[:1]
        worst = max(counted, key=lambda fit: fit.status)
        return cls(sorted_fits, shares, worst.status, worst.message, noise, milliseconds)

    @property
    def superquadrics(self) -> Superquadric:
        """The parts as a batch (k,)."""
        return Superquadric.stack([fit.superquadric for fit in self.fits])

    def __len__(self) -> int:
        return len(self.fits)

    def __iter__(self) -> Iterator[Fit]:
        return iter(self.fits)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Whether points (n, 3) are in one of the parts, (n,)."""
        return np.asarray((self.superquadrics.gauge(np.asarray(points, dtype=float)[None]) <= 1).any(axis=0))

    def signed_distance(self, points: np.ndarray, k_sigma: float = 0.0, *, gradient: bool = False) -> Any:
        """As :meth:`Fit.signed_distance`, of the nearest part."""
        covariances = np.stack([fit.covariance for fit in self.fits])
        from sq_perception.geometry.signed_distance import signed_distance  # here: as above

        found = signed_distance(self.superquadrics, points, covariances, k_sigma)
        return found if gradient else found[0]
