"""The network: canonical view in, superquadric parameters out.

The thesis' arrangement (chapter 5.2): a residual network (:mod:`sq_perception.learning.backbone`), two fully connected
layers of 256, and one head a parameter group.  Size, shape and translation pass a sigmoid into their ranges, so that
the first predictions are moderate bodies; rotation comes out as a unit quaternion, inside as the continuous 6D form.

Input  (n, 1, p, p)  views, p = ``config.pixels``, of one of two framings; the network itself does not care which.
Output Superquadric  batch (n,) in the frame of the views: a unit cube, y up, z towards the viewer.

| framing | view, z of the surface and 0 for background | body |
| --- | --- | --- |
| cropped | one object fills it (:mod:`sq_perception.imaging.canonical_view`) | in the view's own cube |
| full | the thesis' image (:mod:`sq_perception.imaging.unit_cube`), (grey + 0.5) / 255 | in the image's cube |
"""

from __future__ import annotations

import copy

import numpy as np
import torch
from torch import nn

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.learning.backbone import ResNet18, compact_backbone, fold
from sq_perception.learning.network_config import RegressorConfig, check_views


class Regressor(nn.Module):
    """See the module."""

    def __init__(self, config: RegressorConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or RegressorConfig()
        self.features: nn.Module
        if config.backbone == "resnet18":
            self.features, inputs = ResNet18(), ResNet18.CHANNELS
        else:
            self.features = compact_backbone(config.widths, config.blocks)
            inputs = config.widths[-1] * (config.pixels // config.stride) ** 2
        self.mixer = nn.Sequential(
            nn.Flatten(),
            nn.Linear(inputs, config.hidden),
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
        return self.config.decode(self.raw(views))

    def raw(self, views: torch.Tensor) -> torch.Tensor:
        """Outputs (n, 14) of the heads: size 3, shape 2, translation 3, rotation 6, all unbounded."""
        h = self.mixer(self.features(views)).float()
        with torch.autocast(views.device.type, enabled=False):  # eight bits of mantissa are too few for a size
            heads = (self.size_head, self.shape_head, self.translation_head, self.rotation_head)
            return torch.cat([head(h) for head in heads], dim=-1)

    def predict(self, views: np.ndarray) -> Superquadric:
        """NumPy superquadrics (n,) of NumPy views (n, p, p).

        Raises
        ------
        ValueError
            If the views are not (n, p, p) with p = ``config.pixels``, or not finite.
        """
        batch = torch.from_numpy(check_views(views, self.config))[:, None]
        self.eval()
        device = next(self.parameters()).device
        with torch.inference_mode():
            raw = self.raw(batch.to(device, memory_format=torch.channels_last))
        return self.config.decode(raw.cpu().numpy().astype(float))

    def for_inference(self) -> Regressor:
        """A copy that predicts the same, faster: normalisations folded into their convolutions, channels last."""
        copied = copy.deepcopy(self).eval()
        fold(copied.features)
        copied.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        return copied
