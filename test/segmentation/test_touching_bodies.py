"""Bodies that touch, stand on each other, hide each other, or are hollow: one segment each, on seeded noise."""

import numpy as np
import pytest
from table_scenes import VGA, Table, ious, judged_by_network, noisy

from sq_perception.segmentation.segments import segment
from sq_perception.simulation.scenes import plane_depth

CAN, BALL = (0.1, 1.0), (1.0, 1.0)


TABLE = Table()
PARTED = {
    "boxes, one turned": [
        TABLE.body(-0.06, 0, (0.05, 0.04, 0.06)),
        TABLE.body(0.055, 0, (0.045, 0.045, 0.05), turn=np.pi / 4),
    ],
    "two stacked": [
        TABLE.body(0, 0, (0.09, 0.07, 0.03)),
        TABLE.body(0.01, 0.01, (0.05, 0.04, 0.03), turn=0.3, height=0.06),
    ],
    "can before a box": [TABLE.body(0, 0.08, (0.09, 0.04, 0.07)), TABLE.body(0, 0, (0.04, 0.04, 0.05), CAN)],
    "can on a box": [TABLE.body(0, 0, (0.09, 0.07, 0.03)), TABLE.body(0, 0, (0.035, 0.035, 0.05), CAN, height=0.06)],
    "ball before a box": [TABLE.body(0, 0.07, (0.09, 0.03, 0.07)), TABLE.body(0, -0.005, (0.045, 0.045, 0.045), BALL)],
    "cans side by side": [
        TABLE.body(-0.041, 0, (0.04, 0.04, 0.06), CAN),
        TABLE.body(0.041, 0, (0.04, 0.04, 0.05), CAN),
    ],
}


@pytest.mark.parametrize("noise", [0.0, 0.0015])
@pytest.mark.parametrize("bodies", PARTED.values(), ids=PARTED.keys())
def test_touching_bodies_are_parted(bodies, noise):
    depth, truth = TABLE.see(bodies, noise)
    found = segment(depth, VGA)
    assert len(found.ids) == len(bodies)
    assert min(ious(truth, found.labels)) > 0.75


@pytest.mark.parametrize("distance", [0.3, 0.45])
@pytest.mark.parametrize("noise", [0.0, 0.0015])
def test_small_blocks_seen_near_are_parted(noise, distance):
    """Cubes of 26 mm that touch, one of them on two others."""
    table, cube = Table(distance=distance), (0.013, 0.013, 0.013)
    blocks = [
        table.body(-0.016, 0.0, cube),
        table.body(0.016, 0.0, cube, turn=0.8),
        table.body(0.0, 0.004, cube, turn=0.4, height=0.026),
        table.body(0.05, 0.0, cube, turn=0.3),
    ]
    depth, truth = table.see(blocks, noise)
    found = segment(depth, VGA)
    assert len(found.ids) == len(blocks)
    assert min(ious(truth, found.labels)) > 0.75


WHOLE = {
    "corner of a box": TABLE.body(0, 0, (0.06, 0.06, 0.06), turn=np.pi / 4),
    "long box": TABLE.body(0, 0, (0.12, 0.03, 0.04), turn=0.5),
    "can": TABLE.body(0, 0, (0.05, 0.05, 0.08), CAN),
    "egg": TABLE.body(0, 0, (0.05, 0.07, 0.04), (0.7, 0.9)),
    "ball": TABLE.body(0, 0, (0.06, 0.06, 0.06), BALL),
}


@pytest.mark.parametrize("noise", [0.0, 0.001, 0.003])
@pytest.mark.parametrize("body", WHOLE.values(), ids=WHOLE.keys())
def test_a_convex_body_stays_one(body, noise):
    depth, truth = TABLE.see([body], noise)
    found = segment(depth, VGA)
    assert len(found.ids) == 1
    assert ious(truth, found.labels)[0] > 0.93


def test_noise_as_far_as_bodies_are_told_apart():
    """The same two bodies from farther and farther away: two of them, then perhaps one, never pieces."""
    for distance in (0.6, 1.0, 1.5, 2.2, 3.0):
        table = Table(distance=distance)
        bodies = [table.body(0, 0.08, (0.09, 0.04, 0.07)), table.body(0, 0, (0.04, 0.04, 0.05), CAN)]
        depth, truth = table.see(bodies, 0.001, seed=3)
        found = segment(depth, VGA)
        if distance < 1.6:
            assert len(found.ids) == 2
            assert min(ious(truth, found.labels)) > 0.9
        else:
            assert len(found.ids) in (1, 2)


def test_flush_faces_cannot_be_told_apart_and_what_stands_apart_behind_a_post_stays_apart():
    """Two equal boxes side by side are one box as far as depth goes; not a goal, but what the page says. Two boxes in
    one plane with the table visible between them."""
    bodies = [TABLE.body(x, 0, (0.05, 0.04, 0.06)) for x in (-0.05, 0.05)]
    assert len(segment(TABLE.see(bodies)[0], VGA).ids) == 1
    bodies = [TABLE.body(x, 0.15, (0.04, 0.03, 0.05)) for x in (-0.1, 0.1)]
    bodies.append(TABLE.body(0, 0, (0.012, 0.012, 0.1)))
    assert len(segment(TABLE.see(bodies)[0], VGA).ids) == 3


