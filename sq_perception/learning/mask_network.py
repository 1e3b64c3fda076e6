"""The network that predicts which readings of a segment are of its object: segment and surroundings in, logits out.

Segments found in depth alone hold outliers: pixels that a sensor widened an edge by, and parts of neighbours.  A fit
takes them for surface.  For each cell of a view (:mod:`sq_perception.imaging.segment_view`) the network predicts

    l = log p / (1 - p),    p = P(the cell's reading is one of the object that most of the segment shows).

It is a U-Net (Ronneberger et al. 2015): a compact backbone of residual blocks halves the resolution at each stage; on
the way back, cells are doubled and added to those of the same resolution,

    y_k = block(x_k + doubled(up(y_k+1))),    y_last = x_last,

and four outputs a pixel of the finest, half resolution are the logits of 2 x 2 cells.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import nn

from sq_perception.imaging.segment_view import CHANNELS
from sq_perception.learning.backbone import ResidualBlock, compact_backbone
from sq_perception.learning.layout import CELLS_AT_ONCE
from sq_perception.learning.network_config import MaskConfig

_STEM = 3
"""Modules of the backbone before its first residual block."""


class MaskNetwork(nn.Module):
    """See the module."""

    def __init__(self, config: MaskConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or MaskConfig()
        self.features = compact_backbone(config.widths, config.blocks, CHANNELS)
        steps = list(pairwise(config.widths))
        self.up = nn.ModuleList(nn.Conv2d(coarse, fine, 1) for fine, coarse in steps)
        self.joined = nn.ModuleList(ResidualBlock(fine, fine, 1) for fine, _ in steps)
        self.head = nn.Conv2d(config.widths[0], CELLS_AT_ONCE, 1)

    def forward(self, views: torch.Tensor) -> torch.Tensor:
        """Logits (b, p, p) of views (b, CHANNELS, p, p)."""
        levels = [self.features[:_STEM](views)]
        blocks = self.config.blocks
        for first in range(_STEM, len(self.features), blocks):
            levels.append(self.features[first : first + blocks](levels[-1]))
        y = levels.pop()
        for up, joined in zip(reversed(self.up), reversed(self.joined), strict=True):
            y = joined(levels.pop() + nn.functional.interpolate(up(y), scale_factor=2, mode="nearest"))
        return nn.functional.pixel_shuffle(self.head(y), 2)[:, 0]
