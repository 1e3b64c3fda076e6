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

import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval


class ResidualBlock(nn.Module):
    """Two 3 x 3 convolutions beside a shortcut; the first one may halve the resolution."""

    def __init__(self, channels_in: int, channels_out: int, stride: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels_in, channels_out, 3, stride, 1, bias=False)
        self.first_norm = nn.BatchNorm2d(channels_out)
        self.second = nn.Conv2d(channels_out, channels_out, 3, 1, 1, bias=False)
        self.second_norm = nn.BatchNorm2d(channels_out)
        self.shortcut = _shortcut(channels_in, channels_out, stride)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = torch.relu(self.first_norm(self.first(x)))
        return torch.relu(self.second_norm(self.second(y)) + self.shortcut(x))


def compact_backbone(widths: tuple[int, ...], blocks: int, channels_in: int = 1) -> nn.Sequential:
    """Views (n, channels_in, p, p) to cells (n, widths[-1], k, k) with k = p / 2^len(widths)."""
    stem, *stages = widths
    layers: list[nn.Module] = [nn.Conv2d(channels_in, stem, 5, 2, 2, bias=False), nn.BatchNorm2d(stem), nn.ReLU()]
    channels = stem
    for width in stages:
        layers.append(ResidualBlock(channels, width, 2))
        layers.extend(ResidualBlock(width, width, 1) for _ in range(blocks - 1))
        channels = width
    return nn.Sequential(*layers)


class BasicBlock(nn.Module):
    """The residual block under torchvision's names."""

    def __init__(self, channels_in: int, channels_out: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels_in, channels_out, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(channels_out)
        self.conv2 = nn.Conv2d(channels_out, channels_out, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(channels_out)
        self.downsample = _shortcut(channels_in, channels_out, stride)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = torch.relu(self.bn1(self.conv1(x)))
        return torch.relu(self.bn2(self.conv2(y)) + self.downsample(x))


class ResNet18(nn.Module):
    """Views (n, 1, p, p), p a multiple of 32, to features (n, 512)."""

    CHANNELS = 512

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(1, 64, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.layer1 = nn.Sequential(BasicBlock(64, 64, 1), BasicBlock(64, 64, 1))
        self.layer2 = nn.Sequential(BasicBlock(64, 128, 2), BasicBlock(128, 128, 1))
        self.layer3 = nn.Sequential(BasicBlock(128, 256, 2), BasicBlock(256, 256, 1))
        self.layer4 = nn.Sequential(BasicBlock(256, self.CHANNELS, 2), BasicBlock(self.CHANNELS, self.CHANNELS, 1))
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


def _shortcut(channels_in: int, channels_out: int, stride: int) -> nn.Module:
    if stride == 1 and channels_in == channels_out:
        return nn.Identity()
    return nn.Sequential(nn.Conv2d(channels_in, channels_out, 1, stride, bias=False), nn.BatchNorm2d(channels_out))
