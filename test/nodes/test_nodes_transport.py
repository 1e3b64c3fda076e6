"""Packed images between nodes: topics as image_transport names them, and the synthetic camera that sends them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack

import numpy as np
import pytest
import yaml

pytest.importorskip("rclpy", reason="needs the extra 'ros'")

from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from spun_nodes import SpunNodes
from std_msgs.msg import Header

from sq_msgs_py.depth_image import depth_from_message, depth_to_message, labels_from_message
from sq_perception.imaging import compressed_depth
from sq_perception.imaging.calibration import Calibration
from sq_perception.imaging.camera import Camera
from sq_perception.imaging.distortion import Distortion
from sq_perception.imaging.rectification import Rectification
from sq_perception.nodes.frame import decode, image_topic, packed, size_of
from sq_perception.nodes.live_parameters import ParameterError
from sq_perception.nodes.parameters import SyntheticParameters
from sq_perception.nodes.synthetic_depth_node import SyntheticDepthNode, frame_source

LENS = Distortion("plumb_bob", (-0.2, 0.05, 0.001, -0.001, 0.0))


@pytest.fixture
def distorted_camera(tmp_path):
    path = tmp_path / "lens.yaml"
    k = [262.0, 0, 159.5, 0, 262.0, 119.5, 0, 0, 1]
    path.write_text(yaml.safe_dump({"width": 320, "height": 240, "k": k, "d": list(LENS.coefficients)}))
    return path


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
        assert image_topic(nodes.peer, "depth/image", "compressedDepth") == expected
        assert image_topic(nodes.peer, "depth/image", "raw") == nodes.peer.resolve_topic_name("depth/image")


def test_packed_and_plain_are_read_alike(rng):
    depth = (rng.integers(300, 3000, (12, 16)) / 1000).astype(np.float32)
    depth[3, 4] = np.nan
    header = Header(frame_id="camera")
    for message in (depth_to_message(depth, header, "16UC1"), packed(depth, header, "16UC1")):
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


class Heard(SpunNodes):
    """Everything that a synthetic camera with these parameters sends, by stamp."""

    def __init__(self, **parameters) -> None:
        super().__init__(*(word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")))
        self.messages: dict[str, dict] = {}
        topics = {
            "depth/image": Image,
            "depth/image/compressedDepth": CompressedImage,
            "depth/camera_info": CameraInfo,
            "mask/image": Image,
        }
        for topic, kind in topics.items():
            self.messages[topic] = {}
            self.peer.create_subscription(kind, topic, lambda message, topic=topic: self.keep(topic, message), 20)
        self.node = SyntheticDepthNode("synthetic", context=self.context)
        self.spin([self.node])

    def keep(self, topic, message) -> None:
        self.messages[topic][message.header.stamp.sec, message.header.stamp.nanosec] = message

    def together(self, *topics):
        """The first messages of the topics with a common stamp."""

        def common() -> set:
            return set.intersection(*(set(self.messages[topic]) for topic in topics))

        self.until(common)
        stamp = min(common())
        return [self.messages[topic][stamp] for topic in topics]


@pytest.fixture
def hear() -> Iterator:
    with ExitStack() as opened:
        yield lambda **parameters: opened.enter_context(Heard(**parameters))


def test_a_distorting_synthetic_camera_sends_raw_images_packed_and_plain(hear, distorted_camera):
    """Read back by the rule, they are what the rectified camera saw."""
    parameters = {"camera_info_file": str(distorted_camera), "masks": "always", "rate": 5.0}
    heard = hear(**parameters, image_transport="compressedDepth", encoding="16UC1")
    topics = ("depth/image", "depth/image/compressedDepth", "depth/camera_info", "mask/image")
    image, small, info, mask = heard.together(*topics)
    np.testing.assert_array_equal(compressed_depth.decode(small.format, small.data), depth_from_message(image))
    calibration = Calibration.of(info, "/depth/image")
    assert calibration.rectification == Rectification(Camera(320, 240, 262.0, 262.0, 159.5, 119.5), LENS)
    assert size_of(small) == calibration.size == (320, 240)
    true = frame_source(SyntheticParameters(**parameters)).next(0.0)
    found = calibration.rectified(depth_from_message(image))
    both = np.isfinite(found) & np.isfinite(true.depth)
    assert both.mean() > 0.85
    assert np.median(np.abs(found - true.depth)[both]) < 1e-3
    labels = calibration.rectified_labels(labels_from_message(mask))
    assert (labels == true.labels).mean() > 0.99


def test_a_plain_synthetic_camera_packs_nothing(hear):
    heard = hear(rate=5.0)
    _, info = heard.together("depth/image", "depth/camera_info")
    assert not any(info.d)
    assert not heard.messages["depth/image/compressedDepth"]
    assert not heard.peer.get_publishers_info_by_topic("/depth/image/compressedDepth")


def test_grey_images_are_not_packed():
    with pytest.raises(ParameterError, match="image_transport: expected raw for grey images"):
        SyntheticParameters(scene="thesis", image_transport="compressedDepth")
