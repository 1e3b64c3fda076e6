"""Train the regressor on views drawn on the fly, with one of the losses of :mod:`sq_perception.learning.objective`.

One linear script: draw a batch, predict, compare, step.  AdamW under a one-cycle schedule (warm up, cosine down),
gradients clipped, an exponential average of the weights is what is validated and saved.  Everything that changes lives
in one state file, so that a killed run goes on where it stopped.  An unsupervised loss is handed no labels.

    sq-perception train --steps 20000 --output runs/compact
    sq-perception train --loss render --pixels 32 --steps 12000 --output runs/render
"""

from __future__ import annotations

import argparse
import copy
import json
import math
import time
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file, save_file

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.learning import checkpoint
from sq_perception.learning.dataset import ViewPool, ViewSource, draw_views
from sq_perception.learning.disturbance import Disturbance, any_occluder
from sq_perception.learning.objective import LOSSES, Objective
from sq_perception.learning.regressor import Regressor, RegressorConfig
from sq_perception.metrics import volume_iou

CALIBRATION_VIEWS = 2048


@dataclass(frozen=True)
class TrainingConfig:
    """What a run is made of."""

    loss: str = "occupancy"
    """What is minimised, by its name in :mod:`sq_perception.learning.objective`."""
    pixels: int = 64
    """Side of the views, a multiple of 16."""
    largest: float = RegressorConfig().size_range[1]
    """Largest half size the network can express, in sides of the cube.  Bodies of the thesis' protocol reach 0.8."""
    canonical_labels: bool = False
    """List the axes of every label so that a1 >= a2; as drawn, their order is random."""
    steps: int = 20000
    batch: int = 128
    points: int = 256
    """Comparison points a body: half close around it, half in twice its box."""
    stride: int = 2
    """Losses of the view take every ``stride``-th row and column, from a random one on."""
    free_space: float = 4.0
    """Weight of the free space in least_squares_free."""
    root: bool = True
    """Whether least_squares_free is the root of its squares."""
    density: float = 2.0
    """Density n tau of the soft image in render, in units of s."""
    learning_rate: float = 1.5e-3
    weight_decay: float = 1e-2
    warm_up: int = 400
    sharpness_start: float = 0.0
    sharpness_end: float = 0.0
    """s, raised over the run: far basins first, fine fit last; 0 takes the loss's own values."""
    average: float = 0.999
    clip: float = 1.0
    pinhole_share: float = 0.0
    """Share of the views that a pinhole camera sees; the others are orthographic, as in the thesis."""
    wide_share: float = 0.0
    """Share of bodies with proportions up to 1 : 6; the others are those of the thesis' protocol."""
    occluded_share: float = 0.0
    """Share of the views with an occluder before the body."""
    most_hidden: float = 0.4
    """Largest share of a body that an occluder hides."""
    noisy_share: float = 0.0
    """Share of the views with noise, steps, holes and wrong edges."""
    reuse: int = 4
    """How often a rendered view is used."""
    start: str = ""
    """A model file whose weights the network begins with; empty begins at random."""
    validation: int = 1000
    """Bodies in the validation set, and steps between validations."""
    seed: int = 1
    bfloat16: bool = True
    threads: int = 0
    """CPU threads; 0 leaves torch's own choice."""
    device: str = "cpu"


