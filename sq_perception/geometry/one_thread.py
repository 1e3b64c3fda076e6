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

_lock = threading.Lock()
_blocks: list[Any] = []
"""For each block that wants one thread what undoes the setting: the same for all."""


@cache
def _libraries() -> ThreadpoolController:
    return ThreadpoolController()  # looking for them takes milliseconds


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Within the block, and as long as any other such block lasts, BLAS computes on the thread that calls it."""
    with _lock:
        _blocks.append(_blocks[0] if _blocks else _libraries().limit(limits=1, user_api="blas"))
    try:
        yield
    finally:
        with _lock:
            setting = _blocks.pop()
            if not _blocks:
                setting.restore_original_limits()


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
