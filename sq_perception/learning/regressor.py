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
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
import torch
from array_api_compat import array_namespace
from torch import nn

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import canonical_view
from sq_perception.imaging.camera import Camera
from sq_perception.imaging.canonical_view import CanonicalView
from sq_perception.learning.backbone import ResNet18, compact_backbone, fold
from sq_perception.learning.choices import SIZE_RANGE, Backbone, Framing

Array = Any
"""A NumPy array or a torch tensor."""
INFERENCE_DTYPES = (torch.float32, torch.bfloat16, torch.float16)

_EDGE = 1e-3
"""How near to the ends of their ranges bodies can be encoded."""


@dataclass(frozen=True)
class RegressorConfig:
    """Everything that fixes the network's form; travels in the checkpoint's header.

    Raises
    ------
    ValueError
        For an unknown backbone or framing, a side that the backbone cannot halve often enough, or an empty range.
    """

    pixels: int = 64
    """Side of the views: a multiple of 32 for resnet18, of 2 to the number of ``widths`` for compact."""
    widths: tuple[int, ...] = (32, 64, 128, 256)
    """Of compact: channels of the stem and of each stage; every stage halves the resolution."""
    blocks: int = 2
    """Of compact: residual blocks a stage."""
    hidden: int = 256
    size_range: tuple[float, float] = SIZE_RANGE
    """Half sizes in sides of the cube; interpolated on a logarithmic scale."""
    shape_range: tuple[float, float] = (0.1, 1.0)
    translation_range: tuple[float, float] = (-0.4, 1.4)
    backbone: Backbone = "compact"
    framing: Framing = "cropped"
    """What the views show; see the module."""
    marks_hidden: bool = False
    """Whether views tell hidden pixels from background (``CanonicalView.marked``)."""

    def __post_init__(self) -> None:
        for name, value, known in (("backbone", self.backbone, Backbone), ("framing", self.framing, Framing)):
            if value not in get_args(known):
                raise ValueError(f"{name}: expected one of {', '.join(get_args(known))}, got {value!r}")
        if self.pixels < 1 or self.pixels % self.stride:
            raise ValueError(f"pixels: {self.backbone} expects a multiple of {self.stride}, got {self.pixels}")
        for name, (low, high) in (
            ("size_range", self.size_range),
            ("shape_range", self.shape_range),
            ("translation_range", self.translation_range),
        ):
            if not (np.isfinite([low, high]).all() and low < high and (low > 0 or name == "translation_range")):
                raise ValueError(f"{name}: expected a lower and a larger upper end, got {low} and {high}")

    def decode(self, raw: Array) -> Superquadric:
        """Bodies (n,) of unbounded outputs (n, 14), NumPy or torch: size 3, shape 2, translation 3, rotation 6."""
        xp = array_namespace(raw)
        unit = 1 / (1 + xp.exp(-raw[..., :8]))
        low, high = self.size_range
        return Superquadric(
            low * (high / low) ** unit[..., 0:3],
            _between(self.shape_range, unit[..., 3:5]),
            _between(self.translation_range, unit[..., 5:8]),
            quaternions.from_six(raw[..., 8:]),
        )

    def encode(self, bodies: Superquadric) -> np.ndarray:
        """Outputs (n, 14) that :meth:`decode` turns into these NumPy bodies (n,).

        A sigmoid reaches its ends at infinity only, and has no slope there: parameters on a limit, or beyond it by less
        than a thousandth of the range, are moved that far into it.

        Raises
        ------
        ValueError
            For a body outside of the ranges.
        """
        low, high = self.size_range
        shares = (
            ("size", np.log(bodies.size / low) / np.log(high / low), self.size_range),
            ("shape", _share(self.shape_range, bodies.shape), self.shape_range),
            ("translation", _share(self.translation_range, bodies.translation), self.translation_range),
        )
        for name, share, limits in shares:
            if (share < -_EDGE).any() or (share > 1 + _EDGE).any():
                raise ValueError(f"{name}: expected values in {limits}, got {getattr(bodies, name)}")
        unit = np.clip(np.concatenate([share for _, share, _ in shares], axis=-1), _EDGE, 1 - _EDGE)
        matrix = bodies.rotation_matrix
        return np.concatenate([np.log(unit / (1 - unit)), matrix[..., :, 0], matrix[..., :, 1]], axis=-1)

    def view_of(
        self, depth: np.ndarray, mask: np.ndarray, camera: Camera, plane: np.ndarray | None = None
    ) -> CanonicalView:
        """What a network is shown of the object under a mask; its predictions are in the frame of this view.

        Arguments and errors are those of :func:`canonical_view.from_mask`; a network for full frames knows the unit
        cube alone and refuses pinhole cameras.
        """
        if self.framing == "full":
            return canonical_view.full_frame(depth, mask, camera, self.pixels)
        hidden = self.marks_hidden
        return canonical_view.from_mask(depth, mask, camera, self.pixels, find_hidden=hidden, plane=plane)

    @classmethod
    def thesis(cls) -> RegressorConfig:
        """The thesis' network for the thesis' images: ResNet-18, 256 x 256, the whole cube.

        Its bodies have half sizes of 0.098 to 0.294 and centres of 0.35 to 0.66; the ranges leave room beside them.
        """
        return cls(
            pixels=256, size_range=(0.05, 0.4), translation_range=(0.0, 1.0), backbone="resnet18", framing="full"
        )

    @property
    def stride(self) -> int:
        """Pixels of the view, along x or y, to a cell of the backbone's last stage."""
        return ResNet18.STRIDE if self.backbone == "resnet18" else 2 ** len(self.widths)


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
        return self.decode(self.raw(views))

    def raw(self, views: torch.Tensor) -> torch.Tensor:
        """Outputs (n, 14) of the heads: size 3, shape 2, translation 3, rotation 6, all unbounded."""
        h = self.mixer(self.features(views.to(self._dtype))).float()
        with torch.autocast(views.device.type, enabled=False):  # eight bits of mantissa are too few for a size
            heads = (self.size_head, self.shape_head, self.translation_head, self.rotation_head)
            return torch.cat([head(h) for head in heads], dim=-1)

    def decode(self, raw: Array) -> Superquadric:
        """Bodies (n,) of outputs (n, 14), NumPy or torch."""
        return self.config.decode(raw)

    def predict(self, views: np.ndarray) -> Superquadric:
        """NumPy superquadrics (n,) of NumPy views (n, p, p).

        Raises
        ------
        ValueError
            If the views are not (n, p, p) with p = ``config.pixels``, or not finite.
        """
        batch = torch.from_numpy(checked_views(views, self.config))[:, None]
        self.eval()
        device = next(self.parameters()).device
        with torch.inference_mode():
            raw = self.raw(batch.to(device, memory_format=torch.channels_last))
        return self.decode(raw.cpu().numpy().astype(float))

    def for_inference(self, dtype: torch.dtype = torch.float32) -> Regressor:
        """A copy that predicts the same, faster: normalisations folded into their convolutions, channels last.

        Parameters
        ----------
        dtype
            Of everything but the heads, which stay in single precision.  bfloat16 pays on processors that multiply it
            (AVX512-BF16, AMX), float16 on graphics cards; elsewhere they work and are slower.

        Raises
        ------
        ValueError
            For a type other than float32, bfloat16 and float16.
        """
        if dtype not in INFERENCE_DTYPES:
            raise ValueError(f"dtype: expected one of {', '.join(map(str, INFERENCE_DTYPES))}, got {dtype}")
        copied = copy.deepcopy(self).eval()
        fold(copied.features)
        copied.features.to(dtype)
        copied.mixer.to(dtype)
        copied.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        return copied

    @property
    def _dtype(self) -> torch.dtype:
        return next(self.features.parameters()).dtype


def checked_views(views: np.ndarray, config: RegressorConfig) -> np.ndarray:
    """Views (n, p, p) as contiguous float32; raises ValueError if they are of another form, or not finite."""
    expected = (config.pixels, config.pixels)
    if views.ndim != 3 or views.shape[1:] != expected:
        raise ValueError(f"expected views of shape (n, {expected[0]}, {expected[1]}), got {views.shape}")
    if not np.isfinite(views).all():
        raise ValueError("expected finite views; background is 0")
    return np.ascontiguousarray(views, dtype=np.float32)


def _between(bounds: tuple[float, float], unit: Array) -> Array:
    low, high = bounds
    return low + (high - low) * unit


def _share(bounds: tuple[float, float], value: Array) -> Array:
    low, high = bounds
    return (value - low) / (high - low)
