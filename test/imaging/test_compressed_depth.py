"""Packed depth images: there and back, RVL against a packer written from the paper, and what is hostile."""

import struct
import tracemalloc

import cv2
import numpy as np
import pytest
from packed_depth import pack

from sq_perception.imaging import compressed_depth
from sq_perception.imaging.depth_units import metres


@pytest.fixture
def depth(rng):
    """Metres to the millimetre, a tenth of them NaN."""
    metres = rng.integers(300, 9000, (48, 64)).astype(np.float32) / np.float32(1000)
    return np.where(rng.random(metres.shape) < 0.1, np.float32(np.nan), metres).astype(np.float32)


def packed_runs(grey):
    """RVL of uint16 (height, width), number by number."""
    nibbles, values, last = [], [int(value) for value in grey.ravel()], 0

    def put(number):
        while True:
            group, number = number & 7, number >> 3
            nibbles.append(group | (8 if number else 0))
            if not number:
                return

    at = 0
    while at < len(values):
        first = at
        while first < len(values) and values[first] == 0:
            first += 1
        end = first
        while end < len(values) and values[end] != 0:
            end += 1
        put(first - at)
        put(end - first)
        for value in values[first:end]:
            difference, last = value - last, value
            put(2 * difference if difference >= 0 else -2 * difference - 1)
        at = end
    nibbles += [0] * (-len(nibbles) % 8)
    words = [int("".join(f"{one:x}" for one in nibbles[k : k + 8]), 16) for k in range(0, len(nibbles), 8)]
    return struct.pack(f"<{len(words)}I", *words)


def rvl_message(grey, a=0.0, b=0.0):
    height, width = grey.shape
    return struct.pack("<iffII", 0, a, b, width, height) + packed_runs(grey)


def test_millimetres_come_back(depth):
    image_format, data = pack(depth)
    assert image_format == "16UC1; compressedDepth png"
    np.testing.assert_array_equal(metres(compressed_depth.decode(image_format, data)).depth, depth)
    assert compressed_depth.size(image_format, data) == (64, 48)
    # The reference's older versions name no packing.
    np.testing.assert_array_equal(metres(compressed_depth.decode("16UC1; compressedDepth", data)).depth, depth)


def test_inverse_depth_comes_back_within_half_a_level(depth):
    image_format, data = pack(depth, "32FC1")
    assert image_format == "32FC1; compressedDepth png"
    found = compressed_depth.decode(image_format, data)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(depth))
    seen = np.isfinite(depth)
    assert (np.abs(found - depth)[seen] <= 0.51 * depth[seen] ** 2 / 10100 + 1e-6).all()


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_what_cannot_be_packed_becomes_nothing(encoding):
    depth = np.array([[np.nan, np.inf, 0.0, -1.0, 1e-5, 80.0, 1.0]])
    found = metres(compressed_depth.decode(*pack(depth, encoding))).depth
    assert np.isnan(found[0, :-1]).all()
    assert found[0, -1] == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.95, 1.0])
def test_rvl_comes_back(rng, share):
    grey = np.where(rng.random((48, 64)) < share, 0, rng.integers(1, 2**16, (48, 64))).astype(np.uint16)
    data = rvl_message(grey)
    assert compressed_depth.size("16UC1; compressedDepth rvl", data) == (64, 48)
    np.testing.assert_array_equal(compressed_depth.decode_rvl(data[20:], 64, 48), grey)
    np.testing.assert_array_equal(compressed_depth.decode("16UC1; compressedDepth rvl", data), grey)


def test_both_packings_say_the_same(depth):
    image_format, data = pack(depth, "32FC1")
    _, a, b = struct.unpack_from("<iff", data)
    levels = cv2.imdecode(np.frombuffer(data, np.uint8, offset=12), cv2.IMREAD_UNCHANGED)
    runs = compressed_depth.decode("32FC1; compressedDepth rvl", rvl_message(levels, a, b))
    np.testing.assert_array_equal(runs, compressed_depth.decode(image_format, data))


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "header and a size, got 0 bytes"),
        (bytes(20), "at most .* got 0 x 0"),
        (bytes(12) + struct.pack("<II", 2**31, 2**31), "at most"),
        (bytes(12) + struct.pack("<II", 4096, 4096), "at most"),
        (bytes(12) + struct.pack("<II", 4, 4), "ends after 0"),
        (bytes(12) + struct.pack("<II", 4, 4) + bytes(8), "not readable after 0"),
        (bytes(12) + struct.pack("<II", 4, 4) + bytes(1000), "at most 4 bytes"),
        (bytes(12) + struct.pack("<III", 4, 4, 0xFFFFFFFF) + b"\x00\x00\x00\xff" * 2, "at most 9 groups"),
        (bytes(12) + struct.pack("<III", 4, 4, 0xA2A20000), "not readable"),
        (bytes(12) + struct.pack("<III", 4, 4, 0x01203000), "ends after|not readable"),
    ],
)
def test_hostile_rvl_is_refused(data, words):
    tracemalloc.start()
    with pytest.raises(ValueError, match=words):
        compressed_depth.decode("16UC1; compressedDepth rvl", data)
    assert tracemalloc.get_traced_memory()[1] < 2**20
    tracemalloc.stop()


def test_damaged_rvl_never_raises_anything_else(rng):
    sound = np.frombuffer(rvl_message(rng.integers(0, 3, (12, 16)).astype(np.uint16)), np.uint8)
    for _ in range(300):
        damaged = sound.copy()
        damaged[rng.integers(12, damaged.size, 3)] = rng.integers(0, 256, 3)
        try:
            compressed_depth.decode("16UC1; compressedDepth rvl", damaged[: rng.integers(1, damaged.size)].tobytes())
        except ValueError:
            continue
