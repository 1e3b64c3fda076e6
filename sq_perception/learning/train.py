"""Train the regressor, with one of the losses of :mod:`sq_perception.learning.losses`.

One linear script: take a batch, predict, compare, step.  Gradients are clipped; an exponential average of the weights
is what is validated and saved.  Everything that changes lives in one state file, so that a run that was killed goes on
where it stopped when the same command is given again.  An unsupervised loss gets no labels.

The output folder holds state.safetensors, log.jsonl, last.safetensors (the newest validated network) and
model.safetensors (the best one so far).
"""

from __future__ import annotations

import json
import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch

from sq_perception.geometry.metrics import volume_iou
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.learning import checkpoint
from sq_perception.learning.dataset import POOL, ViewPool, ViewSource, draw_views
from sq_perception.learning.disturbance import Disturbance, any_occluder
from sq_perception.learning.inference import check_device
from sq_perception.learning.losses import Objective
from sq_perception.learning.regressor import Regressor, RegressorConfig
from sq_perception.learning.training_config import Plateau, TrainingConfig
from sq_perception.learning.training_state import (
    SETTINGS,
    TrainingState,
    mixed_precision,
    provenance_of,
    recalibrate,
)

_OF_A_RUN = ("loss", "backbone", "framing", "pixels", "canonical_labels", "optimizer")
"""Settings whose change makes another run; others may change when it goes on."""
_VALIDATED = ("pinhole_share", "noisy_share", "occluded_share", "validation")
"""Settings that decide what a network is validated on."""
_FORM = ("backbone", "framing", "pixels")
"""Settings that a network to begin with brings along."""
CALIBRATION_VIEWS, _CALIBRATION_BATCH = 2048, 32
"""Views from which normalisations are measured anew, and at least so many at once: fewer take long and say less."""
_SAVE_SECONDS = 300.0
"""Longest time between two saved states."""
_BATCH = 250
"""Views of a validation that are computed at once."""
_FEWEST_CHANNELS_LAST = 8
"""Channels of the first layer from which on images lie channels last, the faster way: torch 2.13 writes beyond its
memory with fewer of them where a processor has no AVX-512."""
VALIDATION_HIDDEN = 0.3
"""Share of each body that is hidden in the validation set ``hidden``."""


class Stopped(Exception):  # noqa: N818 - nothing is wrong
    """A run that was asked to stop; its state is saved."""


def train(
    config: TrainingConfig,
    output: Path,
    network: RegressorConfig | None = None,
    advance: Callable[[int, float], None] = lambda step, loss: None,
) -> Regressor:
    """Run, or continue, a training; returns the averaged network, also saved in ``output``.

    Parameters
    ----------
    config
        The run.
    output
        The folder of the run.
    network
        A form other than that of ``config``.
    advance
        Called with the steps done and the loss of the last one.

    Raises
    ------
    ArithmeticError
        When the loss or a gradient is no longer finite; the last saved state stays as it was.
    Stopped
        After SIGINT or SIGTERM; the state is saved first.
    CheckpointError
        If a file to begin or to go on with does not fit.
    ValueError
        For a device that this machine does not have, or data or a network to begin with of another form.
    """
    device = torch.device(check_device(config.device))
    with _threads(config.threads), _stop_requests() as stop_requested:
        output.mkdir(parents=True, exist_ok=True)
        torch.manual_seed(config.seed)
        model = _new_network(config, network).to(device)
        config = replace(config, **{name: getattr(model.config, name) for name in _FORM})
        before = _check_same_run(config, output)
        _check_batch(config.batch, model.config)
        objective = Objective(
            config.loss, config.points, config.sharpness_start, config.sharpness_end, config.tau, config.framing
        )
        layout = torch.channels_last if model.config.widths[0] >= _FEWEST_CHANNELS_LAST else torch.contiguous_format
        model.to(memory_format=layout)  # type: ignore[call-overload]
        settings = json.dumps(asdict(config))
        state = TrainingState(output / "state.safetensors", model, _optimizer(config, model), settings)
        if any(before.get(name, getattr(config, name)) != getattr(config, name) for name in _VALIDATED):
            state.best, state.plateau = -math.inf, Plateau()  # what was best was so of other views
        seed = np.random.SeedSequence([config.seed, state.step])
        generator = torch.Generator(device=device).manual_seed(int(seed.generate_state(1)[0]))
        batches = _batches(config, model.config, np.random.default_rng(seed))
        validation = _validation_sets(config, model.config)
        notes = {"training": asdict(config), "made": provenance_of("train", device)}
        started, saved, losses = time.monotonic() - state.seconds, time.monotonic(), []
        while state.step < config.steps and not (config.schedule == "plateau" and state.plateau.exhausted):
            progress, rate = state.step / config.steps, config.rate(state.step, state.plateau)
            images, bodies = batches.batch(config.batch)
            views = torch.from_numpy(images)[:, None].to(device, memory_format=layout)
            truth = _truth(bodies, config, device) if objective.needs_labels else None
            model.train()
            with mixed_precision(device.type, config.bfloat16):
                prediction = model(views)
            loss = objective.loss(prediction, views, truth, progress, generator).mean()
            state.descend(loss, rate, config.average)
            losses.append(loss.item())
            advance(state.step, losses[-1])

            finished = state.step == config.steps
            stopping = stop_requested()
            if state.step % config.validation == 0 or finished:
                state.seconds = time.monotonic() - started
                if config.average > 0:
                    _recalibrate(state.average, batches, config.batch)
                record = {"step": state.step, "loss": float(np.mean(losses)), "rate": rate}
                record |= {"sharpness": objective.sharpness(progress), "seconds": state.seconds}
                record |= _validate_sets(state.average, validation, objective)
                _keep(output, state, record, notes)
                state.plateau.record(1 - record["iou"])
                losses.clear()
            due = time.monotonic() - saved > _SAVE_SECONDS
            if state.step % config.validation == 0 or finished or stopping or due:
                state.seconds, saved = time.monotonic() - started, time.monotonic()
                state.save()
            if stopping and not finished:
                raise Stopped(f"stopped after step {state.step}; the same command goes on from {state.path}")
        return state.average.eval()


