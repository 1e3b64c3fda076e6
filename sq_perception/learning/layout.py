"""Names and shapes of all weights of a network, from its config alone: what a file must hold, without torch.

Names are those of the modules' state dicts (a test compares); the counters of normalisations are left out, as older
files have none.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from sq_perception.geometry.union import DIRECTIONS
from sq_perception.imaging.segment_view import CHANNELS
from sq_perception.learning.network_config import BODY_OUTPUTS, EXTENT, PLANE, MaskConfig, RegressorConfig, ThingConfig

Shapes = dict[str, tuple[int, ...]]

COUNTER = ".num_batches_tracked"  # how the names of those counters end
CELLS_AT_ONCE = 4  # outputs of the network of masks at a pixel of its stem's half resolution: 2 x 2 cells
BLOCK = ("first", "first_norm", "second", "second_norm", "shortcut")
"""The modules of a residual block: two convolutions, each with its normalisation, and the way beside them."""
TORCHVISION_BLOCK = ("conv1", "bn1", "conv2", "bn2", "downsample")  # what torchvision calls them in ResNet-18


def shapes(config: RegressorConfig | ThingConfig | MaskConfig) -> Shapes:
    """Name and shape of every weight; a ValueError for channels or outputs that are no positive integers."""
    found = _masks(config) if isinstance(config, MaskConfig) else _bodies(config)
    if not all(isinstance(side, int) and side > 0 for shape in found.values() for side in shape):
        raise ValueError("expected positive integers as numbers of channels and outputs")
    return found


def _bodies(config: RegressorConfig | ThingConfig) -> Shapes:
    found: Shapes = {}
    of_things = isinstance(config, ThingConfig)
    encoding = config.regressor() if isinstance(config, ThingConfig) else config
    if encoding.backbone == "resnet18":
        inputs = _resnet18(found)
    else:
        cells = (config.pixels // encoding.stride) ** 2
        inputs = _compact(found, config.widths, config.blocks, 2 if of_things else 1) * cells
    first, second = ("mixer.0", "mixer.2") if of_things else ("mixer.1", "mixer.3")
    _linear(found, first, inputs + (PLANE + EXTENT if of_things else 0), config.hidden)
    _linear(found, second, config.hidden, config.hidden)
    for head, outputs in heads(config).items():
        _linear(found, head, config.hidden, outputs)
    return found


def _masks(config: MaskConfig) -> Shapes:
    """The weights of :class:`sq_perception.learning.networks.MaskNetwork`."""
    found: Shapes = {}
    _compact(found, config.widths, config.blocks, CHANNELS)
    for k, (fine, coarse) in enumerate(pairwise(config.widths)):
        _linear(found, f"up.{k}", coarse, fine, 1, 1)
        _block(found, f"joined.{k}", BLOCK, fine, fine, False)
    _linear(found, "head", config.widths[0], CELLS_AT_ONCE, 1, 1)
    return found


def heads(config: RegressorConfig | ThingConfig) -> dict[str, int]:
    """Name and number of outputs of every head, in the order of the outputs."""
    if isinstance(config, RegressorConfig):
        return {"size_head": 3, "shape_head": 2, "translation_head": 3, "rotation_head": 6}
    count = len(DIRECTIONS)
    return {
        "body_head": BODY_OUTPUTS, "support_head": count, "sigma_head": count, "factor_head": count * config.factors
    }


def _compact(found: Shapes, widths: tuple[int, ...], blocks: int, channels: int) -> int:
    """The weights of :func:`sq_perception.learning.networks.compact_backbone`; its channels."""
    stem, *stages = widths
    _convolution(found, "features.0", "features.1", channels, stem, 5)
    channels, number = stem, 3
    for width in stages:
        for k in range(max(blocks, 1)):
            _block(found, f"features.{number}", BLOCK, channels, width, k == 0)
            channels, number = width, number + 1
    return channels


def _resnet18(found: Shapes) -> int:
    """The weights of :class:`sq_perception.learning.networks.ResNet18`; its channels."""
    channels = 64
    _convolution(found, "features.conv1", "features.bn1", 1, channels, 7)
    for stage, width in enumerate((64, 128, 256, 512), 1):
        for k in range(2):
            _block(found, f"features.layer{stage}.{k}", TORCHVISION_BLOCK, channels, width, channels != width)
            channels = width
    return channels


def _block(
    found: Shapes, name: str, modules: Sequence[str], channels_in: int, channels_out: int, changes: bool
) -> None:
    """A residual block; ``changes``: whether what goes beside it is another number of channels or pixels."""
    first, first_norm, second, second_norm, shortcut = (f"{name}.{module}" for module in modules)
    _convolution(found, first, first_norm, channels_in, channels_out, 3)
    _convolution(found, second, second_norm, channels_out, channels_out, 3)
    if changes:
        _convolution(found, f"{shortcut}.0", f"{shortcut}.1", channels_in, channels_out, 1)


def _convolution(found: Shapes, name: str, norm: str, channels_in: int, channels_out: int, size: int) -> None:
    found[f"{name}.weight"] = (channels_out, channels_in, size, size)
    for part in ("weight", "bias", "running_mean", "running_var"):
        found[f"{norm}.{part}"] = (channels_out,)


def _linear(found: Shapes, name: str, inputs: int, outputs: int, *kernel: int) -> None:
    """A fully connected layer, or with a ``kernel`` of 1, 1 a convolution of single pixels."""
    found[f"{name}.weight"], found[f"{name}.bias"] = (outputs, inputs, *kernel), (outputs,)
