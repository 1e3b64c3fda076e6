"""Train the network of masks (:mod:`sq_perception.learning.mask_network`) on segments that a folder holds.

As for the network of things (:mod:`sq_perception.learning.thing_training`), views are drawn into a folder by one
process and read, again and again, by another.  A view is mirrored or turned by a quarter at random, and shown now and
then as if there were no support plane, or no other segments.

    loss = sum_cells w cross entropy(l, truth) / sum_cells w,    w = 1 within the segment, AROUND beside it,
                                                                 0 where nothing was measured

The cells beside the segment find the other pieces of an object.
"""

from __future__ import annotations

import copy
import json
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.numpy import load_file as load_arrays
from safetensors.numpy import save as bytes_of

from sq_perception.files import output_file, provenance
from sq_perception.imaging.segment_view import HEIGHT, OTHERS, PLANE, SEGMENT
from sq_perception.learning import checkpoint
from sq_perception.learning.mask_network import MaskNetwork
from sq_perception.learning.network_config import MaskConfig
from sq_perception.learning.thing_training import falling_rate, shards_of
from sq_perception.learning.training_state import TrainingState
from sq_perception.simulation.segment_views import UNKNOWN, YES, SegmentViews, draw_segment_views

AROUND = 0.5
_KEPT_BACK = 0.1
"""Share of the views without the plane, and without other segments."""
_AVERAGE = 0.998
_BATCH = 128
"""Views of a validation that are computed at once."""


@dataclass(frozen=True)
class MaskTraining:
    """What fixes a run."""

    minutes: float = 60.0
    """Training time, that of all parts of a stopped run together."""
    batch: int = 64
    rate: float = 3e-3
    weight_decay: float = 1e-3
    seed: int = 0
    threads: int = 0
    """Of torch; 0 leaves its own choice."""
    held: int = 2
    """Shards that are kept for validation."""
    validation: int = 200
    """Steps between two validations."""
    start: str = ""
    """Weights to begin with: a file, or shipped ones."""


def write_views(folder: Path, shards: Iterable[int], scenes: int, seed: int, report: Callable[[str], None]) -> None:
    """Write shards of freshly drawn scenes that are not there yet; shard k follows from (seed, k) alone."""
    folder.mkdir(parents=True, exist_ok=True)
    for k in shards:
        path = folder / f"{k:05d}.safetensors"
        if path.exists():
            continue
        drawn = draw_segment_views(scenes, np.random.default_rng([seed, k]))
        output_file.write(path, bytes_of(vars(drawn)))
        report(f"{path}: {len(drawn.images)} segments")


def read_views(paths: list[Path]) -> SegmentViews:
    """All views of some shards."""
    shards = [load_arrays(str(path)) for path in paths]
    return SegmentViews(*(np.concatenate([shard[name] for shard in shards]) for name in ("images", "truth")))


