"""What networks say of objects: asked about many views at once, beside other work or before it goes on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from sq_perception.fitting.hull_prior import HullPrior
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.canonical_view import CanonicalView
from sq_perception.learning.inference import HullAnswers, Predictor, ThingPredictor

if TYPE_CHECKING:
    from sq_perception.recovery.seen_object import SeenObject

Answers: TypeAlias = Superquadric | HullAnswers


@dataclass(frozen=True, eq=False)
class Prediction:
    """What a network says of one object; perhaps it is still being computed.

    Attributes
    ----------
    view
        What the network was shown.
    answers, number
        Its answers for several objects, each in the frame of its view, and which of them is this one's.
    """

    view: CanonicalView
    answers: Future[Answers]
    number: int

    def body(self) -> Superquadric:
        """The predicted body in the optical frame; waits for it."""
        answers = self.answers.result()
        bodies = answers.bodies if isinstance(answers, HullAnswers) else answers
        return self.view.from_canonical(bodies[self.number]).canonical_form()

    def hull(self) -> HullPrior | None:
        """The predicted hull in the optical frame, if the network tells of hulls; waits for it."""
        answers = self.answers.result()
        return answers.hull(self.number, self.view) if isinstance(answers, HullAnswers) else None


def of_hulls(objects: Sequence[SeenObject], network: ThingPredictor) -> list[SeenObject]:
    """The objects with the predictions of their hulls."""
    shown = _shown(objects)
    seen = zip(objects, shown, strict=True)
    planes = [np.zeros(4) if one.plane is None else view.plane_to_canonical(one.plane) for one, view in seen]
    views, extents = np.stack([view.marked for view in shown]), np.array([view.extent for view in shown])
    return _answered(objects, at_once(lambda: network.predict(views, np.stack(planes), extents)))


def of_bodies(
    objects: Sequence[SeenObject], network: Predictor, submit: Callable[[Callable[[], Answers]], Future[Answers]]
) -> list[SeenObject]:
    """The objects with the predictions of their bodies, which what ``submit`` is given computes, now or beside fits."""
    views = np.stack([view.marked for view in _shown(objects)])
    return _answered(objects, submit(lambda: network.predict(views)))


def at_once(asked: Callable[[], Answers]) -> Future[Answers]:
    """What need not be waited for any more."""
    found: Future[Answers] = Future()
    found.set_result(asked())
    return found


def _shown(objects: Sequence[SeenObject]) -> list[CanonicalView]:
    return [one.shown for one in objects if one.shown is not None]


def _answered(objects: Sequence[SeenObject], answers: Future[Answers]) -> list[SeenObject]:
    seen = zip(objects, _shown(objects), strict=True)
    return [replace(one, prediction=Prediction(view, answers, k)) for k, (one, view) in enumerate(seen)]
