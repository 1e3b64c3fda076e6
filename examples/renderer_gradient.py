"""The thesis' differentiable renderer: find a body's height and place by descending the error of its image (torch)."""

import torch

from sq_perception import Superquadric
from sq_perception.imaging.soft_render import depth_projection, grid_points, occupancy_grid

axis = grid_points(16)


def image(height: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
    """The soft depth image of a rounded box in the unit cube, (16, 16)."""
    size = torch.stack([torch.full_like(height, 0.2), height, torch.full_like(height, 0.15)])[None]
    shape = torch.tensor([[0.3, 0.3]], dtype=torch.float64)
    centre = torch.stack([place, place.new_tensor(0.5), place.new_tensor(0.5)])[None]
    turn = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)
    return depth_projection(occupancy_grid(Superquadric(size, shape, centre, turn), axis, 15.0), 4.0)[0]


seen = image(torch.tensor(0.3, dtype=torch.float64), torch.tensor(0.55, dtype=torch.float64))
height, place = (torch.tensor(start, dtype=torch.float64, requires_grad=True) for start in (0.2, 0.4))
descent = torch.optim.Adam([height, place], lr=0.02)
for _step in range(60):
    descent.zero_grad()
    error = (image(height, place) - seen).abs().mean()
    error.backward()
    descent.step()
print(f"error {error.item():.4f}, half height {height.item():.3f} of 0.300, place {place.item():.3f} of 0.550")
