"""Quantiles of few numbers and of many."""

from __future__ import annotations

import numpy as np
import pytest

from sq_perception.geometry.quantiles import densest, quantile, select


@pytest.mark.parametrize("count", [1, 2, 7, 100])
def test_numpy_says_the_same(count: int, rng: np.random.Generator) -> None:
    numbers = rng.standard_normal(count)
    for share in (0.0, 0.02, 0.5, 0.9, 1.0):
        assert quantile(numbers, share) == pytest.approx(np.quantile(numbers, share), rel=1e-12)


@pytest.mark.parametrize("count", [1, 2, 101, 5000])
def test_counting_finds_what_sorting_does(count: int, rng: np.random.Generator) -> None:
    numbers = np.abs(rng.standard_normal(count)).astype(np.float32)
    for rank in (0, count // 2, count - 1):
        assert select(numbers, rank) == np.sort(numbers)[rank]


def test_the_densest_place_is_the_first_that_holds_most() -> None:
    assert densest(np.array([0.0, 0.5, 2.0, 2.1, 2.2, 3.0, 3.1, 3.2]), 0.25) == slice(2, 5)
    assert densest(np.array([]), 1.0) == slice(0)
