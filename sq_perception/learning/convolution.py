"""Convolutions without torch: the residual blocks of a compact backbone, by products of matrices.

Normalisations are folded into the convolutions before them: with g, b, m, v of the normalisation,

    w' = s w,   b' = b - s m,   s = g / sqrt(v + eps).

Images lie channels last with a margin of zeros, in memory that is kept.  A convolution that halves the resolution is a
product of matrices, its windows written side by side.  The others, 3 x 3, take Winograd's short way from tiles d of
4 x 4 pixels to tiles of 2 x 2 (Lavin and Gray, Fast algorithms for convolutional neural networks, 2016):

    A^T ((G w G^T) * (B^T d B)) A,    * the product of 16 matrices (tiles, channels) (channels, channels)

with 16 products instead of 36 for each tile and pair of channels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sq_perception.geometry.kernels import kernel

Weights = Mapping[str, np.ndarray]
"""float32, by the names of :mod:`sq_perception.learning.layout`."""

_EPSILON = 1e-5
"""Of torch's normalisations."""
_G = np.array([[1, 0, 0], [0.5, 0.5, 0.5], [0.5, -0.5, 0.5], [0, 0, 1]])
_ZERO = np.float32(0)


class Memory:
    """Arrays that are used again, by name; what was zero beside an image stays so."""

    def __init__(self) -> None:
        self._arrays: dict[str, np.ndarray] = {}

    def zeros(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """An array (n, ...) that was zero when it was made, for the largest n so far."""
        known = self._arrays.get(name)
        if known is None or len(known) < shape[0]:
            known = self._arrays[name] = np.zeros(shape, np.float32)
        return known[: shape[0]]

    def framed(self, name: str, count: int, side: int, channels: int) -> np.ndarray:
        """Square images with a margin of one pixel, and one more where tiles of 2 x 2 reach beyond."""
        whole = side + 2 + side % 2
        return self.zeros(name, (count, whole, whole, channels))

    def loose(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """An array of any content."""
        return self.zeros(name, (math.prod(shape),)).reshape(shape)


@dataclass(frozen=True, eq=False)
class Direct:
    """A convolution as one product, then max(0, .): ``matrix`` (size^2 c, k)."""

    matrix: np.ndarray
    bias: np.ndarray
    size: int
    stride: int

    @classmethod
    def folded(cls, weights: Weights, name: str, norm: str, stride: int) -> Direct:
        kernels, bias = _folded(weights, name, norm)
        matrix = kernels.transpose(2, 3, 1, 0).reshape(-1, kernels.shape[0])
        return cls(contiguous(matrix), bias, kernels.shape[2], stride)

    @property
    def channels(self) -> int:
        return len(self.bias)

    def products(self, x: np.ndarray, first: int, side: int, memory: Memory, name: str) -> np.ndarray:
        """(n side^2, k) for the windows of images (n, s, s, c) from their pixel (first, first) on."""
        windows = memory.loose("windows", (len(x) * side * side, len(self.matrix)))
        _write_windows(x, first, self.size, self.stride, side, windows)
        return np.matmul(windows, self.matrix, out=memory.loose(name, (len(windows), self.channels)))

    def computed(self, x: np.ndarray, side: int, memory: Memory, name: str) -> np.ndarray:
        """Framed images of ``side`` pixels a side."""
        products = self.products(x, 0, side, memory, "products")
        out = memory.framed(name, len(x), side, self.channels)
        _write_sums(products, self.bias, side, out)
        return out


@dataclass(frozen=True, eq=False)
class _Tiled:
    """A 3 x 3 convolution that keeps the resolution, then max(0, .): ``matrices`` (16, c, k)."""

    matrices: np.ndarray
    bias: np.ndarray

    @classmethod
    def folded(cls, weights: Weights, name: str, norm: str) -> _Tiled:
        kernels, bias = _folded(weights, name, norm)
        matrices = np.einsum("ai,bj,kcij->abck", _G, _G, kernels).reshape(16, kernels.shape[1], -1)
        return cls(contiguous(matrices), bias)

    def computed(
        self, x: np.ndarray, side: int, memory: Memory, name: str, skip: np.ndarray | None = None, margin: int = 0
    ) -> np.ndarray:
        """Framed images of framed ones; ``skip``, images with that margin, is added to the sums."""
        tiles = len(x) * ((side + 1) // 2) ** 2
        _, inputs, outputs = self.matrices.shape
        there = memory.loose("tiles", (16, tiles, inputs))
        _write_tiles(x, side, there)
        back = np.matmul(there, self.matrices, out=memory.loose("products", (16, tiles, outputs)))
        out = memory.framed(name, len(x), side, outputs)
        _write_pixels(back, self.bias, out if skip is None else skip, skip is not None, margin, side, out)
        return out


@dataclass(frozen=True, eq=False)
class Block:
    """:class:`sq_perception.learning.backbone.ResidualBlock`; ``shortcut`` where it halves the resolution."""

    first: Direct | _Tiled
    second: _Tiled
    shortcut: Direct | None

    @classmethod
    def folded(cls, weights: Weights, name: str) -> Block:
        second = _Tiled.folded(weights, f"{name}.second", f"{name}.second_norm")
        if f"{name}.shortcut.0.weight" not in weights:
            return cls(_Tiled.folded(weights, f"{name}.first", f"{name}.first_norm"), second, None)
        shortcut = Direct.folded(weights, f"{name}.shortcut.0", f"{name}.shortcut.1", stride=2)
        second = _Tiled(second.matrices, second.bias + shortcut.bias)
        return cls(Direct.folded(weights, f"{name}.first", f"{name}.first_norm", stride=2), second, shortcut)

    def computed(self, x: np.ndarray, side: int, memory: Memory, name: str) -> tuple[np.ndarray, int]:
        """Framed images of framed ones, and their side."""
        if self.shortcut is None:
            skip, margin = x, 1
        else:
            side, margin = side // 2, 0
            skip = self.shortcut.products(x, 1, side, memory, "skip").reshape(len(x), side, side, -1)
        y = self.first.computed(x, side, memory, f"{name} first")
        return self.second.computed(y, side, memory, f"{name} second", skip, margin), side


def _folded(weights: Weights, name: str, norm: str) -> tuple[np.ndarray, np.ndarray]:
    """Kernels (k, c, s, s) with their normalisation, and their biases."""
    scale, shift, mean, variance = (
        weights[f"{norm}.{part}"].astype(float) for part in ("weight", "bias", "running_mean", "running_var")
    )
    scale = scale / np.sqrt(variance + _EPSILON)
    return scale[:, None, None, None] * weights[f"{name}.weight"], (shift - scale * mean).astype(np.float32)


def contiguous(values: np.ndarray) -> np.ndarray:
    return np.array(values, dtype=np.float32, order="C")


@kernel
def _write_windows(x: np.ndarray, first: int, size: int, stride: int, side: int, windows: np.ndarray) -> None:
    """The windows of images (n, s, s, c) from a pixel on, side by side: (n side^2, size^2 c)."""
    channels = x.shape[3]
    row = 0
    for image in range(x.shape[0]):
        for i in range(side):
            for j in range(side):
                written = windows[row]
                for di in range(size):
                    for dj in range(size):
                        pixel = x[image, first + stride * i + di, first + stride * j + dj]
                        there = written[(di * size + dj) * channels : (di * size + dj + 1) * channels]
                        for c in range(channels):
                            there[c] = pixel[c]
                row += 1


@kernel
def _write_sums(products: np.ndarray, bias: np.ndarray, side: int, out: np.ndarray) -> None:
    """max(0, product + bias) into framed images."""
    row = 0
    for image in range(out.shape[0]):
        for i in range(side):
            for j in range(side):
                pixel, given = out[image, i + 1, j + 1], products[row]
                for c in range(bias.shape[0]):
                    pixel[c] = max(given[c] + bias[c], _ZERO)
                row += 1


@kernel
def _write_tiles(x: np.ndarray, side: int, tiles: np.ndarray) -> None:
    """B^T d B of every tile of framed images: (16, tiles, channels)."""
    channels, count = x.shape[3], (side + 1) // 2
    half = np.empty((4, 4, channels), np.float32)  # B^T d
    tile = 0
    for image in range(x.shape[0]):
        for i in range(count):
            for j in range(count):
                for k in range(4):
                    d0, d1 = x[image, 2 * i, 2 * j + k], x[image, 2 * i + 1, 2 * j + k]
                    d2, d3 = x[image, 2 * i + 2, 2 * j + k], x[image, 2 * i + 3, 2 * j + k]
                    h0, h1, h2, h3 = half[0, k], half[1, k], half[2, k], half[3, k]
                    for c in range(channels):
                        h0[c] = d0[c] - d2[c]
                        h1[c] = d1[c] + d2[c]
                        h2[c] = d2[c] - d1[c]
                        h3[c] = d1[c] - d3[c]
                for k in range(4):
                    h0, h1, h2, h3 = half[k, 0], half[k, 1], half[k, 2], half[k, 3]
                    t0, t1 = tiles[4 * k, tile], tiles[4 * k + 1, tile]
                    t2, t3 = tiles[4 * k + 2, tile], tiles[4 * k + 3, tile]
                    for c in range(channels):
                        t0[c] = h0[c] - h2[c]
                        t1[c] = h1[c] + h2[c]
                        t2[c] = h2[c] - h1[c]
                        t3[c] = h1[c] - h3[c]
                tile += 1


@kernel
def _write_pixels(
    tiles: np.ndarray, bias: np.ndarray, skip: np.ndarray, is_added: bool, margin: int, side: int, out: np.ndarray
) -> None:
    """max(0, A^T m A + bias + skip) of every tile into framed images."""
    channels, count = bias.shape[0], (side + 1) // 2
    half = np.empty((2, 4, channels), np.float32)  # A^T m
    pixel = np.empty(channels, np.float32)
    tile = 0
    for image in range(out.shape[0]):
        for i in range(count):
            for j in range(count):
                for k in range(4):
                    m0, m1, m2, m3 = tiles[k, tile], tiles[4 + k, tile], tiles[8 + k, tile], tiles[12 + k, tile]
                    h0, h1 = half[0, k], half[1, k]
                    for c in range(channels):
                        h0[c] = m0[c] + m1[c] + m2[c]
                        h1[c] = m1[c] - m2[c] - m3[c]
                for k in range(4):
                    y, x = 2 * i + k // 2, 2 * j + k % 2
                    if y >= side or x >= side:
                        continue
                    h0, h1, h2, h3 = half[k // 2, 0], half[k // 2, 1], half[k // 2, 2], half[k // 2, 3]
                    if k % 2 == 0:
                        for c in range(channels):
                            pixel[c] = h0[c] + h1[c] + h2[c] + bias[c]
                    else:
                        for c in range(channels):
                            pixel[c] = h1[c] - h2[c] - h3[c] + bias[c]
                    shown = out[image, y + 1, x + 1]
                    if is_added:
                        added = skip[image, y + margin, x + margin]
                        for c in range(channels):
                            shown[c] = max(pixel[c] + added[c], _ZERO)
                    else:
                        for c in range(channels):
                            shown[c] = max(pixel[c], _ZERO)
                tile += 1
