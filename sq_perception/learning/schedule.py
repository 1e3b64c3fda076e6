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


def cosine(step: int, warm_up: int, steps: int) -> float:
    """The share of the rate at a step."""
    return min(1.0, (step + 1) / max(warm_up, 1)) * 0.5 * (1 + math.cos(math.pi * step / steps))


@dataclass
class Plateau:
    """What the validations of a run have shown."""

    best: float = math.inf
    without_progress: int = 0
    reductions: int = 0

    @property
    def share(self) -> float:
        """Of the rate."""
        return _FACTOR**self.reductions

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
