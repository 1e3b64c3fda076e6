"""Frame nodes under test, closed at the end of each."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from frame_node_bench import Bench


@pytest.fixture
def make_bench() -> Iterator[Callable[..., Bench]]:
    from frame_node_bench import Bench  # needs rclpy; tests without it are skipped before they ask for this

    with ExitStack() as benches:
        yield lambda *arguments: benches.enter_context(Bench(*arguments))


@pytest.fixture
def bench(make_bench: Callable[..., Bench]) -> Bench:
    one = make_bench()
    one.send_info()
    return one
