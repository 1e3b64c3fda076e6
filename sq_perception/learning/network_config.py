"""Everything that fixes a network's form, how outputs become bodies and what a network is shown; without torch.

Frames and units are those of the views: the unit cube, y up, z towards the viewer
(:mod:`sq_perception.learning.networks`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
from array_api_compat import array_namespace, device

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import canonical_view, segment_view
from sq_perception.imaging.camera import Camera
from sq_perception.imaging.canonical_view import CanonicalView
from sq_perception.learning.choices import Backbone, Framing

Array = Any  # a NumPy array or a torch tensor
BODY_OUTPUTS = 14  # numbers of a body: size 3, shape 2, translation 3, rotation 6
PLANE, EXTENT = 4, 1  # inputs of the network of things beside the view
LEAST_LOG, MOST_LOG = -5.0, 0.5
"""Limits of log sigma: 0.7 % of the view's side, what a mask's pixel is, and more than the side."""


@dataclass(frozen=True)
class RegressorConfig:
    """Everything that fixes the network's form; travels in the checkpoint's header.  Raises ValueError for an unknown
    backbone or framing, a side that the backbone cannot halve often enough, or an empty range."""

    pixels: int = 64  # side of the views: a multiple of 32 for resnet18, of 2 to the number of widths for compact
    widths: tuple[int, ...] = (32, 64, 128, 256)
    """For compact: channels of the stem and of each stage; every stage halves the resolution."""
    blocks: int = 2  # for compact: residual blocks a stage
    hidden: int = 256
    size_range: tuple[float, float] = (0.04, 1.2)
    """Half sizes in sides of the cube, interpolated on a logarithmic scale; the thesis' bodies reach 0.8."""
    shape_range: tuple[float, float] = (0.1, 1.0)
    translation_range: tuple[float, float] = (-0.4, 1.4)
    backbone: Backbone = "compact"
    framing: Framing = "cropped"  # what the views show (sq_perception.learning.networks)
    marks_hidden: bool = False  # whether views distinguish hidden pixels from background (CanonicalView.marked)

    def __post_init__(self) -> None:
        for name, value, known in (("backbone", self.backbone, Backbone), ("framing", self.framing, Framing)):
            if value not in get_args(known):
                raise ValueError(f"{name}: expected one of {', '.join(get_args(known))}, got {value!r}")
        if self.pixels < 1 or self.pixels % self.stride:
            raise ValueError(f"pixels: {self.backbone} expects a multiple of {self.stride}, got {self.pixels}")
        for name in ("size_range", "shape_range", "translation_range"):
            low, high = getattr(self, name)
            if not (np.isfinite([low, high]).all() and low < high and (low > 0 or name == "translation_range")):
                raise ValueError(f"{name}: expected a lower and a larger upper end, got {low} and {high}")

    def decode(self, raw: Array) -> Superquadric:
        """Bodies (n,) of unbounded outputs (n, 14), NumPy or torch: size 3, shape 2, translation 3, rotation 6."""
        xp = array_namespace(raw)
        unit = 1 / (1 + xp.exp(-raw[..., :8]))
        low, high = self.size_range
        return Superquadric(
            low * (high / low) ** unit[..., 0:3], _interpolate(self.shape_range, unit[..., 3:5]),
            _interpolate(self.translation_range, unit[..., 5:8]), quaternions.from_six(raw[..., 8:]),
        )

    def view_of(
        self, depth: np.ndarray, mask: np.ndarray, camera: Camera, plane: np.ndarray | None = None
    ) -> CanonicalView:
        """What a network is shown of the object under a mask, and the frame of its predictions; arguments and errors as
        of :func:`canonical_view.from_mask`.  A network for full frames refuses pinhole cameras."""
        if self.framing == "full":
            return canonical_view.full_frame(depth, mask, camera, self.pixels)
        hidden = self.marks_hidden
        return canonical_view.from_mask(depth, mask, camera, self.pixels, find_hidden=hidden, plane=plane)

    @classmethod
    def thesis(cls) -> RegressorConfig:
        """The thesis' network for the thesis' images: ResNet-18, 256 x 256, the whole cube.  Its bodies have half sizes
        of 0.098 to 0.294 and centres of 0.35 to 0.66; the ranges leave room beside them."""
        return cls(
            pixels=256, size_range=(0.05, 0.4), translation_range=(0.0, 1.0), backbone="resnet18", framing="full"
        )

    @property
    def stride(self) -> int:
        """Pixels of the view, along x or y, to a cell of the backbone's last stage."""
        return 32 if self.backbone == "resnet18" else 2 ** len(self.widths)