def _check_same_run(config: TrainingConfig, output: Path) -> dict[str, Any]:
    """The settings of the run so far; CheckpointError where it is of another kind, naming what differs."""
    state = output / "state.safetensors"
    try:
        before = dict(json.loads(checkpoint.read_header(state).get(SETTINGS, "{}")))
    except checkpoint.CheckpointError:  # there is none yet, and a damaged one is refused where it is read
        return {}
    except (ValueError, TypeError) as error:
        raise checkpoint.CheckpointError(f"{state}: its header does not tell what run it is of: {error}") from error
    other = [name for name in _OF_A_RUN if before.get(name, getattr(config, name)) != getattr(config, name)]
    if other:
        differences = ", ".join(f"{name} {before[name]!r}, not {getattr(config, name)!r}" for name in other)
        raise checkpoint.CheckpointError(
            f"{output}: holds a run with {differences}: expected another --output, or the same settings"
        )
    return before


def _check_batch(batch: int, network: RegressorConfig) -> None:
    """Raise ValueError for a batch of one number for each channel, which has no deviation to normalise by."""
    if batch == 1 and network.pixels == network.stride:
        raise ValueError(
            f"batch: expected at least 2 with views of {network.pixels} pixels, of which one cell is left: "
            "one number has no deviation to normalise by"
        )


def validate(
    model: Regressor, views: np.ndarray, truth: Superquadric, objective: Objective | None = None
) -> np.ndarray:
    """Volume IoU (n,) of the network's bodies with the true ones, both in the views' frames.

    With an ``objective`` for which some parameters are given, those are taken from the truth.
    """
    flats = [model.predict(views[i : i + _BATCH]).to_flat() for i in range(0, len(views), _BATCH)]
    prediction = Superquadric.from_flat(np.concatenate(flats))
    return volume_iou(objective.with_given(prediction, truth) if objective else prediction, truth)


def _new_network(config: TrainingConfig, form: RegressorConfig | None) -> Regressor:
    """The network that a run begins with: one of random weights, or that of ``start``, which keeps its form."""
    if not config.start:
        return Regressor(form or config.regressor())
    model = checkpoint.load(config.start)
    for name in _FORM:
        wanted, brought = getattr(config, name), getattr(model.config, name)
        if wanted not in (getattr(TrainingConfig, name), brought):  # defaults say nothing
            raise ValueError(f"{name}: expected {brought!r}, as the network of start has it, got {wanted!r}")
    model.config = replace(model.config, marks_hidden=model.config.marks_hidden or config.marks_hidden)
    return model


def _optimizer(config: TrainingConfig, model: Regressor) -> torch.optim.Optimizer:
    if config.optimizer == "adam":
        return torch.optim.Adam(model.parameters(), config.learning_rate)
    return torch.optim.AdamW(model.parameters(), config.learning_rate, weight_decay=config.weight_decay)


