"""The network that predicts the unseen side of a thing: view and support plane in, support function of its hull out.

Equation
--------
The support function h(n) = max over the thing of n.(p - c) is what boxes, widths, resting and grasps are made of; it
exists for every shape and asks for no order of axes.  For the J directions n_j of
:data:`sq_perception.geometry.support_directions.DIRECTIONS` the network predicts h ~ t_nu(mu, S), a multivariate t
distribution with

    S = diag(sigma^2) + L L^T,    L (J, K),

as directions that look at the same unseen side err alike.  It is trained by the likelihood of the true h,

    -log p = 1/2 log det S + (nu + J)/2 log(1 + m / nu) + const,    m = (h - mu)^T S^-1 (h - mu),

with det and m by the matrices of K x K that follow from Woodbury's identity.  It also predicts a superquadric, whose
own support function (closed form) is drawn to the true one: where a fit begins.

Frames and units
----------------
Those of the canonical view (:mod:`sq_perception.imaging.canonical_view`): the unit cube, y up, z towards the viewer;
c = (1/2, 1/2, z0) is where the middle of the silhouette meets the nearest depth.  Planes are (n, d), n.p + d the height
above the support; all zeros where none is known.

The sides of the views in metres are an input too, as a logarithm: a thing of 0.2 m is seldom a jar.  0 is unknown.

Input   views (b, p, p) as :attr:`CanonicalView.with_steps` has them, planes (b, 4), extents (b,)
Output  :class:`HullPrediction`
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.geometry.support_directions import DIRECTIONS
from sq_perception.imaging.canonical_view import NEAREST
from sq_perception.learning.backbone import compact_backbone
from sq_perception.learning.network_config import (
    BODY_OUTPUTS,
    EXTENT,
    LEAST_LOG,
    MOST_LOG,
    PLANE,
    ThingConfig,
    side_inputs,
)

MIDDLE = (0.5, 0.5, NEAREST)
"""c: what h is measured from."""
_FIRST_SUPPORT, _FIRST_LOG = 0.4, -2.5


@dataclass(frozen=True, eq=False)
class HullPrediction:
    """What the network predicts for a batch of views, in the views' frames; arrays of torch.

    Attributes
    ----------
    body : Superquadric
        Batch (b,).
    support : (b, J)
        mu, in sides of the view.
    log_sigma : (b, J)
    factors : (b, J, K)
        L.
    freedom : float
        nu.
    """

    body: Superquadric
    support: torch.Tensor
    log_sigma: torch.Tensor
    factors: torch.Tensor
    freedom: float

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
        self.mixer = nn.Sequential(
            nn.Linear(inputs + PLANE + EXTENT, config.hidden),
            nn.ReLU(),
            nn.Linear(config.hidden, config.hidden),
            nn.ReLU(),
        )
        self.body_head = nn.Linear(config.hidden, BODY_OUTPUTS)
        self.support_head = nn.Linear(config.hidden, count)
        self.sigma_head = nn.Linear(config.hidden, count)
        self.factor_head = nn.Linear(config.hidden, count * config.factors)
        with torch.no_grad():
            self.body_head.bias[BODY_OUTPUTS - 6 :].copy_(torch.tensor([1.0, 0, 0, 0, 1, 0]))
            self.support_head.bias.fill_(_FIRST_SUPPORT)
            self.sigma_head.bias.fill_(_FIRST_LOG)
            self.factor_head.weight.mul_(0.1)

    def forward(self, views: torch.Tensor, planes: torch.Tensor, extents: torch.Tensor) -> HullPrediction:
        heights, scale = side_inputs(views, planes, extents)
        h = self.features(torch.stack([views, heights], dim=1)).flatten(1)
        h = self.mixer(torch.cat([h, planes.to(h.dtype), scale[:, None].to(h.dtype)], dim=1)).float()
        with torch.autocast(views.device.type, enabled=False):  # eight bits of mantissa are too few for a size
            body = self._encoding.decode(self.body_head(h))
            log_sigma = LEAST_LOG + nn.functional.softplus(self.sigma_head(h) - LEAST_LOG)
            factors = self.factor_head(h).unflatten(1, (len(DIRECTIONS), self.config.factors))
            log_sigma = log_sigma.clamp_max(MOST_LOG) + 0.5 * math.log(self.config.spread)
            factors = math.sqrt(self.config.spread) * factors
            return HullPrediction(body, self.support_head(h), log_sigma, factors, self.config.freedom)

    def predict(
        self, views: np.ndarray, planes: np.ndarray, extents: np.ndarray
    ) -> tuple[Superquadric, np.ndarray, np.ndarray]:
        """The predictions for NumPy views (b, p, p), planes (b, 4) and extents (b,), in float32, in evaluation mode.

        Bodies (b,), support functions (b, J) and their S (b, J, J), in the views' frames; NumPy.
        """
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
    """The support function (b, J) of torch bodies (b,) in the frame of their views, from :data:`MIDDLE`."""
    directions = torch.tensor(DIRECTIONS, dtype=body.size.dtype, device=body.size.device)
    middle = torch.tensor(MIDDLE, dtype=body.size.dtype, device=body.size.device)
    reach = body.support(directions.expand(len(body), -1, -1))
    return (body.translation - middle) @ directions.T + reach


def body_loss(body: Superquadric, truth: torch.Tensor) -> torch.Tensor:
    """Mean distance (b,) between the support functions of bodies and the true ones (b, J), in sides of the view."""
    return (support_of(body) - truth).abs().mean(dim=1)
