"""Settings of the process last as long as the last block that wants them."""

import sys

from threadpoolctl import threadpool_info

from sq_perception.geometry.threads import one_blas_thread, short_turns


def threads_of_blas() -> set[int]:
    return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}


def test_the_last_block_gives_blas_its_threads_back() -> None:
    before = threads_of_blas()
    first, second = one_blas_thread(), one_blas_thread()
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert threads_of_blas() == {1}
    second.__exit__(None, None, None)
    assert threads_of_blas() == before


def test_the_last_block_gives_python_its_turns_back() -> None:
    before = sys.getswitchinterval()
    first, second = short_turns(), short_turns()
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert sys.getswitchinterval() <= 0.001
    second.__exit__(None, None, None)
    assert sys.getswitchinterval() == before


def test_turns_that_are_shorter_already_stay() -> None:
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-4)
    try:
        with short_turns():
            assert sys.getswitchinterval() <= 1.1e-4
        assert sys.getswitchinterval() <= 1.1e-4
    finally:
        sys.setswitchinterval(before)
