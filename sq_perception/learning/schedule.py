"""Learning rates over a run.

    cosine     r = rate min(1, (k + 1) / warm_up) (1 + cos(pi k / steps)) / 2        at step k
    plateau    r is divided by 10 after every 10 validations without a better one, and the run ends after 20 without one

The plateau is the thesis' (chapter 5.3); its epoch is what lies between two validations here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

_PATIENCE = 10
_LONGEST = 20
_FACTOR = 0.1


@dataclass
class Cosine:
    """Warm up, then fall to zero at the last step."""

    rate: float
    warm_up: int
    steps: int

    def at(self, step: int) -> float:
        """The learning rate of a step."""
        return (
            self.rate * min(1.0, (step + 1) / max(self.warm_up, 1)) * 0.5 * (1 + math.cos(math.pi * step / self.steps))
        )

    def validated(self, loss: float) -> None:
        """Take note of a validation; this schedule does not look at it."""

    @property
    def exhausted(self) -> bool:
        return False

    def state(self) -> list[float]:
        """What a continued run has to know."""
        return []

    def restore(self, state: list[float]) -> None:
        """Go on from :meth:`state`."""


@dataclass
class Plateau:
    """The thesis' schedule."""

    rate: float
    best: float = math.inf
    without_progress: int = 0
    reductions: int = 0

    def at(self, step: int) -> float:
        """The learning rate of a step."""
        return self.rate * _FACTOR**self.reductions

    def validated(self, loss: float) -> None:
        """Take note of a validation's loss."""
        if loss < self.best:
            self.best, self.without_progress = loss, 0
            return
        self.without_progress += 1
        if self.without_progress % _PATIENCE == 0:
            self.reductions += 1

    @property
    def exhausted(self) -> bool:
        """Whether nothing has become better for so long that the run should end."""
        return self.without_progress >= _LONGEST

    def state(self) -> list[float]:
        """What a continued run has to know."""
        return [self.best, self.without_progress, self.reductions]

    def restore(self, state: list[float]) -> None:
        """Go on from :meth:`state`."""
        self.best, self.without_progress, self.reductions = state[0], int(state[1]), int(state[2])
