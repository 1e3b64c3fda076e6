"""All contestants on the same images, chunk by chunk, and what each of them made of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sq_perception.evaluation.contestants import Contestant
from sq_perception.evaluation.figures_of_merit import FiguresOfMerit
from sq_perception.evaluation.thesis_images import ThesisImages
from sq_perception.geometry.superquadric import Superquadric

Advance = Callable[[str, int], None]
"""Called with a contestant's name and the number of bodies done."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """A contestant, its figures, and the bodies (n,) they are of, with the labels they were compared with."""

    contestant: Contestant
    figures: FiguresOfMerit
    bodies: Superquadric
    labels: Superquadric


def compare(
    contestants: Sequence[tuple[Contestant, int]],
    images: ThesisImages,
    advance: Advance | None = None,
) -> list[Outcome]:
    """Let every contestant recover the first so many bodies of the test set.

    Parameters
    ----------
    contestants
        Each with the number of its bodies, at most those of the test set.
    images : ThesisImages
    advance
        Called with the progress.

    Raises
    ------
    ValueError
        If a contestant is to recover no body, or more than there are.
    """
    for contestant, count in contestants:
        if not 1 <= count <= images.count:
            raise ValueError(f"{contestant.name}: expected 1 to {images.count} bodies, got {count}")
    parts: list[list[tuple[FiguresOfMerit, np.ndarray, np.ndarray]]] = [[] for _ in contestants]
    most = max((count for _, count in contestants), default=0)
    for piece in images.chunks():
        if piece.first >= most:
            break
        for (contestant, count), part in zip(contestants, parts, strict=True):
            mine = piece.head(count - piece.first)
            if len(mine) == 0:
                continue
            answers, labels = contestant.recover(mine), contestant.labels(mine.truth)
            bodies = contestant.with_given(answers.bodies, labels)
            figures = FiguresOfMerit.of(bodies, labels, answers.recovered, answers.milliseconds)
            part.append((figures, bodies.to_flat(), labels.to_flat()))
            if advance:
                advance(contestant.name, mine.first + len(mine))
    outcomes = []
    for (contestant, _), part in zip(contestants, parts, strict=True):
        figures, flats, labels_flat = zip(*part, strict=True)
        bodies, labels = (Superquadric.from_flat(np.concatenate(flat)) for flat in (flats, labels_flat))
        outcomes.append(Outcome(contestant, FiguresOfMerit.concatenated(figures), bodies, labels))
    return outcomes
