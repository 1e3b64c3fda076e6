"""Things in and on furniture: what is seen of them stays, all else is none of them, but for a carton."""

from __future__ import annotations

import numpy as np
import pytest

from sq_perception.simulation.furniture import KINDS, things_in_furniture
from sq_perception.simulation.things_on_table import TABLE_CAMERA, ThingsOnTable

LOWER = ("carton", "stool", "shelf board", "shelves")
"""Below whose things there is a floor."""
WALLED = {"tray": (0.015, 0.05), "bin": (0.08, 0.3)}
"""Heights of their walls, metres."""


@pytest.fixture(scope="module", params=KINDS)
def scene(request: pytest.FixtureRequest) -> tuple[str, ThingsOnTable]:
    return request.param, things_in_furniture(request.param, np.random.default_rng(3))


def heights(scene: ThingsOnTable, mask: np.ndarray) -> np.ndarray:
    """Above the plane that things stand on, of what some pixels show."""
    rows, columns = np.nonzero(mask & np.isfinite(scene.depth))
    points = scene.camera.unproject(columns, rows, scene.depth[rows, columns])
    return np.asarray(points @ scene.plane[:3] + scene.plane[3])


def is_placed(scene: ThingsOnTable) -> np.ndarray:
    """Where things are that were placed: all labels but a carton's."""
    return np.isin(scene.labels, [placed.label for placed in scene.placed])


def test_things_stand_on_the_plane(scene: tuple[str, ThingsOnTable]) -> None:
    _, seen = scene
    assert heights(seen, is_placed(seen)).min() > -1e-6
    for placed in seen.placed:
        assert placed.pixels == np.count_nonzero(seen.labels == placed.label) > 0
        down = placed.parts.support(-seen.plane[None, :3])[:, 0]
        lowest = placed.parts.translation @ seen.plane[:3] - down + seen.plane[3]
        assert lowest.min() > -1e-6


def test_what_is_no_thing_is_furniture_floor_or_wall(scene: tuple[str, ThingsOnTable]) -> None:
    name, seen = scene
    around = heights(seen, ~is_placed(seen) & (seen.depth < seen.wall - 1e-9))
    assert np.mean(np.abs(around) < 1e-3) > 0.01  # the plane itself is in sight
    if name in LOWER:
        assert around.min() < -0.05
    if name in WALLED:
        least, most = WALLED[name]
        assert around.min() > -1e-3
        assert least - 1e-6 < around.max() < most + 1e-6


def test_a_carton_is_a_thing_and_other_furniture_is_none(scene: tuple[str, ThingsOnTable]) -> None:
    name, seen = scene
    other = (seen.labels > 0) & ~is_placed(seen)
    assert other.any() == (name == "carton")
    if name == "carton":
        assert len(np.unique(seen.labels[other])) == 1
        inside = heights(seen, other)
        assert inside.max() < 1e-6  # up to the plane that things stand on, from the floor
        floor = heights(seen, (seen.labels == 0) & (seen.depth < seen.wall - 1e-9))
        assert inside.min() > floor.max() - 1e-6


def test_a_seed_gives_one_scene_before_any_camera() -> None:
    small = TABLE_CAMERA.cropped(80, 60, 480, 360)
    first, second = (things_in_furniture("bin", np.random.default_rng(9), small) for _ in range(2))
    assert first.depth.shape == (360, 480)
    np.testing.assert_array_equal(first.depth, second.depth)
    np.testing.assert_array_equal(first.labels, second.labels)
