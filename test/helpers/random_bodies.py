"""Columns of the cloud of superquadrics, of random content."""

import numpy as np

from sq_msgs_py.superquadrics import SuperquadricArray


def random_bodies(count: int, rng: np.random.Generator) -> SuperquadricArray:
    """Bodies of which every column is different; half of the deviations of their sizes are unknown."""
    rotation = rng.normal(size=(count, 4))
    return SuperquadricArray(
        size=rng.uniform(0.02, 0.3, (count, 3)), shape=rng.uniform(0.1, 1.0, (count, 2)),
        translation=rng.normal(size=(count, 3)), rotation=rotation / np.linalg.norm(rotation, axis=1, keepdims=True),
        score=rng.random(count), residual=rng.random(count) * 1e-3,
        sigma_size=np.where(rng.random((count, 3)) < 0.5, np.nan, 1e-3), id=rng.integers(0, 2**32, count),
        status=np.arange(count) % 3, label=rng.integers(0, 2**16, count), seen=rng.integers(0, 1000, count),
        reason=rng.integers(0, 16, count), sigma_turn=rng.random((count, 3)), taper=rng.uniform(-0.5, 0.5, (count, 2)),
        objectness=rng.random(count), fused=np.arange(count) % 2, sigma_shape=rng.random((count, 2)),
        sigma_centre=rng.random((count, 3)),
    )
