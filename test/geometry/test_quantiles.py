"""Quantiles of few numbers."""

from __future__ import annotations

import numpy as np
import pytest

from sq_perception.geometry.quantiles import quantile


@pytest.mark.parametrize("count", [1, 2, 7, 100])
def test_numpy_says_the_same(count: int, rng: np.random.Generator) -> None:
    numbers = rng.standard_normal(count)
    for share in (0.0, 0.02, 0.5, 0.9, 1.0):
        assert quantile(numbers, share) == pytest.approx(np.quantile(numbers, share), rel=1e-12)
