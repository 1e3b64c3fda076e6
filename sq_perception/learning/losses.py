"""Losses that know the true body; every one batched over bodies, with finite gradients everywhere.

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

Bodies are torch batches (n,) in the frame of the canonical view, lengths in sides of the cube.
"""

from __future__ import annotations

import torch

from sq_perception.geometry.superquadric import Superquadric

_NOT_ROTATION = ("size", "shape", "translation")


def parameter_loss(prediction: Superquadric, truth: Superquadric) -> torch.Tensor:
    """L_MSE(a, e, t) of each body, shape (n,)."""
    differences = [getattr(prediction, group) - getattr(truth, group) for group in _NOT_ROTATION]
    return torch.cat(differences, dim=-1).square().mean(dim=-1)


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


def turned_truth(prediction: Superquadric, truth: Superquadric) -> Superquadric:
    """The true bodies in the predicted rotations: all that L_OC(q) sees of a prediction."""
    return Superquadric(truth.size, truth.shape, truth.translation, prediction.rotation)


def rotation_loss(
    prediction: Superquadric, truth: Superquadric, points: torch.Tensor, sharpness: float
) -> torch.Tensor:
    """L_OC(q) of each body, shape (n,): :func:`occupancy_loss` of the predicted rotation alone."""
    return occupancy_loss(turned_truth(prediction, truth), truth, points, sharpness)


def dual_loss(prediction: Superquadric, truth: Superquadric, points: torch.Tensor, sharpness: float) -> torch.Tensor:
    """L_DUAL of each body, shape (n,)."""
    return parameter_loss(prediction, truth) + rotation_loss(prediction, truth, points, sharpness)


def points_around(bodies: Superquadric, count: int, generator: torch.Generator, scale: float = 1.25) -> torch.Tensor:
    """Random points (n, count, 3), uniform in each body's own box enlarged by ``scale``."""
    uniform = torch.rand((len(bodies), count, 3), generator=generator, device=bodies.size.device)
    local = (2 * uniform - 1) * scale * bodies.size[:, None, :]
    return bodies.to_parent(local)
