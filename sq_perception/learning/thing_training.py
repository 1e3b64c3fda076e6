"""Train the network of things (:mod:`sq_perception.learning.thing_network`) on views that a folder holds.

Making a view takes as long as learning from it (:mod:`sq_perception.simulation.thing_views`), and each is worth being
seen several times; so views are written into a folder first, or meanwhile by another process, and this script reads
what it finds there, again and again.  Half of them are shown as in a mirror.

    loss = mean over views of  -log p(h) / J  +  BODY |h_body - h|  +  CENTRE |mu - h|

The likelihood alone makes the first steps wild; the last term leads.  The learning rate falls as a cosine over the time
that the run is given, as on a CPU the time is what is known beforehand.  A run that was stopped goes on where it was
when the same command is given again.

Views of the ``held`` first shards are never trained on; the log has their figures by kind: the mean error of h, and the
standard deviation of error / sigma, which an honest network has at 1.
"""

from __future__ import annotations

import copy
import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.numpy import load_file as load_arrays
from safetensors.numpy import save as bytes_of
from scipy.optimize import minimize_scalar

from sq_perception.files import output_file, provenance
from sq_perception.geometry.support_directions import mirrored
from sq_perception.learning import checkpoint, thing_network
from sq_perception.learning.checkpoint import CheckpointError
from sq_perception.learning.network_config import mirrored_planes
from sq_perception.learning.thing_network import HullPrediction, ThingConfig, ThingNetwork
from sq_perception.learning.training_state import TrainingState
from sq_perception.simulation.household import KINDS
from sq_perception.simulation.thing import Thing
from sq_perception.simulation.thing_views import ThingViews, draw_thing_views

BODY, CENTRE = 2.0, 1.0
"""Weights of the losses beside the likelihood, which is of order 1 where they are of order 0.05."""
_UNKNOWN_EXTENT = 0.1
"""Share of the views whose extent is hidden from the network."""
_CALIBRATED, _LOG_SPREADS = 4096, (-5.0, 3.0)
"""Views that settle the spread of the errors to 2 %, and between what it is sought."""
_WARM_UP = 100
_AVERAGE = 0.998
"""The averaged weights, which are what is kept, remember some 500 steps."""
_BATCH = 256
"""Views of a validation that are computed at once."""


@dataclass(frozen=True)
class ThingTraining:
    """What fixes a run."""

    minutes: float = 120.0
    """Training time, that of all parts of a stopped run together."""
    batch: int = 64
    rate: float = 8e-4
    weight_decay: float = 1e-4
    seed: int = 0
    threads: int = 0
    """Of torch; 0 leaves its own choice."""
    held: int = 2
    """Shards that are kept for validation."""
    validation: int = 200
    """Steps between two validations."""
    bfloat16: bool = False
    """Layers before the heads in half the bits, their weights in all: 1.7 times as fast where processors have it."""
    start: str = ""
    """Weights to begin with, as names of torch parameters: a safetensors file of this network or of a Regressor."""


def write_views(
    folder: Path,
    shards: Iterable[int],
    views: int,
    seed: int,
    report: Callable[[str], None],
    own: Sequence[Thing] = (),
) -> None:
    """Write shards of freshly drawn views that are not there yet; shard k follows from (seed, k) and ``own`` alone."""
    folder.mkdir(parents=True, exist_ok=True)
    for k in shards:
        path = folder / f"{k:05d}.safetensors"
        if path.exists():
            continue
        drawn = draw_thing_views(views, np.random.default_rng([seed, k]), own=own)
        output_file.write(path, bytes_of({**vars(drawn), "images": drawn.images.astype(np.float16)}))
        report(f"{path}: {views} views")


def read_views(paths: list[Path]) -> ThingViews:
    """All views of some shards."""
    shards = [load_arrays(str(path)) for path in paths]
    return ThingViews(
        **{each.name: np.concatenate([shard[each.name] for shard in shards]) for each in fields(ThingViews)}
    )


