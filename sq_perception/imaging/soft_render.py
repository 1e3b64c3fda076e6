"""Soft images of superquadrics: the thesis' differentiable renderer, with s and tau.

Equations (thesis, chapters 6.3.2 and 7.4)
------------------------------------------
Occupancy (6.6) on a grid of points, voxel k = 1..n of a line of sight counted from the viewer:

    V = sigma(s (1 - F^e1))

depth projection (7.9, 7.10) along the line of sight:

    A_k = exp(-tau sum_{l <= k} V_l),        T(V) = 1 - 1/n sum_k A_k

A_k stays 1 until a voxel is hit and then drops to 0, so the sum counts the empty voxels before the surface: T is the
image of the unit cube (:mod:`sq_perception.imaging.unit_cube`), z of the nearest surface, near 0 where there is none.
s is the sharpness of a body's boundary, tau that of the hit; both large make T the exact image, up to half a voxel.

All functions are torch, batched over bodies in the cube frame (y up, z towards the viewer), and differentiable.
"""

from __future__ import annotations

import torch

from sq_perception.geometry.superquadric import Superquadric


def grid_points(resolution: int) -> torch.Tensor:
    """Points (resolution,) of [0, 1], ends included: an axis of the thesis' grid and of its images."""
    return torch.linspace(0, 1, resolution, dtype=torch.float64)


def occupancy_grid(bodies: Superquadric, axis: torch.Tensor, sharpness: float) -> torch.Tensor:
    """Soft occupancy of each body, (n, rows, columns, voxels).

    Parameters
    ----------
    bodies : Superquadric
        Torch batch (n,).
    axis : (r,)
        Coordinates shared by x, y and z, ascending.  Rows run from the largest y down, columns along x, voxels from the
        viewer (largest z) away.
    sharpness : float
        s, positive.
    """
    _check_positive("s", sharpness)
    y, x, z = torch.meshgrid(axis.flip(0), axis, axis.flip(0), indexing="ij")
    points = torch.stack([x, y, z], dim=-1).reshape(-1, 3)
    return bodies.occupancy(points, sharpness).reshape(-1, *x.shape)


def depth_projection(occupancy: torch.Tensor, tau: float) -> torch.Tensor:
    """T(V) of occupancy grids (..., voxels), shape (...), in [0, 1] (equations 7.9 and 7.10)."""
    _check_positive("tau", tau)
    return 1 - torch.exp(-tau * occupancy.cumsum(dim=-1)).mean(dim=-1)


def _check_positive(name: str, value: float) -> None:
    if not value > 0:
        raise ValueError(f"{name}: expected a positive number, got {value}")
