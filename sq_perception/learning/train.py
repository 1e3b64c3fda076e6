"""Train the regressor on views drawn during the run, with one of :mod:`sq_perception.learning.losses`.

An unsupervised loss gets no labels.  The output folder holds what :mod:`sq_perception.learning.training` keeps,
last.safetensors (the newest validated network) and model.safetensors (the best one so far).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.optim.swa_utils import update_bn

from sq_perception.geometry.metrics import volume_iou
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.learning import checkpoint
from sq_perception.learning.dataset import POOL, Disturbance, ViewPool, ViewSource, any_occluder, draw_views
from sq_perception.learning.inference import check_device
from sq_perception.learning.losses import Objective
from sq_perception.learning.networks import Regressor, RegressorConfig
from sq_perception.learning.training import Stopped, Task, TrainingState, read_settings, run, threads
from sq_perception.learning.training_config import Plateau, TrainingConfig

__all__ = ["Stopped", "recalibrate", "train", "validate"]

_OF_A_RUN = ("loss", "backbone", "framing", "pixels", "canonical_labels", "optimizer")
"""Settings whose change makes another run; others may change when it goes on."""
_VALIDATED = ("pinhole_share", "noisy_share", "occluded_share", "validation")
"""Settings that decide what a network is validated on."""
_FORM = ("backbone", "framing", "pixels")  # settings that a network to begin with brings along


def train(
    config: TrainingConfig, output: Path, network: RegressorConfig | None = None,
    advance: Callable[[int, float], None] = lambda step, loss: None,
) -> Regressor:
    """Run, or continue, a training, of another form than that of ``config`` if given; returns the averaged network,
    also saved in ``output``.  ``advance`` gets the steps done and the last loss.

    Raises CheckpointError, ValueError for data or a network to begin with of another form or an absent device, and what
    :func:`run` raises.
    """
    device = torch.device(check_device(config.device))
    with threads(config.threads):
        output.mkdir(parents=True, exist_ok=True)
        torch.manual_seed(config.seed)
        model = _new_network(config, network).to(device)
        config = replace(config, **{name: getattr(model.config, name) for name in _FORM})
        if config.batch == 1 and model.config.pixels == model.config.stride:
            raise ValueError(
                f"batch: expected at least 2 with views of {model.config.pixels} pixels, of which one cell is left: "
                "one number has no deviation to normalise by"
            )
        before = read_settings(output / "state.safetensors")
        state = TrainingState.begin(model, config, output, _OF_A_RUN)
        if any(before.get(name, getattr(config, name)) != getattr(config, name) for name in _VALIDATED):
            state.best, state.plateau = -math.inf, Plateau()  # what was best was so of other views
        return run(state, config, _task(config, state, device), advance)


def _task(config: TrainingConfig, state: TrainingState, device: torch.device) -> Task:
    calibration = 2048  # views from which normalisations are measured anew
    form = state.model.config
    objective = Objective(config.loss, config.points, config.sharpness_start, config.sharpness_end, config.framing)
    seed = np.random.SeedSequence([config.seed, state.step])
    generator = torch.Generator(device=device).manual_seed(int(seed.generate_state(1)[0]))
    disturbance = Disturbance(config.occluded_share, config.noisy_share)
    source = ViewSource(form.pixels, config.pinhole_share, config.wide_share, disturbance, form.framing)
    # A short run holds no more views than it takes.
    taken = max(config.steps * config.batch, calibration if config.average > 0 else 0)
    pool = ViewPool(np.random.default_rng(seed), source, min(POOL, taken), config.reuse)
    sets = _validation_sets(config, form)

    def batch() -> tuple[tuple[torch.Tensor], Superquadric | None]:
        images, bodies = pool.batch(config.batch)
        views = torch.from_numpy(images)[:, None].to(device)
        if not objective.needs_labels:
            return (views,), None
        labels = bodies.canonical_form() if config.canonical_labels else bodies
        return (views,), Superquadric.from_flat(torch.from_numpy(labels.to_flat()).float().to(device))

    def loss(
        predicted: Superquadric, views: tuple[torch.Tensor, ...], truth: Superquadric | None, progress: float
    ) -> torch.Tensor:
        return objective.loss(predicted, views[0], truth, progress, generator).mean()

    def validate_sets(network: Regressor) -> dict[str, float]:
        if config.average > 0:
            views, _ = pool.batch(max(calibration, config.batch))
            recalibrate(network, torch.from_numpy(views)[:, None], max(config.batch, 32))
        found = {}
        for name, (views, truth) in sets.items():
            iou = validate(network, views, truth, objective)
            found[name] = float(iou.mean())
            if name == "iou":
                found["iou_std"], found["over_85"] = float(iou.std()), float((iou > 0.85).mean())
        return found

    def score(figures: dict[str, Any]) -> tuple[float, float]:
        return float(np.mean([figures[name] for name in sets])), 1 - figures["iou"]

    return Task("train", "last", batch, loss, validate_sets, score=score)


def validate(
    model: Regressor, views: np.ndarray, truth: Superquadric, objective: Objective | None = None
) -> np.ndarray:
    """Volume IoU (n,) of the network's bodies, with what the ``objective`` gives of the truth, and the true ones."""
    flats = [model.predict(views[i : i + 250]).to_flat() for i in range(0, len(views), 250)]
    prediction = Superquadric.from_flat(np.concatenate(flats))
    return volume_iou(objective.with_given(prediction, truth) if objective else prediction, truth)


def recalibrate(model: Regressor, views: torch.Tensor, batch: int) -> None:
    """Measure the means and variances of all normalisations anew, on ``views`` (n, 1, p, p).  An average of weights has
    activations of its own: those recorded while the moving weights trained do not fit it."""
    device = next(model.parameters()).device
    whole = views[: len(views) // batch * batch].split(batch)
    update_bn((part.to(device, memory_format=torch.channels_last) for part in whole), model)


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
        # Share of each body that is hidden in the validation set ``hidden``.
        occluder = any_occluder(np.full(count, 0.3), rng)
        sets["iou_hidden"] = draw_views(count, rng, ViewSource(pixels, config.pinhole_share), occluder)
    if config.canonical_labels:  # what is given to the network counts as it was given in training
        return {name: (views, bodies.canonical_form()) for name, (views, bodies) in sets.items()}
    return sets
