"""What networks predict of objects: for many views at once, before other work goes on or only if that asks for it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from sq_perception.fitting.hull_prior import HullPrior
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.canonical_view import CanonicalView
from sq_perception.learning.inference import HullPredictions, Predictor, ThingPredictor

Answers: TypeAlias = Superquadric | HullPredictions


@dataclass(frozen=True, eq=False)
class Prediction:
    """What a network predicts of one object; perhaps it is computed when it is asked for.

    Attributes
    ----------
    view
        What the network was shown.
    answers, number
        What gives its answers for several objects, each in the frame of its view, and which of them is this one's.
    """

    view: CanonicalView
    answers: Callable[[], Answers]
    number: int

    def body(self) -> Superquadric:
        """The predicted body in the optical frame."""
        answers = self.answers()
        bodies = answers.bodies if isinstance(answers, HullPredictions) else answers
        return self.view.from_canonical(bodies[self.number]).canonical_form()

    def hull(self) -> HullPrior | None:
        """The predicted hull in the optical frame, if the network predicts hulls."""
        answers = self.answers()
        return answers.hull(self.number, self.view) if isinstance(answers, HullPredictions) else None


def of_hulls(
    views: Sequence[CanonicalView], planes: Sequence[np.ndarray | None], network: ThingPredictor, mirror: bool
) -> list[Prediction]:
    """Predictions of hulls from views, and from their mirror images, and the support planes (4,), optical frame."""
    shown = np.stack([view.with_steps for view in views])
    known = zip(views, planes, strict=True)
    below = np.stack([np.zeros(4) if plane is None else view.plane_to_canonical(plane) for view, plane in known])
    extents = np.array([view.extent for view in views])
    found = network.predict(shown, below, extents, mirror)
    return _answered(views, lambda: found)


def of_bodies(views: Sequence[CanonicalView], network: Predictor, when_asked: bool) -> list[Prediction]:
    """Predictions of bodies from views: computed now, or all of them when the first one is asked for."""
    shown = np.stack([view.marked for view in views])
    if when_asked:
        return _answered(views, _once(lambda: network.predict(shown)))
    found = network.predict(shown)
    return _answered(views, lambda: found)


def _once(compute: Callable[[], Answers]) -> Callable[[], Answers]:
    """A function that computes its answer in the first thread that asks; others wait for it."""
    lock, found = threading.Lock(), list[Answers]()

    def answers() -> Answers:
        with lock:
            if not found:
                found.append(compute())
            return found[0]

    return answers


def _answered(views: Sequence[CanonicalView], answers: Callable[[], Answers]) -> list[Prediction]:
    return [Prediction(view, answers, k) for k, view in enumerate(views)]
