"""Bags: what was recorded is what is read, whatever the storage and encoding; what is broken is named and skipped."""

import json
import sqlite3
import struct
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from python_process import run_python

pytest.importorskip("rosbags", reason="rosbags is missing: install the extra 'bags'")

from recover_runs import CAMERA, camera_yaml, recover, run
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from sq_perception import RecordedFrame, Superquadric
from sq_perception.imaging import compressed_depth, raycast, unit_cube
from sq_perception.imaging.distortion import Distortion
from sq_perception.imaging.rectification import Rectification
from sq_perception.recordings import bag_file, bag_reader
from sq_perception.recordings.bag_file import InputOptions, RecordedBag
from sq_perception.recordings.frame_file import FrameError, Reading, Stamp
from sq_perception.recordings.inputs import RecordedInput

TYPES = get_typestore(Stores.ROS2_JAZZY)
T = {name.rpartition("/")[2]: kind for name, kind in TYPES.types.items()}
SECOND = 10**9
TOPIC, INFO = "/camera/depth/image_rect_raw", "/camera/depth/camera_info"
both_storages = pytest.mark.parametrize("storage", list(StoragePlugin), ids=lambda one: one.name)
K = CAMERA.matrix


def header(stamp: float) -> Any:
    sec = int(stamp)
    time = T["Time"](sec=sec, nanosec=round((stamp - sec) * SECOND))
    return T["Header"](stamp=time, frame_id="depth_optical")


def image(pixels: np.ndarray, stamp: float, encoding: str, *, big: bool = False, padding: int = 0, **wrong: Any) -> Any:
    """Fields may be ``wrong``."""
    height, width = pixels.shape
    kind = {"32FC1": "f4", "mono8": "u1", "8UC1": "u1"}.get(encoding, "u2")
    rows = pixels.astype((">" if big else "<") + kind).view(np.uint8).reshape(height, -1)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=255)
    known = {"height": height, "width": width, "encoding": encoding, "is_bigendian": int(big), "step": rows.shape[1]}
    return T["Image"](**{"header": header(stamp), **known, "data": rows.reshape(-1), **wrong})


def packed(grey: np.ndarray, stamp: float) -> Any:
    png = cv2.imencode(".png", grey)[1].tobytes()
    data = np.frombuffer(struct.pack("<iff", 0, 0.0, 0.0) + png, np.uint8)
    return T["CompressedImage"](header=header(stamp), format="16UC1; compressedDepth png", data=data)


def info(stamp: float, k: np.ndarray = K, size: tuple[int, int] = (160, 120), distortion: float = 0.0) -> Any:
    whole = T["RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return T["CameraInfo"](
        header=header(stamp), height=size[1], width=size[0], distortion_model="plumb_bob",
        d=np.array([distortion, 0, 0, 0, 0.0]), k=k.ravel(), r=np.eye(3).ravel(),
        p=np.hstack([k, np.zeros((3, 1))]).ravel(), binning_x=0, binning_y=0, roi=whole,
    )


def write(path, messages, storage=StoragePlugin.MCAP, mode=CompressionMode.NONE) -> Path:
    """A bag of (topic, second of recording, message); where the message is bytes, the topic is one of images."""
    writer = Writer(path, version=9, storage_plugin=storage)
    if mode is not CompressionMode.NONE:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for topic, second, message in messages:
            kind = "sensor_msgs/msg/Image" if isinstance(message, bytes) else message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=TYPES)
            data = message if isinstance(message, bytes) else TYPES.serialize_cdr(message, kind)
            writer.write(connections[topic], round(second * SECOND), data)
    return path


@pytest.fixture
def grey(rng):
    """Millimetres, 0 for nothing."""
    return np.where(rng.random((120, 160)) < 0.1, 0, rng.integers(300, 4000, (120, 160))).astype(np.uint16)


def metres(grey):
    return np.where(grey > 0, grey / np.float32(1000), np.float32(np.nan)).astype(np.float32)


def frames(path, **options):
    with RecordedBag(path, InputOptions(**options)) as bag:
        return list(bag)


def recording(grey, *seconds):
    """Contents of a bag: a camera_info, and the same image at these seconds."""
    return [(INFO, 1, info(1)), *((TOPIC, second, image(grey, second, "16UC1")) for second in seconds)]


