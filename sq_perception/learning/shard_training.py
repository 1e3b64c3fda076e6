"""Train a network on views that a folder holds: that of things, and that of masks.

Making a view takes as long as learning from it, and each is worth being seen several times; so views are written into
a folder first, shard by shard, or meanwhile by another process, and a training reads what it finds there, again and
again.  Of more shards than the memory is to hold it reads some, others after each validation.  What is particular to a
network is a :class:`Subject`: :data:`sq_perception.learning.thing_training.THINGS`,
:data:`sq_perception.learning.mask_training.MASKS`.

The learning rate falls as a cosine over the time that the run is given, as on a CPU the time is what is known
beforehand.  An exponential average of the weights is what is validated and kept.  A run that was stopped goes on where
it was when the same command is given again.

Views of the ``held`` first shards that a run finds are never trained on; the log has the network's figures on them,
and what is set when a run ends (:attr:`Subject.finish`) is set by them.
The state of the run names them: shards that come later change nothing in that.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.numpy import load_file as load_arrays
from safetensors.numpy import save as bytes_of

from sq_perception.files import output_file
from sq_perception.learning import checkpoint
from sq_perception.learning.inference import check_device
from sq_perception.learning.mask_network import MaskNetwork
from sq_perception.learning.thing_network import ThingNetwork
from sq_perception.learning.training_config import ShardTraining
from sq_perception.learning.training_state import TrainingState, mixed_precision, provenance_of

_WARM_UP = 100
"""Steps over which the learning rate rises."""
_AVERAGE = 0.998
"""The averaged weights remember some 500 steps."""
_IN_MEMORY = 2**30
"""Bytes of shards that are read at once, three times that while others are: as many views as a training of masks shows
between two validations."""
Network = TypeVar("Network", ThingNetwork, MaskNetwork)
Views = TypeVar("Views")
"""A dataclass of arrays (n, ...), the views among them as ``images``."""


@dataclass(frozen=True)
class Subject(Generic[Network, Views]):
    """What is particular to a network that is trained on shards."""

    name: str
    """Name of its file of weights and of its command, ``train-NAME``."""
    none: Views
    """No views at all, in the form of all."""
    network: Callable[[str], Network]
    """A network to begin with, from the weights that :attr:`ShardTraining.start` names."""
    batch: Callable[[Views, np.ndarray, np.random.Generator], tuple[torch.Tensor, ...]]
    """What the network takes of the views of these numbers, varied at random, and last the truth about them."""
    loss: Callable[..., torch.Tensor]
    """Loss of the network's output for a batch, and of that batch."""
    validate: Callable[[Network, Views], dict[str, Any]]
    """Figures of the network on views."""
    finish: Callable[[Network, Views], None] | None = None
    """Changes a network when its training ends, by views that it was not trained on: errors on the others are smaller,
    by a seventh after 8 million views of 700 000."""


def write_views(folder: Path, shards: Iterable[int], draw: Callable[[np.random.Generator], Any], seed: int) -> None:
    """Write shards of freshly drawn views that are not there yet; shard k follows from (seed, k) and ``draw`` alone."""
    folder.mkdir(parents=True, exist_ok=True)
    for k in shards:
        path = folder / f"{k:05d}.safetensors"
        if path.exists():
            print(f"{path}: there already")
            continue
        drawn = draw(np.random.default_rng([seed, k]))
        output_file.write(path, bytes_of(_to_stored(drawn)))
        print(f"{path}: {len(drawn.images)} views")