@dataclass(frozen=True)
class ThingConfig:
    """Everything that fixes the network's form; travels in the checkpoint's header."""

    pixels: int = 64
    widths: tuple[int, ...] = (32, 64, 128, 256)
    """Channels of the stem and of each stage; every stage halves the resolution."""
    blocks: int = 2  # residual blocks a stage
    hidden: int = 256
    factors: int = 8  # K, the columns of L
    freedom: float = 3.0
    """nu of the t distribution.  Trained with 10, the errors on unseen views were likeliest for 2 to 3,
    sigma a third as large: most hulls are plain to see, some are not."""
    spread: float = 1.0
    """Factor of S, set when a training ends: batches are normalised otherwise then, and errors smaller."""

    def view_of(
        self, depth: np.ndarray, mask: np.ndarray, camera: Camera, plane: np.ndarray | None = None
    ) -> CanonicalView:
        """What the network is shown of the object under a mask, as :meth:`RegressorConfig.view_of`."""
        return canonical_view.from_mask(depth, mask, camera, self.pixels, plane=plane, missing_is_hidden=True)

    def regressor(self) -> RegressorConfig:
        """How the superquadric's parameters are encoded."""
        return RegressorConfig(pixels=self.pixels, widths=self.widths, blocks=self.blocks, hidden=self.hidden)


@dataclass(frozen=True)
class MaskConfig:
    """Everything that fixes the network's form; travels in the checkpoint's header."""

    pixels: int = segment_view.PIXELS
    widths: tuple[int, ...] = (16, 32, 64, 64)
    """Channels of the stem and of each stage; every stage halves the resolution."""
    blocks: int = 1  # residual blocks a stage on the way down


def side_inputs(views: Array, planes: Array, extents: Array) -> tuple[Array, Array]:
    """What the network of things is shown beside views (b, p, p): heights above planes (b, 4), in sides of the view, of
    the surface or else of half the cube's depth, and logarithms (b,) of ``extents``, metres, 0 if unknown."""
    xp, pixels = array_namespace(views), views.shape[-1]
    across = (xp.arange(pixels, dtype=views.dtype, device=device(views)) + 0.5) / pixels
    n = planes[:, :, None, None]
    flat = n[:, 0] * across[None, None, :] + n[:, 1] * (1 - across)[None, :, None] + n[:, 3]
    # Depth at which a pixel without a surface is given its height above the plane.
    heights = flat + n[:, 2] * xp.where(views > 0, views, xp.full_like(views, 0.5))
    # Metres; that the logarithm of a view's side is 0 for it.
    usual = xp.full_like(extents, 0.2)
    return heights, xp.log(xp.where(extents > 0, extents, usual) / usual)


def mirror_planes(planes: np.ndarray) -> np.ndarray:
    """Planes (b, 4) of views whose x runs the other way."""
    return np.stack([-planes[:, 0], planes[:, 1], planes[:, 2], planes[:, 3] + planes[:, 0]], axis=1)


def check_views(views: np.ndarray, config: RegressorConfig) -> np.ndarray:
    """Views (n, p, p) as contiguous float32; raises ValueError if they are of another form, or not finite."""
    expected = (config.pixels, config.pixels)
    if views.ndim != 3 or views.shape[1:] != expected:
        raise ValueError(f"expected views of shape (n, {expected[0]}, {expected[1]}), got {views.shape}")
    if not np.isfinite(views).all():
        raise ValueError("expected finite views; background is 0")
    return np.ascontiguousarray(views, dtype=np.float32)


def _interpolate(bounds: tuple[float, float], unit: Array) -> Array:
    low, high = bounds
    return low + (high - low) * unit
