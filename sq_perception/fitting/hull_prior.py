"""What is known of a thing's convex hull before its pixels are looked at: its support function and its uncertainty.

    h(n) = max over the thing of n.p,     h(n_j) ~ N(b_j, S),     j = 1 .. J

n_j, b and S are in the optical frame of the camera, metres.  No thing is a superquadric: what the best one leaves over
is added to S as an independent error of each direction, ``MODEL_SHARE`` of the thing's extent.

The network predicts h ~ t_nu(b, S) with long tails (:mod:`sq_perception.learning.networks`); the fit takes S
alone, the scale of most errors.  With the tails the fit follows bodies that few directions agree with: that cost 1.3 %
of IoU on 229 things of benchmarks/household_things, seeds from 5000.  The covariance of the fitted body depends on them
(:mod:`sq_perception.fitting.covariance`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

PULL_SHARE = 0.07
"""Standard deviation, as a share of the thing's extent, of the pull on a body that misfits twice as much as the best
do.  On 408 things of benchmarks/household_things, seeds from 5000, 0.05 to 0.14 change IoU by less than 0.2 %."""
MODEL_SHARE = 0.02
"""Difference between a thing's support function and that of the nearest superquadric, as a share of the thing's extent.
Chosen on benchmarks/household_things, where 0.01 and 0.03 cost 0.2 % of IoU."""


@dataclass(frozen=True, eq=False)
class HullPrior:
    """A predicted support function.

    Attributes
    ----------
    directions : (J, 3)
        Unit vectors n_j, optical frame.
    support : (J,)
        b_j, metres from the origin of the optical frame.
    covariance : (J, J)
        S, square metres.
    extent : float
        The thing's size as far as it was seen, metres.
    freedom : float
        nu; infinite for errors of a normal distribution.
    """

    directions: np.ndarray
    support: np.ndarray
    covariance: np.ndarray
    extent: float
    freedom: float = math.inf

    def root(self, misfit: float = 1.0) -> np.ndarray:
        """W (J, J) with W^T W = (S + model error)^-1 + (misfit - 1) / pull^2 (1 - mean over the directions).

        ``misfit``, 1 or more: mean loss of the object's rays over that of what a superquadric fits.

        The most probable body is not the one nearest to the prediction.  A superquadric that fits has the thing's form,
        and S tells how probable each form is.  One that does not fit is a compromise: b is the best that is known of
        the thing's form, and the body is to be near to it in each direction, however uncertain.  Growth in all
        directions is left to S, as the outline determines a thing's size.
        """
        count = len(self.support)
        pull = (misfit - 1.0) / (PULL_SHARE * self.extent) ** 2
        precision = self._precision + pull * (np.eye(count) - 1.0 / count)
        return np.ascontiguousarray(np.linalg.cholesky(precision).T)

    @cached_property
    def _precision(self) -> np.ndarray:
        """(S + model error)^-1."""
        model = MODEL_SHARE * self.extent
        return np.linalg.inv(self.covariance + model**2 * np.eye(len(self.support)))
