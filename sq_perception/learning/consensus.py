"""One answer from the 8 positions of a view: a network asked 8 times, its bodies carried back and averaged.

A body seen in another dihedral position is the same body, but a network that learned this from examples errs a little
differently each time.  Of the 8 answers b_k, carried back into the view, the reference is the one nearest to all

    r = argmin_k sum_j min over the equivalent forms f of b_j of  d(f, b_k),
    d = sum |log a - log a'| + angle between the rotations,

each answer takes the form nearest to r, and those with d below a limit are averaged: log sizes, exponents, centres, and
quaternions with one sign.  Answers beyond the limit list their axes in another order and are left out.  No image is
looked at again: this is no refinement, and costs 8 predictions in one batch.
"""

from __future__ import annotations

import numpy as np

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.learning.dihedral import MIRROR, TURNS, moved_back, moved_images
from sq_perception.learning.inference import Predictor
from sq_perception.learning.network_config import checked_views

_POSITIONS = len(TURNS)
_SAME = 0.6
"""Largest d of answers that mean the same list of axes."""


class Consensus:
    """A predictor that asks another one 8 times."""

    def __init__(self, predictor: Predictor) -> None:
        self.config = predictor.config
        self._predictor = predictor

    def predict(self, views: np.ndarray) -> Superquadric:
        """NumPy superquadrics (n,) of NumPy views (n, p, p); errors as of :meth:`Predictor.predict`."""
        views = checked_views(views, self.config)
        turns, mirror = np.tile(TURNS, len(views)), np.tile(MIRROR, len(views))
        moved = moved_images(np.repeat(views, _POSITIONS, axis=0), turns, mirror)
        answers = moved_back(self._predictor.predict(moved), turns, mirror)
        return averaged(Superquadric.from_flat(answers.to_flat().reshape(len(views), _POSITIONS, -1)))


def averaged(answers: Superquadric) -> Superquadric:
    """The consensus (n,) of answers (n, m); see the module."""
    forms = answers.equivalent_forms()
    pairs = _distance(forms[:, :, None, :], answers[None, :, :, None]).min(axis=0)
    reference = answers[np.arange(len(answers)), pairs.sum(axis=2).argmin(axis=1)]
    distance = _distance(forms, reference[None, :, None])
    nearest = np.take_along_axis(forms.to_flat(), distance.argmin(axis=0)[None, ..., None], axis=0)[0]
    chosen = Superquadric.from_flat(nearest)
    weight = (distance.min(axis=0) < _SAME)[..., None] / (distance.min(axis=0) < _SAME).sum(axis=1)[:, None, None]
    sign = np.sign(np.sum(chosen.rotation * reference.rotation[:, None], axis=-1, keepdims=True))
    rotation = np.sum(weight * sign * chosen.rotation, axis=1)
    return Superquadric(
        np.exp(np.sum(weight * np.log(chosen.size), axis=1)),
        np.sum(weight * chosen.shape, axis=1),
        np.sum(weight * chosen.translation, axis=1),
        rotation / np.linalg.norm(rotation, axis=-1, keepdims=True),
    )


def _distance(first: Superquadric, second: Superquadric) -> np.ndarray:
    """d of bodies whose leading dimensions broadcast."""
    stretch = np.abs(np.log(first.size / second.size)).sum(axis=-1)
    return stretch + quaternions.geodesic_angle(*np.broadcast_arrays(first.rotation, second.rotation))
