"""The loop that trains every network: take a batch, predict, compare, step; now and then validate and keep.

What differs between networks is a :class:`Task`: :mod:`sq_perception.learning.train` has that of the regressor,
:mod:`sq_perception.learning.shard_training` those of the networks of things and masks.  Gradients are clipped; an
exponential average of the weights is what is validated and kept.

Everything that changes lies in ``state.safetensors``, written beside the old one and exchanged at once, so that a run
that was stopped or killed goes on where it was when the same command is given again.  Beside it lies ``log.jsonl``, a
line of JSON at each validation.
"""

from __future__ import annotations

import copy
import json
import math
import signal
import textwrap
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, astuple, dataclass, field
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from safetensors.torch import save as bytes_of

from sq_perception.files import output_file, provenance
from sq_perception.learning import checkpoint
from sq_perception.learning.checkpoint import CheckpointError
from sq_perception.learning.training_config import Plateau, Run


class Stopped(Exception):  # noqa: N818 - nothing is wrong
    """A run that was asked to stop; its state is saved."""


@dataclass(frozen=True)
class Task:
    """What is particular to the training of one network."""

    command: str  # the command that runs it
    newest: str  # name of the file of weights that each validation replaces
    batch: Callable[[], tuple[tuple[torch.Tensor, ...], Any]]
    """What the network takes of a batch, and the truth about it, on the run's device."""
    loss: Callable[[Any, tuple[torch.Tensor, ...], Any, float], torch.Tensor]
    """Loss of the network's output for what it took, the truth, and the share of the run that is done."""
    validate: Callable[[Any], dict[str, Any]]  # figures of a network on views that it is not trained on
    finish: Callable[[Any], None] = lambda network: None  # changes a network when its training ends
    score: Callable[[dict[str, Any]], tuple[float, float]] | None = None
    """What of the figures the best network, kept as model.safetensors, has most of, and the loss of a plateau."""


@dataclass(eq=False)
class TrainingState:
    """What a training holds between two steps; goes on from the file where there is one.  Raises CheckpointError if the
    file is damaged, or of a run with another network."""

    path: Path
    model: Any
    optimizer: torch.optim.Optimizer
    settings: str = ""  # what the run is made of, JSON
    average: Any = field(init=False)
    plateau: Plateau = field(default_factory=Plateau)
    step: int = 0  # steps done
    seconds: float = 0.0  # time spent, in all parts of the run
    best: float = -math.inf  # best validation so far
    held: list[str] = field(default_factory=list)
    """Names of the files of views that are kept for validation, where a run has such."""

    def __post_init__(self) -> None:
        self.average = copy.deepcopy(self.model)
        if self.path.exists():
            self._restore()

    @classmethod
    def begin(cls, model: Any, config: Run, output: Path, form: tuple[str, ...] = ()) -> TrainingState:
        """The state of a new run of a network, or of the one that ``output`` holds.  Raises CheckpointError also where
        that one differs in a setting of ``form``."""
        path, device = output / "state.safetensors", next(model.parameters()).device
        before = read_settings(path)
        other = [name for name in form if before.get(name, getattr(config, name)) != getattr(config, name)]
        if other:
            differences = ", ".join(f"{name} {before[name]!r}, not {getattr(config, name)!r}" for name in other)
            raise CheckpointError(
                f"{output}: holds a run with {differences}: expected another --output, or the same settings"
            )
        # Torch 2.13 writes beyond its memory with fewer channels that lie last where a processor has no AVX-512.
        layout = torch.channels_last if model.config.widths[0] >= 8 else torch.contiguous_format
        model.to(device, memory_format=layout)
        is_adam = config.optimizer == "adam"
        kind = torch.optim.Adam if is_adam else torch.optim.AdamW
        decay = 0.0 if is_adam else config.weight_decay
        optimizer = kind(model.parameters(), config.learning_rate, weight_decay=decay)
        return cls(path, model, optimizer, json.dumps(asdict(config)))

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
        output_file.write(self.path, bytes_of(tensors, {"training": self.settings or "{}"}))

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
            reason = textwrap.shorten(str(error), 240)  # of another network's weights every one is named
            raise CheckpointError(f"{self.path}: not the state of such a run: {reason}") from error

    def descend(self, loss: torch.Tensor, rate: float, keep: float) -> None:
        """Make a step down the gradient of a loss at this rate; averaged weights keep ``keep`` of themselves, less
        early in a run.  Raises ArithmeticError if the loss or its gradient is not finite; the weights are then as they
        were."""
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        # Largest norm of the gradient.
        norm = torch.nn.utils.clip_grad_norm_(self.model.parameters(), 1.0)
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


