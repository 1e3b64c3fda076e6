"""What objects stand on: the table, or the tops of others; what stands behind another one stands on the table."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from table_scenes import VGA, Table, noisy

from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast
from sq_perception.recovery import seen_object, supports
from sq_perception.segmentation.options import SegmentationOptions
from sq_perception.segmentation.segments import from_labels
from sq_perception.segmentation.support_plane import Plane
from sq_perception.simulation.scenes import plane_depth

LOW_BOX = (0.12, 0.1, 0.04)


def heights(table: Table, bodies: list[Superquadric], noise: float = 0.0) -> list[float]:
    """Of what each body is said to stand on, above the table, metres."""
    depth, labels = table.see(bodies, noise)
    found = from_labels(labels, depth, VGA)
    objects = {obj.label: obj for obj in seen_object.objects(depth, found, VGA)}
    planes = [
        supports.support(objects[k + 1], list(objects.values()), depth, VGA, found, SegmentationOptions())
        for k in range(len(bodies))
    ]
    assert all(plane is not None and plane[:3] @ table.plane[:3] > 0.9999 for plane in planes)
    return [float(table.plane[3] - plane[3]) for plane in planes if plane is not None]


@pytest.mark.parametrize("noise", [0.0, 1.5e-3])
@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (-0.06, 0.04), (0.05, -0.05)])
def test_a_box_on_a_box_stands_on_its_top(noise: float, x: float, y: float) -> None:
    table = Table()
    below, above = heights(table, [table.body(0, 0, LOW_BOX), table.body(x, y, (0.03,) * 3, height=0.08)], noise)
    assert abs(below) < 2e-3
    assert abs(above - 0.08) < 3e-3


def test_each_of_three_storeys_an_egg_and_what_is_seen_from_above_stands_on_the_top_below() -> None:
    """The lower half of the egg is unseen; the lowest that is seen of the tall box is its own top."""
    table = Table()
    bodies = [table.body(0, 0, LOW_BOX), table.body(0, 0, (0.07, 0.06, 0.03), height=0.08)]
    bodies.append(table.body(0, 0, (0.03, 0.03, 0.03), height=0.14))
    np.testing.assert_allclose(heights(table, bodies), [0, 0.08, 0.14], atol=3e-3)
    table = Table(pitch=1.1)
    egg = table.body(0, 0, (0.07, 0.035, 0.035), (1.0, 1.0), height=0.08)
    assert abs(heights(table, [table.body(0, 0, LOW_BOX), egg])[1] - 0.08) < 3e-3
    table = Table(pitch=np.pi / 2 - 1e-6)
    boxes = [table.body(0, 0, LOW_BOX), table.body(0.02, 0, (0.06, 0.05, 0.08), height=0.08)]
    assert abs(heights(table, boxes)[1] - 0.08) < 3e-3


@pytest.mark.parametrize("pitch", [0.5, 0.75, 1.0])
@pytest.mark.parametrize("gap", [0.0, 0.01, 0.04])
def test_what_stands_behind_another_stands_on_the_table(pitch: float, gap: float) -> None:
    """The lowest that is seen of it is as high as the top before it, where both touch."""
    table = Table(pitch)
    before, behind = table.body(0, 0, LOW_BOX), table.body(0, 0.1 + gap + 0.04, (0.05, 0.04, 0.1))
    assert behind.translation[2] > before.translation[2]
    for at in heights(table, [before, behind]):
        assert abs(at) < 2e-3


def test_one_between_two_of_its_height_stands_on_the_table() -> None:
    """Neither top reaches under it, though the hull of both does."""
    table = Table()
    bodies = [table.body(-0.1, 0, (0.04, 0.1, 0.04)), table.body(0.1, 0, (0.04, 0.1, 0.04))]
    bodies.append(table.body(0, 0, (0.055, 0.05, 0.08)))
    assert abs(heights(table, bodies)[2]) < 2e-3


@pytest.mark.parametrize("drop", [0.015, 0.018, 0.05])
@pytest.mark.parametrize("is_seen", [True, False])
def test_what_reaches_below_the_table_stands_on_what_is_lower_or_on_nothing_known(drop: float, is_seen: bool) -> None:
    """On a step beside the table, or in a hole of it that it fills: it does not end where the table is."""
    table = Table()
    lower = table.plane + np.array([0, 0, 0, drop])
    depth, index = raycast.render(table.body(0.15, 0, (0.04, 0.03, 0.06), height=-drop), VGA)
    beside = (np.arange(VGA.width) > 360) & is_seen
    ground = np.where(beside, plane_depth(lower, VGA), plane_depth(table.plane, VGA))
    # Of what stands in a hole the whole front is seen, as if the table before it were of glass.
    labels = np.where((depth < ground) | ((index == 0) & ~beside), index + 1, 0).astype(np.int32)
    depth = noisy(np.where(labels > 0, depth, ground), 1e-3)
    found = replace(from_labels(labels, depth, VGA), support=Plane(table.plane, 1.0, 1e-3))
    (box,) = seen_object.objects(depth, found, VGA)
    plane = supports.support(box, [box], depth, VGA, found, SegmentationOptions())
    assert (plane is not None) == is_seen
    assert plane is None or abs(plane[3] - lower[3]) < 3e-3


@pytest.mark.parametrize("wall", [1.0, 1.2, 1.4])
def test_the_wall_behind_in_a_mask_too_large_is_no_support(wall: float) -> None:
    """A box that something unseen holds up, and a rim of pixels around it, some of which show the wall behind."""
    table = Table(pitch=0.35)
    depth, labels = table.see([table.body(0, 0, (0.03, 0.02, 0.02), height=0.15)])
    depth = np.fmin(depth, np.float32(wall))
    labels = cv2.dilate(labels.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(np.int32)
    assert np.mean(depth[labels > 0] > wall - 0.01) > 0.02
    found = replace(from_labels(labels, depth, VGA), support=Plane(table.plane, 1.0, 1e-3))
    (box,) = seen_object.objects(depth, found, VGA)
    plane = supports.support(box, [box], depth, VGA, found, SegmentationOptions())
    np.testing.assert_array_equal(plane, table.plane)


@pytest.mark.parametrize("wall", [1.05, 1.2])
def test_things_on_a_board_of_which_the_front_alone_is_seen_do_not_stand_on_the_wall(wall: float) -> None:
    """A camera below the board, level: they would reach to the wall.  Without the board it is a table from above."""
    camera, level = VGA, np.array([0.0, 0.0, 0.0, 1.0])
    boxes = [
        Superquadric([0.04, 0.08, 0.05], (0.1, 0.1), [-0.15, -0.12, 0.8], level),
        Superquadric([0.03, 0.1, 0.03], (0.1, 0.1), [0.12, -0.14, 0.85], level),
    ]
    board = Superquadric([0.5, 0.01, 0.2], (0.1, 0.1), [0.0, -0.03, 0.85], level)
    for shelf, stand in ((boxes, True), ([*boxes, board], False)):
        depth, index = raycast.render(Superquadric.stack(shelf), camera)
        labels = np.where((index >= 0) & (index < 2), index + 1, 0).astype(np.int32)
        depth = np.where(np.isfinite(depth), depth, wall).astype(np.float32)
        found = from_labels(labels, depth, camera)
        assert found.plane is not None
        assert abs(found.plane[3] - wall) < 0.01
        objects = seen_object.objects(depth, found, camera)
        planes = [supports.support(obj, objects, depth, camera, found, SegmentationOptions()) for obj in objects]
        assert [plane is not None for plane in planes] == [stand, stand]
