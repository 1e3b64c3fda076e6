"""The networks as modules of torch: of bodies (the regressor), of things (their hulls) and of masks.

All are residual networks (He et al. 2016): every block adds the output of two 3 x 3 convolutions to its input.

| backbone | view | stem | stages | out |
| --- | --- | --- | --- | --- |
| compact | 64 x 64 | 5 x 5, stride 2 | each halves the resolution | cells (n, c, k, k) |
| ResNet18 | 256 x 256 | 7 x 7, stride 2; maximum of 3 x 3, stride 2 | 64, 128, 256, 512 channels | means (n, 512) |

The regressor
-------------
Canonical view in, superquadric parameters out: a backbone, two fully connected layers of 256, and one head a parameter
group (thesis, chapter 5.2, which has ResNet-18 with one input channel and without the classifier).  Size, shape and
translation pass a sigmoid into their ranges, so that the first predictions are moderate bodies; rotation comes out as a
unit quaternion, inside as the continuous 6D form.  Views (n, 1, p, p) and bodies (n,) are in one frame, a unit cube, y
up, z towards the viewer:

| framing | view, z of the surface and 0 for background | body |
| --- | --- | --- |
| cropped | one object fills it (:mod:`sq_perception.imaging.canonical_view`) | in the view's own cube |
| full | the thesis' image (:mod:`sq_perception.imaging.unit_cube`), (grey + 0.5) / 255 | in the image's cube |

The network of things
---------------------
View and support plane in, support function of the thing's hull out.  h(n) = max over the thing of n.(p - c) is what
boxes, widths, resting and grasps are made of; it exists for every shape and asks for no order of axes.  For the J
directions n_j of :data:`sq_perception.geometry.union.DIRECTIONS` the network predicts h ~ t_nu(mu, S), a
multivariate t distribution with

    S = diag(sigma^2) + L L^T,    L (J, K),

as directions that look at the same unseen side err alike.  It is trained by the likelihood of the true h,

    -log p = 1/2 log det S + (nu + J)/2 log(1 + m / nu) + const,    m = (h - mu)^T S^-1 (h - mu),

with det and m by the matrices of K x K that follow from Woodbury's identity.  It also predicts a superquadric, whose
own support function (closed form) is drawn to the true one: where a fit begins.

Views are those of :attr:`CanonicalView.with_steps`; c = (1/2, 1/2, z0) is where the middle of the silhouette meets the
nearest depth.  Planes are (n, d), n.p + d the height above the support; all zeros where none is known.  The sides of
the views in metres are an input too, as a logarithm: a thing of 0.2 m is seldom a jar.  0 is unknown.

The network of masks
--------------------
Segments found in depth alone hold outliers: pixels that a sensor widened an edge by, and parts of neighbours.  A fit
takes them for surface.  For each cell of a view (:mod:`sq_perception.imaging.segment_view`) the network predicts

    l = log p / (1 - p),    p = P(the cell's reading is one of the object that most of the segment shows).

It is a U-Net (Ronneberger et al. 2015): a compact backbone halves the resolution at each stage; on the way back, cells
are doubled and added to those of the same resolution,

    y_k = block(x_k + doubled(up(y_k+1))),    y_last = x_last,

and four outputs a pixel of the finest, half resolution are the logits of 2 x 2 cells.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.geometry.union import DIRECTIONS
from sq_perception.imaging.canonical_view import NEAREST
from sq_perception.imaging.segment_view import CHANNELS
from sq_perception.learning import network_config
from sq_perception.learning.layout import BLOCK, CELLS_AT_ONCE, TORCHVISION_BLOCK, heads
from sq_perception.learning.network_config import MaskConfig, RegressorConfig, ThingConfig


class ResidualBlock(nn.Module):
    """Two 3 x 3 convolutions, the first of which may halve the resolution, beside a shortcut; five named modules."""

    def __init__(self, channels_in: int, channels_out: int, stride: int, names: Sequence[str] = BLOCK) -> None:
        super().__init__()
        shortcut: nn.Module = nn.Identity()
        if stride > 1 or channels_in != channels_out:
            shortcut = nn.Sequential(
                nn.Conv2d(channels_in, channels_out, 1, stride, bias=False), nn.BatchNorm2d(channels_out)
            )
        modules = (
            nn.Conv2d(channels_in, channels_out, 3, stride, 1, bias=False), nn.BatchNorm2d(channels_out),
            nn.Conv2d(channels_out, channels_out, 3, 1, 1, bias=False), nn.BatchNorm2d(channels_out), shortcut,
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


class Regressor(nn.Module):
    """The network of bodies; see the module."""

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
            nn.Flatten(), nn.Linear(inputs, config.hidden), nn.ReLU(), nn.Linear(config.hidden, config.hidden),
            nn.ReLU(),
        )
        for name, outputs in heads(config).items():
            self.add_module(name, nn.Linear(config.hidden, outputs))
        with torch.no_grad():
            self.get_parameter("rotation_head.bias").copy_(torch.tensor([1.0, 0, 0, 0, 1, 0]))

    def forward(self, views: torch.Tensor) -> Superquadric:
        """Superquadrics (n,) of views (n, 1, p, p)."""
        return self.config.decode(self.raw(views))

    def raw(self, views: torch.Tensor) -> torch.Tensor:
        """Outputs (n, 14) of the heads: size 3, shape 2, translation 3, rotation 6, all unbounded."""
        h = self.mixer(self.features(views)).float()
        with torch.autocast(views.device.type, enabled=False):  # eight bits of mantissa are too few for a size
            return torch.cat([self.get_submodule(name)(h) for name in heads(self.config)], dim=-1)

    def predict(self, views: np.ndarray) -> Superquadric:
        """NumPy superquadrics (n,) of NumPy views (n, p, p).  Raises ValueError if the views are not (n, p, p) with p =
        ``config.pixels``, or not finite."""
        batch = torch.from_numpy(network_config.check_views(views, self.config))[:, None]
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


@dataclass(frozen=True, eq=False)
class HullPrediction:
    """What the network predicts for a batch of views, in the views' frames; arrays of torch."""

    body: Superquadric  # batch (b,)
    support: torch.Tensor  # (b, J), mu, in sides of the view
    log_sigma: torch.Tensor  # (b, J)
    factors: torch.Tensor  # (b, J, K), L
    freedom: float  # nu

    def covariance(self) -> torch.Tensor:
        """S (b, J, J)."""
        spread = torch.diag_embed(torch.exp(2 * self.log_sigma))
        return spread + self.factors @ self.factors.transpose(1, 2)

    def deviation(self) -> torch.Tensor:
        """Standard deviations (b, J) of h."""
        share = self.freedom / (self.freedom - 2)
        return torch.sqrt(share * torch.diagonal(self.covariance(), dim1=1, dim2=2))

    def negative_log_likelihood(self, truth: torch.Tensor) -> torch.Tensor:
        """-log p (b,) of true support functions (b, J), without its constant."""
        count = truth.shape[1]
        distance, log_det = self.distance(truth)
        return 0.5 * log_det + 0.5 * (self.freedom + count) * torch.log1p(distance / self.freedom)

    def distance(self, truth: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """m and log det S (b,) for true support functions (b, J)."""
        weight = torch.exp(-2 * self.log_sigma)
        error = truth - self.support
        weighted = self.factors * weight[..., None]
        inner = torch.eye(self.factors.shape[2], device=truth.device) + self.factors.transpose(1, 2) @ weighted
        root = torch.linalg.cholesky(inner)
        along = torch.linalg.solve_triangular(root, (weighted.transpose(1, 2) @ error[..., None]), upper=False)[..., 0]
        distance = (weight * error * error).sum(1) - (along * along).sum(1)
        log_det = 2 * self.log_sigma.sum(1) + 2 * torch.log(torch.diagonal(root, dim1=1, dim2=2)).sum(1)
        return distance.clamp_min(0), log_det


class ThingNetwork(nn.Module):
    """See the module."""

    def __init__(self, config: ThingConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or ThingConfig()
        self._encoding = config.regressor()
        count = len(DIRECTIONS)
        self.features = compact_backbone(config.widths, config.blocks, channels_in=2)
        inputs = config.widths[-1] * (config.pixels // self._encoding.stride) ** 2
        inputs += network_config.PLANE + network_config.EXTENT
        self.mixer = nn.Sequential(
            nn.Linear(inputs, config.hidden), nn.ReLU(), nn.Linear(config.hidden, config.hidden), nn.ReLU()
        )
        self.body_head = nn.Linear(config.hidden, network_config.BODY_OUTPUTS)
        self.support_head = nn.Linear(config.hidden, count)
        self.sigma_head = nn.Linear(config.hidden, count)
        self.factor_head = nn.Linear(config.hidden, count * config.factors)
        with torch.no_grad():
            self.body_head.bias[network_config.BODY_OUTPUTS - 6 :].copy_(torch.tensor([1.0, 0, 0, 0, 1, 0]))
            self.support_head.bias.fill_(0.4)
            self.sigma_head.bias.fill_(-2.5)
            self.factor_head.weight.mul_(0.1)

    def forward(self, views: torch.Tensor, planes: torch.Tensor, extents: torch.Tensor) -> HullPrediction:
        heights, scale = network_config.side_inputs(views, planes, extents)
        h = self.features(torch.stack([views, heights], dim=1)).flatten(1)
        h = self.mixer(torch.cat([h, planes.to(h.dtype), scale[:, None].to(h.dtype)], dim=1)).float()
        with torch.autocast(views.device.type, enabled=False):  # eight bits of mantissa are too few for a size
            body = self._encoding.decode(self.body_head(h))
            log_sigma = network_config.LEAST_LOG + nn.functional.softplus(self.sigma_head(h) - network_config.LEAST_LOG)
            factors = self.factor_head(h).unflatten(1, (len(DIRECTIONS), self.config.factors))
            log_sigma = log_sigma.clamp_max(network_config.MOST_LOG) + 0.5 * math.log(self.config.spread)
            factors = math.sqrt(self.config.spread) * factors
            return HullPrediction(body, self.support_head(h), log_sigma, factors, self.config.freedom)

    def predict(
        self, views: np.ndarray, planes: np.ndarray, extents: np.ndarray
    ) -> tuple[Superquadric, np.ndarray, np.ndarray]:
        """The predictions for NumPy views (b, p, p), planes (b, 4) and extents (b,), in float32, in evaluation mode.
        Bodies (b,), support functions (b, J) and their S (b, J, J), in the views' frames; NumPy."""
        self.eval()
        device = next(self.parameters()).device
        with torch.inference_mode():
            predicted = self(*(torch.from_numpy(each).to(device) for each in (views, planes, extents)))
            flat, support, covariance = (
                each.double().cpu().numpy()
                for each in (predicted.body.to_flat(), predicted.support, predicted.covariance())
            )
        return Superquadric.from_flat(flat), support, covariance


def support_of(body: Superquadric) -> torch.Tensor:
    """The support function (b, J) of torch bodies (b,) in the frame of their views, from c of the module."""
    directions = torch.tensor(DIRECTIONS, dtype=body.size.dtype, device=body.size.device)
    middle = torch.tensor((0.5, 0.5, NEAREST), dtype=body.size.dtype, device=body.size.device)
    reach = body.support(directions.expand(len(body), -1, -1))
    return (body.translation - middle) @ directions.T + reach


def body_loss(body: Superquadric, truth: torch.Tensor) -> torch.Tensor:
    """Mean distance (b,) between the support functions of bodies and the true ones (b, J), in sides of the view."""
    return (support_of(body) - truth).abs().mean(dim=1)


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
        stem = 3  # modules before the first residual block
        levels = [self.features[:stem](views)]
        blocks = self.config.blocks
        for first in range(stem, len(self.features), blocks):
            levels.append(self.features[first : first + blocks](levels[-1]))
        y = levels.pop()
        for up, joined in zip(reversed(self.up), reversed(self.joined), strict=True):
            y = joined(levels.pop() + nn.functional.interpolate(up(y), scale_factor=2, mode="nearest"))
        return nn.functional.pixel_shuffle(self.head(y), 2)[:, 0]