def lone(folder):
    (path,) = [one for one in folder.iterdir() if one.suffix in (".mcap", ".db3")]
    return path


@both_storages
@pytest.mark.parametrize(("big", "padding"), [(False, 0), (True, 7)])
def test_every_encoding_is_the_same_depth(tmp_path, grey, storage, big, padding):
    truth = metres(grey)
    messages = [
        image(grey, 1.5, "16UC1", big=big, padding=padding),
        image(truth, 2.5, "32FC1", big=big, padding=padding),
        image(np.where(grey > 0, truth, np.inf), 3.5, "32FC1", big=big, padding=padding),
    ]
    contents = [(INFO, 1.5, info(1.5))] + [(TOPIC, 1.5 + k, one) for k, one in enumerate(messages)]
    bag = write(tmp_path / "bag", contents, storage)
    for path in (bag, lone(bag)):
        found = frames(path)
        assert [frame.stamp for frame in found] == [Stamp(k, 500_000_000) for k in (1, 2, 3)]
        for frame in found:
            np.testing.assert_array_equal(frame.depth, truth)
            assert (frame.depth.dtype, frame.camera) == (np.float32, CAMERA)
            assert (frame.topic, frame.frame_id, frame.warning) == (TOPIC, "depth_optical", "")
        assert found[0].name == "bag_1.500000000"


@both_storages
@pytest.mark.parametrize("mode", [CompressionMode.MESSAGE, CompressionMode.STORAGE], ids=lambda mode: mode.name)
def test_compressed_bags(tmp_path, grey, storage, mode):
    if (storage, mode) == (StoragePlugin.SQLITE3, CompressionMode.STORAGE):
        pytest.skip("sqlite3 has no compression of its own")
    bag = write(tmp_path / "bag", recording(grey, 1), storage, mode)
    for path in (bag, lone(bag)):
        (frame,) = frames(path)
        np.testing.assert_array_equal(frame.depth, metres(grey))


def test_a_bag_packed_as_a_whole_or_of_ros_1_says_what_to_do(tmp_path, grey):
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n")
    ((_, error),) = RecordedInput([str(tmp_path / "a.bag")])
    assert "rosbags-convert --src" in str(error)
    messages = [(TOPIC, 1, image(grey, 1, "16UC1"))]
    bag = write(tmp_path / "bag", messages, StoragePlugin.SQLITE3, CompressionMode.FILE)
    with pytest.raises(FrameError, match="zstd -d"):
        RecordedBag(bag)


def widened(focal):
    return np.array([[focal, 0, 79.5], [0, focal, 59.5], [0, 0, 1]])


def test_a_camera_info_belongs_to_the_image_of_its_stamp(tmp_path, grey):
    """Whether it lies before or after it in the bag; and without one of its stamp, the last one before the image."""
    contents = [
        (INFO, 1.0, info(1, widened(201.0))),
        (TOPIC, 1.1, image(grey, 1, "16UC1")),
        (TOPIC, 2.0, image(grey, 2, "16UC1")),
        (INFO, 2.1, info(2, widened(202.0))),
        (TOPIC, 3.0, image(grey, 3, "16UC1")),
        (INFO, 4.0, info(4, widened(204.0))),
        (TOPIC, 4.1, image(grey, 4, "16UC1")),
        (TOPIC, 5.0, image(grey, 5, "16UC1")),
    ]
    found = frames(write(tmp_path / "bag", contents))
    assert [frame.camera.fx for frame in found] == [201, 202, 202, 204, 204]
    assert [frame.stamp.sec for frame in found] == [1, 2, 3, 4, 5]


@both_storages
def test_a_late_camera_info_serves_all(tmp_path, grey, storage):
    late = write(tmp_path / "bag", [*recording(grey, 1, 2, 3)[1:], (INFO, 9, info(0))], storage)
    assert [frame.camera for frame in frames(late)] == [CAMERA] * 3


def test_a_missing_camera_info_is_named_and_can_be_given(tmp_path, grey):
    other = [("/colour/camera_info", 1, info(1)), (TOPIC, 1, image(grey, 1, "16UC1"))]
    bag = write(tmp_path / "bag", other)
    (error,) = frames(bag)
    assert isinstance(error, FrameError)
    assert TOPIC in str(error)
    assert "1.000000000" in str(error)
    assert f"no camera_info on {INFO} (camera_info topics: /colour/camera_info)" in str(error)
    (frame,) = frames(bag, camera_info="200,200,79.5,59.5")
    assert frame.camera == CAMERA


