"""Garbage collection of a node: none while it starts, and afterwards none of what the start has made.

Python looks for cycles of unreachable objects whenever enough new ones exist, now and then among all that there are.
torch, numba and SciPy make 300 000 objects that live as long as the process.  While they are imported, 690 collections
find next to nothing and take 0.5 of 2.4 seconds; later each full collection takes 200 ms, in the middle of some frame.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def postponed() -> Iterator[None]:
    """No collection within the block; what exists at its end is never collected again, new objects are as ever.

    For the start of a process: what becomes unreachable within the block, or of its objects later, by a cycle stays.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if was_enabled:
            gc.enable()


def keep() -> None:
    """Collect once, and leave what is left alone from now on: it lives as long as the node is configured."""
    gc.collect()
    gc.freeze()


def release() -> None:
    """Collect everything that cannot be reached, what was left alone included; leave what is left alone again."""
    gc.unfreeze()
    keep()