def read_settings(state: Path) -> dict[str, Any]:
    """What the run of a state was made of, empty where that is not known; CheckpointError where it is not readable."""
    try:
        return dict(json.loads(checkpoint.read_header(state).get("training", "{}")))
    except CheckpointError:  # there is none yet, and a damaged one is refused where it is read
        return {}
    except (ValueError, TypeError) as error:
        raise CheckpointError(f"{state}: its header does not tell what run it is of: {error}") from error


def run(
    state: TrainingState, config: Run, task: Task, advance: Callable[[int, float], None] = lambda step, loss: None
) -> Any:
    """Run a training to its end; returns the averaged network, which the folder of the state keeps.  Raises
    ArithmeticError when loss or gradient are not finite, Stopped after SIGINT or SIGTERM, when the state is saved."""
    device, losses, rate = next(state.model.parameters()).device, list[float](), 0.0
    began = saved = time.monotonic()
    began -= state.seconds
    validated = None

    def validate() -> None:
        nonlocal validated
        validated = state.step
        record = {"step": state.step, "seconds": state.seconds, "rate": rate}
        if losses:
            record["loss"] = float(np.mean(losses))
        losses.clear()
        record.update(task.validate(state.average))
        _keep(state, config, task, record)

    with _stop_requests() as stop_requested:
        while (progress := config.progress(state.step, state.seconds, state.plateau)) < 1:
            rate = config.rate(state.step, progress, state.plateau)
            views, truth = task.batch()
            state.model.train()
            with mixed_precision(device.type, config.bfloat16):
                predicted = state.model(*views)
            loss = task.loss(predicted, views, truth, progress)
            state.descend(loss, rate, config.average)
            losses.append(loss.item())
            advance(state.step, losses[-1])
            state.seconds = time.monotonic() - began
            if config.progress(state.step, state.seconds, state.plateau) >= 1:
                break
            if state.step % config.validation == 0:
                validate()
            # Longest time between two saved states.
            if stop_requested() or time.monotonic() - saved > 300.0:
                state.save()
                saved = time.monotonic()
            if stop_requested():
                raise Stopped(f"stopped after step {state.step}; the same command goes on from {state.path}")
    task.finish(state.average)
    if validated != state.step:
        validate()
    return state.average.eval()


def _keep(state: TrainingState, config: Run, task: Task, record: dict[str, Any]) -> None:
    """Log the figures of a validation; save the averaged network, as the best one too where none was better."""
    print(json.dumps(record), flush=True)
    with state.path.with_name("log.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps(record) + "\n")
    names = [task.newest]
    if task.score is not None:
        score, loss = task.score(record)
        state.plateau.record(loss)
        if score >= state.best:
            state.best = score
            names.append("model")
    device = next(state.model.parameters()).device
    made = provenance.facts(f"sq-perception {task.command}")
    if device.type != "cpu":
        made["device"] = torch.cuda.get_device_name(device)
    notes = {"training": {**asdict(config), "start": Path(config.start).name}, "made": made, "metrics": record}
    for name in names:
        checkpoint.save(state.path.with_name(f"{name}.safetensors"), state.average, notes)
    state.save()


def mixed_precision(device: str, wanted: bool) -> torch.autocast:
    """Within it a network computes in bfloat16, where that is wanted and the device has such products."""
    has_products = device != "cpu" or bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())
    return torch.autocast(device, torch.bfloat16, enabled=wanted and has_products)


@contextmanager
def threads(count: int) -> Iterator[None]:
    """So many threads for a network and for the rendering of its views; 0 leaves both their own choice.  Each has a
    pool of its own, whose threads wait by spinning: beside other work a second one makes both much slower."""
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
