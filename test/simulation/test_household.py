"""Household things: hulls, poses, measures."""

import numpy as np
import pytest

from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.geometry.union import DIRECTIONS, flat_support, move, support_of_union
from sq_perception.simulation.household import KINDS, draw_thing

MEASURES = {
    "box": (0.012, 0.36), "can": (0.03, 0.34), "bottle": (0.07, 0.5), "vessel": (0.05, 0.3),
    "round": (0.025, 0.3), "tool": (0.08, 0.42), "union": (0.03, 0.4), "soft": (0.05, 0.5),
}
"""Longest edges of a thing's box, metres."""


def test_the_compiled_support_function_is_the_closed_form() -> None:
    rng = np.random.default_rng(0)
    size, shape = rng.uniform(0.1, 2, (50, 3)), rng.uniform(0.03, 1.9, (50, 2))
    parts = Superquadric(size, shape, rng.normal(size=(50, 3)), quaternions.random(50, rng))
    closed = (parts.support(DIRECTIONS) + parts.translation @ DIRECTIONS.T).max(axis=0)
    np.testing.assert_allclose(support_of_union(parts, DIRECTIONS), closed, atol=1e-9)
    turn, shift = quaternions.random(1, rng)[0], rng.normal(size=3)
    np.testing.assert_allclose(move(parts.to_flat(), turn, shift), parts.transformed(turn, shift).to_flat(), atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_things_have_household_measures(kind: str) -> None:
    rng = np.random.default_rng(1)
    things = [draw_thing(rng, [kind]) for _ in range(120)]
    edges = np.array([np.sort(thing.box[1] - thing.box[0]) for thing in things])
    least, most = MEASURES[kind]
    assert (edges[:, 2] > least).all()
    assert (edges[:, 2] < most).all()
    assert (edges > 0.003).all()
    assert all(thing.kind == kind and len(thing.parts) <= 16 for thing in things)
    # The middle of the box is the origin.
    assert max(np.abs(thing.box[0] + thing.box[1]).max() for thing in things) < 1e-9


def test_oval_bottles_are_flatter_than_wide_and_round_ones_are_not() -> None:
    rng = np.random.default_rng(2)
    things = [draw_thing(rng, ["bottle"]) for _ in range(250)]
    body: dict[str, list[float]] = {name: [] for name in ("oval bottle", "round bottle")}
    for thing in things:
        if thing.name in body:
            body[thing.name].append(thing.parts.size[0, 1] / thing.parts.size[0, 0])
    assert min(len(ratios) for ratios in body.values()) > 60
    assert 0.4 <= min(body["oval bottle"]) <= max(body["oval bottle"]) <= 0.92
    assert body["round bottle"] == pytest.approx(np.ones(len(body["round bottle"])))


def test_probabilities_of_rests_add_up_and_rotations_are_rotations() -> None:
    rng = np.random.default_rng(4)
    for _ in range(200):
        thing = draw_thing(rng)
        assert sum(rest.likely for rest in thing.rests) == pytest.approx(1)
        assert all(np.linalg.norm(rest.turn) == pytest.approx(1) for rest in thing.rests)
        assert np.linalg.norm(thing.pose(rng)[1]) == pytest.approx(1)


def test_a_lying_thing_is_as_high_as_it_is_deep() -> None:
    """The rest named after an axis points that axis up."""
    rng = np.random.default_rng(5)
    for _ in range(50):
        thing = draw_thing(rng, ["can"])
        edges = thing.box[1] - thing.box[0]
        for rest in thing.rests:
            flat = move(thing.parts.to_flat(), rest.turn, np.zeros(3))
            height = flat_support(flat, np.array([[0.0, 0, 1], [0, 0, -1]])).sum()
            assert height == pytest.approx(edges[1] if rest.name == "lying" else edges[2], abs=1e-9)


def test_cavities_stay_within_the_outside_of_a_vessel() -> None:
    """Below the rim, a cavity is narrower than the hull wherever it is."""
    rng = np.random.default_rng(6)
    ways = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, -1.0]])
    vessels = [thing for thing in (draw_thing(rng, ["vessel"]) for _ in range(100)) if len(thing.cavities)]
    assert len(vessels) > 40
    for thing in vessels:
        assert (support_of_union(thing.cavities, ways) < thing.support(ways)).all()


@pytest.mark.parametrize("kind", ["vessel", "can"])
def test_no_wall_has_a_slit(kind: str) -> None:
    """What bounds a cavity below its rim lies inside the union."""
    rng = np.random.default_rng(7)
    checked = 0
    for thing in (draw_thing(rng, [kind]) for _ in range(100)):
        for cavity in thing.cavities:
            surface = cavity.sample_surface(500, rng, oversampling=2)
            inner = surface[np.abs(surface[:, 2]) < abs(cavity.translation[2]) - 0.001]
            if len(inner):
                assert thing.parts.gauge(inner).min(axis=0).max() < 1
                checked += 1
    assert checked > 30


def test_unknown_kinds_are_refused() -> None:
    rng = np.random.default_rng(0)
    for kinds in ([], ["elephant"]):
        with pytest.raises(ValueError, match="kinds: expected some of box, can"):
            draw_thing(rng, kinds)


def test_parts_hold_together() -> None:
    """From every part one gets to every other one through parts that overlap or touch."""
    rng = np.random.default_rng(8)
    for _ in range(80):
        parts = draw_thing(rng, ["bottle", "can", "vessel", "tool", "union", "round"]).parts
        points = parts.sample_surface(150, rng, oversampling=2)
        points = np.concatenate([points, parts.translation[:, None]], axis=1)
        gauges = (part.gauge(points.reshape(-1, 3)).reshape(len(parts), -1) for part in parts)
        near = np.array([gauge.min(axis=1) < 1.02 for gauge in gauges])
        near |= near.T
        reached = np.arange(len(parts)) == 0
        for _ in parts:
            reached = near[reached].any(axis=0)
        assert reached.all()
