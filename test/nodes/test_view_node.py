"""The viewer's node without a browser: in which frame bodies are drawn, whatever the clock does."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from time import monotonic
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs the extra 'ros'")
pytest.importorskip("viser", reason="needs the extra 'view'")

from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo
from spun_nodes import PATIENCE
from std_msgs.msg import Header

from sq_msgs_py.depth_image import depth_to_message
from sq_msgs_py.superquadrics import SuperquadricArray, to_message
from sq_perception.nodes.frame import latched
from sq_perception.nodes.view_node import ViewNode


@pytest.fixture
def view() -> Iterator[ViewNode]:
    page: Any = SimpleNamespace(watched=False, requests=list, close=lambda: None)
    context = Context()
    context.init(args=["--ros-args"])
    node = ViewNode("sq_view", page, "depth/image", "depth/camera_info", ["/recover_node"], 10.0, context)
    yield node
    node.close()
    node.destroy_node()
    context.try_shutdown()


def test_bodies_in_another_frame_are_drawn_though_a_bag_begins_again(view, monkeypatch):
    """tf2 takes no transforms of the beginning while it remembers the end."""
    known = {60}

    def lookup_transform(target: str, source: str, stamp: Any, patience: Any) -> TransformStamped:
        if stamp.nanoseconds // 10**9 not in known:
            raise LookupError("would require extrapolation into the past")
        answer = TransformStamped()
        answer.transform.rotation.w = 1.0
        return answer

    buffer = SimpleNamespace(lookup_transform=lookup_transform, clear=lambda: known.add(4))
    stand_in = SimpleNamespace(Buffer=lambda: buffer, TransformListener=lambda *_: None)
    monkeypatch.setitem(sys.modules, "tf2_ros", stand_in)
    drawn = []
    for sec in (60, 3, 4):
        stamp = Time(sec=sec)
        image = depth_to_message(np.ones((2, 2)), Header(stamp=stamp, frame_id="camera"))
        view._on_image(image)
        cloud = to_message(SuperquadricArray.empty(), Header(stamp=stamp, frame_id="base"))
        drawn.append(view._converted(cloud, image.header)[1] == "")
    assert drawn == [True, False, True]


def test_a_camera_info_that_was_published_once_before_is_received(view):
    """By a driver that keeps it for late comers; nobody hears it who does not ask for that."""
    executor, peer = SingleThreadedExecutor(context=view.context), Node("peer", context=view.context)
    infos = peer.create_publisher(CameraInfo, "depth/camera_info", latched())
    infos.publish(CameraInfo(width=2, height=2))
    view._page.watched, view._page.changes = True, tuple
    executor.add_node(view)
    deadline = monotonic() + PATIENCE
    while view._info is None:
        assert monotonic() < deadline, "waited in vain"
        executor.spin_once(timeout_sec=0.2)
    assert view._info.width == 2
    view._page.watched = False
    view._on_tick()
    assert (view._inputs, view._latched) == ([], None)
    executor.remove_node(view)
    executor.shutdown()
    peer.destroy_node()


def test_the_newest_image_is_the_last_one_where_a_short_bag_is_in_a_loop(view):
    newest = []
    for sec in (1, 2, 3, 1, 2):
        view._on_image(depth_to_message(np.ones((2, 2)), Header(stamp=Time(sec=sec), frame_id="camera")))
        newest.append(next(reversed(view._images.values())).header.stamp.sec)
    assert newest == [1, 2, 3, 1, 2]


@pytest.mark.parametrize(
    ("remapped", "given", "expected"),
    [
        ((), None, "/depth/camera_info"),
        (("depth/image:=/camera/depth/image_raw",), None, "/camera/depth/camera_info"),
        (("depth/image:=/camera/depth/image_raw", "depth/camera_info:=/camera/info"), None, "/camera/info"),
        (("depth/image:=/camera/depth/image_raw",), "/other/info", "/other/info"),
    ],
)
def test_the_camera_info_is_beside_the_images_unless_it_is_named(remapped, given, expected):
    page: Any = SimpleNamespace(watched=False, requests=list, close=lambda: None)
    context = Context()
    context.init(args=["--ros-args", *(part for rule in remapped for part in ("-r", rule))])
    node = ViewNode("sq_view", page, "depth/image", given, ["/recover_node"], 10.0, context)
    try:
        assert node._topics[1] == expected
    finally:
        node.close()
        node.destroy_node()
        context.try_shutdown()
