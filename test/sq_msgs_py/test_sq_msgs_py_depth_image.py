"""Images by hand, byte by byte, against what the module reads and writes."""

import struct
from typing import Any

import numpy as np
import pytest

pytest.importorskip("sensor_msgs", reason="message packages missing: install the extra 'ros' or source ROS 2")

from builtin_interfaces.msg import Time
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from sq_msgs_py import depth_image
from sq_msgs_py.depth_image import ImageError, Intrinsics
from sq_perception.recordings import publication

HEADER = Header(stamp=Time(sec=12, nanosec=345), frame_id="camera_optical")


def depth_from_message(message: Image) -> np.ndarray:
    return publication.depth_of(message, is_cube=False)[0].depth


def image(encoding: str, width: int, height: int, data: bytes, *, step: int, big: bool = False) -> Image:
    fields = {"header": HEADER, "encoding": encoding, "width": width, "height": height, "step": step}
    return Image(**fields, is_bigendian=int(big), data=data)


def test_millimetres_become_metres_which_keep_their_value_and_what_is_no_reading_becomes_nan() -> None:
    message = image("16UC1", 3, 2, struct.pack("<6H", 0, 1, 1000, 1500, 65534, 2), step=6)
    depth = depth_from_message(message)
    assert depth.dtype == np.float32
    np.testing.assert_array_equal(depth, np.float32([[np.nan, 0.001, 1.0], [1.5, 65.534, 0.002]]))
    message = image("32FC1", 3, 2, struct.pack("<6f", 0.5, np.nan, np.inf, -np.inf, 0.0, -1.0), step=12)
    np.testing.assert_array_equal(depth_from_message(message), [[0.5, np.nan, np.nan], [np.nan] * 3])


@pytest.mark.parametrize(("encoding", "code"), [("16UC1", "H"), ("32FC1", "f")])
@pytest.mark.parametrize("padding", [0, 1, 7])
@pytest.mark.parametrize("big", [False, True])
def test_rows_may_be_padded_and_bytes_swapped(encoding: str, code: str, padding: int, big: bool) -> None:
    order = ">" if big else "<"
    rows = [struct.pack(f"{order}3{code}", *values) + b"\xff" * padding for values in ([1, 2, 3], [4, 5, 6])]
    message = image(encoding, 3, 2, b"".join(rows), step=len(rows[0]), big=big)
    scale = 1000 if encoding == "16UC1" else 1
    depth = depth_from_message(message)
    np.testing.assert_array_equal(depth, np.float32([[1, 2, 3], [4, 5, 6]]) / np.float32(scale))
    assert depth.dtype.isnative


def test_pixels_are_read_in_place_and_a_depth_image_does_not_change_with_its_message() -> None:
    message = depth_image.depth_to_message(np.ones((4, 5), np.float32), HEADER)
    pixels, depth = depth_image.pixels_from_message(message), depth_from_message(message)
    message.data[0:4] = message.data[0:0].__class__("B", struct.pack("<f", 7.0))
    assert pixels[0, 0] == 7.0
    assert (depth == 1).all()
    depth[:] = 2
    assert depth_from_message(message)[1, 1] == 1


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (image("rgb8", 2, 2, bytes(12), step=6), ["16UC1 or 32FC1", "'rgb8'"]),
        (image("", 2, 2, bytes(8), step=4), ["16UC1 or 32FC1", "''"]),
        (image("mono16", 2, 2, bytes(8), step=4), ["16UC1 or 32FC1", "'mono16'"]),
        (image("16UC1", 2, 2, bytes(6), step=3), ["at least 4 bytes", "got 3"]),
        (image("16UC1", 2, 2, bytes(0), step=0), ["at least 4 bytes", "got 0"]),
        (image("32FC1", 2, 2, bytes(15), step=8), ["2 x 8 = 16 bytes", "got 15"]),
        (image("32FC1", 2, 2, bytes(17), step=8), ["2 x 8 = 16 bytes", "got 17"]),
        (image("32FC1", 2, 2, b"", step=8), ["2 x 8 = 16 bytes", "got 0"]),
        (image("32FC1", 0, 2, b"", step=0), ["at least 1 x 1", "got 0 x 2"]),
        (image("32FC1", 2, 0, b"", step=8), ["at least 1 x 1", "got 2 x 0"]),
    ],
)
def test_refusals_say_what_was_expected_and_what_arrived(message: Image, words: list[str]) -> None:
    with pytest.raises(ImageError) as error:
        depth_from_message(message)
    assert all(word in str(error.value) for word in words), str(error.value)


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_depth_survives_the_round_trip(encoding: str, rng: np.random.Generator) -> None:
    """Also of a view of an array, and of one pixel."""
    depth = (rng.integers(1, 5000, (17, 46)).astype(np.float32) / np.float32(1000))[::-1, ::2]
    depth[rng.random(depth.shape) < 0.3] = np.nan
    dot = np.ones((1, 1), np.float32)
    assert depth_from_message(depth_image.depth_to_message(dot, HEADER, encoding)) == dot
    message = depth_image.depth_to_message(depth, HEADER, encoding)
    assert message.header == HEADER
    assert (message.width, message.height, message.encoding) == (23, 17, encoding)
    np.testing.assert_array_equal(depth_from_message(message), depth)


