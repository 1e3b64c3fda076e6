"""The network of a weights file, made ready to predict, by what computes it fastest.

| network | device | computed by |
| --- | --- | --- |
| compact | cpu | :mod:`sq_perception.learning.forward`, without torch |
| resnet18 | cpu | torch, on one thread |
| any | cuda | torch |

torch is imported where it computes.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sq_perception.fitting.priors import HullPrior
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.geometry.threads import one_torch_thread
from sq_perception.geometry.union import DIRECTIONS, mirrored
from sq_perception.imaging.canonical_view import CanonicalView
from sq_perception.learning import checkpoint, forward
from sq_perception.learning.choices import NEEDS_TORCH
from sq_perception.learning.network_config import (
    MaskConfig,
    RegressorConfig,
    ThingConfig,
    check_views,
    mirror_planes,
)
from sq_perception.learning.positions import predict_in_positions

if TYPE_CHECKING:
    from sq_perception.learning.networks import ThingNetwork


@dataclass(frozen=True, eq=False)
class Predictor:
    """A network of bodies, made ready to predict; it is shown each view in four positions, as one batch."""

    config: RegressorConfig
    predict_once: Callable[[np.ndarray], Superquadric]  # bodies (n,) of checked views (n, p, p), in one position

    def predict(self, views: np.ndarray) -> Superquadric:
        """NumPy superquadrics (n,) of NumPy views (n, p, p).

        Raises ValueError if the views are not (n, p, p) with p = ``config.pixels``, or not finite.
        """
        return predict_in_positions(self.predict_once, check_views(views, self.config))


@dataclass(frozen=True, eq=False)
class HullPredictions:
    """What the network of things predicts for a batch of views, each in the frame of its view; NumPy."""

    bodies: Superquadric  # batch (n,)
    support: np.ndarray
    """(n, J), support functions in sides of the view, from c of :mod:`sq_perception.learning.networks`."""
    covariance: np.ndarray  # (n, J, J), scale of their errors
    freedom: float  # nu

    def hull(self, number: int, view: CanonicalView) -> HullPrior:
        """The prediction of one view in the optical frame."""
        directions = DIRECTIONS @ quaternions.to_matrix(view.rotation)
        support = directions @ view.anchor + view.extent * self.support[number]
        covariance = view.extent**2 * self.covariance[number]
        return HullPrior(directions, support, covariance, view.extent, self.freedom)


class ThingPredictor:
    """The network of things, made ready to predict.

    It computes each view and its mirror image, whose prediction is mirrored back: the mean of two support functions
    errs less than one (by 3 to 6 % on recorded things); the mean of their covariances does not promise more.  The
    body is that of the view itself.
    """

    def __init__(self, network: forward.CompactThings | ThingNetwork) -> None:
        self.config = network.config
        self._network = network

    def predict(
        self, views: np.ndarray, planes: np.ndarray, extents: np.ndarray, mirror: bool = True
    ) -> HullPredictions:
        """Bodies and hulls of views (n, p, p) of sides ``extents`` (n,), metres, 0 where unknown.

        What the things stand on are planes (n, 4) in the frames of the views, zeros where there is none.  Without
        ``mirror``, only the views themselves: in half of the time.

        Raises ValueError for views of another form, or not finite.
        """
        views = check_views(views, self.config.regressor())
        if not mirror:
            of_views = self._network.predict(views, planes.astype(np.float32), extents.astype(np.float32))
            return HullPredictions(*of_views, self.config.freedom)
        both = np.concatenate([views, views[:, :, ::-1]])
        sides = np.concatenate([extents, extents]).astype(np.float32)
        supports = np.concatenate([planes, mirror_planes(planes)]).astype(np.float32)
        bodies, support, covariance = self._network.predict(both, supports, sides)
        straight, turned = np.split(support, 2)
        of_straight, of_turned = np.split(covariance, 2)
        back = mirrored(0)
        return HullPredictions(
            bodies[: len(views)],
            (straight + turned[:, back]) / 2,
            (of_straight + of_turned[:, back][:, :, back]) / 2,
            self.config.freedom,
        )


def load(path: Path | str | None = None, device: str = "cpu") -> Predictor:
    """A predictor of bodies; the path as :func:`checkpoint.resolve` takes it.

    Raises CheckpointError as :func:`checkpoint.read`, and for a network that only torch computes where there is no
    torch.
    """
    config, weights = checkpoint.read(RegressorConfig, path)
    if _is_cpu(device) and config.backbone == "compact":
        return Predictor(config, forward.CompactRegressor(config, weights).predict)
    try:
        model = checkpoint.load(path, device).for_inference()
    except ModuleNotFoundError as error:
        what = f"a network of the backbone {config.backbone} on {device}"
        raise checkpoint.CheckpointError(f"{what} {NEEDS_TORCH}") from error

    def predict(views: np.ndarray) -> Superquadric:
        # On busy cores the slowest of several threads sets the time, and one image is small.
        with one_torch_thread() if _is_cpu(device) else nullcontext():
            return model.predict(views)

    return Predictor(config, predict)


def load_things(path: Path | str | None = None, device: str = "cpu") -> ThingPredictor:
    """A predictor of hulls, None for the network that ships; the device is one that :func:`check_device` has seen.

    Raises CheckpointError as :func:`checkpoint.read`.
    """
    if _is_cpu(device):
        return ThingPredictor(forward.CompactThings(*checkpoint.read(ThingConfig, path)))
    return ThingPredictor(checkpoint.load_things(path, device))


def load_masks(path: Path | str | None = None) -> forward.CompactMasks:
    """A network of masks, None for the one that ships, computed without torch.

    Raises CheckpointError as :func:`checkpoint.read`.
    """
    return forward.CompactMasks(*checkpoint.read(MaskConfig, path))


def _is_cpu(device: str) -> bool:
    return device.partition(":")[0] == "cpu"


def check_device(device: str) -> str:
    """The name of a device that is there, as torch names it.

    Raises ValueError if it is none of cpu, cuda and cuda:N, or not the cpu and there is no torch, or torch sees no such
    device.
    """
    if device == "cpu":
        return device
    if (known := re.fullmatch(r"(cpu|cuda)(?::(\d+))?", device)) is None:
        raise ValueError(f"device: expected cpu, cuda or cuda:N, got {device!r}")
    try:
        import torch
    except ModuleNotFoundError as error:
        raise ValueError(f"device: {device!r} {NEEDS_TORCH}") from error
    if known[1] == "cuda" and int(known[2] or 0) >= (count := torch.cuda.device_count()):
        raise ValueError(f"device: {device!r} was asked for, but torch sees {count} CUDA devices here")
    return device
