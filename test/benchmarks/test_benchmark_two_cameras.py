"""The second camera of the benchmark sees the scene of the first one."""

import numpy as np
import two_cameras

from sq_perception.simulation.things_on_table import things_on_table


def test_the_things_rest_where_they_are():
    truth = things_on_table(np.random.default_rng([1, 2]), 3)
    there, (turn, position) = two_cameras.from_aside(truth, 60.0)
    for one, other in zip(truth.placed, there.placed, strict=True):
        back = other.parts.transformed(turn, position)
        np.testing.assert_allclose(back.translation, one.parts.translation, atol=1e-12)
        height = other.parts.translation @ there.plane[:3] + there.plane[3]
        np.testing.assert_allclose(height, one.parts.translation @ truth.plane[:3] + truth.plane[3], atol=1e-12)
    again, _ = two_cameras.from_aside(truth, 0.0)
    np.testing.assert_allclose(again.depth, truth.depth)
    np.testing.assert_array_equal(again.labels, truth.labels)
    assert np.isfinite(there.depth[there.labels > 0]).all()
