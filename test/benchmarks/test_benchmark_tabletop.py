"""What the benchmark of household scenes builds on: that its scenes are possible, repeatable, and as its truth says."""

import numpy as np
import pytest
import trimesh
from common import mesh_things, scene_tables, scene_verdict, tabletop

from sq_perception.geometry import Superquadric, rotation

SEEDS = range(6)


@pytest.fixture(scope="module")
def scenes() -> list[tabletop.Tabletop]:
    return [tabletop.scene(seed) for seed in SEEDS]


def test_things_stand_on_the_table_and_apart(scenes: list[tabletop.Tabletop]) -> None:
    assert max(len(scene.placed) for scene in scenes) > 4
    for scene in scenes:
        normal = scene.plane[:3]
        assert np.linalg.norm(normal) == pytest.approx(1)
        np.testing.assert_allclose(scene.table.T @ scene.table, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(scene.table[:, 2], normal, atol=1e-12)
        outlines = []
        for placed in scene.placed:
            surface = placed.thing.mesh.vertices @ placed.rotation.T + placed.translation
            assert (surface @ normal + scene.plane[3]).min() == pytest.approx(0, abs=1e-9)
            outlines.append(tabletop.outline(surface @ scene.table))
        for k, one in enumerate(outlines):
            for other in outlines[:k]:
                assert tabletop.gap(one, other) >= tabletop.GAP - 1e-9


def test_the_gap_of_two_squares_is_their_distance() -> None:
    square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    assert tabletop.gap(square, square + [1.5, 0.3]) == pytest.approx(0.5)
    assert tabletop.gap(square, square + [0.8, 0.9]) == pytest.approx(-0.1)
    assert tabletop.gap(square, 0.1 * square + 0.4) < 0


def test_a_seed_is_a_scene(scenes: list[tabletop.Tabletop]) -> None:
    again = tabletop.scene(3)
    np.testing.assert_array_equal(again.depth, scenes[3].depth)
    np.testing.assert_array_equal(again.labels, scenes[3].labels)
    assert not np.array_equal(scenes[3].true_depth, scenes[5].true_depth)
    assert scenes[2].sensor == scenes[4].sensor != scenes[3].sensor


def test_what_stands_alone_is_wholly_visible(scenes: list[tabletop.Tabletop]) -> None:
    shares = []
    for scene in scenes:
        counts = np.bincount(scene.labels.ravel(), minlength=len(scene.placed) + 1)
        assert counts[1:].tolist() == [placed.pixels for placed in scene.placed]
        shares += [placed.visible_share for placed in scene.placed]
        if len(scene.placed) == 1:
            assert shares[-1] == 1
    assert 0 <= min(shares) < 0.9
    assert max(shares) == 1


def test_a_mask_shows_the_mesh_and_the_sensor_nearly_does(scenes: list[tabletop.Tabletop]) -> None:
    for scene in scenes[:4]:
        points = scene.camera.points(np.where(np.isfinite(scene.true_depth), scene.true_depth, np.nan))
        for placed in scene.placed:
            chosen = points[scene.labels == placed.label][::200]
            if len(chosen) == 0:
                continue
            in_thing = (chosen - placed.translation) @ placed.rotation
            # In millimetres: trimesh's tolerances are absolute, and too coarse for rims of a millimetre in metres.
            surface = placed.thing.mesh.copy().apply_scale(1000)
            _, distance, _ = trimesh.proximity.closest_point_naive(surface, 1000 * in_thing)
            assert distance.max() < 1e-5
        shown = np.isfinite(scene.depth) & (scene.labels > 0)
        assert shown.sum() > 0.5 * (scene.labels > 0).sum()
        assert np.median(np.abs(scene.depth - scene.true_depth)[shown]) < 0.005


@pytest.mark.parametrize("kind", ["box", "can", "bottle"])
def test_edges_are_those_of_the_hull(kind: str, rng: np.random.Generator) -> None:
    for _ in range(5):
        thing = mesh_things.MAKERS[kind](rng)
        np.testing.assert_allclose(np.sort(np.ptp(thing.hull, axis=0)), thing.edges, rtol=2e-3)
        assert thing.mesh.is_watertight
        assert sum(rest.likely for rest in thing.rests) == pytest.approx(1)
        for rest in thing.rests:
            np.testing.assert_allclose(rest.turn @ rest.turn.T, np.eye(3), atol=1e-12)
            assert np.linalg.det(rest.turn) == pytest.approx(1)


def test_a_box_is_itself(scenes: list[tabletop.Tabletop]) -> None:
    edges = np.array([0.04, 0.09, 0.15])
    thing = mesh_things.rounded_box(edges, 0.0005)
    scene = scenes[1]
    turn, place = scene.table, scene.table @ np.array([0, 0, 0.075]) + scene.placed[0].translation
    placed = tabletop.Placed(thing, "upright", turn, place, 1, 1000, 1000)
    body = Superquadric(edges[[2, 0, 1]] / 2, [0.02, 0.02], place, rotation.from_matrix(turn[:, [2, 0, 1]]))
    answer = scene_verdict.answer(body, placed, scene)
    assert answer.iou > 0.995
    np.testing.assert_allclose(answer.edge_errors, 0, atol=1e-9)
    np.testing.assert_allclose(answer.excess, 0, atol=2e-3)
    longer = Superquadric(body.size * [1.1, 1, 1], body.shape, body.translation, body.rotation)
    answer = scene_verdict.answer(longer, placed, scene)
    assert answer.iou == pytest.approx(1 / 1.1, abs=0.005)
    np.testing.assert_allclose(answer.edge_errors, [0, 0, 0.015], atol=1e-9)
    assert (answer.size_error, answer.excess[2]) == (pytest.approx(0.005), pytest.approx(0.015, abs=2e-3))


def test_masks_match_by_their_common_share() -> None:
    true, own = np.zeros((10, 30), int), np.zeros((10, 30), int)
    true[:, :10], true[:, 10:20], true[:, 20:] = 1, 2, 3
    own[:, :8], own[:4, 10:20], own[4:, 10:20], own[:, 24:] = 7, 8, 9, 5
    depth = np.ones(true.shape)
    assert scene_verdict.matches(own, true, depth) == {1: 7, 2: 9, 3: 5}
    own[:, 24:26] = 0
    assert scene_verdict.matches(own, true, depth) == {1: 7, 2: 9}
    depth[:, 20:22] = np.nan  # of the 8 columns that are left of it the mask has 4
    assert scene_verdict.matches(own, true, depth) == {1: 7, 2: 9, 3: 5}


def test_a_missed_thing_has_no_iou_and_no_size() -> None:
    found = scene_verdict.Answer(0.9, np.array([0.001, -0.002, 0.006]), np.zeros(3), np.array([1.0, 1, 0]), "weak", "")
    things = [
        scene_verdict.ThingVerdict(0, "stereo", "box", "box", "flat", 1, 900, 900, 1.0, np.ones(3), {"own": answer})
        for answer in (found, scene_verdict.Answer())
    ]
    figures = scene_tables.summary(things, "own")
    assert (figures["iou"]["mean"], figures["edge_error"]["mean"]) == (pytest.approx(45), pytest.approx(3))
    assert figures["within_2_sigma"] == pytest.approx(200 / 3)
    assert figures["status"] == {"converged": 0, "weak": 50, "failed": 0, "none": 50}
