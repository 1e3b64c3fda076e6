"""What stands on a carton is a thing of its own, and neither a bare carton nor a vessel falls apart."""

from __future__ import annotations

import numpy as np
import pytest
from table_scenes import VGA, Table, best_iou, ious

from sq_perception.segmentation.segments import segment
from sq_perception.simulation import sensor_noise

CARTON = (0.2, 0.13, 0.1)
TOP = 2 * CARTON[2]
EDGES = (0.05, 0.05)


def far_table():
    """Where things of some centimetres are low before a sensor's noise."""
    return Table(pitch=0.75, distance=1.2)


def sensed(table, bodies, sensor, seed):
    depth, truth = table.see(bodies)
    measured = sensor_noise.preset(sensor).measured(depth.astype(float), VGA, np.random.default_rng(seed))
    return measured.astype(np.float32), truth


@pytest.mark.parametrize("sensor", ["realsense_d435", "kinect_v1"])
def test_small_things_on_a_carton_are_not_swallowed_by_it(sensor):
    found = []
    for seed in range(4):
        table = far_table()
        on_it = [
            table.body(-0.06, -0.03, (0.02, 0.02, 0.015), height=TOP, turn=0.2),
            table.body(0.06, 0.02, (0.018, 0.018, 0.025), shape=(0.1, 1.0), height=TOP),
        ]
        depth, truth = sensed(table, [table.body(0, 0, CARTON, EDGES, turn=0.4), *on_it], sensor, seed)
        carton, *small = ious(truth, segment(depth, VGA).labels)
        assert carton > 0.85
        found += small
    assert np.min(found) > 0.5
    assert np.mean(found) > 0.7


def test_a_bare_carton_stays_one():
    table = far_table()
    for seed in range(3):
        depth, truth = sensed(table, [table.body(0, 0, CARTON, EDGES, turn=0.4)], "realsense_d435", seed)
        found = segment(depth, VGA)
        assert len(found.ids) == 1
        assert best_iou(truth == 1, found.labels) > 0.85
