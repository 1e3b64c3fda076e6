"""The room behind a table: things stay, the table ends behind them, and what stands there is behind the end."""

from __future__ import annotations

import numpy as np
import pytest

from sq_perception.simulation import furniture
from sq_perception.simulation.things_on_table import ThingsOnTable, things_on_table


@pytest.fixture(scope="module", params=(0, 1, 2, 5))  # where no wall hides the floor
def pair(request: pytest.FixtureRequest) -> tuple[ThingsOnTable, np.ndarray]:
    rng = np.random.default_rng(request.param)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(furniture, "_TURN", 0.0)  # the table ends across y of its own frame
        while True:  # until the image shows the room
            scene = things_on_table(rng, 3)
            depth = furniture.add_room(scene, rng)
            if (depth != scene.depth).mean() > 0.1:
                return scene, depth


def changed(pair: tuple[ThingsOnTable, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The readings (n, 3), optical frame, that are of the room, and what the scene had there."""
    scene, depth = pair
    v, u = np.nonzero(depth != scene.depth)
    assert v.size
    return scene.camera.unproject(u, v, depth[v, u]), scene.camera.unproject(u, v, scene.depth[v, u])


def test_things_stay(pair: tuple[ThingsOnTable, np.ndarray]) -> None:
    scene, depth = pair
    np.testing.assert_array_equal(depth[scene.labels > 0], scene.depth[scene.labels > 0])


def test_the_room_is_behind_the_things(pair: tuple[ThingsOnTable, np.ndarray]) -> None:
    scene, _ = pair
    away = scene.table[:, 1]
    v, u = np.nonzero(scene.labels)
    farthest = (scene.camera.unproject(u, v, scene.depth[v, u]) @ away).max()
    now, before = changed(pair)
    assert (now @ away).min() >= farthest + 0.03 - 1e-9
    assert (before @ away).min() >= farthest + 0.03 - 1e-9


def test_a_floor_lies_below_the_table(pair: tuple[ThingsOnTable, np.ndarray]) -> None:
    """Level, 5 to 90 cm below: most readings, or many, share one height, which is the lowest."""
    scene, _ = pair
    now, _ = changed(pair)
    height = now @ scene.plane[:3] + scene.plane[3]
    floor = height.min()
    assert -0.9 <= floor <= -0.05
    assert np.mean(height < floor + 1e-6) > 0.1


def test_the_wall_is_the_scenes(pair: tuple[ThingsOnTable, np.ndarray]) -> None:
    scene, depth = pair
    assert 1.8 <= scene.wall <= 3.5
    assert scene.depth[scene.labels == 0].max() <= scene.wall
    assert depth.max() <= scene.wall
