"""Refinement by gradient descent through the soft renderer.

Equation
--------
In the unit cube of a canonical view X (:mod:`sq_perception.imaging.canonical_view`), with the soft image T of equations
7.8 to 7.10 (:mod:`sq_perception.imaging.soft_render`), the thesis' render loss with its final error measure is

    L_DR(y) = 1/|X| sum_ij | X_ij - T_ij(y; s, tau) |                                (thesis, chapter 7.5)

Parameters are log a, logit of e within its bounds, t, and a rotation vector on top of the start.  A sharp boundary has
a gradient in a layer of about a/(2 s) only, thinner than a voxel; s therefore grows geometrically from s/8 to its
value, which widens the basin and leaves the optimum that the caller's s and tau define.
"""

from __future__ import annotations

import numpy as np
import torch

from sq_perception.fitting.bounds import Bounds
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import soft_agreement, soft_render

_GRID = 48
"""Pixels and voxels a side: 2 % of the cube, in 40 % of the time of the thesis' 64."""
_SOFTER = 8.0
"""s at the start is the s of the caller divided by this; see the module."""
_STEP = 0.02
"""Of Adam's first step, in log sizes, cube widths and radians."""


def refine(
    view: np.ndarray,
    start: Superquadric,
    sharpness: float = soft_agreement.THESIS_SHARPNESS,
    tau: float = soft_agreement.THESIS_TAU,
    *,
    iterations: int = 60,
    bounds: Bounds | None = None,
) -> tuple[Superquadric, float, float]:
    """Descend on L_DR from a start.

    Parameters
    ----------
    view : float (n, n)
        Image of the cube, 0 for background.
    start : Superquadric
        A single NumPy body in the cube frame of the view.
    sharpness, tau : float
        s and tau of the soft image.
    iterations : int
        Gradient steps (Adam, step width falling with the cosine).

    Returns
    -------
    body : Superquadric
        The better of start and end, in the cube frame.
    loss_before, loss_after : float
        L_DR at the given s and tau.

    Raises
    ------
    ValueError
        For a view that is not square and finite, a batch of bodies, or s, tau that are not positive.
    """
    view = np.asarray(view)
    if view.ndim != 2 or view.shape[0] != view.shape[1] or not np.isfinite(view).all():
        raise ValueError(f"view: expected a finite square image, got {view.dtype} {view.shape}")
    if start.batch_shape:
        raise ValueError(f"start: expected a single body, got a batch of shape {start.batch_shape}")
    low, high = (bounds or Bounds()).shape
    image, axis = _resampled(view)
    base = torch.as_tensor(np.array(start.rotation), dtype=torch.float32)
    share = np.clip((np.asarray(start.shape) - low) / max(high - low, 1e-9), 0.02, 0.98)
    variables = torch.tensor(
        np.concatenate([np.log(start.size), np.log(share / (1 - share)), start.translation, np.zeros(3)]),
        dtype=torch.float32,
        requires_grad=True,
    )

    def body_of(v: torch.Tensor) -> Superquadric:
        turn = quaternions.from_rotation_vector(v[None, 8:11])
        return Superquadric(
            torch.exp(v[None, 0:3]),
            low + (high - low) * torch.sigmoid(v[None, 3:5]),
            v[None, 5:8],
            quaternions.normalize(quaternions.multiply(base[None], turn)),
        )

    def loss_of(body: Superquadric, s: float) -> torch.Tensor:
        return (image - soft_render.render_depth(body, axis, s, tau)[0]).abs().mean()

    with torch.no_grad():
        fixed = Superquadric.from_flat(torch.as_tensor(np.array(start.to_flat())[None], dtype=torch.float32))
        before = float(loss_of(fixed, sharpness))
    optimiser = torch.optim.Adam([variables], lr=_STEP)
    for k in range(iterations):
        progress = (k + 1) / iterations
        for group in optimiser.param_groups:
            group["lr"] = _STEP * (0.02 + 0.98 * 0.5 * (1 + np.cos(np.pi * progress)))
        optimiser.zero_grad()
        loss = loss_of(body_of(variables), sharpness * _SOFTER ** (progress - 1))
        loss.backward()
        if variables.grad is None or not bool(torch.isfinite(variables.grad).all()):
            break
        optimiser.step()
    with torch.no_grad():
        end = body_of(variables)
        after = float(loss_of(end, sharpness))
    if not after < before:
        return start, before, before
    return Superquadric.from_flat(end.to_flat()[0].detach().double().numpy()), before, after


def _resampled(view: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """The view at the grid's resolution and the grid's axis: nearest pixels, as means would invent depths at edges."""
    pixels = view.shape[0]
    count = min(_GRID, pixels)
    rows = ((np.arange(count) + 0.5) * pixels / count).astype(int)
    return torch.as_tensor(view[np.ix_(rows, rows)], dtype=torch.float32), torch.as_tensor(
        (rows + 0.5) / pixels, dtype=torch.float32
    )
