"""Training losses; every one batched over bodies, with finite gradients everywhere.

Occupancy loss (thesis, equations 6.6 to 6.8): the mean squared difference of two soft occupancies

    L_OC = 1/|P| sum_p (G(p; y) - G(p; y_hat))^2,      G = sigma(s (1 - F^e1)) = sigma(s (1 - g^2)).

It compares bodies, never parameters, so the 8 equivalent parameter vectors and every symmetry cost nothing.  P is the
thesis' grid or any other set of points; random points around the body are an unbiased and far cheaper choice.
"""

from __future__ import annotations

import torch

from sq_perception.geometry.superquadric import Superquadric


def occupancy_loss(
    prediction: Superquadric, truth: Superquadric, points: torch.Tensor, sharpness: float
) -> torch.Tensor:
    """L_OC of each body, shape (n,).

    Parameters
    ----------
    prediction, truth : Superquadric
        Torch batches (n,).
    points : (n, N, 3) or (N, 3)
        Where the occupancies are compared.
    sharpness : float
        s of equation 6.6; the surface is a transition about 1/s of the body wide.
    """
    difference = prediction.occupancy(points, sharpness) - truth.occupancy(points, sharpness)
    return (difference * difference).mean(dim=-1)


def grid(resolution: int, low: float = 0.0, high: float = 1.0, **like: torch.dtype | torch.device) -> torch.Tensor:
    """The thesis' grid of points (resolution^3, 3) in [low, high]^3, ends included (chapter 6.3.3)."""
    axis = torch.linspace(low, high, resolution, **like)  # type: ignore[call-overload]
    return torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).reshape(-1, 3)


def points_around(bodies: Superquadric, count: int, generator: torch.Generator, scale: float = 1.25) -> torch.Tensor:
    """Random points (n, count, 3), uniform in each body's own box enlarged by ``scale``."""
    uniform = torch.rand((len(bodies), count, 3), generator=generator, device=bodies.size.device)
    local = (2 * uniform - 1) * scale * bodies.size[:, None, :]
    return bodies.to_parent(local)
