"""The compact networks computed without torch: weights of a file in, outputs of the heads out.

:mod:`sq_perception.learning.convolution` has the layers.  One thread computes: the layers are small, and one
that fits bodies meanwhile wants the other cores (:mod:`sq_perception.geometry.threads`).

A test compares with the modules of torch (:mod:`sq_perception.learning.networks`), which state the same networks.
"""

from __future__ import annotations

import numpy as np

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.geometry.threads import one_blas_thread
from sq_perception.geometry.union import DIRECTIONS
from sq_perception.imaging.segment_view import CHANNELS
from sq_perception.learning import layout
from sq_perception.learning.convolution import Block, Direct, Memory, Weights, contiguous, write_doubled
from sq_perception.learning.network_config import (
    BODY_OUTPUTS,
    LEAST_LOG,
    MOST_LOG,
    MaskConfig,
    RegressorConfig,
    ThingConfig,
    check_views,
    side_inputs,
)


class CompactRegressor:
    """:class:`sq_perception.learning.networks.Regressor` with a compact backbone, ready to predict."""

    def __init__(self, config: RegressorConfig, weights: Weights) -> None:
        self.config = config
        self._network = _Network(config, weights, channels=1)

    def predict(self, views: np.ndarray) -> Superquadric:
        """As :meth:`sq_perception.learning.networks.Regressor.predict`, errors included."""
        views = check_views(views, self.config)
        raw = self._network.outputs(views[..., None], np.empty((len(views), 0), np.float32))
        return self.config.decode(raw.astype(float))


class CompactThings:
    """:class:`sq_perception.learning.networks.ThingNetwork`, ready to predict."""

    def __init__(self, config: ThingConfig, weights: Weights) -> None:
        self.config = config
        self._encoding = config.regressor()
        self._network = _Network(config, weights, channels=2)

    def predict(
        self, views: np.ndarray, planes: np.ndarray, extents: np.ndarray
    ) -> tuple[Superquadric, np.ndarray, np.ndarray]:
        """As :meth:`sq_perception.learning.networks.ThingNetwork.predict`, without torch."""
        heights, scale = side_inputs(views, planes, extents)
        images = np.stack([views, heights], axis=-1)
        raw = self._network.outputs(images, np.column_stack([planes, scale]))
        count = len(DIRECTIONS)
        body, support, sigma, factors = np.split(raw.astype(float), np.cumsum([BODY_OUTPUTS, count, count]), axis=1)
        variance = np.exp(2 * np.minimum(LEAST_LOG + np.logaddexp(0, sigma - LEAST_LOG), MOST_LOG))
        factors = factors.reshape(len(raw), count, self.config.factors)
        covariance = factors @ factors.transpose(0, 2, 1)
        covariance[:, np.arange(count), np.arange(count)] += variance
        return self._encoding.decode(body), support, self.config.spread * covariance


class CompactMasks:
    """:class:`sq_perception.learning.networks.MaskNetwork`, ready to predict."""

    def __init__(self, config: MaskConfig, weights: Weights) -> None:
        self.config = config
        self._backbone = _Backbone(weights, config.pixels, CHANNELS)
        steps = range(len(config.widths) - 1)
        self._up = [_linear(weights, [f"up.{k}"]) for k in steps]
        self._joined = [Block.fold(weights, f"joined.{k}") for k in steps]
        self._head = _linear(weights, ["head"])
        self._memory = Memory()

    def logits(self, views: np.ndarray) -> np.ndarray:
        """Logits float32 (n, p, p) of views (n, p, p, CHANNELS)."""
        memory = self._memory
        with one_blas_thread():
            images = self._backbone.compute(views, memory)
            stages = [images[0], *images[self.config.blocks :: self.config.blocks]]
            x, side = stages.pop()
            for k in reversed(range(len(stages))):
                matrix, bias = self._up[k]
                sums = memory.framed_images(f"raised to {2 * side}", len(x), 2 * side, len(bias))
                write_doubled(_inner(x, side) @ matrix + bias, stages[k][0], sums)
                x, side = self._joined[k].compute(sums, 2 * side, memory, f"joined {k}")
            matrix, bias = self._head
            cells = (_inner(x, side) @ matrix + bias).reshape(len(x), side, side, 2, 2)
            return cells.transpose(0, 1, 3, 2, 4).reshape(len(x), 2 * side, 2 * side)