def _truth(bodies: Superquadric, config: TrainingConfig, device: torch.device) -> Superquadric:
    """Labels of a batch as a torch batch on the device, their axes listed as the run wants them."""
    labels = bodies.canonical_form() if config.canonical_labels else bodies
    return Superquadric.from_flat(torch.from_numpy(labels.to_flat()).float().to(device))


def _recalibrate(model: Regressor, batches: ViewPool, batch: int) -> None:
    """Measure the normalisations of an averaged network anew, on views of the training."""
    views, _ = batches.batch(max(CALIBRATION_VIEWS, batch))
    recalibrate(model, torch.from_numpy(views)[:, None], max(batch, _CALIBRATION_BATCH))


def _batches(config: TrainingConfig, network: RegressorConfig, rng: np.random.Generator) -> ViewPool:
    # A short run holds no more views than it takes.
    taken = max(config.steps * config.batch, CALIBRATION_VIEWS if config.average > 0 else 0)
    disturbance = Disturbance(config.occluded_share, config.noisy_share)
    source = ViewSource(network.pixels, config.pinhole_share, config.wide_share, disturbance, network.framing)
    return ViewPool(rng, source, min(POOL, taken), config.reuse)


def _validation_sets(config: TrainingConfig, network: RegressorConfig) -> dict[str, tuple[np.ndarray, Superquadric]]:
    """Views and bodies that no run trains on: the thesis' images, and what a real camera makes of them."""
    count, pixels = config.validation, network.pixels
    # A seed of its own kind: [0] and [0, 0], of a run, are the same numbers.
    seed = np.random.SeedSequence(0, spawn_key=(0,))
    sets = {"iou": draw_views(count, np.random.default_rng(seed), ViewSource(pixels, framing=network.framing))}
    if config.pinhole_share > 0:
        sets["iou_pinhole"] = draw_views(count, np.random.default_rng(seed), ViewSource(pixels, 1.0))
    if config.noisy_share > 0:
        rng = np.random.default_rng(seed)
        near, bodies = draw_views(count, rng, ViewSource(pixels, config.pinhole_share))
        sets["iou_worn"] = Disturbance(noisy_share=1.0).apply(near, rng), bodies
    if config.occluded_share > 0:
        rng = np.random.default_rng(seed)
        occluder = any_occluder(np.full(count, VALIDATION_HIDDEN), rng)
        sets["iou_hidden"] = draw_views(count, rng, ViewSource(pixels, config.pinhole_share), occluder)
    if config.canonical_labels:  # what is given to the network counts as it was given in training
        return {name: (views, bodies.canonical_form()) for name, (views, bodies) in sets.items()}
    return sets


def _validate_sets(
    model: Regressor, sets: dict[str, tuple[np.ndarray, Superquadric]], objective: Objective
) -> dict[str, float]:
    record = {}
    for name, (views, truth) in sets.items():
        iou = validate(model, views, truth, objective=objective)
        record[name] = float(iou.mean())
        if name == "iou":
            record["iou_std"], record["over_85"] = float(iou.std()), float((iou > 0.85).mean())
    return record


def _keep(output: Path, state: TrainingState, record: dict[str, Any], notes: dict[str, Any]) -> None:
    """Log a validation and save the averaged network; as the model too, where no validation was better."""
    print(json.dumps(record), flush=True)
    state.log(record)
    names = ["last.safetensors"]
    score = float(np.mean([value for name, value in record.items() if name.startswith("iou") and name != "iou_std"]))
    if score >= state.best:
        state.best = score
        names.append("model.safetensors")
    for name in names:
        checkpoint.save(output / name, state.average, {**notes, "metrics": record})


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """So many threads for the network and for the rendering of its views; 0 leaves both their own choice.

    Each has a pool of its own, and OpenMP's threads wait by spinning.  Beside other work on all cores, a renderer's
    second thread, which got its turn late and held a core while it had nothing to do, made a run of one torch thread
    more than seven times as slow.
    """
    before = torch.get_num_threads(), numba.get_num_threads()
    if count:
        torch.set_num_threads(count)
        numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        numba.set_num_threads(before[1])


@contextmanager
def _stop_requests() -> Iterator[Callable[[], bool]]:
    """Within it SIGINT and SIGTERM only note that the run should stop after its step."""
    received: list[int] = []
    previous = {}
    with suppress(ValueError):  # signals belong to the main thread; elsewhere nobody can send them
        for number in (signal.SIGINT, signal.SIGTERM):
            previous[number] = signal.signal(number, lambda signum, _: received.append(signum))
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
