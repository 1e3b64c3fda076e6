"""Candidate grasps: the probabilities of their margins, and common functions of all kinds of grasps.

Metres, newtons, kilograms.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

DENSITY = 500.0  # density of objects, kg/m^3, between empty and full packages; the sigma of a mass is half of it
CLEARANCE = 0.005  # clearance on either side of the body and before the palm, metres
LEAST_ENGAGED = 0.004  # smallest length of finger beyond the near end, metres
TABLE_SIGMA, POINT_SIGMA = 0.002, 0.001
SIDE_SIGMA = 0.0026
"""Standard deviation, metres, to which thinned points tell where an object's side is that the image shows a finger to
pass: in benchmarks/picking.py 3.3 mm with the 2 mm of the hand."""
PASSES = 0.001
"""Metres by which a finger may come down on the edge of an object: half of those that did passed it and pushed it aside
(a quarter at 2 mm, few at 3)."""
MARGINS = ("opening", "engagement", "palm", "friction", "weight", "table", "other bodies", "measured points", "unseen")


class Trials(NamedTuple):
    """k candidate grasps and the logarithm of the probability of each margin so far.  ``sides`` (k, 2) are those of the
    two sides that the fingers pass, whose sum is the margin of the opening."""

    owner: np.ndarray
    frames: np.ndarray
    opening: np.ndarray
    width: np.ndarray
    logs: np.ndarray
    sides: np.ndarray

    def at(self, which: np.ndarray) -> Trials:
        return Trials(*(part[which] for part in self))

    def join(self, other: Trials) -> Trials:
        return Trials(*map(np.concatenate, zip(self, other, strict=True)))

    @property
    def total(self) -> np.ndarray:
        """Return the logarithm (k,) of the probability that all margins hold."""
        return np.asarray(np.einsum("ij->i", self.logs))

    @property
    def weakest(self) -> np.ndarray:
        """Return the index (k,) of the least probable margin of each trial."""
        return np.asarray(np.argmin(self.logs, axis=1))

    def first(self, count: int, least: float = -np.inf) -> Trials:
        """Return the most probable trials of each body in order, without those below the logarithm ``least``."""
        total = self.total
        rows = np.flatnonzero(total >= least)  # also what cannot hold, -inf: why it does not is a reason
        rows = rows[np.lexsort((-total[rows], self.owner[rows]))]
        owner = self.owner[rows]
        rank = np.arange(len(owner)) - np.searchsorted(owner, owner)
        return self.at(rows[rank < count])


def log_passing(gap: np.ndarray, sigma: np.ndarray, placement: float) -> np.ndarray:
    """Return log P (k,) that the gripper passes sides that are ``gap`` away and known to ``sigma``."""
    # Sides are nearer than fits say, by 0.4 sigma in the median over benchmarks/picking.py (not its reported scenes).
    return log_phi(gap + PASSES + 0.4 * sigma, np.hypot(sigma, placement))


def log_phi(margin: np.ndarray, sigma: np.ndarray | float) -> np.ndarray:
    """Return log Phi(m / sigma), at least log(1e-12); sigma is at least a micrometre."""
    from scipy.special import ndtr  # here: a node that recovers does without

    return np.asarray(np.log(np.maximum(ndtr(margin / np.maximum(sigma, 1e-6)), 1e-12)))


def weight(mass: np.ndarray, lever: np.ndarray, force: float, arm: float | np.ndarray = 0.006) -> np.ndarray:
    """Return log P (k,) that the friction ``force`` of both pads lifts a mass ``lever`` beside the closing line, with 2
    m/s^2 and by the torque that it holds with its mean ``arm``, by default that of a pad of some 18 mm."""
    load = np.maximum(1.0, lever / arm) * (9.81 + 2.0) * mass / force
    return log_phi(1 / np.maximum(load, 1e-9) - 1, 0.5)
