"""What a configured node holds is not searched for garbage; its threads share heaps; a start that fails says why."""

import gc
import platform
import weakref
from typing import ClassVar

import pytest
from python_process import run_python

from sq_perception.nodes import process


class Ring:
    """Refers to itself: only a collection can free it."""

    def __init__(self) -> None:
        self.itself = self


def test_what_is_kept_is_not_looked_at_until_it_is_released():
    ring = Ring()
    ghost = weakref.ref(ring)
    process.keep_objects()
    del ring
    gc.collect()
    assert ghost() is not None
    process.release_objects()
    assert ghost() is None


def test_of_a_node_that_cannot_be_made_nothing_is_left():
    class Half:
        destroyed: ClassVar[list[str]] = []

        def __init__(self, name: str) -> None:
            self.name = name
            raise ValueError("depth_min, depth_max: expected depth_min < depth_max")

        def destroy_node(self) -> None:
            self.destroyed.append(self.name)

    with pytest.raises(ValueError, match="depth_min < depth_max"):
        process.make(Half, "recover_node")
    assert Half.destroyed == ["recover_node"]


HEAPS = """
import ctypes, threading
from sq_perception.nodes import process
{first}
together = threading.Barrier(8)
def work():
    kept = []
    for _ in range(20):
        together.wait()
        kept.append(bytearray(50_000))
threads = [threading.Thread(target=work) for _ in range(8)]
for one in threads: one.start()
for one in threads: one.join()
c = ctypes.CDLL(None)
c.fdopen.restype = ctypes.c_void_p
out = ctypes.c_void_p(c.fdopen(1, b"w"))
c.malloc_info(0, out)
c.fflush(out)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other libraries have other heaps")
def test_threads_share_heaps():
    def heaps(first: str) -> int:
        return run_python("-c", HEAPS.format(first=first)).stdout.count("<heap nr=")

    assert heaps("") > 2
    assert heaps("process.share_heaps()") == 2