def train(config: ThingTraining, views: Path, output: Path, form: ThingConfig | None = None) -> ThingNetwork:
    """Run, or continue, a training; returns the averaged network, also kept in ``output``/things.safetensors.

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
    network = ThingNetwork(form)
    if config.start:
        begin_with(network, checkpoint.resolve(config.start))
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
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
        rate = falling_rate(config.rate, state.step, progress)
        images, planes, extents, truth = _batch(pool, rng.integers(len(pool.images), size=config.batch), rng)
        network.train()
        with torch.autocast("cpu", torch.bfloat16, enabled=config.bfloat16):
            predicted = network(images, planes, extents)
        loss = (
            predicted.negative_log_likelihood(truth).mean() / truth.shape[1]
            + BODY * thing_network.body_loss(predicted.body, truth).mean()
            + CENTRE * (predicted.support - truth).abs().mean()
        )
        state.descend(loss, rate)
        if not bool(torch.isfinite(loss)):
            raise ArithmeticError(f"step {state.step}: the loss is {loss.item()}; {path} is the last good state")
        state.advance(_AVERAGE)
        losses.append(loss.item())
        if state.step % config.validation == 0:
            state.seconds = time.monotonic() - began
            record = {"step": state.step, "loss": float(np.mean(losses)), "rate": rate, "views": len(pool.images)}
            _keep(output, state, {**record, "seconds": state.seconds, **validate(state.average, held)}, config)
            losses.clear()
    state.seconds = time.monotonic() - began
    sample = ThingViews(*(each[:_CALIBRATED] for each in vars(pool).values()))
    state.average.config = replace(state.average.config, spread=likeliest_spread(state.average, sample))
    _keep(output, state, {"step": state.step, "seconds": state.seconds, **validate(state.average, held)}, config)
    return state.average


def likeliest_spread(network: ThingNetwork, views: ThingViews) -> float:
    """The factor of S for which true hulls are likeliest, now that the network predicts and does not learn.

    As temperature scaling (C. Guo et al., "On calibration of modern neural networks", ICML 2017).
    """
    found = []
    for truth, predicted in _predictions(network, views):
        found.append(predicted.distance(truth)[0])
    m, nu, count = torch.cat(found).numpy(), network.config.freedom, views.support.shape[1]
    best = minimize_scalar(
        lambda log: 0.5 * count * log + 0.5 * (nu + count) * float(np.log1p(m / (math.exp(log) * nu)).mean()),
        bounds=_LOG_SPREADS,
        method="bounded",
    )
    return network.config.spread * float(math.exp(best.x))


def validate(network: ThingNetwork, views: ThingViews) -> dict[str, Any]:
    """Mean errors of h and of the body's h in sides of the view, and the deviation of error / sigma, by kind."""
    errors, body_errors, ratios = [], [], []
    for truth, predicted in _predictions(network, views):
        error = (predicted.support - truth).numpy()
        body_errors.append(thing_network.body_loss(predicted.body, truth).numpy())
        errors.append(np.abs(error).mean(axis=1))
        ratios.append(error / predicted.deviation().numpy())
    error, body_error, ratio = np.concatenate(errors), np.concatenate(body_errors), np.concatenate(ratios)
    found: dict[str, Any] = {
        "error": float(error.mean()),
        "body": float(body_error.mean()),
        "ratio": float(ratio.std()),
    }
    for k, kind in enumerate(KINDS):
        mine = views.kinds == k
        if mine.any():
            found[kind] = [float(error[mine].mean()), float(np.sqrt(np.mean(ratio[mine] ** 2)))]
    return found


@torch.inference_mode()
def _predictions(network: ThingNetwork, views: ThingViews) -> Iterator[tuple[torch.Tensor, HullPrediction]]:
    """True and predicted support functions, batch by batch."""
    network.eval()
    for i in range(0, len(views.images), _BATCH):
        part = slice(i, i + _BATCH)
        shown = (views.images[part].astype(np.float32), views.planes[part], views.extents[part])
        yield torch.from_numpy(views.support[part]), network(*map(torch.from_numpy, shown))


