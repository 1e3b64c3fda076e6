"""Convolutions of the network: a compact residual net for small views, and the thesis' ResNet-18.

Both are residual networks (He et al. 2016): every block adds the output of two 3 x 3 convolutions to its input.

| backbone | view | stem | stages | out |
| --- | --- | --- | --- | --- |
| compact | 64 x 64 | 5 x 5, stride 2 | each halves the resolution | cells (n, c, k, k) |
| ResNet18 | 256 x 256 | 7 x 7, stride 2; maximum of 3 x 3, stride 2 | 64, 128, 256, 512 channels | means (n, 512) |

The thesis' network (chapter 5.2) is ResNet-18 with one input channel and without the classifier.  Its modules bear the
names of torchvision's state dict, so that ImageNet weights find their places (docs/training.md).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from sq_perception.learning.layout import BLOCK, TORCHVISION_BLOCK


class ResidualBlock(nn.Module):
    """Two 3 x 3 convolutions beside a shortcut; the first one may halve the resolution.

    ``names`` are those of its five modules.
    """

    def __init__(self, channels_in: int, channels_out: int, stride: int, names: Sequence[str] = BLOCK) -> None:
        super().__init__()
        modules = (
            nn.Conv2d(channels_in, channels_out, 3, stride, 1, bias=False),
            nn.BatchNorm2d(channels_out),
            nn.Conv2d(channels_out, channels_out, 3, 1, 1, bias=False),
            nn.BatchNorm2d(channels_out),
            _shortcut(channels_in, channels_out, stride),
        )
        for name, module in zip(names, modules, strict=True):
            self.add_module(name, module)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        first, first_norm, second, second_norm, shortcut = self.children()
        y = torch.relu(first_norm(first(x)))
        return torch.relu(second_norm(second(y)) + shortcut(x))


def compact_backbone(widths: tuple[int, ...], blocks: int, channels_in: int = 1) -> nn.Sequential:
    """Views (n, channels_in, p, p) to cells (n, widths[-1], k, k) with k = p / 2^len(widths)."""
    stem, *stages = widths
    layers: list[nn.Module] = [nn.Conv2d(channels_in, stem, 5, 2, 2, bias=False), nn.BatchNorm2d(stem), nn.ReLU()]
    channels = stem
    for width in stages:
        layers += _stage(channels, width, 2, blocks)
        channels = width
    return nn.Sequential(*layers)


class ResNet18(nn.Module):
    """Views (n, 1, p, p), p a multiple of 32, to features (n, 512)."""

    CHANNELS = 512

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(1, 64, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.layer1 = nn.Sequential(*_stage(64, 64, 1, 2, TORCHVISION_BLOCK))
        self.layer2 = nn.Sequential(*_stage(64, 128, 2, 2, TORCHVISION_BLOCK))
        self.layer3 = nn.Sequential(*_stage(128, 256, 2, 2, TORCHVISION_BLOCK))
        self.layer4 = nn.Sequential(*_stage(256, self.CHANNELS, 2, 2, TORCHVISION_BLOCK))
        for module in self.modules():
            if isinstance(module, nn.Conv2d):  # keeps the size of gradients from layer to layer (He et al. 2015)
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, views: torch.Tensor) -> torch.Tensor:
        x = torch.relu(self.bn1(self.conv1(views)))
        x = nn.functional.max_pool2d(x, 3, 2, 1)
        x = self.layer4(self.layer3(self.layer2(self.layer1(x))))
        return x.mean(dim=(2, 3))


def fold(module: nn.Module) -> None:
    """Move every normalisation into the convolution registered just before it, in place; for inference only."""
    last: tuple[str, nn.Module] | None = None
    for name, child in list(module.named_children()):
        if isinstance(child, nn.BatchNorm2d) and last is not None and isinstance(last[1], nn.Conv2d):
            setattr(module, last[0], fuse_conv_bn_eval(last[1], child))
            setattr(module, name, nn.Identity())
        fold(child)
        last = name, child


def _stage(
    channels_in: int, channels_out: int, stride: int, blocks: int, names: Sequence[str] = BLOCK
) -> list[nn.Module]:
    """Residual blocks one after the other, of which the first may halve the resolution."""
    first: list[nn.Module] = [ResidualBlock(channels_in, channels_out, stride, names)]
    return first + [ResidualBlock(channels_out, channels_out, 1, names) for _ in range(blocks - 1)]


def _shortcut(channels_in: int, channels_out: int, stride: int) -> nn.Module:
    if stride == 1 and channels_in == channels_out:
        return nn.Identity()
    return nn.Sequential(nn.Conv2d(channels_in, channels_out, 1, stride, bias=False), nn.BatchNorm2d(channels_out))