def read_views(none: Views, paths: list[Path]) -> Views:
    """All views of some shards, in the form of ``none``.

    Raises
    ------
    ValueError
        If a shard is damaged, or of another form, or all of them are empty.
    """
    kind, shards = type(none), []
    for path in paths:
        try:
            arrays = load_arrays(str(path))
            shards.append([arrays[name] for name in vars(none)])
            for (name, wanted), array in zip(_to_stored(none).items(), shards[-1], strict=True):
                shape = len(shards[-1][0]), *wanted.shape[1:]
                if array.shape != shape or array.dtype != wanted.dtype:
                    raise ValueError(f"{name}: expected {wanted.dtype} {shape}, got {array.dtype} {array.shape}")
        except (SafetensorError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{path}: not a readable shard of {kind.__name__}: {error}") from error
    if not any(len(shard[0]) for shard in shards):
        raise ValueError(f"{paths[0].parent}: expected views in {', '.join(path.name for path in paths)}, found none")
    return kind(*(np.concatenate(parts) for parts in zip(*shards, strict=True)))


def _to_stored(views: Any) -> dict[str, np.ndarray]:
    """Views as a shard holds them."""
    return {**vars(views), "images": views.images.astype(np.float16)}


def train(subject: Subject[Network, Any], config: ShardTraining, views: Path, output: Path) -> Network:
    """Run, or continue, a training; returns the averaged network, also kept in ``output``/NAME.safetensors.

    Raises
    ------
    ValueError
        If the folder holds no more shards than are kept for validation, or one that cannot be read, or for a device
        that this machine does not have.
    OSError
        If a shard that is kept for validation is gone.
    CheckpointError
        If a file to begin or to go on with does not fit.
    ArithmeticError
        If the loss or a gradient is no longer finite; the last state that was saved stays.
    """
    device = torch.device(check_device(config.device))
    if config.threads:
        torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    output.mkdir(parents=True, exist_ok=True)
    goes_on = (output / "state.safetensors").exists()  # and has all weights, though the start may be gone
    network = subject.network("" if goes_on else config.start).to(device).train()
    optimizer = torch.optim.AdamW(network.parameters(), lr=config.rate, weight_decay=config.weight_decay)
    state = TrainingState(output / "state.safetensors", network, optimizer)
    rng = np.random.default_rng([config.seed, state.step])
    state.held = state.held or [shard.name for shard in _shards(views, config.held)[: config.held]]
    held = read_views(subject.none, [views / name for name in state.held])
    shards = _some(views, state.held, rng)
    pool = read_views(subject.none, shards)
    began, losses = time.monotonic() - state.seconds, []
    while (progress := (time.monotonic() - began) / (60 * config.minutes)) < 1:
        if state.step % config.validation == 0 and (chosen := _some(views, state.held, rng)) != shards:
            shards, pool = chosen, read_views(subject.none, chosen)
        rate = falling_rate(config.rate, state.step, progress)
        drawn = subject.batch(pool, rng.integers(len(pool.images), size=config.batch), rng)
        batch = [each.to(device) for each in drawn]
        with mixed_precision(device.type, config.bfloat16):
            predicted = network(*batch[:-1])
        loss = subject.loss(predicted, *batch)
        state.descend(loss, rate, _AVERAGE)
        losses.append(loss.item())
        if state.step % config.validation == 0:
            state.seconds = time.monotonic() - began
            record = {"loss": float(np.mean(losses)), "rate": rate, "views": len(pool.images)}
            _keep(output, subject, config, state, {**record, **subject.validate(state.average, held)})
            losses.clear()
    state.seconds = time.monotonic() - began
    if subject.finish is not None:
        subject.finish(state.average, held)
    _keep(output, subject, config, state, subject.validate(state.average, held))
    return state.average


def falling_rate(rate: float, step: int, progress: float) -> float:
    """The learning rate: it rises over some steps and falls as a cosine of the time that passed, 0 to 1."""
    return rate * min(1.0, (step + 1) / _WARM_UP) * (0.5 * (1 + math.cos(math.pi * progress)) + 0.01)


def _shards(folder: Path, held: int) -> list[Path]:
    """The shards that a folder holds, in order; raises ValueError if there are none but those kept for validation."""
    found = sorted(folder.glob("[!.]*.safetensors"))  # one that is being written is hidden
    if len(found) <= held:
        raise ValueError(f"{folder}: expected more than {held} shards of views, found {len(found)}")
    return found


def _some(folder: Path, held: Sequence[str], rng: np.random.Generator) -> list[Path]:
    """All shards to train on if the memory is to hold them, else some at random, in order."""
    shards = [shard for shard in _shards(folder, len(held)) if shard.name not in held]
    sizes = np.array([shard.stat().st_size for shard in shards])
    if sizes.sum() <= _IN_MEMORY:
        return shards
    drawn = rng.permutation(len(shards))
    fit = np.cumsum(sizes[drawn]) <= _IN_MEMORY
    fit[0] = True
    return [shards[k] for k in np.sort(drawn[fit])]


def _keep(
    output: Path,
    subject: Subject[Network, Any],
    config: ShardTraining,
    state: TrainingState[Network],
    record: dict[str, Any],
) -> None:
    """Log, state and network of this moment."""
    record = {"step": state.step, "seconds": state.seconds, **record}
    print(json.dumps(record), flush=True)
    state.log(record)
    state.save()
    training = {**asdict(config), "start": Path(config.start).name}
    made = provenance_of(f"train-{subject.name}", next(state.model.parameters()).device)
    facts = {"training": training, "made": made, "validation": record}
    checkpoint.save(output / f"{subject.name}.safetensors", state.average, facts)
