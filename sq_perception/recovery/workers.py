"""Frames recovered by several processes at a time, answered in their order.

Each process has a Recoverer of its own, of one thread.  A few frames a process are under way, so that none waits while
results are written, and that no more are read than that.  Where a process dies, killed or out of memory, new ones
begin.  What had no answer then is asked again when its turn comes, so that a frame at which processes die takes no
other with it; it is given up after some tries.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias, TypeVar

import numpy as np

from sq_perception.imaging.camera import Camera
from sq_perception.recovery.options import RecoveryOptions
from sq_perception.recovery.recovery import FrameRecovery

if TYPE_CHECKING:
    from sq_perception.recovery.recoverer import Recoverer

AHEAD = 3
"""Frames under way for each process: the one it works on, one that waits for it, one whose answer waits."""
TRIES = 3
"""Deaths of its process after which a frame is given up: one may be an operator's, or another frame's memory."""

_Key = TypeVar("_Key")
_Answer: TypeAlias = "Future[FrameRecovery | None]"


@dataclass(frozen=True, eq=False)
class Work:
    """What :meth:`Recoverer.recover` is called with: shapes and units are given there."""

    depth: np.ndarray
    camera: Camera
    labels: np.ndarray | None
    options: RecoveryOptions


@dataclass(frozen=True)
class Setup:
    """What each process makes its Recoverer from."""

    model: Path | str | None
    options: RecoveryOptions
    consensus: bool


class WorkerLostError(RuntimeError):
    """The processes that worked on a frame died, again and again."""


def recovered(
    frames: Iterable[tuple[_Key, Work | None]], setup: Setup, jobs: int
) -> Iterator[tuple[_Key, FrameRecovery | Exception | None]]:
    """In the order of the frames, the recovery of each or what it raised, None for no work.

    An answer may be a :class:`WorkerLostError`.
    """
    processes = _Processes(setup, jobs)
    asked: deque[tuple[_Key, Work | None, _Answer]] = deque()

    def first() -> tuple[_Key, FrameRecovery | Exception | None]:
        key, work, answer = asked.popleft()
        for _ in range(TRIES):
            try:
                return key, answer.result()
            except BrokenProcessPool:
                answer = processes.ask(work)
            except Exception as error:  # whatever it raised there is for the one that asked
                return key, error
        return key, WorkerLostError(f"the process that recovered it died, {TRIES} times")

    try:
        for key, work in frames:
            asked.append((key, work, processes.ask(work)))
            while asked and (len(asked) >= AHEAD * jobs or asked[0][2].done()):
                yield first()
        while asked:
            yield first()
    finally:
        processes.end()


class _Processes:
    """A pool that is made anew where it broke."""

    def __init__(self, setup: Setup, jobs: int) -> None:
        self._setup, self._jobs = setup, jobs
        self._pool = _pool(setup, jobs)

    def ask(self, work: Work | None) -> _Answer:
        if work is None:
            answer: _Answer = Future()
            answer.set_result(None)
            return answer
        try:
            return self._pool.submit(_recover, self._setup, work)
        except BrokenProcessPool:
            self.end()
            self._pool = _pool(self._setup, self._jobs)
            return self._pool.submit(_recover, self._setup, work)

    def end(self) -> None:
        self._pool.shutdown(wait=False, cancel_futures=True)


def _pool(setup: Setup, jobs: int) -> ProcessPoolExecutor:
    # Not forked: a process that has threads of torch, OpenMP and numba cannot be copied.
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(jobs, context, initializer=_begin, initargs=(setup,))


def _begin(setup: Setup) -> None:
    """Of a new process; Ctrl-C is for the one that asks."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _recoverer(setup)


@cache
def _recoverer(setup: Setup) -> Recoverer:
    import torch

    from sq_perception.recovery.recoverer import Recoverer

    torch.set_num_threads(1)
    return Recoverer(setup.model, method=setup.options.method, consensus=setup.consensus, threads=1)


def _recover(setup: Setup, work: Work) -> FrameRecovery | None:
    return _recoverer(setup).recover(work.depth, work.camera, work.labels, work.options)
