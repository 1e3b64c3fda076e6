"""All of a run that changes, in one file: weights, their average, the optimiser's moments, schedule, step and time.

Beside it lies the run's log, a line of JSON at each validation.

A state is written beside the old one and takes its place at once, so that a run killed at any moment finds the last
whole state again.  Like every file of weights it is safetensors and can carry no code.
"""

from __future__ import annotations

import copy
import json
import math
import textwrap
from dataclasses import astuple, dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from safetensors.torch import save as bytes_of
from torch import nn
from torch.optim.swa_utils import update_bn

from sq_perception.files import output_file, provenance
from sq_perception.learning.checkpoint import CheckpointError
from sq_perception.learning.training_config import Plateau

Network = TypeVar("Network", bound=nn.Module)
SETTINGS = "training"
"""Name, in the header of the file, of what a run is made of."""
_CLIP = 1.0
"""Largest norm of the gradient."""
_LONGEST = 240
"""Characters of a reason."""


def mixed_precision(device: str, wanted: bool) -> torch.autocast:
    """Within it a network computes in bfloat16, where that is wanted and the device has such products.

    A processor without them takes 16 times as long for a step in bfloat16 as in float32; one with them is twice
    as fast.
    """
    has_products = device != "cpu" or bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())
    return torch.autocast(device, torch.bfloat16, enabled=wanted and has_products)


def provenance_of(command: str, device: torch.device) -> dict[str, Any]:
    """Where the weights of a run come from, the graphics card among it: :func:`provenance.facts`."""
    facts = provenance.facts(f"sq-perception {command}")
    return facts if device.type == "cpu" else {**facts, "device": torch.cuda.get_device_name(device)}


@dataclass(eq=False)
class TrainingState(Generic[Network]):
    """What a training holds between two steps; goes on from the file where there is one.

    Raises
    ------
    CheckpointError
        If the file is damaged, or of a run with another network.
    """

    path: Path
    model: Network
    optimizer: torch.optim.Optimizer
    settings: str = ""
    """What the run is made of, JSON; empty where that is not to be compared when it goes on."""
    average: Network = field(init=False)
    plateau: Plateau = field(default_factory=Plateau)
    step: int = 0
    """Steps done."""
    seconds: float = 0.0
    """Time spent, in all parts of the run."""
    best: float = -math.inf
    """Best validation so far."""
    held: list[str] = field(default_factory=list)
    """Names of the files of views that are kept for validation, where a run has such."""

    def __post_init__(self) -> None:
        self.average = copy.deepcopy(self.model)
        if self.path.exists():
            self._restore()

    def save(self) -> None:
        """Write everything to the file."""
        tensors = {
            "step": torch.tensor(self.step),
            "seconds": torch.tensor(self.seconds, dtype=torch.float64),
            "best": torch.tensor(self.best, dtype=torch.float64),
            "held": torch.tensor([*"\n".join(self.held).encode()], dtype=torch.uint8),
            "schedule": torch.tensor(astuple(self.plateau), dtype=torch.float64),
        }
        for prefix, network in (("model", self.model), ("average", self.average)):
            tensors.update({f"{prefix}.{k}": v.contiguous() for k, v in network.state_dict().items()})
        for index, slots in self.optimizer.state_dict()["state"].items():
            tensors.update({f"optimizer.{index}.{k}": torch.as_tensor(v).contiguous() for k, v in slots.items()})
        header = {SETTINGS: self.settings} if self.settings else None
        output_file.write(self.path, bytes_of(tensors, header))

    def _restore(self) -> None:
        try:
            tensors = load_file(str(self.path), device=str(next(self.model.parameters()).device))
            for prefix, network in (("model.", self.model), ("average.", self.average)):
                own = {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
                network.load_state_dict(own)
            state, parameters = self.optimizer.state_dict(), list(self.model.parameters())
            for key, value in tensors.items():
                if key.startswith("optimizer."):
                    _, index, slot = key.split(".")
                    if value.ndim and value.shape != parameters[int(index)].shape:  # the optimizer would not say so
                        raise ValueError(
                            f"{key}: expected shape {[*parameters[int(index)].shape]}, got {[*value.shape]}"
                        )
                    state["state"].setdefault(int(index), {})[slot] = value
            self.optimizer.load_state_dict(state)
            best, without_progress, reductions = tensors["schedule"].tolist() or astuple(Plateau())
            self.plateau = Plateau(best, int(without_progress), int(reductions))
            self.step, self.seconds = int(tensors["step"]), float(tensors["seconds"])
            self.best = float(tensors["best"])
            if "held" in tensors:  # not in the states of 0.2.0
                self.held = bytes(tensors["held"].tolist()).decode().splitlines()
        except (SafetensorError, OSError, KeyError, IndexError, RuntimeError, ValueError) as error:
            reason = textwrap.shorten(str(error), _LONGEST)  # of another network's weights every one is named
            raise CheckpointError(f"{self.path}: not the state of such a run: {reason}") from error

    def log(self, record: dict[str, Any]) -> None:
        """Add the numbers of a validation, by name, to the ``log.jsonl`` beside the file."""
        with self.path.with_name("log.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(record) + "\n")

    def descend(self, loss: torch.Tensor, rate: float, keep: float) -> None:
        """Make a step down the gradient of a loss at this rate, and let the averaged weights follow.

        Early in a run they keep less than ``keep`` of themselves.

        Raises
        ------
        ArithmeticError
            If the loss or its gradient is not finite; the weights are left as they are.
        """
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.model.parameters(), _CLIP)
        if not torch.isfinite(loss) & torch.isfinite(norm):
            raise ArithmeticError(
                f"step {self.step}: loss {loss.item():.4g}, norm of the gradient {norm.item():.4g}; "
                f"{self.path if self.path.exists() else 'no state'} is the last good one. "
                "A smaller learning rate may help."
            )
        self.optimizer.step()
        keep = min(keep, (self.step + 1) / (self.step + 10))
        with torch.no_grad():
            for mine, theirs in zip(self.average.state_dict().values(), self.model.state_dict().values(), strict=True):
                if mine.is_floating_point():
                    mine.lerp_(theirs, 1 - keep)
                else:
                    mine.copy_(theirs)
        self.step += 1


def recalibrate(model: nn.Module, views: torch.Tensor, batch: int) -> None:
    """Measure the means and variances of all normalisations anew, on ``views`` (n, 1, p, p).

    An average of weights has activations of its own: those recorded while the moving weights trained do not fit it.
    """
    device = next(model.parameters()).device
    whole = views[: len(views) // batch * batch].split(batch)
    update_bn((part.to(device, memory_format=torch.channels_last) for part in whole), model)
