"""The network of a weights file, made ready to predict, by what computes it fastest.

| network | device | computed by |
| --- | --- | --- |
| compact | cpu | :mod:`sq_perception.learning.forward`, without torch |
| resnet18 | cpu | torch, on one thread |
| any | cuda | torch |

torch is imported where it computes.

Positions of a view
-------------------
A view has 8 positions, quarter turns and reflections.  Position (k, mirror) is a reflection of x, where ``mirror``, and
then k quarter turns counter-clockwise in x and y, all about the middle (1/2, 1/2) of the view.  The image of the moved
body is the moved image, for cropped views and for full frames alike.  A mirrored image is the image of the mirrored
body, which is a superquadric again: with M = diag(-1, 1, 1), M R M is a rotation, and the body's own symmetry takes up
the second M.

A network of bodies is shown four of them, and its answers are made one, as four errors have a smaller mean.  Parameters
are averaged in that of the 8 equivalent forms whose turn is nearest, sizes as logarithms.  Turns far apart are
different answers: averaged are those near to one of them, to the one that has the most.
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
from sq_perception.learning.network_config import MaskConfig, RegressorConfig, ThingConfig, check_views, mirror_planes

if TYPE_CHECKING:
    from sq_perception.learning.networks import ThingNetwork


@dataclass(frozen=True, eq=False)
class Predictor:
    """A network of bodies, made ready to predict; it is shown each view in four positions, as one batch."""

    config: RegressorConfig
    predict_once: Callable[[np.ndarray], Superquadric]  # bodies (n,) of checked views (n, p, p), in one position

    def predict(self, views: np.ndarray) -> Superquadric:
        """NumPy superquadrics (n,) of NumPy views (n, p, p).  Raises ValueError if the views are not (n, p, p) with p =
        ``config.pixels``, or not finite."""
        return predict_in_positions(self.predict_once, check_views(views, self.config))


@dataclass(frozen=True, eq=False)
class HullPredictions:
    """What the network of things predicts for a batch of views, each in the frame of its view; NumPy."""

    bodies: Superquadric  # batch (n,)
    support: np.ndarray  # (n, J), support functions in sides of the view, from c of sq_perception.learning.networks
    covariance: np.ndarray  # (n, J, J), scale of their errors
    freedom: float  # nu

    def hull(self, number: int, view: CanonicalView) -> HullPrior:
        """The prediction of one view in the optical frame."""
        directions = DIRECTIONS @ quaternions.to_matrix(view.rotation)
        support = directions @ view.anchor + view.extent * self.support[number]
        covariance = view.extent**2 * self.covariance[number]
        return HullPrior(directions, support, covariance, view.extent, self.freedom)


class ThingPredictor:
    """The network of things, made ready to predict: the means of support functions and covariances of each view and of
    its mirror image, mirrored back, which err less; the body is that of the view itself."""

    def __init__(self, network: forward.CompactThings | ThingNetwork) -> None:
        self.config = network.config
        self._network = network

    def predict(
        self, views: np.ndarray, planes: np.ndarray, extents: np.ndarray, mirror: bool = True
    ) -> HullPredictions:
        """Bodies and hulls of views (n, p, p) of sides ``extents`` (n,), metres, 0 where unknown, on planes (n, 4) in
        their frames, zeros for none; without ``mirror`` in half of the time.  Raises ValueError for other views."""
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
            bodies[: len(views)], (straight + turned[:, back]) / 2, (of_straight + of_turned[:, back][:, :, back]) / 2,
            self.config.freedom,
        )


def load(path: Path | str | None = None, device: str = "cpu") -> Predictor:
    """A predictor of bodies; the path as :func:`checkpoint.resolve` takes it.  Raises CheckpointError as
    :func:`checkpoint.read`, and for a network that only torch computes where there is no torch."""
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
    """A predictor of hulls, path and errors as of :func:`checkpoint.read`; :func:`check_device` has seen the device."""
    if _is_cpu(device):
        return ThingPredictor(forward.CompactThings(*checkpoint.read(ThingConfig, path)))
    return ThingPredictor(checkpoint.load_things(path, device))


def load_masks(path: Path | str | None = None) -> forward.CompactMasks:
    """A network of masks, computed without torch; path and errors as of :func:`checkpoint.read`."""
    return forward.CompactMasks(*checkpoint.read(MaskConfig, path))


def _is_cpu(device: str) -> bool:
    return device.partition(":")[0] == "cpu"


def check_device(device: str) -> str:
    """The name of a device that is there, as torch names it.  Raises ValueError if it is none of cpu, cuda and cuda:N,
    or not the cpu and there is no torch, or torch sees no such device."""
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


def predict_in_positions(predict: Callable[[np.ndarray], Superquadric], views: np.ndarray) -> Superquadric:
    """Bodies (n,) of views (n, p, p), of which ``predict`` gives those of any number of views."""
    # Positions that a network is shown, each of which undoes itself.
    positions = ((0, False), (0, True), (2, False), (2, True))
    turns, mirror = (np.repeat(each, len(views)) for each in zip(*positions, strict=True))
    shown = move_images(np.concatenate([views] * len(positions)), turns, mirror)
    flat = move_bodies(predict(shown), turns, mirror).to_flat()
    return mean_body(Superquadric.from_flat(flat.reshape(len(positions), len(views), -1)))


def move_images(images: np.ndarray, turns: np.ndarray, mirror: np.ndarray) -> np.ndarray:
    """Images (n, p, p) in positions (n,)."""
    images = np.where(mirror[:, None, None], images[:, :, ::-1], images)
    out = np.empty_like(images)
    for k in range(4):
        chosen = turns == k
        out[chosen] = np.rot90(images[chosen], k, axes=(1, 2))
    return out


def move_bodies(bodies: Superquadric, turns: np.ndarray, mirror: np.ndarray) -> Superquadric:
    """The bodies (n,) of those images."""
    sign = np.where(mirror, -1.0, 1.0)
    centred = bodies.translation - 0.5
    centred = np.stack([sign * centred[:, 0], centred[:, 1], centred[:, 2]], axis=-1)
    rotation = bodies.rotation * np.stack([np.ones_like(sign), sign, sign, np.ones_like(sign)], axis=-1)
    angle = 0.5 * np.pi * turns
    turn = np.stack([np.zeros_like(angle), np.zeros_like(angle), np.sin(angle / 2), np.cos(angle / 2)], axis=-1)
    return Superquadric(bodies.size, bodies.shape, centred, rotation).transformed(turn, np.full(3, 0.5))


def mean_body(answers: Superquadric) -> Superquadric:
    """The means (n,) of answers (k, n); see the module."""
    # Cosine of half of the largest angle between two turns that are averaged.
    farthest = float(np.cos(np.deg2rad(15.0)))
    forms = answers.equivalent_forms()
    cosines = np.einsum("fkni,rni->fkrn", forms.rotation, answers.rotation)
    each = np.arange(answers.batch_shape[1])
    chosen = np.argmax((np.abs(cosines).max(axis=0) > farthest).sum(axis=0), axis=0)
    cosines = cosines[:, :, chosen, each]
    nearest = np.argmax(np.abs(cosines), axis=0)
    near = forms[nearest, np.arange(len(answers))[:, None], each]
    cosine = np.take_along_axis(cosines, nearest[None], axis=0)[0]
    weights = ((np.abs(cosine) > farthest) / (np.abs(cosine) > farthest).sum(axis=0))[..., None]
    turn = (weights * np.sign(cosine)[..., None] * near.rotation).sum(axis=0)
    return Superquadric(
        np.exp((weights * np.log(near.size)).sum(axis=0)), (weights * near.shape).sum(axis=0),
        (weights * near.translation).sum(axis=0), turn / np.linalg.norm(turn, axis=1, keepdims=True),
    )
