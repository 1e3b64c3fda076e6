"""Images as cameras send them: packed, raw from a lens that distorts, and as points."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs the extra 'ros'")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from frame_node_bench import CAMERA, Bench
from packed_depth import pack
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2, PointField
from spun_nodes import SpunNodes
from stand_in_tf2 import Tf2
from std_msgs.msg import Header

from sq_msgs_py.depth_image import depth_to_message, labels_to_message
from sq_perception.geometry import rotation as quaternions
from sq_perception.nodes.frame import image_topic


def test_packed_images_are_read_and_hostile_ones_refused(make_bench):
    bench = make_bench("-p", "image_transport:=compressedDepth", "-r", "depth/image:=/camera/depth")
    packed = bench.peer.create_publisher(CompressedImage, "/camera/depth/compressedDepth", 5)
    bench.until(packed.get_subscription_count)
    bench.send_info()
    depth = np.full((48, 64), 0.731, np.float32)
    depth[:5] = np.nan
    for encoding in ("16UC1", "32FC1"):
        form, data = pack(depth, encoding)
        bench.answer(CompressedImage(header=bench.header(), format=form, data=data), packed)
        seen = bench.recoverer.asked[-1][0]
        assert np.isnan(seen[:5]).all()
        np.testing.assert_allclose(seen[5:], 0.731, atol=1e-3)
    hostile = [("", b""), ("16UC1; compressedDepth png", b""), (form, data[:40]), ("rgb8; jpeg", b"abc")]
    for number, (bad_form, bad_data) in enumerate(hostile, start=1):
        counts = bench.send(CompressedImage(header=bench.header(), format=bad_form, data=bad_data), packed)
        assert counts.refused == number
        assert counts.last_error
    bench.answer(CompressedImage(header=bench.header(), format=form, data=data), packed)


@pytest.mark.parametrize(
    ("rules", "expected"),
    [
        ([], "/depth/image/compressedDepth"),
        (["-r", "depth/image:=/camera/depth/image_rect_raw"], "/camera/depth/image_rect_raw/compressedDepth"),
        (["-r", "depth/image:=/camera/image_rect/compressedDepth"], "/camera/image_rect/compressedDepth"),
        (["-r", "__ns:=/robot"], "/robot/depth/image/compressedDepth"),
    ],
)
def test_topics_of_packed_images_are_named_as_image_transport_names_them(rules, expected):
    with SpunNodes(*rules) as nodes:
        nodes.spin([])
        assert image_topic(nodes.peer, "compressedDepth") == expected
        assert image_topic(nodes.peer, "raw") == nodes.peer.resolve_topic_name("depth/image")


def test_units_marks_and_ranges_are_read_as_in_files(make_bench, monkeypatch):
    bench = make_bench("-p", "depth_scale:=1000.0")
    bench.send_info()
    bench.answer(bench.depth(value=500.0))
    np.testing.assert_allclose(bench.recoverer.asked[-1][0], 0.5)
    bench.set(bench.node, depth_scale=0.0)
    infos: list[str] = []
    monkeypatch.setattr(bench.node.get_logger(), "info", lambda text, **_: infos.append(text))
    depth = np.full((48, 64), 0.5)
    depth[20:25, 20:25] = 10.0
    bench.answer(depth_to_message(depth, bench.header()))
    np.testing.assert_array_equal(np.isnan(bench.recoverer.asked[-1][0]), depth == 10)
    assert any("10 m is taken for no reading" in text for text in infos)
    bench.set(bench.node, depth_kind="range")
    bench.answer(bench.depth(value=0.5))
    seen, camera, _, _ = bench.recoverer.asked[-1]
    np.testing.assert_allclose(np.linalg.norm(camera.points(seen), axis=2), 0.5, rtol=1e-6)


def test_an_image_that_seems_to_have_another_unit_is_a_warning_in_log_and_diagnostics(bench, monkeypatch):
    """Though it is answered, and has no bodies."""
    reports, warnings = bench.hear(DiagnosticArray, "/diagnostics"), []
    monkeypatch.setattr(bench.node.get_logger(), "warning", lambda text, **_: warnings.append(text))
    bench.recoverer.bodies, bench.recoverer.doubt, bench.recoverer.message = (), "hardly metres", "hardly metres"
    bench.send_info()
    bench.until(lambda: bench.node.count_publishers("/diagnostics") and bench.node.count_subscribers("/diagnostics"))
    bench.answer(bench.depth(value=500.0))
    assert "hardly metres" in warnings
    found = lambda: [one.status[0] for one in reports if one.status[0].message == "hardly metres"]  # noqa: E731
    bench.until(found)
    assert found()[0].level == DiagnosticStatus.WARN


def test_raw_images_of_a_lens_are_rectified_and_rendered_as_they_were_sent(make_bench):
    bench = make_bench()
    bench.until(bench.infos.get_subscription_count)
    info = CameraInfo(width=64, height=48, distortion_model="plumb_bob", d=[-0.2, 0.05, 0.001, -0.001, 0.0])
    info.k = [60.0, 0.0, 31.5, 0.0, 60.0, 23.5, 0.0, 0.0, 1.0]
    bench.put_info(info)
    rendered = bench.hear(Image, "recover_node/rendered_depth")
    bench.until(lambda: bench.node._outputs.rendered_depth.get_subscription_count())
    bench.answer(bench.depth())
    depth, camera, _, _ = bench.recoverer.asked[-1]
    assert depth.shape == (camera.height, camera.width)
    assert (camera.width, camera.height) > (64, 48), "a barrel's corners lie farther out in the ideal image"
    assert np.nanmax(np.abs(depth - 0.5)) < 1e-6
    bench.until(lambda: rendered)
    assert (rendered[-1].width, rendered[-1].height) == (64, 48)


def cloud(points: np.ndarray, header: Header, labels: np.ndarray | None = None) -> PointCloud2:
    """As drivers send (height, width, 3): coordinates among other fields, points and rows padded."""
    height, width, _ = points.shape
    first = "rgb" if labels is None else "label"
    layout = {"names": [first, "x", "y", "z"], "formats": ["<u4", "<f4", "<f4", "<f4"], "offsets": [0, 4, 8, 16]}
    rows = np.zeros((height, width + 3), np.dtype({**layout, "itemsize": 32}))
    for k, name in enumerate("xyz"):
        rows[name][:, :width] = points[..., k]
    rows[first][:, :width] = 0 if labels is None else labels
    found = PointCloud2(header=header, height=height, width=width, point_step=32, row_step=32 * (width + 3))
    kinds = (PointField.UINT32, *[PointField.FLOAT32] * 3)
    found.fields = [
        PointField(name=name, offset=offset, datatype=kind, count=1)
        for name, offset, kind in zip(layout["names"], layout["offsets"], kinds, strict=True)
    ]
    found.data = rows.tobytes()
    return found


def seen_points() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A depth image, the column of each of its pixels, and its points."""
    depth = 0.5 + 0.003 * np.random.default_rng(5).random((48, 64))
    v, u = np.mgrid[:48, :64]
    return depth, u, CAMERA.unproject(u, v, depth)


