"""Things on a table, in and on furniture, and the room behind: what touches, what carries, what is seen of things."""

import numpy as np
import pytest

from sq_perception.geometry.union import DIRECTIONS, support_of_union
from sq_perception.imaging.camera import Camera
from sq_perception.simulation import furniture
from sq_perception.simulation import things_on_table as module
from sq_perception.simulation.furniture import KINDS, things_in_furniture
from sq_perception.simulation.things_on_table import TABLE_CAMERA, ThingsOnTable, things_on_table

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


def test_things_stand_on_the_plane_and_what_is_no_thing_is_furniture_floor_or_wall(scene) -> None:
    name, seen = scene
    assert heights(seen, is_placed(seen)).min() > -1e-6
    for placed in seen.placed:
        assert placed.pixels == np.count_nonzero(seen.labels == placed.label) > 0
        down = placed.parts.support(-seen.plane[None, :3])[:, 0]
        assert (placed.parts.translation @ seen.plane[:3] - down + seen.plane[3]).min() > -1e-6
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


def test_a_scene_is_that_of_its_camera() -> None:
    small = TABLE_CAMERA.cropped(80, 60, 480, 360)
    assert things_in_furniture("bin", np.random.default_rng(9), small).depth.shape == (360, 480)


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


def test_things_stay_before_the_room_behind_a_floor_below_and_the_wall_of_the_scene(pair) -> None:
    """The floor is level, 5 to 90 cm below: most readings, or many, share one height, which is the lowest."""
    scene, depth = pair
    np.testing.assert_array_equal(depth[scene.labels > 0], scene.depth[scene.labels > 0])
    away = scene.table[:, 1]
    v, u = np.nonzero(scene.labels)
    farthest = (scene.camera.unproject(u, v, scene.depth[v, u]) @ away).max()
    now, before = changed(pair)
    assert (now @ away).min() >= farthest + 0.03 - 1e-9
    assert (before @ away).min() >= farthest + 0.03 - 1e-9
    height = now @ scene.plane[:3] + scene.plane[3]
    floor = height.min()
    assert -0.9 <= floor <= -0.05
    assert np.mean(height < floor + 1e-6) > 0.1
    assert 1.8 <= scene.wall <= 3.5
    assert scene.depth[scene.labels == 0].max() <= scene.wall
    assert depth.max() <= scene.wall


SMALL = Camera(160, 120, 138.6, 138.6, 79.5, 59.5)


@pytest.fixture(scope="module")
def scenes() -> list[ThingsOnTable]:
    return [things_on_table(np.random.default_rng([5, seed]), 5, SMALL) for seed in range(12)]


def test_things_rest_on_the_table_or_on_each_other_and_do_not_penetrate(scenes: list[ThingsOnTable]) -> None:
    """No point of one hull's parts is inside of another thing's parts."""
    rests = [placed.rest for scene in scenes for placed in scene.placed]
    assert {"standing", "lying"} <= set(rests)
    assert any(rest.startswith("stacked") for rest in rests)
    for scene in scenes:
        normal, offset = scene.plane[:3], scene.plane[3]
        for placed in scene.placed:
            lowest = offset - support_of_union(placed.parts, -normal[None])[0]
            if placed.rest.startswith("stacked"):
                assert lowest > 0.005
            else:
                assert abs(lowest) < 1e-9
    rng = np.random.default_rng(1)
    for scene in scenes[:6]:
        surfaces = [placed.parts.sample_surface(300, rng, oversampling=2).reshape(-1, 3) for placed in scene.placed]
        for i, placed in enumerate(scene.placed):
            for j, points in enumerate(surfaces):
                if i != j:
                    assert placed.parts.gauge(points).min() > 1 - 1e-3


@pytest.mark.parametrize("how", ["beside", "leaning"])
def test_things_that_are_pushed_touch(monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    """Most hulls have another one within 3 mm; things of other heights touch only as seen from above."""
    monkeypatch.setattr(module, "_HOW", (how,))
    rng = np.random.default_rng(8)
    ways = rng.normal(size=(4000, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    near = count = 0
    for seed in range(12):
        first, *others = things_on_table(np.random.default_rng([6, seed]), 4, SMALL).placed
        known = [first]
        for placed in others:
            gaps = [
                -(support_of_union(placed.parts, ways) + support_of_union(other.parts, -ways)).min() for other in known
            ]
            known.append(placed)
            near += min(gaps) < 0.003
            count += 1
    assert near > 0.5 * count


def test_labels_are_those_of_things_in_the_image(scenes: list[ThingsOnTable]) -> None:
    for scene in scenes:
        assert scene.depth.shape == scene.labels.shape == (120, 160)
        for placed in scene.placed:
            mask = scene.labels == placed.label
            assert placed.pixels == mask.sum()
            rows, columns = np.nonzero(mask)
            points = SMALL.unproject(columns, rows, scene.depth[mask])
            if len(points):
                reach = support_of_union(placed.parts, DIRECTIONS)
                assert ((points @ DIRECTIONS.T).max(axis=0) < reach + 1e-6).all()


def test_misuse_is_told() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="expected 1 to 8 things, got 9"):
        things_on_table(rng, 9)
    with pytest.raises(ValueError, match="expected a pinhole camera"):
        things_on_table(rng, 2, Camera(64, 64, 64.0, 64.0, 31.5, 31.5, "orthographic"))
    with pytest.raises(ValueError, match="no room for 8 things"):
        things_on_table(rng, 8, Camera(16, 16, 400.0, 400.0, 7.5, 7.5))