ELSEWHERE = "/device_0/sensor_0/Depth_0/info/camera_info"


def test_a_camera_info_elsewhere_is_used_where_it_is_the_only_one_that_fits_and_named(tmp_path, grey):
    others = [("/left/camera_info", 1, info(1, size=(80, 60))), ("/color/camera_info", 1, info(1, widened(150.0)))]
    contents = [*others, (TOPIC, 1, image(grey, 1, "16UC1")), (ELSEWHERE, 1, info(1))]
    (frame,) = frames(write(tmp_path / "bag", contents))
    assert frame.camera == CAMERA
    assert ELSEWHERE in frame.notes
    late = [*contents, ("/right/camera_info", 1, info(2, widened(250.0)))]
    (frame,) = frames(write(tmp_path / "late", late))
    assert frame.camera == CAMERA, "the stamp decides"
    two = write(tmp_path / "two", [*contents, ("/right/camera_info", 1, info(1, widened(250.0)))])
    (error,) = frames(two)
    assert f"{ELSEWHERE}, /left/camera_info, /right/camera_info" in str(error)
    assert "--camera-info-topic" in str(error)
    (frame,) = frames(two, camera_info_topic="right/camera_info")
    assert frame.camera.fx == 250
    with pytest.raises(FrameError, match=f"no camera_info on /nowhere; camera_info topics: .*{ELSEWHERE}"):
        RecordedBag(two, InputOptions(camera_info_topic="/nowhere"))


def test_marks_units_and_ranges_are_those_of_files(tmp_path, grey):
    holes = grey == 0
    for number, (topic, message) in enumerate(
        [
            (TOPIC, image(np.where(holes, 65535, grey), 1, "16UC1")),
            (TOPIC, image(np.where(holes, 10.0, metres(grey) / 2), 1, "32FC1")),
            (TOPIC + "/compressedDepth", packed(np.where(holes, 65535, grey).astype(np.uint16), 1)),
        ]
    ):
        (frame,) = frames(write(tmp_path / f"bag{number}", [(INFO, 1, info(1)), (topic, 1, message)]))
        np.testing.assert_array_equal(np.isnan(frame.depth), holes)
        assert "is taken for no reading" in frame.notes
    (tmp_path / "camera.json").write_text(json.dumps({"cam_K": K.ravel().tolist(), "depth_scale": 0.1}))
    (frame,) = frames(tmp_path / "bag0", camera_info=tmp_path / "camera.json", reading=Reading(kind="range"))
    ranges = np.linalg.norm(CAMERA.points(frame.depth), axis=2)
    np.testing.assert_allclose(ranges[~holes], metres(grey)[~holes] / 10, rtol=1e-5)


def test_distortion_is_undone_unless_the_topic_is_a_rectified_one(tmp_path, grey):
    raw = "/camera/depth/image_raw"
    contents = [(INFO, 1, info(1, distortion=0.1))] + [(one, 1, image(grey, 1, "16UC1")) for one in (TOPIC, raw)]
    bag = write(tmp_path / "bag", contents)
    cases = ((TOPIC, "auto", False), (TOPIC, "apply", True), (raw, "auto", True), (raw, "ignore", False))
    for topic, treatment, applied in cases:
        (frame,) = frames(bag, topic=topic, distortion=treatment)
        undone = Rectification(CAMERA, Distortion("plumb_bob", (0.1, 0, 0, 0, 0)))
        assert frame.camera == (undone.camera if applied else CAMERA)
        expected = undone.there.depth(metres(grey)) if applied else metres(grey)
        np.testing.assert_array_equal(frame.depth, expected)
        assert frame.warning == "" if treatment != "auto" else "0.1 0 0 0 0" in frame.warning
        assert ("not undone" in frame.warning) == (treatment == "auto" and not applied)


