"""Convolutions without torch: the residual blocks of a compact backbone, by products of matrices.

Normalisations are folded into the convolutions before them: with g, b, m, v of the normalisation,

    w' = s w,   b' = b - s m,   s = g / sqrt(v + eps).

Images lie channels last with a margin of zeros, in memory that is kept.  A convolution that halves the resolution, or
of few channels, is a product of matrices, its windows written side by side.  The others, 3 x 3, take Winograd's short
way from tiles d of s x s pixels to tiles of s - 2 (Lavin and Gray, Fast algorithms for convolutional neural networks,
2016):

    A^T ((G w G^T) * (B^T d B)) A,    * the product of s^2 matrices (tiles, channels) (channels, channels)

with 36 products instead of 144 for each tile and pair of channels where s = 6, 16 instead of 36 where s = 4.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from sq_perception.geometry.kernels import inline_kernel, kernel

Weights = Mapping[str, np.ndarray]
"""float32, by the names of :mod:`sq_perception.learning.layout`."""

_G = {
    4: np.array([[2, 0, 0], [1, 1, 1], [1, -1, 1], [0, 0, 2]]) / 2,
    6: np.array([[6, 0, 0], [-4, -4, -4], [-4, 4, -4], [1, 2, 4], [1, -2, 4], [0, 0, 24]]) / 24,
}
_ZERO, _2, _4, _5, _8 = (np.float32(number) for number in (0, 2, 4, 5, 8))


class Memory(threading.local):
    """Arrays that are used again, by name, each thread's own; what was zero beside an image stays so."""

    def __init__(self) -> None:
        self._arrays: dict[str, np.ndarray] = {}

    def zeros(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """An array (n, ...) that was zero when it was made, for the largest n so far."""
        known = self._arrays.get(name)
        if known is None or len(known) < shape[0]:
            known = self._arrays[name] = np.zeros(shape, np.float32)
        return known[: shape[0]]

    def framed_images(self, name: str, count: int, side: int, channels: int) -> np.ndarray:
        """Square images with a margin of one pixel, and more where tiles of 4 x 4 reach beyond."""
        whole = side + 2 + -side % 4
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
    def fold(cls, weights: Weights, name: str, norm: str, stride: int) -> Direct:
        kernels, bias = _fold_norm(weights, name, norm)
        matrix = kernels.transpose(2, 3, 1, 0).reshape(-1, kernels.shape[0])
        return cls(contiguous(matrix), bias, kernels.shape[2], stride)

    @property
    def channels(self) -> int:
        return len(self.bias)

    def products(self, x: np.ndarray, first: int, side: int, memory: Memory, name: str) -> np.ndarray:
        """(n side^2, k) for the windows of images (n, s, s, c) from their pixel (first, first) on."""
        pixels = side * side
        out = memory.loose(name, (len(x) * pixels, self.channels))
        for part in _parts(len(x), pixels, len(self.matrix)):
            rows = out[part.start * pixels : part.stop * pixels]
            windows = memory.loose("windows", (len(rows), len(self.matrix)))
            _write_windows(x[part], first, self.size, self.stride, side, windows)
            np.matmul(windows, self.matrix, out=rows)
        return out

    def compute(
        self, x: np.ndarray, side: int, memory: Memory, name: str, skip: np.ndarray | None = None, margin: int = 0
    ) -> np.ndarray:
        """Framed images of ``side`` pixels a side; ``skip``, images with that margin, is added to the sums."""
        products = self.products(x, 0, side, memory, "products")
        out = memory.framed_images(name, len(x), side, self.channels)
        _write_sums(products, self.bias, out if skip is None else skip, skip is not None, margin, side, out)
        return out


@dataclass(frozen=True, eq=False)
class _Tiled:
    """A 3 x 3 convolution that keeps the resolution, then max(0, .): ``matrices`` (s^2, c, k)."""

    matrices: np.ndarray
    bias: np.ndarray

    @classmethod
    def fold(cls, weights: Weights, name: str, norm: str) -> _Tiled:
        kernels, bias = _fold_norm(weights, name, norm)
        inputs = kernels.shape[1]
        # Channels: here tiles of 4 x 4 are taken, as to read matrices of those of 6 x 6 takes longer than they save.
        g = _G[4 if inputs >= 256 else 6]
        # g w g^T of all kernels as one product: a sum over four indices takes thirty times as long, at every start.
        taps = kernels.transpose(2, 3, 1, 0).reshape(g.shape[1] ** 2, -1)
        tiles = np.kron(g, g) @ taps
        return cls(contiguous(tiles.reshape(len(tiles), inputs, -1)), bias)

    def compute(
        self, x: np.ndarray, side: int, memory: Memory, name: str, skip: np.ndarray | None = None, margin: int = 0
    ) -> np.ndarray:
        """As :meth:`Direct.compute`."""
        squares, inputs, outputs = self.matrices.shape
        size = math.isqrt(squares)
        out = memory.framed_images(name, len(x), side, outputs)
        tiles = math.ceil(side / (size - 2)) ** 2
        for part in _parts(len(x), tiles, squares * inputs):
            count = (part.stop - part.start) * tiles
            there = memory.loose("tiles", (count, squares, inputs))
            _write_tiles(x[part], side, size, there)
            back = memory.loose("products", (count, squares, outputs))
            np.matmul(there.transpose(1, 0, 2), self.matrices, out=back.transpose(1, 0, 2))
            added = out[part] if skip is None else skip[part]
            _write_pixels(back, size, self.bias, added, skip is not None, margin, side, out[part])
        return out


@dataclass(frozen=True, eq=False)
class Block:
    """:class:`sq_perception.learning.networks.ResidualBlock`; ``shortcut`` where it halves the resolution."""

    first: Direct | _Tiled
    second: Direct | _Tiled
    shortcut: Direct | None

    @classmethod
    def fold(cls, weights: Weights, name: str) -> Block:
        second = _keep_resolution(weights, f"{name}.second", f"{name}.second_norm")
        if f"{name}.shortcut.0.weight" not in weights:
            return cls(_keep_resolution(weights, f"{name}.first", f"{name}.first_norm"), second, None)
        shortcut = Direct.fold(weights, f"{name}.shortcut.0", f"{name}.shortcut.1", stride=2)
        second = replace(second, bias=second.bias + shortcut.bias)
        return cls(Direct.fold(weights, f"{name}.first", f"{name}.first_norm", stride=2), second, shortcut)

    def compute(self, x: np.ndarray, side: int, memory: Memory, name: str) -> tuple[np.ndarray, int]:
        """Framed images of framed ones, and their side."""
        if self.shortcut is None:
            skip, margin = x, 1
        else:
            side, margin = side // 2, 0
            skip = self.shortcut.products(x, 1, side, memory, "skip").reshape(len(x), side, side, -1)
        y = self.first.compute(x, side, memory, f"{name} first")
        return self.second.compute(y, side, memory, f"{name} second", skip, margin), side


def _keep_resolution(weights: Weights, name: str, norm: str) -> Direct | _Tiled:
    """A convolution that keeps the resolution."""
    # Channels: up to here tiles take longer to write than products of matrices; views of 32 x 32 pixels take 0.4 of it.
    if weights[f"{name}.weight"].shape[1] <= 16:
        return Direct.fold(weights, name, norm, stride=1)
    return _Tiled.fold(weights, name, norm)


def _parts(images: int, rows: int, columns: int) -> Iterator[slice]:
    """Slices of some images that go through a layer's product together, each (rows, columns) in it."""
    # Numbers that stay in a processor's cache between two steps of a layer, and rows of a product that are worth
    # reading its matrix: chosen on a cache of 1 MB a core.
    cached, fewest_rows = 130_000, 160
    at_once = max(1, cached // (rows * columns), fewest_rows // rows)
    return (slice(first, min(first + at_once, images)) for first in range(0, images, at_once))


def _fold_norm(weights: Weights, name: str, norm: str) -> tuple[np.ndarray, np.ndarray]:
    """Kernels (k, c, s, s) with their normalisation, and their biases."""
    scale, shift, mean, variance = (
        weights[f"{norm}.{part}"].astype(float) for part in ("weight", "bias", "running_mean", "running_var")
    )
    # What torch's normalisations add to a variance.
    scale = scale / np.sqrt(variance + 1e-5)
    return scale[:, None, None, None] * weights[f"{name}.weight"], (shift - scale * mean).astype(np.float32)


def contiguous(values: np.ndarray) -> np.ndarray:
    return np.array(values, dtype=np.float32, order="C")


@kernel
def _write_windows(x: np.ndarray, first: int, size: int, stride: int, side: int, windows: np.ndarray) -> None:
    """The windows of images (n, s, s, c) from a pixel on, side by side: (n side^2, size^2 c)."""
    channels = x.shape[3]
    length = size * channels
    row = 0
    for image in range(x.shape[0]):
        lines = x[image].reshape(x.shape[1], x.shape[2] * channels)
        for i in range(side):
            for j in range(side):
                begin = (first + stride * j) * channels
                for d in range(size):
                    there = windows[row, d * length : (d + 1) * length]
                    line = lines[first + stride * i + d, begin : begin + length]
                    for k in range(length):
                        there[k] = line[k]
                row += 1


@kernel
def _write_sums(
    products: np.ndarray, bias: np.ndarray, skip: np.ndarray, is_added: bool, margin: int, side: int, out: np.ndarray
) -> None:
    """max(0, product + bias + skip) into framed images."""
    row = 0
    for image in range(out.shape[0]):
        for i in range(side):
            for j in range(side):
                pixel, given = out[image, i + 1, j + 1], products[row]
                if is_added:
                    added = skip[image, i + margin, j + margin]
                    for c in range(bias.shape[0]):
                        pixel[c] = max(given[c] + bias[c] + added[c], _ZERO)
                else:
                    for c in range(bias.shape[0]):
                        pixel[c] = max(given[c] + bias[c], _ZERO)
                row += 1


@kernel
def write_doubled(coarse: np.ndarray, finer: np.ndarray, out: np.ndarray) -> None:
    """Images (n, s, s, c), each pixel four times, and framed ones of twice the side: their sums into framed images."""
    side = 2 * coarse.shape[1]
    for image in range(coarse.shape[0]):
        for i in range(side):
            for j in range(side):
                low, high, pixel = coarse[image, i // 2, j // 2], finer[image, i + 1, j + 1], out[image, i + 1, j + 1]
                for c in range(low.shape[0]):
                    pixel[c] = low[c] + high[c]


@kernel
def _write_tiles(x: np.ndarray, side: int, size: int, tiles: np.ndarray) -> None:
    """B^T d B of every tile of framed images: (tiles, size^2, channels)."""
    channels, step = x.shape[3], size - 2
    count = (side + step - 1) // step
    # B^T d of a row of tiles; images are framed for the larger tiles, and as wide as these need.
    half = np.empty((size, x.shape[2] * channels), np.float32)
    tile = 0
    for image in range(x.shape[0]):
        rows = x[image].reshape(x.shape[1], x.shape[2] * channels)
        for i in range(count):
            _forward(rows[step * i : step * i + size], half)
            for j in range(count):
                for k in range(size):
                    row = half[k].reshape(x.shape[2], channels)
                    _forward(row[step * j : step * j + size], tiles[tile, size * k : size * (k + 1)])
                tile += 1


@kernel
def _write_pixels(
    tiles: np.ndarray, size: int, bias: np.ndarray, skip: np.ndarray, is_added: bool, margin: int, side: int,
    out: np.ndarray,
) -> None:
    """max(0, A^T m A + bias + skip) of every tile into framed images."""
    channels, step = bias.shape[0], size - 2
    count = (side + step - 1) // step
    half = np.empty((step, size * channels), np.float32)  # A^T m
    pixels = np.empty((step, channels), np.float32)
    tile = 0
    for image in range(out.shape[0]):
        for i in range(count):
            for j in range(count):
                _back(tiles[tile].reshape(size, size * channels), half)
                for y in range(step * i, min(step * (i + 1), side)):
                    _back(half[y - step * i].reshape(size, channels), pixels)
                    for x in range(step * j, min(step * (j + 1), side)):
                        pixel, shown = pixels[x - step * j], out[image, y + 1, x + 1]
                        if is_added:
                            added = skip[image, y + margin, x + margin]
                            for c in range(channels):
                                shown[c] = max(pixel[c] + bias[c] + added[c], _ZERO)
                        else:
                            for c in range(channels):
                                shown[c] = max(pixel[c] + bias[c], _ZERO)
                tile += 1


@inline_kernel
def _forward(d: np.ndarray, out: np.ndarray) -> None:
    """B^T d for rows d (s, n); each loop works on few enough rows to become vector code."""
    d0, d1, d2, d3 = d[0], d[1], d[2], d[3]
    t0, t1, t2, t3 = out[0], out[1], out[2], out[3]
    count = len(d0)
    if len(d) == 4:
        for c in range(count):
            t0[c], t1[c] = d0[c] - d2[c], d1[c] + d2[c]
        for c in range(count):
            t2[c], t3[c] = d2[c] - d1[c], d1[c] - d3[c]
        return
    d4, d5, t4, t5 = d[4], d[5], out[4], out[5]
    for c in range(count):
        t0[c] = _4 * d0[c] - _5 * d2[c] + d4[c]
    for c in range(count):
        even, odd = d4[c] - _4 * d2[c], d3[c] - _4 * d1[c]
        t1[c], t2[c] = even + odd, even - odd
    for c in range(count):
        even, odd = d4[c] - d2[c], _2 * (d3[c] - d1[c])
        t3[c], t4[c] = even + odd, even - odd
    for c in range(count):
        t5[c] = _4 * d1[c] - _5 * d3[c] + d5[c]


@inline_kernel
def _back(m: np.ndarray, out: np.ndarray) -> None:
    """A^T m for rows m (s, n), likewise."""
    m0, m1, m2, m3, y0, y1 = m[0], m[1], m[2], m[3], out[0], out[1]
    count = len(m0)
    if len(m) == 4:
        for c in range(count):
            y0[c], y1[c] = m0[c] + m1[c] + m2[c], m1[c] - m2[c] - m3[c]
        return
    m4, m5, y2, y3 = m[4], m[5], out[2], out[3]
    for c in range(count):
        once, twice = m1[c] + m2[c], m3[c] + m4[c]
        y0[c], y2[c] = m0[c] + once + twice, once + _4 * twice
    for c in range(count):
        once, twice = m1[c] - m2[c], m3[c] - m4[c]
        y1[c], y3[c] = once + _2 * twice, once + _8 * twice + m5[c]