@pytest.mark.parametrize("noise", [0.0, 0.0015])
def test_a_box_goes_on_behind_a_post(noise):
    bodies = [TABLE.body(0, 0.15, (0.13, 0.03, 0.05)), TABLE.body(0, 0, (0.025, 0.025, 0.1))]
    depth, truth = TABLE.see(bodies, noise)
    found = segment(depth, VGA)
    assert len(found.ids) == 2
    assert min(ious(truth, found.labels)) > 0.95


def bowl(depth, truth, label, radius, thickness, rim, camera=VGA):
    """Put a spherical bowl with its rim at a height above the table into a rendered image."""
    centre = TABLE.origin + TABLE.axes @ np.array([-0.05, 0, rim])
    v, u = np.indices(depth.shape)
    ray = camera.rays(u, v)[1]
    along, square = ray @ centre, (ray * ray).sum(-1)
    nearest = np.full(depth.shape, np.inf)
    for r, side in ((radius, -1), (radius - thickness, 1)):
        rest = along**2 - square * (centre @ centre - r**2)
        z = (along + side * np.sqrt(np.maximum(rest, 0))) / square
        point = z[..., None] * ray
        up = TABLE.axes[:, 2]
        solid = (rest > 0) & ((point - centre) @ up < 0) & (point @ up + TABLE.plane[3] > 0)
        nearest = np.where(solid & (z < nearest), z, nearest)
    seen = nearest < np.nan_to_num(depth, nan=9)
    return np.where(seen, nearest, depth), np.where(seen, label, truth)


@pytest.mark.parametrize("noise", [0.0, 0.002])
@pytest.mark.parametrize(("radius", "rim"), [(0.045, 0.04), (0.07, 0.06), (0.1, 0.07)])
def test_a_bowl_stays_one(radius, rim, noise):
    """Its inner wall is a step behind its rim; a box beside it is not drawn in."""
    depth, truth = bowl(*TABLE.see([TABLE.body(0.2, 0, (0.03, 0.03, 0.03))]), 2, radius, 0.004, rim)
    found = judged_by_network(noisy(depth, noise), VGA)
    assert len(found.ids) == 2
    assert min(ious(truth, found.labels)) > 0.9


@pytest.mark.parametrize(("pitch", "roll"), [(0.4, 0.0), (0.7, 0.3), (0.7, -0.3), (1.3, 0.1), (1.55, 0.0)])
def test_tilted_tables(pitch, roll):
    table = Table(pitch, roll)
    bodies = [table.body(-0.1, 0.02, (0.05, 0.04, 0.05)), table.body(0.1, 0, (0.04, 0.04, 0.04), CAN)]
    depth, truth = table.see(bodies, 0.001)
    found = segment(depth, VGA)
    assert len(found.ids) == 2
    assert min(ious(truth, found.labels)) > 0.93
    assert np.degrees(np.arccos(min(1.0, found.plane[:3] @ table.plane[:3]))) < 0.5


def test_the_largest_of_many_is_found_among_low_ones():
    """They are no noise of the table, though they are smaller, so that they are not known when it is asked about."""
    steep = Table(pitch=1.2)
    around = [steep.body(0.087 * np.cos(a), 0.087 * np.sin(a), (0.025, 0.025, 0.014), CAN) for a in np.arange(9) * 0.7]
    depth, truth = steep.see([steep.body(0, 0, (0.06, 0.06, 0.024), CAN), *around], 5e-4)
    assert ious(truth, segment(depth, VGA).labels)[0] > 0.9


def test_touching_bodies_without_a_table():
    depth, truth = TABLE.see(PARTED["can before a box"], 0.001, table=False)
    found = judged_by_network(depth, VGA)
    assert found.plane is None
    assert len(found.ids) == 2
    assert min(ious(truth, found.labels)) > 0.95


def test_things_on_a_higher_table_are_found_and_the_table_is_none():
    step = 0.12
    bodies = [
        TABLE.body(-0.15, 0, (0.04, 0.04, 0.05)),
        TABLE.body(0.2, 0, (0.04, 0.03, 0.05), height=step),
        TABLE.body(-0.1, 0.15, (0.05, 0.04, 0.05)),
    ]
    depth, truth = TABLE.see(bodies)
    higher = plane_depth(TABLE.plane - [0, 0, 0, step], VGA)
    v, u = np.indices(higher.shape)
    here = (VGA.unproject(u, v, higher) - TABLE.origin) @ TABLE.axes[:, 0] > 0.05
    covered = here & (truth != 2) & (higher < np.nan_to_num(depth, nan=9))
    depth, truth = np.where(covered, higher, depth), np.where(covered, 0, truth)
    found = segment(noisy(depth, 0.001), VGA)
    assert len(found.ids) == 3
    assert min(ious(truth, found.labels)) > 0.93
    assert found.plane[3] == pytest.approx(TABLE.plane[3], abs=0.005)