def cloud_publisher(bench: Bench) -> Any:
    clouds = bench.peer.create_publisher(PointCloud2, "depth/points", 5)
    bench.until(clouds.get_subscription_count)
    return clouds


def test_an_organised_cloud_is_its_depth_image_and_any_other_one_tells_less(make_bench):
    bench = make_bench("-p", "image_transport:=points")
    clouds = cloud_publisher(bench)
    assert bench.infos.get_subscription_count() == 0, "the points say where the camera is"
    depth, _, points = seen_points()
    points[:5] = np.nan
    points[5, :9] = 0.0  # what some drivers send for nothing

    def answered(message: PointCloud2) -> tuple:
        bench.answer(message, clouds)
        return bench.recoverer.asked[-1]

    seen, camera, labels, options = answered(cloud(points, bench.header()))
    assert (camera, labels, options.free_space) == (CAMERA, None, True)
    assert np.isnan(seen[:5]).all()
    assert np.isnan(seen[5, :9]).all()
    np.testing.assert_array_equal(seen[6:], depth[6:].astype(np.float32))

    measured = points[np.isfinite(points).all(axis=2) & (points[..., 2] > 0)]
    np.random.default_rng(6).shuffle(measured)
    seen, camera, _, options = answered(cloud(measured[None], bench.header()))
    assert not options.free_space
    assert set(seen[np.isfinite(seen)]) <= set(measured[:, 2].astype(np.float32))
    assert np.isfinite(seen).sum() > 0.5 * len(measured)

    unnamed, short, nowhere = (cloud(points, bench.header()) for _ in range(3))
    unnamed.fields = unnamed.fields[:3]
    short.data = short.data[:-1]
    nowhere.fields[3].offset = 30
    behind, nothing = cloud(-points, bench.header()), cloud(points[:0], bench.header())
    for number, hostile in enumerate((unnamed, short, nowhere, behind, nothing), start=1):
        assert bench.send(hostile, clouds).refused == number
    answered(cloud(points, bench.header()))


