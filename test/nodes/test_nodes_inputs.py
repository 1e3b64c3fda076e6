"""Images as cameras send them: packed, and raw from a lens that distorts."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs the extra 'ros'")

from frame_node_bench import Bench
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from sq_perception.imaging import compressed_depth


@pytest.fixture
def make_bench() -> Iterator[Callable[..., Bench]]:
    benches: list[Bench] = []

    def make(*arguments: str) -> Bench:
        benches.append(Bench(*arguments))
        return benches[-1]

    yield make
    for bench in benches:
        bench.close()


def test_packed_images_are_read_and_hostile_ones_refused(make_bench):
    bench = make_bench("-p", "image_transport:=compressedDepth", "-r", "depth/image:=/camera/depth")
    packed = bench.peer.create_publisher(CompressedImage, "/camera/depth/compressedDepth", 5)
    bench.until(lambda: packed.get_subscription_count() == 1)
    bench.send_info()
    depth = np.full((48, 64), 0.731, np.float32)
    depth[:5] = np.nan
    for encoding in ("16UC1", "32FC1"):
        form, data = compressed_depth.encode(depth, encoding)
        header = bench.header()
        packed.publish(CompressedImage(header=header, format=form, data=data))
        bench.until(lambda header=header: any(one.header == header for one in bench.answers))
        seen = bench.recoverer.asked[-1][0]
        assert np.isnan(seen[:5]).all()
        np.testing.assert_allclose(seen[5:], 0.731, atol=1e-3)
    hostile = [("", b""), ("16UC1; compressedDepth png", b""), (form, data[:40]), ("rgb8; jpeg", b"abc")]
    for number, (bad_form, bad_data) in enumerate(hostile, start=1):
        packed.publish(CompressedImage(header=bench.header(), format=bad_form, data=bad_data))
        bench.until(lambda number=number: bench.counts.refused == number)
        assert bench.counts.last_error
    header = bench.header()
    packed.publish(CompressedImage(header=header, format=form, data=data))
    bench.until(lambda: any(one.header == header for one in bench.answers))


def test_raw_images_of_a_lens_are_rectified_and_rendered_as_they_were_sent(make_bench):
    bench = make_bench()
    bench.until(lambda: bench.infos.get_subscription_count() == 1)
    info = CameraInfo(width=64, height=48, distortion_model="plumb_bob", d=[-0.2, 0.05, 0.001, -0.001, 0.0])
    info.k = [60.0, 0.0, 31.5, 0.0, 60.0, 23.5, 0.0, 0.0, 1.0]
    bench.put_info(info)
    rendered: list[Image] = []
    bench.peer.create_subscription(Image, "recover_node/rendered_depth", rendered.append, 5)
    bench.until(lambda: bench.node._outputs.rendered_depth.get_subscription_count())
    bench.answer(bench.depth())
    depth, camera, _, _ = bench.recoverer.asked[-1]
    assert depth.shape == (camera.height, camera.width)
    assert (camera.width, camera.height) > (64, 48), "a barrel's corners lie farther out in the ideal image"
    assert np.nanmax(np.abs(depth - 0.5)) < 1e-6
    bench.until(lambda: rendered)
    assert (rendered[-1].width, rendered[-1].height) == (64, 48)