def test_what_millimetres_cannot_say_is_no_reading() -> None:
    depth = np.array([[np.inf, -1.0, 70.0, 0.0004, 0.0006, 65.535]], np.float32)
    message = depth_image.depth_to_message(depth, HEADER, "16UC1")
    assert struct.unpack("<6H", message.data.tobytes()) == (0, 0, 0, 0, 1, 65535)


@pytest.mark.parametrize(
    ("write", "pixels", "encoding"),
    [
        (depth_image.depth_to_message, np.ones((2, 2), np.float32), "mono8"),
        (depth_image.depth_to_message, np.ones((2, 2), np.uint16), "16UC1"),
        (depth_image.depth_to_message, np.ones(4, np.float32), "32FC1"),
        (depth_image.depth_to_message, np.ones((0, 4), np.float32), "32FC1"),
        (depth_image.labels_to_message, np.array([[256]]), "mono8"),
        (depth_image.labels_to_message, np.array([[-1]]), "16UC1"),
        (depth_image.labels_to_message, np.array([[1.0]]), "16UC1"),
        (depth_image.labels_to_message, np.array([[1]]), "32FC1"),
    ],
)
def test_what_is_no_image_of_the_kind_is_not_written(write: Any, pixels: np.ndarray, encoding: str) -> None:
    with pytest.raises(ImageError, match="expected"):
        write(pixels, HEADER, encoding)


@pytest.mark.parametrize(("dtype", "encoding"), [(np.uint8, "mono8"), (np.uint16, "mono16")])
def test_grey_survives_the_round_trip(dtype: type, encoding: str, rng: np.random.Generator) -> None:
    grey = rng.integers(0, np.iinfo(dtype).max, (5, 4), dtype, endpoint=True)
    message = depth_image.grey_to_message(grey, HEADER)
    assert message.encoding == encoding
    back = depth_image.grey_from_message(message)
    assert back.dtype == dtype
    np.testing.assert_array_equal(back, grey)
    foreign = depth_image.grey_from_message(image("mono16", 2, 1, struct.pack(">2H", 258, 3), step=4, big=True))
    assert foreign.dtype.isnative
    assert foreign.tolist() == [[258, 3]]
    with pytest.raises(ImageError, match="mono8 or mono16, got '16UC1'"):
        depth_image.grey_from_message(image("16UC1", 1, 1, b"\x01\x00", step=2))


@pytest.mark.parametrize("encoding", depth_image.LABEL_ENCODINGS)
def test_labels_survive_the_round_trip_in_every_encoding(encoding: str, rng: np.random.Generator) -> None:
    labels = rng.integers(0, 256, (6, 7))
    back = depth_image.labels_from_message(depth_image.labels_to_message(labels, HEADER, encoding))
    assert back.dtype == np.int32
    np.testing.assert_array_equal(back, labels)


def test_negative_labels_are_background() -> None:
    message = depth_image.labels_to_message(np.array([[-1, 0, 70000]]), HEADER, "32SC1")
    assert depth_image.labels_from_message(message).tolist() == [[0, 0, 70000]]


def test_intrinsics_survive_the_round_trip() -> None:
    intrinsics = Intrinsics(640, 480, 525.0, 526.0, 319.5, 239.5)
    message = depth_image.intrinsics_to_message(intrinsics, HEADER)
    assert message.header == HEADER
    assert depth_image.intrinsics_from_message(message) == intrinsics


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({}, "not calibrated"),
        ({"k": [1e-9, 0.0, 2.0, 0.0, 6.0, 1.0, 0.0, 0.0, 1.0]}, "0.01 to 1e\\+06 pixels"),
        ({"k": [5.0, 0.0, 2.0, 0.0, 1e300, 1.0, 0.0, 0.0, 1.0]}, "0.01 to 1e\\+06 pixels"),
        ({"k": [5.0, 0.0, -1e20, 0.0, 6.0, 1.0, 0.0, 0.0, 1.0]}, "principal point"),
    ],
)
def test_a_camera_info_that_says_nothing_is_refused(change: dict, words: str) -> None:
    message = CameraInfo(**{"width": 4, "height": 3, **change})
    with pytest.raises(ImageError, match=words):
        depth_image.intrinsics_from_message(message)