def train(config: MaskTraining, views: Path, output: Path, form: MaskConfig | None = None) -> MaskNetwork:
    """Run, or continue, a training; returns the averaged network, also kept in ``output``/masks.safetensors.

    Raises
    ------
    ValueError
        If the folder holds no more shards than are kept for validation.
    CheckpointError
        If a file to begin or to go on with does not fit.
    ArithmeticError
        If the loss is no longer finite; the last state that was saved stays.
    """
    if config.threads:
        torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    output.mkdir(parents=True, exist_ok=True)
    network = checkpoint.load_masks(config.start).train() if config.start else MaskNetwork(form)
    optimizer = torch.optim.AdamW(network.parameters(), lr=config.rate, weight_decay=config.weight_decay)
    state = TrainingState(network, copy.deepcopy(network), optimizer)
    path = output / "state.safetensors"
    if path.exists():
        state.restore(path)
    rng = np.random.default_rng([config.seed, state.step])
    shards: list[Path] = []
    pool = held = read_views(shards_of(views, config.held)[: config.held])
    began, losses = time.monotonic() - state.seconds, []
    while (progress := (time.monotonic() - began) / (60 * config.minutes)) < 1:
        if state.step % config.validation == 0 or not shards:
            found = shards_of(views, config.held)[config.held :]
            if len(found) > len(shards):
                shards, pool = found, read_views(found)
        images, truth = _batch(pool, rng.integers(len(pool.images), size=config.batch), rng)
        loss = mask_loss(network(images), images, truth)
        state.descend(loss, falling_rate(config.rate, state.step, progress))
        if not bool(torch.isfinite(loss)):
            raise ArithmeticError(f"step {state.step}: the loss is {loss.item()}; {path} is the last good state")
        state.advance(_AVERAGE)
        losses.append(loss.item())
        if state.step % config.validation == 0:
            state.seconds = time.monotonic() - began
            record = {"step": state.step, "loss": float(np.mean(losses)), "views": len(pool.images)}
            _keep(output, state, {**record, "seconds": state.seconds, **validate(state.average, held)}, config)
            losses.clear()
    state.seconds = time.monotonic() - began
    _keep(output, state, {"step": state.step, "seconds": state.seconds, **validate(state.average, held)}, config)
    return state.average


def mask_loss(logits: torch.Tensor, images: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """The loss of logits (b, p, p) for views (b, CHANNELS, p, p) and their truth (b, p, p); see the module."""
    weight = torch.where(images[:, SEGMENT] > 0, 1.0, AROUND) * (truth != UNKNOWN)
    each = torch.nn.functional.binary_cross_entropy_with_logits(logits, (truth == YES).float(), reduction="none")
    return (weight * each).sum() / weight.sum().clamp_min(1)


@torch.inference_mode()
def validate(network: MaskNetwork, views: SegmentViews) -> dict[str, float]:
    """Shares in the objects' readings: strays in segments before and after, and readings that are lost."""
    network.eval()
    strays = left = lost = objects = 0
    for i in range(0, len(views.images), _BATCH):
        images = torch.from_numpy(views.images[i : i + _BATCH].astype(np.float32)).permute(0, 3, 1, 2)
        truth = torch.from_numpy(views.truth[i : i + _BATCH])
        inside = (images[:, SEGMENT] > 0) & (truth != UNKNOWN)
        kept, own = network(images) >= 0, inside & (truth == YES)
        objects += int(own.sum())
        strays += int((inside & ~own).sum())
        left += int((inside & ~own & kept).sum())
        lost += int((own & ~kept).sum())
    network.train()
    return {"strays": strays / objects, "left": left / objects, "lost": lost / objects}


def _batch(views: SegmentViews, chosen: np.ndarray, rng: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Images (b, CHANNELS, p, p) and their truth (b, p, p), varied as the module says."""
    images = views.images[chosen].astype(np.float32)
    without_plane, alone = rng.random((2, len(chosen))) < _KEPT_BACK
    for channels, which in (((HEIGHT, PLANE), without_plane), ((OTHERS,), alone)):
        for channel in channels:
            images[which, :, :, channel] = 0
    truth = views.truth[chosen]
    if rng.random() < 0.5:
        images, truth = images[:, :, ::-1], truth[:, :, ::-1]
    if rng.random() < 0.5:
        images, truth = images.transpose(0, 2, 1, 3), truth.transpose(0, 2, 1)
    return torch.from_numpy(np.ascontiguousarray(images.transpose(0, 3, 1, 2))), torch.from_numpy(truth.copy())


def _keep(output: Path, state: TrainingState[MaskNetwork], record: dict[str, Any], config: MaskTraining) -> None:
    """Log, state and network of this moment."""
    with (output / "log.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps(record) + "\n")
    state.save(output / "state.safetensors")
    training = {**asdict(config), "start": Path(config.start).name}
    facts = {"training": training, "made": provenance.facts("sq-perception train-masks"), "validation": record}
    checkpoint.save(output / "masks.safetensors", state.average, facts)
