"""Scenes of household things: what touches, what carries, what is seen."""

import numpy as np
import pytest

from sq_perception.geometry.union import DIRECTIONS, support_of_union
from sq_perception.imaging.camera import Camera
from sq_perception.simulation import things_on_table as module
from sq_perception.simulation.things_on_table import ThingsOnTable, things_on_table

SMALL = Camera(160, 120, 138.6, 138.6, 79.5, 59.5)


@pytest.fixture(scope="module")
def scenes() -> list[ThingsOnTable]:
    return [things_on_table(np.random.default_rng([5, seed]), 5, SMALL) for seed in range(12)]


def test_things_rest_on_the_table_or_on_each_other(scenes: list[ThingsOnTable]) -> None:
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


def test_things_do_not_penetrate(scenes: list[ThingsOnTable]) -> None:
    """No point of one hull's parts is inside of another thing's parts."""
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