class _Network:
    """Images (n, p, p, c) and further numbers (n, m) to the outputs of all heads, side by side."""

    def __init__(self, config: RegressorConfig | ThingConfig, weights: Weights, channels: int) -> None:
        self._backbone = _Backbone(weights, config.pixels, channels)
        first, second = sorted({name.rsplit(".", 1)[0] for name in weights if name.startswith("mixer.")})
        names = layout.heads(config)
        self._mixer = [_linear(weights, [first]), _linear(weights, [second])]
        self._heads = _linear(weights, list(names))
        # Cells lie channels last here and channels first in torch's weights.
        width, side = config.widths[-1], config.pixels // 2 ** len(config.widths)
        matrix, cells = self._mixer[0][0], width * side**2
        matrix[:cells] = matrix[:cells].reshape(width, side**2, -1).transpose(1, 0, 2).reshape(cells, -1)
        self._memory = Memory()

    def outputs(self, images: np.ndarray, more: np.ndarray) -> np.ndarray:
        """Outputs (n, k), float32."""
        at_once = 40  # views that pass through the layers together: 20 things, each seen twice
        slices = [slice(first, first + at_once) for first in range(0, len(images), at_once)]
        with one_blas_thread():
            parts = [self._outputs(images[part], more[part]) for part in slices]
        return np.concatenate(parts) if parts else np.empty((0, self._heads[0].shape[1]), np.float32)

    def _outputs(self, images: np.ndarray, more: np.ndarray) -> np.ndarray:
        x, side = self._backbone.compute(images, self._memory)[-1]
        h = np.concatenate([_inner(x, side).reshape(len(x), -1), more.astype(np.float32, copy=False)], axis=1)
        for matrix, bias in self._mixer:
            h = np.maximum(h @ matrix + bias, 0)
        matrix, bias = self._heads
        return h @ matrix + bias


class _Backbone:
    """:func:`sq_perception.learning.networks.compact_backbone`."""

    def __init__(self, weights: Weights, pixels: int, channels: int) -> None:
        self._pixels, self._channels = pixels, channels
        self._stem = Direct.fold(weights, "features.0", "features.1", stride=2)
        self._blocks: list[Block] = []
        while f"features.{3 + len(self._blocks)}.first.weight" in weights:
            self._blocks.append(Block.fold(weights, f"features.{3 + len(self._blocks)}"))

    def compute(self, images: np.ndarray, memory: Memory) -> list[tuple[np.ndarray, int]]:
        """Framed images, and their side, after the stem and after each block."""
        count, side = len(images), self._pixels
        margin = self._stem.size // 2
        framed = memory.zeros("images", (count, side + 2 * margin, side + 2 * margin, self._channels))
        framed[:, margin:-margin, margin:-margin] = images
        side //= 2
        found = [(self._stem.compute(framed, side, memory, "stem"), side)]
        for number, block in enumerate(self._blocks):
            found.append(block.compute(*found[-1], memory, str(number)))
        return found


def _inner(framed: np.ndarray, side: int) -> np.ndarray:
    return framed[:, 1 : side + 1, 1 : side + 1]


def _linear(weights: Weights, names: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Matrix (inputs, outputs) and bias of fully connected layers, or convolutions of single pixels, side by side."""
    matrix = np.concatenate([weights[f"{name}.weight"] for name in names])
    return contiguous(matrix.reshape(len(matrix), -1).T), np.concatenate([weights[f"{name}.bias"] for name in names])
