"""Packed images: their topics are as image_transport names them, and they are read as plain ones are."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs the extra 'ros'")

from packed_depth import pack
from sensor_msgs.msg import CompressedImage
from spun_nodes import SpunNodes
from std_msgs.msg import Header

from sq_msgs_py.depth_image import depth_to_message
from sq_perception.imaging.calibration import Calibration
from sq_perception.imaging.camera import Camera
from sq_perception.nodes.frame import decode, image_topic
from sq_perception.recordings.publication import size_of


@pytest.mark.parametrize(
    ("rules", "expected"),
    [
        ([], "/depth/image/compressedDepth"),
        (["-r", "depth/image:=/camera/depth/image_rect_raw"], "/camera/depth/image_rect_raw/compressedDepth"),
        (["-r", "depth/image:=/camera/image_rect/compressedDepth"], "/camera/image_rect/compressedDepth"),
        (["-r", "__ns:=/robot"], "/robot/depth/image/compressedDepth"),
    ],
)
def test_topics_follow_the_image_s(rules, expected):
    with SpunNodes(*rules) as nodes:
        nodes.spin([])
        assert image_topic(nodes.peer, "compressedDepth") == expected
        assert image_topic(nodes.peer, "raw") == nodes.peer.resolve_topic_name("depth/image")


def packed(depth, header):
    form, data = pack(depth)
    return CompressedImage(header=header, format=form, data=data)


def test_packed_and_plain_are_read_alike(rng):
    depth = (rng.integers(300, 3000, (12, 16)) / 1000).astype(np.float32)
    depth[3, 4] = np.nan
    header = Header(frame_id="camera")
    for message in (depth_to_message(depth, header, "16UC1"), packed(depth, header)):
        frame = decode(message, lambda: Calibration(Camera(16, 12, 15.0, 15.0, 7.5, 5.5)))
        np.testing.assert_array_equal(frame.depth, depth)
        assert frame.depth.dtype == np.float32
        assert frame.encoding == "16UC1"
        assert size_of(message) == (16, 12)
        assert message.header == header
    hostile = packed(depth, header)
    hostile.data = hostile.data[:40]
    with pytest.raises(ValueError, match="not readable"):
        decode(hostile, pytest.fail)
    hostile.format = "jpeg"
    for read in (lambda message: decode(message, pytest.fail), size_of):
        with pytest.raises(ValueError, match="format: expected"):
            read(hostile)
