"""The processes of one training: a single one, or several that torchrun started, each with its own device and views.

    torchrun --nproc-per-node 4 -m sq_perception train --device cuda ...

Every process draws its own views; gradients are averaged, so that a step sees batch x processes views.  The first
process alone validates, writes and speaks.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import distributed, nn
from torch.nn.parallel import DistributedDataParallel


@dataclass(frozen=True)
class Processes:
    """This process among its like."""

    rank: int
    count: int
    device: torch.device

    @property
    def is_first(self) -> bool:
        return self.rank == 0

    def wrapped(self, model: nn.Module) -> nn.Module:
        """The model, or one whose backward pass averages gradients over all processes."""
        if self.count == 1:
            return model
        return DistributedDataParallel(model, device_ids=[self.device.index] if self.device.type == "cuda" else None)

    def any(self, here: bool) -> bool:
        """Whether something is true in any process; every process has to ask."""
        if self.count == 1:
            return here
        flag = torch.tensor(float(here), device=self.device)
        distributed.all_reduce(flag, distributed.ReduceOp.MAX)
        return bool(flag.item() > 0)

    def from_first(self, value: float) -> float:
        """The first process's value; every process has to ask."""
        if self.count == 1:
            return value
        shared = torch.tensor(value, dtype=torch.float64, device=self.device)
        distributed.broadcast(shared, 0)
        return float(shared.item())


@contextmanager
def joined(device: str) -> Iterator[Processes]:
    """Join the processes that torchrun announces in the environment; without it there is this one.

    Raises
    ------
    ValueError
        For a device that this machine does not have.
    """
    count, rank = int(os.environ.get("WORLD_SIZE", "1")), int(os.environ.get("RANK", "0"))
    try:
        own = torch.device(device)
    except RuntimeError as error:
        raise ValueError(f"device: {error}") from error
    if own.type == "cuda":
        if not torch.cuda.is_available():
            raise ValueError(f"device: {device!r} was asked for, but torch sees no CUDA device here")
        if count > 1:
            own = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
            torch.cuda.set_device(own)
    if count == 1:
        yield Processes(0, 1, own)
        return
    distributed.init_process_group("nccl" if own.type == "cuda" else "gloo")
    try:
        yield Processes(rank, count, own)
    finally:
        distributed.destroy_process_group()