def test_a_cloud_that_is_no_image_has_pixels_of_no_mask(make_bench):
    bench = make_bench("-p", "image_transport:=points", "-p", "patience:=10.0")
    clouds = cloud_publisher(bench)
    masks = bench.peer.create_publisher(Image, "mask/image", 5)
    bench.until(lambda: masks.get_subscription_count() and bench.node.count_publishers("/mask/image"))
    points = np.random.default_rng(7).uniform([-0.2, -0.2, 0.5], [0.2, 0.2, 0.502], (3000, 3)).astype(np.float32)
    row = cloud(points[None], bench.header())

    def decided(use: str) -> SimpleNamespace:
        bench.set(bench.node, use_masks=use)
        row.header = bench.header()
        masks.publish(labels_to_message(np.ones((48, 64), np.int32), row.header))
        return bench.send(row, clouds)

    counts = decided("auto")
    assert (counts.answered, counts.refused) == (1, 0), counts.last_error
    assert bench.recoverer.asked[-1][2] is None
    assert "mask: expected an image or an organised cloud" in decided("always").last_error


def test_labels_of_points_are_masks_and_points_of_another_frame_are_moved_by_tf(make_bench, monkeypatch):
    """A labelled cloud of the robot's frame: seen from the camera, with masks, and without either in plain words."""
    turn, place = quaternions.normalize(np.array([0.6, -0.5, 0.4, -0.5])), np.array([0.3, -0.4, 1.2])

    def look_up(target: str, source: str, *_: Any) -> Any:
        if (target, source) != ("camera_optical", "base"):
            raise LookupError(f"{source} is not connected")
        return turn, place

    Tf2(monkeypatch, look_up)
    bench = make_bench("-p", "image_transport:=points", "-p", "camera_frame:=camera_optical")
    clouds = cloud_publisher(bench)
    depth, u, seen = seen_points()
    there = (seen - place) @ quaternions.to_matrix(turn)
    labels = (u // 32 + 1).astype(np.int32)

    def labelled(frame_id: str) -> PointCloud2:
        header = bench.header()
        header.frame_id = frame_id
        return cloud(there, header, labels)

    bench.set(bench.node, use_masks="always")
    assert bench.answer(labelled("base"), clouds)[0].header.frame_id == "camera_optical"
    image, camera, masks, _ = bench.recoverer.asked[-1]
    np.testing.assert_allclose(image, depth, rtol=1e-5)
    assert camera.fx == pytest.approx(CAMERA.fx, rel=1e-3)
    np.testing.assert_array_equal(masks, labels)
    bench.set(bench.node, use_masks="never")
    bench.answer(labelled("base"), clouds)
    assert bench.recoverer.asked[-1][2] is None
    expected = "camera_frame: expected a transform from 'map' to 'camera_optical'"
    assert expected in bench.send(labelled("map"), clouds).last_error
