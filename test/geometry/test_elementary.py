"""Logarithms and powers in plain arithmetic, and quantiles, against NumPy and the mathematics library."""

import numba
import numpy as np
import pytest

from sq_perception.geometry.elementary import exp2, exp2_to_half, log2, log2_from_1_to_2
from sq_perception.geometry.quantiles import densest, quantile, select


@numba.vectorize
def vectorised_log2(x: float) -> float:
    return log2(x)


def test_log2_of_all_magnitudes_is_numpys_and_grows(rng: np.random.Generator) -> None:
    powers = 2.0 ** np.arange(-1022, 1024)
    x = np.concatenate([powers, rng.uniform(1.0, 2.0, 20000) * rng.choice(powers[:-1], 20000)])
    np.testing.assert_allclose(vectorised_log2(x), np.log2(x), rtol=1e-14, atol=3e-14)
    x = np.sort(rng.uniform(0.25, 8.0, 5000))
    x = x[np.concatenate([[True], np.diff(x) > 1e-9])]
    assert (np.diff(vectorised_log2(x)) > 0).all()


@pytest.mark.parametrize(
    ("function", "known", "numbers"),
    [
        (log2_from_1_to_2, np.log2, [1.0, 1.2, np.sqrt(2.0), 1.9, 2.0]),
        (exp2, np.exp2, [-1022.0, -115.3, -1.5, -0.5, 0.0, 0.5, 1.0, 33.25, 1023.0]),
        (exp2_to_half, np.exp2, [-0.5, -0.1, 0.0, 0.3, 0.5]),
    ],
)
def test_logarithms_and_powers_are_those_of_numpy(function, known, numbers) -> None:
    np.testing.assert_allclose([function(x) for x in numbers], known(numbers), rtol=1e-13, atol=3e-14)


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
