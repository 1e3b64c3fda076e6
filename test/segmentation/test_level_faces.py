"""What stands on a carton is a thing of its own, and neither a bare carton nor a vessel falls apart."""

import numpy as np
import pytest
from table_scenes import VGA, Table, best_iou, ious

from sq_perception.segmentation import level_faces, support_plane
from sq_perception.segmentation.segments import segment

CARTON = (0.2, 0.13, 0.1)
TOP = 2 * CARTON[2]
EDGES = (0.05, 0.05)


def far_table():
    """Where things of some centimetres are low before a sensor's noise."""
    return Table(pitch=0.75, distance=1.2)


@pytest.mark.parametrize("sensor", ["realsense_d435", "kinect_v1"])
def test_small_things_on_a_carton_are_not_swallowed_by_it(sensor):
    found = []
    for seed in range(4):
        table = far_table()
        on_it = [
            table.body(-0.06, -0.03, (0.02, 0.02, 0.015), height=TOP, turn=0.2),
            table.body(0.06, 0.02, (0.018, 0.018, 0.025), shape=(0.1, 1.0), height=TOP),
        ]
        depth, truth = table.sensed([table.body(0, 0, CARTON, EDGES, turn=0.4), *on_it], sensor, seed)
        carton, *small = ious(truth, segment(depth, VGA).labels)
        assert carton > 0.85
        found += small
    assert np.min(found) > 0.5
    assert np.mean(found) > 0.7


def test_a_bare_carton_stays_one():
    table = far_table()
    for seed in range(3):
        depth, truth = table.sensed([table.body(0, 0, CARTON, EDGES, turn=0.4)], "realsense_d435", seed)
        found = segment(depth, VGA)
        assert len(found.ids) == 1
        assert best_iou(truth == 1, found.labels) > 0.85


def supported(depth):
    """The support of an image, and its depth with 0 where there is none."""
    valid = np.isfinite(depth)
    return support_plane.support(depth, valid, VGA), np.where(valid, depth, np.float32(0))


def faces(labels, known, support):
    segments = level_faces.samples(labels, known, VGA, 100)
    return level_faces.find_faces(segments, labels, known, VGA, support, 100)


@pytest.mark.parametrize("seed", range(3))
def test_the_face_is_that_of_the_carton(seed):
    """n.p + d of the table, less the height of the carton; what stands before the carton is not under the face."""
    table = Table(pitch=0.7, distance=1.0)
    low, before = (0.04, 0.03, 0.015), (0.03, 0.03, 0.08)
    bodies = [table.body(0, 0, CARTON, EDGES), table.body(0, 0, low, height=TOP), table.body(0, -0.3, before)]
    depth, truth = table.see(bodies, 2e-3, seed)
    labels = np.where(truth == 2, 1, truth).astype(np.int32)
    support, known = supported(depth)
    ((label, face),) = faces(labels, known, support).items()
    assert label == 1
    assert face.equation[:3] @ table.plane[:3] > np.cos(np.deg2rad(1))
    assert face.height(table.origin + TOP * table.plane[:3]) == pytest.approx(0, abs=2e-3)
    points = level_faces.samples(labels, known, VGA, 1)[1]
    above = level_faces.find_above(1, points, face, labels, known, VGA)
    assert above[truth == 1].all()
    assert not above[truth == 3].any()
    taken = np.where(truth == 3, 3, 0).astype(np.int32)  # as by another face
    assert not level_faces.find_above(1, points, face, taken, known, VGA)[truth == 3].any()


def test_the_seat_of_a_stool_is_a_face_though_it_is_the_lowest_that_is_seen_of_it():
    table = Table(pitch=0.7, distance=1.2)
    seat = table.body(0, 0, (0.18, 0.18, 0.015), (0.1, 1.0), height=0.42)
    depth, truth = table.see([seat, table.body(0, 0, (0.03, 0.02, 0.015), height=0.45)], 1e-3)
    support, known = supported(depth)
    (face,) = faces((truth > 0).astype(np.int32), known, support).values()
    assert face.height(table.origin + 0.45 * table.plane[:3]) == pytest.approx(0, abs=2e-3)


def test_a_carton_without_a_load_a_thing_without_a_level_face_and_a_vessel_have_no_face():
    """It lies on the support, as far as the noise tells; the wall around it is no load."""
    table = Table(pitch=0.7, distance=1.0)
    ball = table.body(0.3, 0.0, (0.1, 0.1, 0.1), (1.0, 1.0))
    depth, truth = table.see([table.body(-0.05, 0, CARTON, EDGES), ball], 2e-3)
    support, known = supported(depth)
    assert faces(truth, known, support) == {}
    table = Table(pitch=1.1, distance=0.9)
    walls = [table.body(x, y, (0.1 if y else 0.004, 0.1 if x else 0.004, 0.04)) for x, y in _SIDES]
    depth, truth = table.see([table.body(0, 0, (0.1, 0.1, 0.006)), *walls], 2e-3)
    support, known = supported(depth)
    assert faces((truth > 0).astype(np.int32), known, support) == {}


_SIDES = ((0.1, 0.0), (-0.1, 0.0), (0.0, 0.1), (0.0, -0.1))