def test_the_topic_is_found_by_encoding_and_several_must_be_chosen_from(tmp_path, grey):
    other = "/aligned/image_raw"
    contents = [
        ("/infra/image", 1, image(np.zeros((4, 4)), 1, "mono8")),
        (INFO, 1, info(1)),
        ("/aligned/camera_info", 1, info(1)),
        (TOPIC + "/compressedDepth", 1, packed(grey, 1)),
        (TOPIC, 1, image(grey, 1, "16UC1")),
    ]
    (frame,) = frames(write(tmp_path / "one", contents))
    assert frame.topic == TOPIC  # not its packed copy
    (frame,) = frames(tmp_path / "one", topic=TOPIC + "/compressedDepth")
    assert frame.topic == TOPIC + "/compressedDepth"
    two = write(tmp_path / "two", [*contents, (other, 1, image(metres(grey) + 1, 1, "32FC1"))])
    rendered = ("/recover_node/rendered_depth", 1, image(metres(grey), 1, "32FC1"))  # of a bag of results
    (frame,) = frames(write(tmp_path / "results", [*contents, rendered]))
    assert frame.topic == TOPIC
    (frame,) = frames(write(tmp_path / "rendered", [("/recover_node/camera_info", 1, info(1)), rendered]))
    assert frame.topic == rendered[0], "nothing else shows depth"
    with pytest.raises(FrameError, match=f"several depth topics.*{other}, {TOPIC}"):
        RecordedBag(two)
    (frame,) = frames(two, topic=other.lstrip("/"))
    np.testing.assert_array_equal(frame.depth, metres(grey) + 1)
    with pytest.raises(FrameError, match=f"no images on /nowhere.*{TOPIC}"):
        RecordedBag(two, InputOptions(topic="/nowhere"))
    none = write(tmp_path / "none", contents[:3])
    with pytest.raises(FrameError, match=r"no topic with 16UC1 or 32FC1.*/infra/image \(mono8\)"):
        RecordedBag(none)


def test_orthographic_images(tmp_path):
    grey = np.zeros((64, 64), np.uint8)
    grey[20:40, 20:40] = 100
    bag = write(tmp_path / "bag", [("/view", 1, image(grey, 1, "mono8"))])
    (frame,) = frames(bag, projection="orthographic")
    assert frame.is_cube
    np.testing.assert_array_equal(frame.depth, unit_cube.depth_from_grey(grey))


@both_storages
def test_masks_are_found_by_their_stamps_in_whatever_order_they_were_recorded(tmp_path, grey, storage):
    """Before and after their images, not in their order; the third image has none, and the last comes twice."""
    contents = [(INFO, 0, info(0))]
    contents += [(TOPIC, 1 + k, image(grey, second, "16UC1")) for k, second in enumerate((1, 2, 3, 5, 4, 4))]
    contents += [
        ("/mask/image", second, image(np.full_like(grey, stamp), stamp, "8UC1"))
        for second, stamp in ((1.5, 2), (1.6, 1), (2.5, 4), (2.6, 5))
    ]
    found = frames(write(tmp_path / "bag", sorted(contents, key=lambda one: one[1]), storage))
    masks = [None if frame.labels is None else np.unique(frame.labels).tolist() for frame in found]
    assert masks == [[1], [2], None, [5], [4], [4]]


def test_images_without_a_stamp_have_no_mask_and_masks_that_are_ignored_are_not_read(tmp_path, grey):
    """Ignored ones may be a coloured picture of segments on a topic of that name."""
    mask = image(np.ones_like(grey), 0, "8UC1")
    contents = [(INFO, 0, info(0)), (TOPIC, 1, image(grey, 0, "16UC1")), ("/mask/image", 1.1, mask)]
    assert [frame.labels for frame in frames(write(tmp_path / "bag", contents))] == [None]
    path = write(tmp_path / "ignored", [*recording(grey, 1), ("/mask/image", 1, image(grey, 1, "rgb8"))])
    (refused,) = frames(path)
    assert "got 'rgb8'" in str(refused)
    (frame,) = frames(path, reading=Reading(ignore_masks=True))
    assert frame.labels is None


def test_where_a_mask_cannot_be_read_no_other_segments_are_taken_for_it(tmp_path, grey):
    contents = [*recording(grey, 1, 2), ("/mask/image", 1, image(np.ones_like(grey), 1, "8UC1"))]
    cut = bytes(TYPES.serialize_cdr(image(np.ones_like(grey), 2, "8UC1"), "sensor_msgs/msg/Image"))[:-100]
    first, second = frames(write(tmp_path / "bag", [*contents, ("/mask/image", 2, cut)]))
    assert (first.labels == 1).all()
    assert isinstance(second, FrameError)
    assert "one that cannot be read" in str(second)


