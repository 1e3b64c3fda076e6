"""The room behind a table: things stay, the table ends behind them, and what stands there is behind the end."""

from __future__ import annotations

import numpy as np
import pytest

from sq_perception.simulation import room
from sq_perception.simulation.things_on_table import ThingsOnTable, things_on_table


@pytest.fixture(scope="module", params=range(4))
def pair(request: pytest.FixtureRequest) -> tuple[ThingsOnTable, np.ndarray]:
    rng = np.random.default_rng(request.param)
    scene = things_on_table(rng, 3)
    return scene, room.behind(scene, rng)


def test_things_and_the_table_before_them_stay(pair: tuple[ThingsOnTable, np.ndarray]) -> None:
    scene, depth = pair
    kept = scene.labels > 0
    assert (depth != scene.depth).any()
    np.testing.assert_array_equal(depth[kept], scene.depth[kept])
    nearest = scene.labels[-1] == 0
    np.testing.assert_array_equal(depth[-1, nearest], scene.depth[-1, nearest])


def test_beyond_the_edge_nothing_lies_on_the_table(pair: tuple[ThingsOnTable, np.ndarray]) -> None:
    """It is below the table's top, or, where it rises above, nearer than the table was."""
    scene, depth = pair
    v, u = np.nonzero((depth != scene.depth) & np.isfinite(depth))
    height = scene.camera.unproject(u, v, depth[v, u]) @ scene.plane[:3] + scene.plane[3]
    farther = depth[v, u] > scene.depth[v, u]
    assert (height[farther] < 0).all()
    assert (height[~farther] > 0).all()
