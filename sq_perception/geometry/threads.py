"""Limits on the threads of this process: BLAS, torch and kernels on one thread, short turns of Python threads.

The matrices here are small.  After such small products BLAS threads spin on cores that fits of other objects, or other
programs, need.  The settings are those of the process; they are restored when the last block that needs them ends.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from typing import Any

from threadpoolctl import ThreadpoolController

_lock = threading.Lock()
_blocks: list[Any] = []  # what undoes the setting, once for each block that asks for one thread: the same for all
TURN = 0.001
"""Seconds after which a thread of Python lets another one go on.  A thread that returns from compiled code waits for
the interpreter: with Python's 5 ms, two threads recovered five bodies of a VGA frame in 53 ms, where one took 51; with
1 ms in 45, and with less as well."""
_turns: list[float] = []  # Python's own setting, once for each block that asks for short turns


@cache
def _libraries() -> ThreadpoolController:
    return ThreadpoolController()  # looking for them takes milliseconds


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Compute BLAS on the calling thread within the block, and while any other such block lasts."""
    with _lock:
        _blocks.append(_blocks[0] if _blocks else _libraries().limit(limits=1, user_api="blas"))
    try:
        yield
    finally:
        with _lock:
            setting = _blocks.pop()
            if not _blocks:
                setting.restore_original_limits()


def one_torch_thread() -> AbstractContextManager[None]:
    """Compute torch on the calling thread within the block: on busy cores the slowest thread sets the time."""
    import torch

    return _one_thread(torch)


def one_kernel_thread() -> AbstractContextManager[None]:
    """Compute parallel kernels on the calling thread within the block.

    For many small images beside other work: threads that wait for each other on busy cores take ten times as long.
    """
    import numba

    return _one_thread(numba)


@contextmanager
def _one_thread(library: Any) -> Iterator[None]:
    before = library.get_num_threads()
    library.set_num_threads(1)
    try:
        yield
    finally:
        library.set_num_threads(before)


@contextmanager
def short_turns() -> Iterator[None]:
    """Let Python threads switch every millisecond within the block, and while any other such block lasts."""
    with _lock:
        _turns.append(_turns[0] if _turns else sys.getswitchinterval())
        sys.setswitchinterval(min(TURN, _turns[0]))
    try:
        yield
    finally:
        with _lock:
            before = _turns.pop()
            if not _turns:
                sys.setswitchinterval(before)