def train(config: TrainingConfig, output: Path, network: RegressorConfig | None = None) -> Regressor:
    """Run, or continue, a training; returns the averaged network, also saved as ``output``/model.safetensors.

    Raises
    ------
    FloatingPointError
        When the loss is no longer finite; the last saved state stays as it was.
    """
    if config.threads:
        torch.set_num_threads(config.threads)
    objective = Objective(
        config.loss,
        config.points,
        config.sharpness_start,
        config.sharpness_end,
        config.stride,
        config.density,
        config.free_space,
        config.root,
    )
    output.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(config.seed)
    device = torch.device(config.device)
    if network is None:
        network = RegressorConfig(pixels=config.pixels, size_range=(RegressorConfig().size_range[0], config.largest))
    model = (checkpoint.load(config.start) if config.start else Regressor(network)).to(device)
    model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    average = copy.deepcopy(model)
    optimizer = torch.optim.AdamW(model.parameters(), config.learning_rate, weight_decay=config.weight_decay)
    state_path = output / "state.safetensors"
    first, spent = _restore(state_path, model, average, optimizer) if state_path.exists() else (0, 0.0)
    rng = np.random.default_rng([config.seed, first])
    generator = torch.Generator(device=device).manual_seed(config.seed + first)
    pixels = model.config.pixels
    disturbance = Disturbance(config.occluded_share, config.most_hidden, config.noisy_share)
    source = ViewSource(pixels, config.pinhole_share, config.wide_share, disturbance)
    pool = ViewPool(rng, source, reuse=config.reuse)
    validation = draw_views(config.validation, np.random.default_rng(0), ViewSource(pixels))
    near = draw_views(config.validation, np.random.default_rng(0), ViewSource(pixels, 1.0))
    hidden_rng = np.random.default_rng(0)
    hidden = draw_views(
        config.validation, hidden_rng, ViewSource(pixels), any_occluder(np.full(config.validation, 0.3), hidden_rng)
    )
    worn = (Disturbance(0, 0, 1.0).worn(near[0], np.random.default_rng(0)), near[1])
    log = (output / "log.jsonl").open("a", encoding="utf-8")
    started, losses = time.monotonic() - spent, []
    for step in range(first, config.steps):
        progress = step / config.steps
        rate = config.learning_rate * min(1.0, (step + 1) / config.warm_up) * 0.5 * (1 + math.cos(math.pi * progress))
        for group in optimizer.param_groups:
            group["lr"] = rate
        images, bodies = pool.batch(config.batch)
        views = torch.from_numpy(images)[:, None].to(device, memory_format=torch.channels_last)
        truth = None
        if objective.needs_labels:
            labels = bodies.canonical_form() if config.canonical_labels else bodies
            truth = Superquadric.from_flat(torch.from_numpy(labels.to_flat()).float().to(device))
        model.train()
        with torch.autocast(device.type, torch.bfloat16, enabled=config.bfloat16):
            prediction = model(views)
        loss = objective.loss(prediction, views, truth, progress, generator).mean()
        if not bool(torch.isfinite(loss)):
            raise FloatingPointError(f"step {step}: the loss is {loss.item()}; {state_path} holds the last good state")
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), config.clip)
        optimizer.step()
        _update_average(average, model, min(config.average, (step + 1) / (step + 10)))
        losses.append(loss.item())
        done = step + 1
        if done % config.validation == 0 or done == config.steps:
            recalibrate(average, pool.batch(CALIBRATION_VIEWS)[0], config.batch)
            iou = validate(average, *validation, objective=objective)
            record = {
                "step": done,
                "loss": float(np.mean(losses)),
                "iou": float(iou.mean()),
                "iou_std": float(iou.std()),
                "iou_pinhole": float(validate(average, *near, objective=objective).mean()),
                "iou_hidden": float(validate(average, *hidden, objective=objective).mean()),
                "iou_worn": float(validate(average, *worn, objective=objective).mean()),
                "over_85": float((iou > 0.85).mean()),
                "rate": rate,
                "sharpness": objective.sharpness(progress),
                "seconds": time.monotonic() - started,
            }
            print(json.dumps(record), flush=True)
            log.write(json.dumps(record) + "\n")
            log.flush()
            losses.clear()
            _store(state_path, done, record["seconds"], model, average, optimizer)
            checkpoint.save(output / "model.safetensors", average, {"training": asdict(config), "metrics": record})
    return average.eval()