def begin_with(network: ThingNetwork, path: Path) -> None:
    """Take over the weights that fit by name and shape; those of a Regressor's first layers among them.

    Raises
    ------
    CheckpointError
        If the file cannot be read, or nothing in it fits.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        given = load_file(str(path))
    except (OSError, SafetensorError) as error:
        raise CheckpointError(f"{path}: not a readable safetensors file: {error}") from error
    given = {name: tensor.float() for name, tensor in given.items()}
    if "mixer.0.weight" not in given:  # a Regressor flattens there, and has one channel in and no plane
        given = {_mixer_without_flatten(name): tensor for name, tensor in given.items()}
    taken = 0
    with torch.no_grad():
        for name, mine in network.state_dict().items():
            theirs = given.get(name)
            if theirs is None or theirs.ndim != mine.ndim:
                continue
            if theirs.shape == mine.shape:
                mine.copy_(theirs)
            elif mine.ndim > 1 and theirs.shape[1] < mine.shape[1] and theirs.shape[0] == mine.shape[0]:
                mine.zero_()
                mine[:, : theirs.shape[1]].copy_(theirs)
            else:
                continue
            taken += 1
        for name, mine in network.body_head.named_parameters():  # a Regressor has one for each part of the body
            heads = [f"{part}_head.{name}" for part in ("size", "shape", "translation", "rotation")]
            if given.keys() >= set(heads):
                mine.copy_(torch.cat([given[head] for head in heads]))
    if taken == 0:
        raise CheckpointError(f"{path}: none of its weights fits the network")


def _mixer_without_flatten(name: str) -> str:
    parts = name.split(".")
    if parts[0] == "mixer":
        parts[1] = str(int(parts[1]) - 1)
    return ".".join(parts)


def falling_rate(rate: float, step: int, progress: float) -> float:
    """The learning rate: it rises over some steps and falls as a cosine of the time that passed, 0 to 1."""
    return rate * min(1.0, (step + 1) / _WARM_UP) * (0.5 * (1 + math.cos(math.pi * progress)) + 0.01)


def shards_of(folder: Path, held: int) -> list[Path]:
    """The shards that a folder holds, in order; raises ValueError if there are none but those kept for validation."""
    found = sorted(folder.glob("*.safetensors"))
    if len(found) <= held:
        raise ValueError(f"{folder}: expected more than {held} shards of views, found {len(found)}")
    return found


def _batch(views: ThingViews, chosen: np.ndarray, rng: np.random.Generator) -> tuple[torch.Tensor, ...]:
    """Images (b, p, p), planes (b, 4), extents (b,) and support functions (b, J) of some views.

    Half of them are mirrored, and the extent of some is kept back.
    """
    images = views.images[chosen].astype(np.float32)
    planes, support = views.planes[chosen], views.support[chosen]
    extents = np.where(rng.random(len(chosen)) < _UNKNOWN_EXTENT, np.float32(0), views.extents[chosen])
    turned = rng.random(len(chosen)) < 0.5
    images[turned] = images[turned][:, :, ::-1]
    planes = np.where(turned[:, None], mirrored_planes(planes), planes)
    support = np.where(turned[:, None], support[:, mirrored(0)], support)
    return tuple(map(torch.from_numpy, (images, planes, extents, support)))


def _keep(output: Path, state: TrainingState[ThingNetwork], record: dict[str, Any], config: ThingTraining) -> None:
    """Log, state and network of this moment."""
    with (output / "log.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps(record) + "\n")
    state.save(output / "state.safetensors")
    made = provenance.facts("sq-perception train-things")
    validation = {name: value for name, value in record.items() if name in ("step", "error", "body", "ratio", *KINDS)}
    training = {**asdict(config), "start": Path(config.start).name}
    facts = {"training": training, "made": made, "validation": validation}
    checkpoint.save(output / "things.safetensors", state.average, facts)
