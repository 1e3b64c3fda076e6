"""How a body walks down a loss (:mod:`sq_perception.evaluation.gradient_search`); importable at once, for the help."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sq_perception.learning.choices import LOSSES, WITHOUT_SHARPNESS


@dataclass(frozen=True)
class WalkOptions:
    """How to walk.

    Raises
    ------
    ValueError
        For an unknown loss, a loss without s that is given one, or numbers that are not positive.
    """

    loss: str = "occupancy"
    """By its name in :mod:`sq_perception.learning.objective`."""
    steps: int = 200
    learning_rate: float = 0.05
    """Of Adam, at the first step."""
    sharpness: tuple[float, float] | None = None
    """s at the first and at the last step, geometric in between; None is the s with which trainings end, throughout."""
    points: int = 1024
    """Comparison points, or about so many lines of sight."""
    seed: int = 0
    """Of the points."""

    def __post_init__(self) -> None:
        if self.loss not in LOSSES:
            raise ValueError(f"loss: expected one of {', '.join(LOSSES)}, got {self.loss!r}")
        for name in ("steps", "points", "learning_rate"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name}: expected a positive number, got {getattr(self, name)}")
        if self.sharpness is not None:
            if self.loss in WITHOUT_SHARPNESS:
                raise ValueError(f"sharpness: the loss {self.loss} has no s")
            if not all(math.isfinite(s) and s > 0 for s in self.sharpness):
                raise ValueError(f"sharpness: expected positive numbers, got {self.sharpness}")
