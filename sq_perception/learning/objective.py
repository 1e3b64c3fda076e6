"""What a training minimises: one of the losses by name, with its schedule and what it is allowed to see.

| name | loss | sees | s over the run |
| --- | --- | --- | --- |
| occupancy | L_OC at random points | labels | 6 to 25 |
| occupancy_rotation | L_OC(q): size, shape and place given | labels | 6 to 25 |
| dual | L_DUAL | labels | 6 to 25 |
| least_squares | L_LS | the view | |
| least_squares_free | L_LS and free space | the view | |
| render | L_DR | the view | 6 to 100 |

s grows geometrically: a soft boundary is felt from afar, a sharp one has its optimum at the true body.  Losses of the
view are computed on a random subset of its lines of sight, another one at every step.

Least squares needs a curriculum.  Nothing in L_LS holds what lies behind the silhouette, and the first thing a network
learns, one body for all images, is a column that runs away from the viewer; few images bring it back.  The factor
sqrt(a1 a2 a3) is therefore multiplied by (a1 a2 a3 / 0.05)^k, k falling from 1 to 0 over the first four fifths of the
run, which keep bodies small until the residual determines them; what is minimised in the end is equation 7.7.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import sight_lines
from sq_perception.learning import losses
from sq_perception.learning.choices import LOSSES, UNSUPERVISED

_SHARPNESS = {"render": (6.0, 100.0)}
_OTHER_SHARPNESS = (6.0, 25.0)
_TYPICAL_VOLUME = 0.05
_CURRICULUM = 0.8
_ROOT_FLOOR = 1e-6
_DENSITY = 2.0
"""D of the soft depth, in units of s."""
_FREE_SPACE = 4.0
"""Weight w of the free space."""


@dataclass(frozen=True)
class Objective:
    """A loss and its settings; see the module.

    Raises
    ------
    ValueError
        For a loss of another name.
    """

    name: str = "occupancy"
    points: int = 256
    """Comparison points a body: half close around it, half in twice its box."""
    sharpness_start: float = 0.0
    sharpness_end: float = 0.0
    """s at the start and the end of the run; 0 takes the values of the table."""
    framing: str = "cropped"
    """Of the views."""
    stride: int = 2
    """Every ``stride``-th row and column of the view is a line of sight."""

    def __post_init__(self) -> None:
        if self.name not in LOSSES:
            raise ValueError(f"loss: expected one of {', '.join(LOSSES)}, got {self.name!r}")

    @property
    def needs_labels(self) -> bool:
        return self.name not in UNSUPERVISED

    def sharpness(self, progress: float) -> float:
        """s after a share ``progress`` of the run."""
        start, end = _SHARPNESS.get(self.name, _OTHER_SHARPNESS)
        start, end = self.sharpness_start or start, self.sharpness_end or end
        return start * (end / start) ** progress

    def loss(
        self,
        prediction: Superquadric,
        views: torch.Tensor,
        truth: Superquadric | None,
        progress: float,
        generator: torch.Generator,
    ) -> torch.Tensor:
        """The loss of each body (n,); views (n, 1, p, p), and the labels only where :attr:`needs_labels` is true."""
        s = self.sharpness(progress)
        if self.needs_labels:
            assert truth is not None
            around = [losses.points_around(truth, self.points // 2, generator, scale) for scale in (1.15, 2.0)]
            compare = {
                "occupancy": losses.occupancy_loss,
                "occupancy_rotation": losses.rotation_loss,
                "dual": losses.dual_loss,
            }[self.name]
            return compare(prediction, truth, torch.cat(around, dim=1), s)
        row, column = torch.randint(self.stride, (2,), generator=generator, device=views.device).tolist()
        lines, depth = sight_lines.of_view(views[:, 0], self.stride, row, column, self.framing)
        if self.name == "render":
            return losses.render_loss(prediction, lines, depth, s, _DENSITY * s)
        smallness = max(0.0, 1 - progress / _CURRICULUM)
        loss = losses.least_squares_loss(prediction, lines, depth)
        loss = loss * (prediction.size.prod(dim=-1) / _TYPICAL_VOLUME) ** smallness
        if self.name == "least_squares_free":
            loss = loss + _FREE_SPACE * losses.free_space_loss(prediction, lines, depth)
            # The same optimum, but a few badly seen bodies, whose squares are a hundred times those of the others, do
            # not make the whole gradient.
            loss = torch.sqrt(loss + _ROOT_FLOOR)
        return loss

    def with_given(self, prediction: Superquadric, truth: Superquadric) -> Superquadric:
        """The bodies that a validation compares with the true ones: what is given counts as predicted."""
        return losses.turned_truth(prediction, truth) if self.name == "occupancy_rotation" else prediction
