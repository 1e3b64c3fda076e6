"""Walls of bins and trays are walls; boxes, cans, books and bowls are things, however they stand."""

import numpy as np
import pytest
from table_scenes import VGA, Table, best_iou

from sq_perception.segmentation import container_walls
from sq_perception.segmentation.segments import segment

PLANE = np.array([0.0, 0.0, 1.0, 0.0])
"""z up, as if the camera looked along -z."""
HIGH = 0.12


def box(low, high, count=400, seed=0):
    """Points on the sides and the top of a box, as from above."""
    rng = np.random.default_rng(seed)
    low, high = np.array(low), np.array(high)
    points = rng.uniform(low, high, (count, 3))
    edges = high - low
    areas = np.array([edges[1] * edges[2], edges[0] * edges[2], edges[0] * edges[1]])
    axis = rng.choice(3, count, p=areas / areas.sum())
    for k in range(3):
        ends = high[k] if k == 2 else rng.choice([low[k], high[k]], count)
        points[axis == k, k] = np.broadcast_to(ends, count)[axis == k]
    return points


def around(x, y, thick=0.01, high=HIGH):
    """Four walls, two long ones first; x and y half the sides."""
    return [
        box((-x, -y - thick, 0), (x, -y, high), seed=1),
        box((-x, y, 0), (x, y + thick, high), seed=2),
        box((-x - thick, -y, 0), (-x, y, high), seed=3),
        box((x, -y, 0), (x + thick, y, high), seed=4),
    ]


def can(x, y, radius, high, seed=0):
    rng = np.random.default_rng(seed)
    angle, level = rng.uniform(0, 2 * np.pi, 400), rng.uniform(0, high, 400)
    r = np.where(np.arange(400) % 2, radius, radius * np.sqrt(rng.uniform(0, 1, 400)))
    level = np.where(np.arange(400) % 2, level, high)
    return np.stack([x + r * np.cos(angle), y + r * np.sin(angle), level], axis=1)


def numbered(parts, turn=0.7):
    """Segments from 1, turned on the table, with some noise."""
    c, s = np.cos(turn), np.sin(turn)
    axes = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    rng = np.random.default_rng(5)
    return {k + 1: part @ axes.T + rng.normal(0, 0.001, part.shape) for k, part in enumerate(parts)}


THING = box((-0.03, -0.02, 0), (0.03, 0.02, 0.06))


@pytest.mark.parametrize("turn", [0.0, 0.4, 1.1])
def test_walls_around_a_thing(turn):
    assert container_walls.walls(numbered([*around(0.2, 0.12), THING], turn), PLANE) == {1, 2, 3, 4}


def test_a_plane_of_any_direction():
    found = numbered([*around(0.2, 0.12), THING])
    c, s = np.cos(0.8), np.sin(0.8)
    tilt = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    shift = np.array([0.1, -0.2, 0.9])
    moved = {label: points @ tilt.T + shift for label, points in found.items()}
    assert container_walls.walls(moved, np.append(tilt[:, 2], -tilt[:, 2] @ shift)) == {1, 2, 3, 4}


def test_walls_may_be_two_of_a_corner_or_cut_into_pieces_and_a_thing_as_high_is_none():
    wide, _, side, _ = around(0.2, 0.12)
    assert container_walls.walls(numbered([wide, side, THING]), PLANE) == {1, 2}
    left, right = wide[wide[:, 0] < -0.05], wide[wide[:, 0] > 0.02]
    assert container_walls.walls(numbered([left, right, side, THING]), PLANE) == {1, 2, 3}
    as_high = box((-0.03, -0.02, 0), (0.03, 0.02, HIGH))
    assert container_walls.walls(numbered([*around(0.2, 0.12), as_high]), PLANE) == {1, 2, 3, 4}


ROW = [can(0.08 * k, 0.0, 0.033, HIGH, k) for k in range(5)]
SQUARE = [can(x, y, 0.033, HIGH, 1) for x in (-0.1, 0, 0.1) for y in (-0.1, 0, 0.1)]
NOT_WALLS = {
    "a bin with nothing in it": around(0.2, 0.12),
    "two boxes at a right angle, as high": [
        box((-0.2, 0.1, 0), (0.2, 0.16, HIGH)),
        box((-0.26, -0.2, 0), (-0.2, 0.1, HIGH)),
        THING,
    ],
    "two books on either side": [
        box((-0.15, 0.1, 0), (0.15, 0.115, HIGH)),
        box((-0.15, -0.115, 0), (0.15, -0.1, HIGH)),
        THING,
    ],
    "walls that end at other heights": [
        box((-0.2, -0.01, 0), (0.2, 0.0, 0.08)),
        box((0.2, 0.0, 0), (0.21, 0.24, 0.14)),
        THING + [0, 0.12, 0],
    ],
    "a row of cans beside a thing": [*ROW, THING + [0.16, 0.1, 0]],
    "cans in a square, a shorter one among them": [*SQUARE[:4], can(0, 0, 0.033, 0.08), *SQUARE[5:]],
    "the halves of a bowl and its bottom": [
        *(can(0, 0, 0.1, HIGH, k)[1::2] for k in range(2)),
        can(0, 0, 0.05, 0.01)[::2],
    ],
    "things behind a wall": [*around(0.2, 0.12)[:3:2], THING + [0.5, 0.5, 0]],
    "a long tool in pieces": [
        box((-0.2, -0.01, 0), (0.0, 0.01, 0.03)),
        box((0.0, -0.03, 0), (0.03, 0.03, 0.03)),
        box((-0.1, -0.005, 0), (-0.08, 0.005, 0.01)),
    ],
}


@pytest.mark.parametrize("kind", NOT_WALLS)
def test_things_are_no_walls(kind):
    assert container_walls.walls(numbered(NOT_WALLS[kind]), PLANE) == set()


@pytest.mark.parametrize("turn", [0.2, 0.9])
def test_things_in_a_bin_are_found_and_its_walls_are_not(turn):
    table = Table(pitch=1.1, distance=0.9)
    half, thick, high = np.array([0.2, 0.14]), 0.006, 0.05
    sides = [(half[0], 0, thick, half[1]), (-half[0], 0, thick, half[1]), (0, half[1], half[0], thick)]
    sides.append((0, -half[1], half[0], thick))
    c, s = np.cos(turn), np.sin(turn)
    walls = [table.body(c * x - s * y, s * x + c * y, (a, b, high), turn=turn) for x, y, a, b in sides]
    things = [table.body(-0.06, 0.03, (0.03, 0.02, 0.03)), table.body(0.07, -0.02, (0.025, 0.025, 0.04), (0.1, 1.0))]
    depth, truth = table.see([*things, *walls], 1e-3)
    found = segment(depth, VGA)
    assert len(found.ids) == 2
    assert min(best_iou(truth == k, found.labels) for k in (1, 2)) > 0.7
    empty, _ = table.see(walls, 1e-3)
    assert segment(empty, VGA).ids
