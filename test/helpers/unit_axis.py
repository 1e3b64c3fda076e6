"""The axis of grids that canonical views are compared with."""

from __future__ import annotations

import torch


def cell_centres(resolution: int) -> torch.Tensor:
    """Centres of equal cells of [0, 1], as the pixels of a canonical view."""
    return (torch.arange(resolution, dtype=torch.float64) + 0.5) / resolution