def test_of_several_topics_with_masks_none_is_taken_and_frames_say_so(tmp_path, grey):
    contents = recording(grey, 1)
    contents += [(topic, 1, image(np.ones_like(grey), 1, "8UC1")) for topic in ("/b/mask/image", "/a/mask/image")]
    (frame,) = frames(write(tmp_path / "bag", contents))
    assert frame.labels is None
    assert "several topics with masks, none is taken: /a/mask/image, /b/mask/image" in frame.warning


@pytest.mark.parametrize(("every", "limit", "wanted"), [(1, None, 7), (3, None, 3), (2, 2, 2), (1, 9, 7), (8, 1, 1)])
def test_every_and_limit(tmp_path, grey, every, limit, wanted):
    write(tmp_path / "bag", recording(grey, *range(1, 8)))
    with RecordedBag(tmp_path / "bag", InputOptions(every=every, limit=limit)) as bag:
        assert len(bag) == wanted
        assert [frame.stamp.sec for frame in bag] == list(range(1, 8, every))[:limit]
    with pytest.raises(ValueError, match="at least 1"):
        InputOptions(every=0)


def hostile(grey):
    """Images that are none: name -> message, and what is said about it."""
    whole = image(grey, 2, "16UC1")
    sound = bytes(TYPES.serialize_cdr(whole, "sensor_msgs/msg/Image"))

    def wrong(**fields):
        return image(grey, 2, "16UC1", **fields)

    return {
        "half a message": (sound[:100], "recorded at 2.000000000"),
        "no message": (b"", "recorded at 2.000000000"),
        "noise": (bytes(range(256)), "recorded at 2.000000000"),
        "a length of 4 GB": (sound[:60].replace(b"16UC1", b"\xff" * 5) + b"\xff" * 60, "recorded at 2.000000000"),
        "a byte missing": (wrong(data=whole.data[:-1]), "at 2.000000000: data: expected height x step"),
        "a size of 2^64 pixels": (wrong(height=2**32 - 1, width=2**32 - 1), "step: expected"),
        "a row beyond its step": (wrong(width=2**31), "step: expected"),
        "colour": (image(grey, 2, "rgb8"), "encoding: expected 16UC1"),
        "another size": (image(grey[:50], 2, "16UC1"), "does not fit"),
    }


@pytest.mark.parametrize("what", hostile(np.zeros((120, 160), np.uint16)))
@both_storages
def test_broken_messages_are_named_and_skipped(tmp_path, grey, storage, what):
    message, reason = hostile(grey)[what]
    contents = [*recording(grey, 1), (TOPIC, 2, message), *recording(grey, 3)[1:]]
    first, error, last = frames(write(tmp_path / "bag", contents, storage))
    assert (first.stamp.sec, last.stamp.sec) == (1, 3)
    assert isinstance(error, FrameError)
    assert TOPIC in str(error)
    assert reason in str(error)


def test_a_broken_camera_info_is_named_and_the_last_good_one_serves(tmp_path, grey):
    bag = write(tmp_path / "bag", recording(grey, 2), StoragePlugin.SQLITE3)
    with sqlite3.connect(lone(bag)) as database:
        ((topic_id, data),) = database.execute("SELECT topic_id, data FROM messages WHERE timestamp = 1000000000")
        database.execute("INSERT INTO messages VALUES (9, ?, 1500000000, ?)", (topic_id, data[:40]))
    error, frame = frames(bag)
    assert INFO in str(error)
    assert frame.camera == CAMERA
    uncalibrated = info(1, np.zeros((3, 3)))
    (error,) = frames(write(tmp_path / "zero", [(INFO, 1, uncalibrated), (TOPIC, 1, image(grey, 1, "16UC1"))]))
    assert "not calibrated" in str(error)


