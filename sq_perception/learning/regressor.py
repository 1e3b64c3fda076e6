"""The network: canonical view in, superquadric parameters out.

A residual network (He et al. 2016) in the thesis' arrangement (chapter 5.2): convolutions, two fully connected layers
of 256, and one head a parameter group.  Size, shape and translation pass a sigmoid into their ranges, so that the first
predictions are moderate bodies; rotation comes out as a unit quaternion, inside as the continuous 6D form.

Input  (n, 1, p, p)  views of :mod:`sq_perception.imaging.canonical_view`, p = ``config.pixels``.
Output Superquadric  batch (n,) in the canonical frame (unit cube, y up, z towards the viewer).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric


@dataclass(frozen=True)
class RegressorConfig:
    """Everything that fixes the network's form; travels in the checkpoint's header."""

    pixels: int = 64
    widths: tuple[int, ...] = (32, 64, 128, 256)
    """Channels of the stem and of each stage; every stage halves the resolution."""
    blocks: int = 2
    """Residual blocks a stage."""
    hidden: int = 256
    size_range: tuple[float, float] = (0.04, 1.2)
    """Half sizes in sides of the cube; interpolated on a logarithmic scale."""
    shape_range: tuple[float, float] = (0.1, 1.0)
    translation_range: tuple[float, float] = (-0.4, 1.4)


class ResidualBlock(nn.Module):
    """Two 3 x 3 convolutions beside a shortcut; the first one may halve the resolution."""

    def __init__(self, channels_in: int, channels_out: int, stride: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels_in, channels_out, 3, stride, 1, bias=False)
        self.first_norm = nn.BatchNorm2d(channels_out)
        self.second = nn.Conv2d(channels_out, channels_out, 3, 1, 1, bias=False)
        self.second_norm = nn.BatchNorm2d(channels_out)
        self.shortcut: nn.Module = nn.Identity()
        if stride != 1 or channels_in != channels_out:
            self.shortcut = nn.Sequential(
                nn.Conv2d(channels_in, channels_out, 1, stride, bias=False), nn.BatchNorm2d(channels_out)
            )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = torch.relu(self.first_norm(self.first(x)))
        return torch.relu(self.second_norm(self.second(y)) + self.shortcut(x))


class Regressor(nn.Module):
    """See the module."""

    def __init__(self, config: RegressorConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or RegressorConfig()
        stem, *stages = config.widths
        layers: list[nn.Module] = [
            nn.Conv2d(1, stem, 5, 2, 2, bias=False),
            nn.BatchNorm2d(stem),
            nn.ReLU(),
        ]
        channels = stem
        for width in stages:
            layers.append(ResidualBlock(channels, width, 2))
            layers.extend(ResidualBlock(width, width, 1) for _ in range(config.blocks - 1))
            channels = width
        self.features = nn.Sequential(*layers)
        cells = config.pixels // 2 ** len(config.widths)
        self.mixer = nn.Sequential(
            nn.Flatten(),
            nn.Linear(channels * cells * cells, config.hidden),
            nn.ReLU(),
            nn.Linear(config.hidden, config.hidden),
            nn.ReLU(),
        )
        self.size_head = nn.Linear(config.hidden, 3)
        self.shape_head = nn.Linear(config.hidden, 2)
        self.translation_head = nn.Linear(config.hidden, 3)
        self.rotation_head = nn.Linear(config.hidden, 6)
        with torch.no_grad():
            self.rotation_head.bias.copy_(torch.tensor([1.0, 0, 0, 0, 1, 0]))

    def forward(self, views: torch.Tensor) -> Superquadric:
        """Superquadrics (n,) of views (n, 1, p, p)."""
        h = self.mixer(self.features(views)).float()
        low, high = self.config.size_range
        with torch.autocast(views.device.type, enabled=False):  # eight bits of mantissa are too few for a size
            size = low * (high / low) ** torch.sigmoid(self.size_head(h))
            return Superquadric(
                size,
                _between(self.config.shape_range, self.shape_head(h)),
                _between(self.config.translation_range, self.translation_head(h)),
                quaternions.from_six(self.rotation_head(h)),
            )

    def predict(self, views: np.ndarray) -> Superquadric:
        """NumPy superquadrics (n,) of NumPy views (n, p, p).

        Raises
        ------
        ValueError
            If the views are not (n, p, p) with p = ``config.pixels``, or not finite.
        """
        expected = (self.config.pixels, self.config.pixels)
        if views.ndim != 3 or views.shape[1:] != expected:
            raise ValueError(f"expected views of shape (n, {expected[0]}, {expected[1]}), got {views.shape}")
        if not np.isfinite(views).all():
            raise ValueError("expected finite views; background is 0")
        self.eval()
        parameter = next(self.parameters())
        with torch.inference_mode():
            batch = torch.from_numpy(np.ascontiguousarray(views, dtype=np.float32))[:, None]
            flat = self(batch.to(parameter.device)).to_flat()
        return Superquadric.from_flat(flat.cpu().numpy().astype(float))


def _between(bounds: tuple[float, float], x: torch.Tensor) -> torch.Tensor:
    low, high = bounds
    return low + (high - low) * torch.sigmoid(x)
