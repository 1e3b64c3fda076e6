"""Frames of synthetic_depth_node: seeded, held, looped, replayed, and refused where a file or a parameter is wrong."""

import cv2
import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs the extra 'ros'")


from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo, Image
from spun_nodes import SpunNodes

from sq_perception.imaging import unit_cube
from sq_perception.imaging.camera import Camera
from sq_perception.nodes.parameters import ParameterError
from sq_perception.nodes.synthetic_depth_node import FrameSource, SyntheticDepthNode, SyntheticParameters, frame_source
from sq_perception.recordings.frame_file import FrameError


def names(source: FrameSource, count: int) -> list[str | None]:
    frames = [source.next(0.0) for _ in range(count)]
    return [None if frame is None else frame.name for frame in frames]


@pytest.fixture
def recordings(tmp_path):
    """Three frames of different sizes, the second one with masks, and a file of another kind."""
    for k in range(3):
        depth = np.full((4 + k, 6), 1.0 + k, np.float32)
        fields = {"depth": depth, "K": np.array([[5.0, 0, 2.5], [0, 5.0, 1.5], [0, 0, 1]])}
        if k == 1:
            fields["labels"] = np.ones(depth.shape, np.int16)
        np.savez(tmp_path / f"{k}.npz", **fields)
    (tmp_path / "notes.txt").write_text("no frame")
    return tmp_path


@pytest.mark.parametrize("scene", ["thesis", "table"])
def test_a_scene_is_held_and_only_its_noise_changes(scene):
    noise = 2.0 if scene == "thesis" else 0.003
    source = frame_source(SyntheticParameters(scene=scene, hold=3, objects=2))
    frames = [source.next(noise) for _ in range(4)]
    flat = [frame.truth.to_flat() for frame in frames]
    np.testing.assert_array_equal(flat[0], flat[2])
    assert not np.allclose(flat[0], flat[3])
    difference = frames[0].depth - frames[1].depth
    sigma = noise / 255 if scene == "thesis" else noise
    assert np.nanstd(difference) == pytest.approx(np.sqrt(2) * sigma, rel=0.05)
    assert frames[0].labels is None


def test_a_seed_names_the_images_whatever_the_noise():
    first, again = (frame_source(SyntheticParameters(seed=5, hold=1)) for _ in range(2))
    for _ in range(2):
        np.testing.assert_array_equal(first.next(0.001).depth, again.next(0.001).depth)
    np.testing.assert_array_equal(first.next(0.0).truth.to_flat(), again.next(0.5).truth.to_flat())
    other = frame_source(SyntheticParameters(seed=6, hold=1))
    assert not np.array_equal(other.next(0.0).depth, frame_source(SyntheticParameters(seed=5)).next(0.0).depth)


def test_a_sensor_measures_the_scene_it_is_held_at():
    source = frame_source(SyntheticParameters(sensor="kinect_v1", hold=2, objects=2))
    true = frame_source(SyntheticParameters(hold=2, objects=2)).next(0.0)
    first, again = (source.next(0.0, "kinect_v1") for _ in range(2))
    np.testing.assert_array_equal(first.truth.to_flat(), true.truth.to_flat())
    assert not np.array_equal(first.depth, again.depth, equal_nan=True)
    assert np.isnan(first.depth).sum() > np.isnan(true.depth).sum()
    assert 0.5e-3 < np.nanmedian(np.abs(first.depth - true.depth)) < 5e-3
    with pytest.raises(ValueError, match="sensor: expected one of"):
        source.next(0.0, "lidar")


def test_scenes_end_or_begin_again():
    ending = names(frame_source(SyntheticParameters(scenes=2, hold=2, loop=False)), 6)
    assert ending == ["table scene 0"] * 2 + ["table scene 1"] * 2 + [None] * 2
    assert names(frame_source(SyntheticParameters(scenes=2, hold=1)), 4)[2:] == ["table scene 0", "table scene 1"]


def test_the_truth_of_thesis_scenes_is_in_the_cube_frame():
    frame = frame_source(SyntheticParameters(scene="thesis", masks="always")).next(0.0)
    assert frame.is_cube
    assert frame.camera == unit_cube.camera(256)
    u, v = unit_cube.camera(256).project(unit_cube.optical_from_cube(frame.truth).translation[0])
    assert (frame.labels[round(v), round(u)], frame.truth.translation[0, 1]) == (1, pytest.approx(1 - v / 255))


