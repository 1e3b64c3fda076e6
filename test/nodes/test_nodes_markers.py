"""Markers of the frame node: made while somebody listens, and gone with what they show."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs the extra 'ros'")

from frame_node_bench import ball
from sensor_msgs.msg import Image
from std_srvs.srv import SetBool
from visualization_msgs.msg import Marker, MarkerArray

from sq_perception.fitting.fit import Status
from sq_perception.recordings import publication


def test_pictures_are_made_while_somebody_listens(bench):
    bench.set(bench.node, tracking=False)
    bench.recoverer.bodies = (ball(1), ball(5), ball(6, Status.FAILED))
    assert len(bench.answer(bench.depth())[1]) == 3
    shown = bench.hear(MarkerArray, "recover_node/markers")
    rendered = bench.hear(Image, "recover_node/rendered_depth")
    outputs = bench.node._outputs
    bench.until(lambda: outputs.markers.get_subscription_count() and outputs.rendered_depth.get_subscription_count())
    assert not shown
    image = bench.depth()
    bench.answer(image)
    bench.until(lambda: shown and rendered)
    assert sorted({marker.id for marker in shown[0].markers[1:]}) == [1, 5]
    assert all(marker.header == image.header for marker in shown[0].markers)
    depth = publication.depth_of(rendered[0], False)[0].depth
    assert rendered[0].header == image.header
    assert np.nanmin(depth) == pytest.approx(0.4, abs=2e-3)
    assert np.isnan(depth).any()


@pytest.mark.parametrize("end", ["disabled", "deactivated", "ended"])
def test_markers_go_with_the_one_who_would_move_them(bench, end):
    shown = bench.hear(MarkerArray, "recover_node/markers")
    bench.until(lambda: bench.node._outputs.markers.get_subscription_count())
    bench.recoverer.bodies = (ball(1), ball(5))
    bench.answer(bench.depth())
    bench.until(lambda: len(shown) == 1)
    if end == "disabled":
        assert bench.call(SetBool, "/recover_node/enable", SetBool.Request(data=False)).success
    elif end == "deactivated":
        bench.node._tasks.put(lambda: bench.node._change("deactivate"))
    else:
        bench.until(bench.node.close)
    bench.until(lambda: len(shown) == 2)
    assert [marker.action for marker in shown[1].markers] == [Marker.DELETEALL]
