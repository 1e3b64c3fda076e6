"""BLAS and torch on one thread, wherever in the process it is asked for.

The matrices here are small.  Threads of a BLAS spin after products as small as these, on the cores that fits of other
objects, or other programs, want.  The setting is the process'; it is taken back when the last block that wants it ends.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

from threadpoolctl import ThreadpoolController


class _Limit:
    """How many blocks want one thread, and what undoes the setting."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._blocks = 0
        self._undone: Any = None

    def begin(self) -> None:
        with self._lock:
            if not self._blocks:
                self._undone = _libraries().limit(limits=1, user_api="blas")
            self._blocks += 1

    def end(self) -> None:
        with self._lock:
            self._blocks -= 1
            if not self._blocks:
                self._undone.restore_original_limits()


_limit = _Limit()


@cache
def _libraries() -> ThreadpoolController:
    return ThreadpoolController()  # looking for them takes milliseconds


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Within the block, and as long as any other such block lasts, BLAS computes on the thread that calls it."""
    _limit.begin()
    try:
        yield
    finally:
        _limit.end()


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Within the block torch computes on the thread that calls it: on busy cores the slowest of many sets the time."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