def validate(
    model: Regressor, views: np.ndarray, truth: Superquadric, batch: int = 250, objective: Objective | None = None
) -> np.ndarray:
    """Volume IoU (n,) of the network's bodies with the true ones, both in the views' frames.

    With an ``objective`` for which some parameters are given, those are taken from the truth.
    """
    flats = [model.predict(views[i : i + batch]).to_flat() for i in range(0, len(views), batch)]
    prediction = Superquadric.from_flat(np.concatenate(flats))
    return volume_iou(objective.judged(prediction, truth) if objective else prediction, truth)


@torch.no_grad()
def recalibrate(model: Regressor, views: np.ndarray, batch: int) -> None:
    """Measure the means and variances of all normalisations anew, on ``views`` (n, p, p).

    An average of weights has activations of its own: those recorded while the moving weights trained do not fit it.
    """
    norms = [module for module in model.modules() if isinstance(module, torch.nn.BatchNorm2d)]
    momenta = [norm.momentum for norm in norms]
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None
    device = next(model.parameters()).device
    model.train()
    for i in range(0, len(views) - batch + 1, batch):
        model(torch.from_numpy(views[i : i + batch])[:, None].to(device, memory_format=torch.channels_last))
    model.eval()
    for norm, momentum in zip(norms, momenta, strict=True):
        norm.momentum = momentum


@torch.no_grad()
def _update_average(average: Regressor, model: Regressor, keep: float) -> None:
    for mine, theirs in zip(average.state_dict().values(), model.state_dict().values(), strict=True):
        if mine.is_floating_point():
            mine.lerp_(theirs, 1 - keep)
        else:
            mine.copy_(theirs)


def _store(
    path: Path, step: int, seconds: float, model: Regressor, average: Regressor, optimizer: torch.optim.AdamW
) -> None:
    tensors = {"step": torch.tensor(step), "seconds": torch.tensor(seconds)}
    tensors.update({f"model.{k}": v.contiguous() for k, v in model.state_dict().items()})
    tensors.update({f"average.{k}": v.contiguous() for k, v in average.state_dict().items()})
    for index, slots in optimizer.state_dict()["state"].items():
        tensors.update({f"optimizer.{index}.{k}": v.contiguous() for k, v in slots.items()})
    partial = path.with_suffix(".partial")
    save_file(tensors, str(partial))
    partial.replace(path)


def _restore(path: Path, model: Regressor, average: Regressor, optimizer: torch.optim.AdamW) -> tuple[int, float]:
    """Steps done and seconds spent by the run that is continued."""
    tensors = load_file(str(path), device=str(next(model.parameters()).device))
    for prefix, network in (("model.", model), ("average.", average)):
        network.load_state_dict({k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)})
    state = optimizer.state_dict()
    for key, value in tensors.items():
        if key.startswith("optimizer."):
            _, index, slot = key.split(".")
            state["state"].setdefault(int(index), {})[slot] = value
    optimizer.load_state_dict(state)
    return int(tensors["step"]), float(tensors.get("seconds", 0.0))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of ``sq-perception train``: one per field of TrainingConfig."""
    parser.add_argument("--output", type=Path, default=Path("runs/compact"), help="folder of state, log and model")
    for field in fields(TrainingConfig):
        name = "--" + field.name.replace("_", "-")
        if field.name == "loss":
            parser.add_argument(name, choices=LOSSES, default=field.default, help=f"default {field.default}")
        elif isinstance(field.default, bool):
            parser.add_argument(name, action=argparse.BooleanOptionalAction, default=field.default)
        else:
            parser.add_argument(name, type=type(field.default), default=field.default, help=f"default {field.default}")


def main(arguments: list[str] | None = None) -> int:
    """Entry of ``sq-perception train``."""
    parser = argparse.ArgumentParser(prog="sq-perception train", description=__doc__.split("\n\n")[0])
    add_arguments(parser)
    options = vars(parser.parse_args(arguments))
    output = options.pop("output")
    train(TrainingConfig(**options), output)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