def small_png(width, height):
    """A PNG that says it is larger than it is."""
    png = bytearray(cv2.imencode(".png", np.zeros((2, 2), np.uint16))[1].tobytes())
    png[16:24] = struct.pack(">II", width, height)
    return bytes(12) + bytes(png)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "got 0 bytes"),
        (bytes(100), "expected a PNG"),
        (small_png(2**16, 2**16), "at most"),
        (small_png(0, 2), "at most"),
        (small_png(2000, 2000), "not readable"),
        (bytes(12) + cv2.imencode(".png", np.zeros((4, 4), np.uint8))[1].tobytes(), "16 bit grey, got 8"),
        (bytes(12) + cv2.imencode(".png", np.zeros((4, 4, 3), np.uint16))[1].tobytes(), "colour type 2"),
    ],
)
def test_hostile_pngs_and_other_packings_are_refused(data, reason):
    with pytest.raises(ValueError, match=reason):
        compressed_depth.decode("16UC1; compressedDepth png", data)
    for text in ("rgb8; jpeg compressed bgr8", "", "8UC1; compressedDepth png"):
        assert compressed_depth.encoding(text) is None
        with pytest.raises(ValueError, match="format"):
            compressed_depth.decode(text, bytes(100))


def test_bombs_do_not_unpack():
    """64 MB of zeros in some kilobytes, where 1000 bytes were announced."""
    zstd = pytest.importorskip("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")
    import lz4.frame

    zeros = bytes(2**26)
    for unpack, pack in ((bag_reader._unpack, zstd.compress), (bag_reader._unpack_lz4, lz4.frame.compress)):
        bomb = pack(zeros)
        assert unpack(bomb, 2**26) == zeros
        tracemalloc.start()
        with pytest.raises(ValueError, match="at most 1000"):
            unpack(bomb, 1000)
        with pytest.raises(ValueError, match="announced"):
            unpack(bomb, 2**40)
        assert tracemalloc.get_traced_memory()[1] < 2**22
        tracemalloc.stop()
        with pytest.raises((ValueError, RuntimeError)):
            unpack(bomb[: len(bomb) // 2], 2**26)


@both_storages
@pytest.mark.parametrize("kept", [0.0, 0.001, 0.4, 0.9, 0.999])
def test_truncated_files_are_named(tmp_path, grey, storage, kept):
    path = lone(write(tmp_path / "bag", recording(grey, *range(1, 9)), storage))
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    for bag in (tmp_path / "bag", path):
        try:
            found = frames(bag)
        except FrameError as error:
            found = [error]
        assert any(isinstance(one, FrameError) for one in found)
        assert all(str(bag) in str(one) for one in found if isinstance(one, FrameError))
        for frame in found:
            if isinstance(frame, RecordedFrame):
                np.testing.assert_array_equal(frame.depth, metres(grey))


@both_storages
def test_damaged_files_never_raise_anything_else(tmp_path, grey, storage, rng):
    path = lone(write(tmp_path / "bag", recording(grey[:12, :16], 1, 2), storage))
    content = np.frombuffer(path.read_bytes(), np.uint8)
    for _ in range(60):
        damaged = content.copy()
        places = rng.integers(0, content.size, 8)
        damaged[places] = rng.integers(0, 256, 8)
        path.write_bytes(damaged.tobytes())
        try:
            found = frames(path)
        except FrameError:
            continue
        assert all(isinstance(one, RecordedFrame | FrameError) for one in found)


@pytest.mark.parametrize(
    "text", ["", "[]", "{", "rosbag2_bagfile_information: 3", "rosbag2_bagfile_information: {version: 9}"]
)
def test_bad_metadata_is_named(tmp_path, text):
    (tmp_path / "metadata.yaml").write_text(text)
    with pytest.raises(FrameError, match=str(tmp_path)):
        RecordedBag(tmp_path)


def test_what_is_a_bag(tmp_path):
    assert not bag_file.is_bag(tmp_path)
    (tmp_path / "metadata.yaml").touch()
    assert bag_file.is_bag(tmp_path)
    assert bag_file.is_bag("any.mcap")
    assert bag_file.is_bag("any.DB3")
    assert not bag_file.is_bag("any.npz")
    (tmp_path / "metadata.yaml").write_text("name: a data set\n")
    assert not bag_file.is_bag(tmp_path)
    (tmp_path / "metadata.yaml").write_text("# of a bag\nrosbag2_bagfile_information:\n  version: 9\n")
    assert bag_file.is_bag(tmp_path)
    with pytest.raises(FrameError, match=r"none\.mcap"):
        RecordedBag(tmp_path / "none.mcap")


def test_without_rosbags_one_sentence_says_so():
    code = "import sys; sys.modules['rosbags'] = None; from sq_perception.commands import main; "
    code += "sys.exit(main.main(['recover', 'x.mcap', '--method', 'classic']))"
    said = run_python("-c", code, code=1).stderr
    assert "pip install 'sq_perception[bags]'" in said
    assert "Traceback" not in said


def without_times(frame, *also):
    return {name: value for name, value in frame.items() if name not in ("ms", "ms_by_stage", "file", *also)}


def test_a_frame_has_the_same_numbers_from_every_kind_of_recording(tmp_path):
    body = Superquadric([0.05, 0.04, 0.08], [0.2, 0.9], [0.02, 0.01, 0.7], [0.4, 0.2, 0.1, 0.8])
    depth, _ = raycast.render(body, CAMERA)
    grey = np.where(np.isfinite(depth), np.round(1e3 * depth), 0).astype(np.uint16)
    np.savez(tmp_path / "frame.npz", depth=metres(grey), K=K)
    png = tmp_path / "frames" / "frame.png"
    png.parent.mkdir()
    cv2.imwrite(str(png), grey)
    camera_yaml(png.parent / "camera.yaml")
    messages = {
        "bag": recording(grey, 1),
        "metric": [(INFO, 1, info(1)), (TOPIC, 1, image(metres(grey), 1, "32FC1", big=True, padding=3))],
        "packed": [(INFO, 1, info(1)), (TOPIC + "/compressedDepth", 1, packed(grey, 1))],
    }
    bags = [write(tmp_path / name, content) for name, content in messages.items()]
    reference, *others = recover(tmp_path, tmp_path / "frame.npz", png.parent, *bags)
    assert reference["stamp"] is None
    (entry,) = reference["superquadrics"]
    assert 0.99 * np.count_nonzero(grey) < entry["pixels"] <= np.count_nonzero(grey)
    np.testing.assert_allclose(sorted(entry["size"]), sorted(body.size), atol=2e-3)
    origin = ("stamp", "topic", "frame_id")
    for other in others:
        assert without_times(other, *origin) == without_times(reference, *origin)
    assert [other["stamp"] for other in others] == [None] + 3 * [{"sec": 1, "nanosec": 0}]
    assert {other["frame_id"] for other in others[1:]} == {"depth_optical"}


def test_broken_bags_cost_the_exit_code_and_nothing_else(tmp_path, grey, capsys):
    grey[:] = 0
    contents = [(INFO, 1, info(1, distortion=0.2)), (TOPIC, 1, image(grey, 1, "16UC1")), (TOPIC, 2, b"\x1b[2Jnoise")]
    bag = write(tmp_path / "bag", [*contents, (TOPIC, 3, image(grey, 3, "16UC1"))])
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(lone(bag).read_bytes()[:-50])
    assert [frame["stamp"]["sec"] for frame in recover(tmp_path, cut, bag, code=1)] == [1, 3]
    errors = capsys.readouterr().err
    assert f"{cut}: not a readable bag" in errors
    assert f"{TOPIC} recorded at 2.000000000" in errors
    assert errors.count("not undone") == 1
    assert "2 frames, 0 objects (0 failed), 2 frames or sources unreadable, median" in errors


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("focal", [1e-300, 1e-6, 1e300])
@pytest.mark.parametrize("size", [(160, 120), (1, 1)])
def test_absurd_cameras_are_no_crash(tmp_path, grey, focal, size, capsys):
    grey = grey[: size[1], : size[0]] | 1
    k = np.array([[focal, 0, 0], [0, focal, 0], [0, 0, 1]])
    bag = write(tmp_path / "bag", [(INFO, 1, info(1, k, size)), (TOPIC, 1, image(grey, 1, "16UC1"))])
    assert run(bag) in (0, 1)
    assert "Traceback" not in capsys.readouterr().err


def test_a_database_cannot_make_up_large_messages(tmp_path, grey):
    """A computed column is a blob of a gigabyte that takes no room in the file."""
    bag = write(tmp_path / "bag", recording(grey, 1), StoragePlugin.SQLITE3)
    with sqlite3.connect(lone(bag)) as database:
        database.execute("ALTER TABLE messages RENAME COLUMN data TO stored")
        database.execute(f"ALTER TABLE messages ADD COLUMN data AS (zeroblob({bag_reader.LARGEST + 1}))")
    with pytest.raises(FrameError, match="TooBig"):
        RecordedBag(bag)
