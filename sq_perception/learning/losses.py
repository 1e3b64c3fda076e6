"""Losses that know the true body, and losses that know the depth image alone.

Every one is batched over bodies, with finite gradients everywhere.  Bodies are torch batches (n,) in the frame of the
canonical view, lengths in sides of the cube.

With the true body
------------------
Parameters (thesis, equation 6.10)

    L_MSE(a, e, t) = 1/8 sum (y - y_hat)^2      over sizes, exponents and centre

Occupancy (6.6 to 6.8): the mean squared difference of two soft occupancies

    L_OC = 1/|P| sum_p (G(p; y) - G(p; y_hat))^2,      G = sigma(s (1 - F^e1)) = sigma(s (1 - g^2)).

It compares bodies, never parameters, so the 8 equivalent parameter vectors and every symmetry cost nothing.  P is the
thesis' grid or any other set of points; random points around the body are an unbiased and far cheaper choice.

Rotation only, and both together (6.9)

    L_OC(q) = L_OC with a, e and t of the truth,        L_DUAL = L_MSE(a, e, t) + L_OC(q).

L_OC(q) fits the predicted rotation to the true sizes, hence to the order in which the truth happens to list its axes.
That order is no property of the body: a1 and a2 may be exchanged, and where e1 is about e2 any axis may pass for z.  A
predictor that sees the body alone can only guess it; L_OC over all parameters does not depend on it.

With the depth image alone
--------------------------
No labels, only the canonical view X and its orthographic camera, a line of sight a pixel
(:mod:`sq_perception.imaging.soft_render`); on a line that met a surface X is its z, on the others 0.

Least squares (thesis, equation 7.7), over the points p of the surface

    L_LS = sqrt(a1 a2 a3) mean_p (F^e1 - 1)^2,        F^e1 = g^2

(a mean where the thesis has a sum, so that large objects do not outweigh small ones).  It asks only that the points lie
on the surface: a body may run on behind its silhouette, and the points may even lie on its back.

Free space: a line of sight is empty until it ends, at its point or, on the background, never

    L_LS + 4 mean_lines max(0, 1 - min g)^2,      min over the empty part of the line.

Render loss (7.8 to 7.11)

    L_DR = mean_lines |X - T|,        T: soft depth at s and tau.

T is the limit of ever finer voxels with D = n tau held fixed (:mod:`sq_perception.imaging.soft_render`), cheap at any
s.  A soft boundary moves the optimum: fits at s = 20, 40 and 100 (D = 2 s) end at 83, 90 and 95 % IoU.

What a training minimises
-------------------------
| name | loss | sees | s over the run |
| --- | --- | --- | --- |
| occupancy | L_OC at random points | labels | 6 to 25 |
| occupancy_rotation | L_OC(q): size, shape and place given | labels | 6 to 25 |
| dual | L_DUAL | labels | 6 to 25 |
| mse | L_MSE: the rotation given | labels | |
| least_squares | L_LS | the view | |
| least_squares_free | L_LS and free space | the view | |
| render | L_DR | the view | 6 to 100 |

s grows geometrically: a soft boundary is felt from afar, a sharp one has its optimum at the true body.  Losses of the
view are computed on a random subset of its lines of sight, another one at every step.

Nothing in L_LS holds what lies behind the silhouette.  The factor sqrt(a1 a2 a3) is therefore multiplied by
(a1 a2 a3 / 0.05)^k, k falling from 1 to 0 over the first four fifths of the run, which keeps bodies small until the
residual determines them; what is minimised in the end is equation 7.7.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import soft_render
from sq_perception.learning.choices import LOSSES, UNSUPERVISED


def parameter_loss(prediction: Superquadric, truth: Superquadric) -> torch.Tensor:
    """L_MSE(a, e, t) of each body, shape (n,)."""
    return (prediction.to_flat() - truth.to_flat())[..., :8].square().mean(dim=-1)


def occupancy_loss(
    prediction: Superquadric, truth: Superquadric, points: torch.Tensor, sharpness: float
) -> torch.Tensor:
    """L_OC (n,) of torch batches, compared at ``points`` (n, N, 3) or (N, 3) with s = ``sharpness``: the surface is a
    transition about 1/s of the body wide."""
    difference = prediction.occupancy(points, sharpness) - truth.occupancy(points, sharpness)
    return (difference * difference).mean(dim=-1)


def turn_truth(prediction: Superquadric, truth: Superquadric) -> Superquadric:
    """The true bodies in the predicted rotations: all that L_OC(q) sees of a prediction."""
    return Superquadric(truth.size, truth.shape, truth.translation, prediction.rotation)


def rotation_loss(
    prediction: Superquadric, truth: Superquadric, points: torch.Tensor, sharpness: float
) -> torch.Tensor:
    """L_OC(q) of each body, shape (n,): :func:`occupancy_loss` of the predicted rotation alone."""
    return occupancy_loss(turn_truth(prediction, truth), truth, points, sharpness)


def dual_loss(prediction: Superquadric, truth: Superquadric, points: torch.Tensor, sharpness: float) -> torch.Tensor:
    """L_DUAL of each body, shape (n,)."""
    return parameter_loss(prediction, truth) + rotation_loss(prediction, truth, points, sharpness)


def points_around(bodies: Superquadric, count: int, generator: torch.Generator, scale: float = 1.25) -> torch.Tensor:
    """Random points (n, count, 3), uniform in each body's own box enlarged by ``scale``."""
    uniform = torch.rand((len(bodies), count, 3), generator=generator, device=bodies.size.device)
    local = (2 * uniform - 1) * scale * bodies.size[:, None, :]
    return bodies.to_parent(local)