def test_a_folder_is_replayed_in_order_without_what_is_damaged_and_a_recording_alone(recordings):
    settings = {"scene": "replay", "path": str(recordings), "hold": 1}
    source = frame_source(SyntheticParameters(**settings))
    frames = [source.next(0.0) for _ in range(4)]
    assert [frame.name for frame in frames] == ["0.npz", "1.npz", "2.npz", "0.npz"]
    assert [frame.depth.shape[0] for frame in frames] == [4, 5, 6, 4]
    assert [frame.labels is not None for frame in frames] == [False, True, False, False]
    assert all(frame.truth is None for frame in frames)
    silent = frame_source(SyntheticParameters(**settings, masks="never"))
    assert all(silent.next(0.0).labels is None for _ in range(3))
    alone = {**settings, "path": str(recordings / "2.npz"), "hold": 2, "loop": False}
    assert names(frame_source(SyntheticParameters(**alone)), 3) == ["2.npz", "2.npz", None]
    (recordings / "1.npz").write_bytes(b"damaged")
    source = frame_source(SyntheticParameters(scene="replay", path=str(recordings), hold=1))
    assert source.next(0.0).name == "0.npz"
    with pytest.raises(FrameError, match=r"1\.npz"):
        source.next(0.0)
    assert source.next(0.0).name == "2.npz"


def test_misuse_is_named(recordings, tmp_path):
    def replay(**settings):
        return frame_source(SyntheticParameters(scene="replay", **settings))

    with pytest.raises(ValueError, match="does not exist"):
        replay(path=str(tmp_path / "nowhere"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="there are none"):
        replay(path=str(tmp_path / "empty"))
    with pytest.raises(ParameterError, match="expected 16UC1 or 32FC1"):
        replay(path=str(recordings), encoding="mono8")
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((16, 16), 90, np.uint8))
    with pytest.raises(ParameterError, match=r"sensor: expected ideal for grey\.png, got zed"):
        replay(path=str(tmp_path / "grey.png"), projection="orthographic", sensor="zed")
    (recordings / "0.npz").write_bytes(b"damaged")
    with pytest.raises(FrameError, match=r"0\.npz"):
        replay(path=str(recordings))
    with pytest.raises(FrameError, match="camera_info"):
        replay(path=str(recordings / "1.npz"), camera_info_file=str(tmp_path / "no.yaml"))


def test_a_camera_is_that_of_its_parameter_or_lies_beside_the_image(tmp_path):
    cv2.imwrite(str(tmp_path / "1.png"), np.full((48, 64), 900, np.uint16))
    numbers = SyntheticParameters(scene="replay", path=str(tmp_path), camera_info_file="60,60,31.5,23.5")
    assert frame_source(numbers).clean.camera == Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
    (tmp_path / "intrinsics.json").write_text(
        '{"width": 64, "height": 48, "intrinsic_matrix": [70, 0, 0, 0, 70, 0, 31.5, 23.5, 1]}'
    )
    beside = frame_source(SyntheticParameters(scene="replay", path=str(tmp_path)))
    assert beside.clean.camera == Camera(64, 48, 70.0, 70.0, 31.5, 23.5)
    lens = tmp_path / "lens.yaml"
    lens.write_text("{width: 320, height: 240, k: [262, 0, 159.5, 0, 260, 119.5, 0, 0, 1], d: [-0.2, 0.05, 0, 0, 0]}")
    table = frame_source(SyntheticParameters(camera_info_file=str(lens))).clean
    assert table.camera == Camera(320, 240, 262.0, 260.0, 159.5, 119.5), "without its distortion"
    assert table.depth.shape == (240, 320)


def test_a_node_replays_what_a_folder_holds(tmp_path):
    """First an orthographic frame, then a pinhole one with large labels: camera_info and masks come with these."""
    depth = np.full((8, 8), 0.5, np.float32)
    np.savez(tmp_path / "0.npz", depth=depth, projection="orthographic")
    matrix = np.array([[5.0, 0, 3.5], [0, 5.0, 3.5], [0, 0, 1]])
    np.savez(tmp_path / "1.npz", depth=depth, K=matrix, labels=np.full(depth.shape, 70000, np.int32))
    bench = SpunNodes("-p", "scene:=replay", "-p", f"path:={tmp_path}", "-p", "hold:=1", "-p", "rate:=20.0")
    heard = {"depth/camera_info": [], "mask/image": [], "depth/image": []}
    for topic, kind in (("depth/camera_info", CameraInfo), ("mask/image", Image), ("depth/image", Image)):
        bench.peer.create_subscription(kind, f"/{topic}", heard[topic].append, 10)
    bench.spin([SyntheticDepthNode("synthetic_depth_node", context=bench.context)])
    with bench:
        bench.until(lambda: all(len(messages) > 2 for messages in heard.values()))
        assert {message.encoding for message in heard["mask/image"]} == {"32SC1"}


def test_a_sensor_that_cannot_measure_the_scene_is_refused_while_the_node_runs(tmp_path):
    np.savez(tmp_path / "0.npz", depth=np.full((8, 8), 0.5, np.float32), projection="orthographic")
    with SpunNodes("-p", "scene:=replay", "-p", f"path:={tmp_path}") as bench:
        node = SyntheticDepthNode("synthetic_depth_node", context=bench.context)
        bench.spin([node])
        (refused,) = node.set_parameters([Parameter("sensor", value="zed")])
        assert not refused.successful
        assert "sensor" in refused.reason
