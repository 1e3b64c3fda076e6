"""Grids of the unit cube: what canonical views and soft images are compared with, and where occupancies are."""

import torch

from sq_perception.geometry import Superquadric
from sq_perception.imaging import soft_render


def cell_centres(resolution: int) -> torch.Tensor:
    """Centres of equal cells of [0, 1], as the pixels of a canonical view."""
    return (torch.arange(resolution, dtype=torch.float64) + 0.5) / resolution


def grid(resolution: int) -> torch.Tensor:
    """The thesis' grid of points (resolution^3, 3) in [0, 1]^3, ends included (chapter 6.3.3)."""
    axis = torch.linspace(0, 1, resolution, dtype=torch.float64)
    return torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).reshape(-1, 3)


def soft_images(bodies: Superquadric, axis: torch.Tensor, sharpness: float, tau: float) -> torch.Tensor:
    """The thesis' soft images (n, rows, columns), a grid of voxels projected (chapter 7.4)."""
    return soft_render.depth_projection(soft_render.occupancy_grid(bodies, axis, sharpness), tau)