def least_squares_loss(prediction: Superquadric, lines: torch.Tensor, depth: torch.Tensor) -> torch.Tensor:
    """L_LS (n,) of a torch batch in the view's frame, for lines of sight (r, 2) and z (n, r) where they end, 0 for
    background, as :func:`soft_render.of_view` gives them."""
    seen = depth > 0
    gauge = soft_render.gauge(prediction, lines, depth)
    # Background lines carry a number that is no depth: cut them off before the square, not after it.
    residual = torch.where(seen, gauge, torch.ones_like(gauge)) ** 2 - 1
    mean = (residual * residual).sum(dim=-1) / seen.sum(dim=-1).clamp(min=1)
    return prediction.size.prod(dim=-1).sqrt() * mean


def free_space_loss(prediction: Superquadric, lines: torch.Tensor, depth: torch.Tensor) -> torch.Tensor:
    """Mean of max(0, 1 - min g)^2 over the empty part of each line, (n,); arguments as above."""
    excess = soft_render.free_space_excess(prediction, lines, depth)
    return (excess * excess).mean(dim=-1)


def render_loss(
    prediction: Superquadric, lines: torch.Tensor, depth: torch.Tensor, sharpness: float, density: float
) -> torch.Tensor:
    """L_DR of each body, (n,), in the limit of fine voxels; ``density`` is D = n tau."""
    soft = soft_render.soft_depth(prediction, lines, sharpness, density, cells=8)
    return (depth - soft).abs().mean(dim=-1)


@dataclass(frozen=True)
class Objective:
    """A loss and its settings; see the module.  Raises ValueError for another name."""

    name: str = "occupancy"
    points: int = 256  # comparison points a body: half close around it, half in twice its box
    sharpness_start: float = 0.0
    sharpness_end: float = 0.0  # s at the start and the end of the run; 0 takes the values of the table
    framing: str = "cropped"  # framing of the views
    stride: int = 2  # every stride-th row and column of the view is a line of sight

    def __post_init__(self) -> None:
        if self.name not in LOSSES:
            raise ValueError(f"loss: expected one of {', '.join(LOSSES)}, got {self.name!r}")

    @property
    def needs_labels(self) -> bool:
        return self.name not in UNSUPERVISED

    def sharpness(self, progress: float) -> float:
        """s after a share ``progress`` of the run."""
        start, end = {"render": (6.0, 100.0)}.get(self.name, (6.0, 25.0))
        start, end = self.sharpness_start or start, self.sharpness_end or end
        return start * (end / start) ** progress

    def loss(
        self, prediction: Superquadric, views: torch.Tensor, truth: Superquadric | None, progress: float,
        generator: torch.Generator,
    ) -> torch.Tensor:
        """The loss of each body (n,); views (n, 1, p, p), and the labels only where :attr:`needs_labels` is true."""
        s = self.sharpness(progress)
        if self.needs_labels:
            assert truth is not None
            if self.name == "mse":
                return parameter_loss(prediction, truth)
            around = [points_around(truth, self.points // 2, generator, scale) for scale in (1.15, 2.0)]
            compare = {"occupancy": occupancy_loss, "occupancy_rotation": rotation_loss, "dual": dual_loss}[self.name]
            return compare(prediction, truth, torch.cat(around, dim=1), s)
        row, column = torch.randint(self.stride, (2,), generator=generator, device=views.device).tolist()
        lines, depth = soft_render.of_view(views[:, 0], self.stride, row, column, self.framing)
        if self.name == "render":
            return render_loss(prediction, lines, depth, s, density=2 * s)
        smallness = max(0.0, 1 - progress / 0.8)
        loss = least_squares_loss(prediction, lines, depth)
        loss = loss * (prediction.size.prod(dim=-1) / 0.05) ** smallness
        if self.name == "least_squares_free":
            loss = loss + 4 * free_space_loss(prediction, lines, depth)
            # The same optimum, but a few badly seen bodies, whose squares are a hundred times those of the others, do
            # not make the whole gradient.
            loss = torch.sqrt(loss + 1e-6)
        return loss

    def with_given(self, prediction: Superquadric, truth: Superquadric) -> Superquadric:
        """The bodies that a validation compares with the true ones: what is given counts as predicted."""
        if self.name == "mse":
            return Superquadric(prediction.size, prediction.shape, prediction.translation, truth.rotation)
        return turn_truth(prediction, truth) if self.name == "occupancy_rotation" else prediction
