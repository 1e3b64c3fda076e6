"""The network: canonical view in, superquadric parameters out.

A residual network (He et al. 2016) in the thesis' arrangement (chapter 5.2): convolutions, two fully connected layers
of 256, and one head a parameter group.  Size, shape and translation pass a sigmoid into their ranges, so that the first
predictions are moderate bodies; rotation comes out as a unit quaternion, inside as the continuous 6D form.

Input  (n, 1, p, p)  views of :mod:`sq_perception.imaging.canonical_view`, p = ``config.pixels``.
Output Superquadric  batch (n,) in the canonical frame (unit cube, y up, z towards the viewer).
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from array_api_compat import array_namespace
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric

Array = Any
"""A NumPy array or a torch tensor."""


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
    marks_hidden: bool = False
    """Whether views tell hidden pixels from background (``CanonicalView.marked``)."""


class ResidualBlock(nn.Module):
    """Two 3 x 3 convolutions beside a shortcut; the first one may halve the resolution."""

    def __init__(self, channels_in: int, channels_out: int, stride: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels_in, channels_out, 3, stride, 1, bias=False)
        self.first_norm: nn.Module = nn.BatchNorm2d(channels_out)
        self.second = nn.Conv2d(channels_out, channels_out, 3, 1, 1, bias=False)
        self.second_norm: nn.Module = nn.BatchNorm2d(channels_out)
        self.shortcut: nn.Module = nn.Identity()
        if stride != 1 or channels_in != channels_out:
            self.shortcut = nn.Sequential(
                nn.Conv2d(channels_in, channels_out, 1, stride, bias=False), nn.BatchNorm2d(channels_out)
            )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = torch.relu(self.first_norm(self.first(x)))
        return torch.relu(self.second_norm(self.second(y)) + self.shortcut(x))

    def fold(self) -> None:
        """Move the normalisations into the convolutions before them; for inference only."""
        self.first, self.first_norm = _folded(self.first, self.first_norm), nn.Identity()
        self.second, self.second_norm = _folded(self.second, self.second_norm), nn.Identity()
        if isinstance(self.shortcut, nn.Sequential):
            self.shortcut = _folded(self.shortcut[0], self.shortcut[1])


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
        return self.decode(self.raw(views))

    def raw(self, views: torch.Tensor) -> torch.Tensor:
        """Outputs (n, 14) of the heads: size 3, shape 2, translation 3, rotation 6, all unbounded."""
        h = self.mixer(self.features(views)).float()
        with torch.autocast(views.device.type, enabled=False):  # eight bits of mantissa are too few for a size
            heads = (self.size_head, self.shape_head, self.translation_head, self.rotation_head)
            return torch.cat([head(h) for head in heads], dim=-1)

    def decode(self, raw: Array) -> Superquadric:
        """Bodies (n,) of outputs (n, 14), NumPy or torch."""
        xp = array_namespace(raw)
        unit = 1 / (1 + xp.exp(-raw[..., :8]))
        low, high = self.config.size_range
        return Superquadric(
            low * (high / low) ** unit[..., 0:3],
            _between(self.config.shape_range, unit[..., 3:5]),
            _between(self.config.translation_range, unit[..., 5:8]),
            quaternions.from_six(raw[..., 8:]),
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
        device = next(self.parameters()).device
        with torch.inference_mode():
            batch = torch.from_numpy(np.ascontiguousarray(views, dtype=np.float32))[:, None]
            raw = self.raw(batch.to(device, memory_format=torch.channels_last))
        return self.decode(raw.cpu().numpy().astype(float))

    def for_inference(self) -> Regressor:
        """A copy that predicts the same, faster: normalisations folded into their convolutions, channels last."""
        copied = copy.deepcopy(self).eval()
        layers = copied.features
        layers[0], layers[1] = _folded(layers[0], layers[1]), nn.Identity()
        for block in layers:
            if isinstance(block, ResidualBlock):
                block.fold()
        copied.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        return copied


def _between(bounds: tuple[float, float], unit: Array) -> Array:
    low, high = bounds
    return low + (high - low) * unit


def _folded(convolution: nn.Module, norm: nn.Module) -> nn.Conv2d:
    assert isinstance(convolution, nn.Conv2d)
    assert isinstance(norm, nn.BatchNorm2d)
    return fuse_conv_bn_eval(convolution, norm)
