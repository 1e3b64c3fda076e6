"""Losses that know the depth image alone: no labels, only the canonical view and its orthographic camera.

X is the view, a line of sight a pixel (:mod:`sq_perception.imaging.sight_lines`); on a line that met a surface X is its
z, on the others 0.

Least squares (thesis, equation 7.7), over the points p of the surface

    L_LS = sqrt(a1 a2 a3) mean_p (F^e1 - 1)^2,        F^e1 = g^2

(a mean where the thesis has a sum, so that large objects do not outweigh small ones).  It asks only that the points lie
on the surface: a body may run on behind its silhouette, and the points may even lie on its back.

Free space: a line of sight is empty until it ends, at its point or, on the background, never

    L_LS + w mean_lines max(0, 1 - min g)^2,      min over the empty part of the line.

Render loss (7.8 to 7.11)

    L_DR = mean_lines |X - T|,        T: soft depth at s and tau.

T comes from a grid of n^3 voxels, as in the thesis (:mod:`sq_perception.imaging.soft_render`), or as the limit of ever
finer voxels with D = n tau held fixed.  The limit is cheap at any s.  That matters: a soft boundary moves the optimum,
and fitting at s = 20, 40 and 100 (D = 2 s) ends at 83, 90 and 95 % IoU even if it starts from the truth.
"""

from __future__ import annotations

import torch

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import sight_lines


def least_squares_loss(prediction: Superquadric, lines: torch.Tensor, depth: torch.Tensor) -> torch.Tensor:
    """L_LS of each body, (n,).

    Parameters
    ----------
    prediction : Superquadric
        Torch batch (n,) in the view's frame.
    lines, depth : (r, 2), (n, r)
        Lines of sight and z where they end, 0 for background, as :func:`sight_lines.of_view` gives them.
    """
    seen = depth > 0
    gauge = sight_lines.gauge(prediction, lines, depth)
    # Background lines carry a number that is no depth: cut them off before the square, not after it.
    residual = torch.where(seen, gauge, torch.ones_like(gauge)) ** 2 - 1
    mean = (residual * residual).sum(dim=-1) / seen.sum(dim=-1).clamp(min=1)
    return prediction.size.prod(dim=-1).sqrt() * mean


def free_space_loss(prediction: Superquadric, lines: torch.Tensor, depth: torch.Tensor) -> torch.Tensor:
    """Mean of max(0, 1 - min g)^2 over the empty part of each line, (n,); arguments as above."""
    excess = sight_lines.free_space_excess(prediction, lines, depth)
    return (excess * excess).mean(dim=-1)


def render_loss(
    prediction: Superquadric, lines: torch.Tensor, depth: torch.Tensor, sharpness: float, density: float
) -> torch.Tensor:
    """L_DR of each body, (n,), in the limit of fine voxels; ``density`` is D = n tau."""
    soft = sight_lines.soft_depth(prediction, lines, sharpness, density, cells=8)
    return (depth - soft).abs().mean(dim=-1)
