"""Settings of the process last as long as the last block that wants them."""

import sys

import pytest
from threadpoolctl import threadpool_info

from sq_perception.geometry.threads import one_blas_thread, short_turns


def threads_of_blas() -> set[int]:
    return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}


@pytest.mark.parametrize(
    ("block", "setting", "is_changed"),
    [
        (one_blas_thread, threads_of_blas, lambda threads: threads == {1}),
        (short_turns, sys.getswitchinterval, lambda interval: interval <= 0.001),
    ],
)
def test_the_last_block_gives_the_process_its_setting_back(block, setting, is_changed) -> None:
    before = setting()
    first, second = block(), block()
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert is_changed(setting())
    second.__exit__(None, None, None)
    assert setting() == before


def test_turns_that_are_shorter_already_stay() -> None:
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-4)
    try:
        with short_turns():
            assert sys.getswitchinterval() <= 1.1e-4
        assert sys.getswitchinterval() <= 1.1e-4
    finally:
        sys.setswitchinterval(before)
