"""Depth images as the compressedDepth transport of ROS packs them: a header of 12 bytes, then a PNG or RVL.

The header holds an enumeration (int32) and two numbers A and B (float32, little endian).  The message's ``format``
names the encoding of the image before it was packed, and the packing; where it names none, it is PNG:

    16UC1; compressedDepth png    16 bit grey holds millimetres, 0 = nothing
    32FC1; compressedDepth png    it holds q = A / z + B, a quantised inverse depth, so that z = A / (q - B) metres,
                                  0 = nothing
    ...; compressedDepth rvl      the same numbers as RVL, after width and height (uint32, little endian)

A PNG can unpack to a thousand times its own length; its size is therefore read and checked before it is decoded.

RVL is a sequence of runs: how many zeros, how many other pixels, then each of these as its difference to the last pixel
that was not zero, with the sign in the lowest bit (0 -1 1 -2 2 ... become 0 1 2 3 4 ...).  Every number is written in
groups of three bits, low groups first; a group is a nibble, whose fourth and highest bit marks that another one
follows.  Nibbles fill words of 32 bits from the top, and words are little endian.

References: compressed_depth_image_transport, https://github.com/ros-perception/image_transport_plugins; A. D. Wilson,
Fast lossless depth image compression, ISS 2017.
"""

from __future__ import annotations

import struct

import cv2
import numpy as np

from sq_perception.files.unpacking import MOST_PIXELS

TRANSPORT = "compressedDepth"
_HEADER = struct.Struct("<iff")
_PNG = b"\x89PNG\r\n\x1a\n"
_IMAGE_HEADER = struct.Struct(">8xI4sIIBB")
"""The beginning of a PNG: length and name of its first chunk, width, height, bits, colour type (0 is grey)."""
_RVL_HEADER = struct.Struct("<II")
_MOST_RVL_PIXELS = 2**23  # above any depth camera's; unpacking takes some 100 bytes of memory for each


def encoding(image_format: str) -> str | None:
    """16UC1 or 32FC1 of a CompressedImage's ``format`` ("16UC1; compressedDepth png"); None for anything else."""
    packed, _, transport = image_format.partition(";")
    if TRANSPORT not in transport or packed.strip() not in ("16UC1", "32FC1"):
        return None
    return packed.strip()


def size(image_format: str, data: bytes | np.ndarray) -> tuple[int, int]:
    """Width and height of a packed image, without unpacking it.  Raises ValueError as :func:`decode`."""
    _known(image_format)
    head = bytes(data[: _HEADER.size + _IMAGE_HEADER.size])
    return _rvl_size(head) if _is_rvl(image_format) else _png_size(head)


def decode(image_format: str, data: bytes | np.ndarray) -> np.ndarray:
    """The numbers (height, width) before they were packed, by ``format`` and ``data`` of a CompressedImage: uint16 of
    16UC1, 0 for nothing, or float32 metres of 32FC1, NaN for nothing.  Raises ValueError for anything else."""
    packed = _known(image_format)
    message = bytes(data)
    if _is_rvl(image_format):
        width, height = _rvl_size(message)
        grey = decode_rvl(message[_HEADER.size + _RVL_HEADER.size :], width, height)
    else:
        grey = _grey(message)
    _, a, b = _HEADER.unpack_from(message)
    if packed == "16UC1":
        return grey
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        depth: np.ndarray = np.float32(a) / (grey.astype(np.float32) - np.float32(b))
    depth[grey == 0] = np.nan
    return depth


def _known(image_format: str) -> str:
    packed = encoding(image_format)
    if packed is None:
        raise ValueError(
            f"format: expected '16UC1; {TRANSPORT} png', 32FC1 or rvl instead of them, got {image_format!r}"
        )
    return packed


def _is_rvl(image_format: str) -> bool:
    return "rvl" in image_format.partition(";")[2]


def _rvl_size(message: bytes) -> tuple[int, int]:
    if len(message) < _HEADER.size + _RVL_HEADER.size:
        raise ValueError(f"data: expected a header and a size, got {len(message)} bytes")
    width, height = _RVL_HEADER.unpack_from(message, _HEADER.size)
    if not (width >= 1 and height >= 1 and width * height <= _MOST_RVL_PIXELS):
        raise ValueError(f"RVL: expected at most {_MOST_RVL_PIXELS} pixels, got {width} x {height}")
    return width, height


def _png_size(message: bytes) -> tuple[int, int]:
    """Width and height of the PNG after the header; ValueError unless it is 16 bit grey and not too large."""
    if len(message) < _HEADER.size + _IMAGE_HEADER.size:
        raise ValueError(f"data: expected a header and a PNG, got {len(message)} bytes")
    length, name, width, height, bits, colour = _IMAGE_HEADER.unpack_from(message, _HEADER.size)
    if message[_HEADER.size :][: len(_PNG)] != _PNG or (length, name) != (13, b"IHDR"):
        raise ValueError(f"data: expected a PNG after the header of {_HEADER.size} bytes")
    if (bits, colour) != (16, 0):
        raise ValueError(f"PNG: expected 16 bit grey, got {bits} bit of colour type {colour}")
    if not (width >= 1 and height >= 1 and width * height <= MOST_PIXELS):
        raise ValueError(f"PNG: expected at most {MOST_PIXELS} pixels, got {width} x {height}")
    return width, height


def _grey(message: bytes) -> np.ndarray:
    """The PNG's pixels, uint16 (height, width)."""
    width, height = _png_size(message[: _HEADER.size + _IMAGE_HEADER.size])
    try:
        image = cv2.imdecode(np.frombuffer(message, np.uint8, offset=_HEADER.size), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ValueError(f"PNG: not readable: {error.err}") from error
    if image is None or image.shape != (height, width) or image.dtype != np.uint16:
        raise ValueError("PNG: not readable")
    return image


def decode_rvl(data: bytes, width: int, height: int) -> np.ndarray:
    """The pixels, uint16 (height, width), of RVL.  Raises ValueError if the data does not hold that many pixels."""
    count = width * height
    # 17 bits of a difference are 6 nibbles, and a run of one pixel has 2 more.
    if len(data) > 4 * count + 64:
        raise ValueError(f"RVL: expected at most 4 bytes for each of {count} pixels, got {len(data)} bytes")
    numbers = _numbers(data)
    view = memoryview(numbers.data)  # whose elements are plain integers, six times faster than an array's
    heads, runs = [], []
    at = pixel = 0
    while pixel < count:
        if at + 2 > len(view):
            raise ValueError(f"RVL: expected {count} pixels, the data ends after {pixel}")
        zeros, others = view[at], view[at + 1]
        if zeros + others == 0 or pixel + zeros + others > count or at + 2 + others > len(view):
            raise ValueError(f"RVL: not readable after {pixel} of {count} pixels")
        heads += [at, at + 1]
        runs += [zeros, others]
        at, pixel = at + 2 + others, pixel + zeros + others
    folded = np.delete(numbers[:at], heads)
    differences = (folded >> 1) ^ -(folded & 1)
    image = np.zeros(count, np.uint16)
    is_pixel = np.repeat(np.arange(len(runs)) % 2 == 1, runs)
    # What leaves 16 bits comes back at the other end.
    image[is_pixel] = np.cumsum(differences, dtype=np.int64).astype(np.uint16)
    return image.reshape(height, width)


def _numbers(data: bytes) -> np.ndarray:
    """All numbers, int32, in their order; the last ones may be padding."""
    words = np.frombuffer(data, "<u4", len(data) // 4)
    octets = words.astype(">u4").view(np.uint8)
    nibbles = np.stack([octets >> 4, octets & 15], axis=-1).reshape(-1)
    ends = np.flatnonzero(nibbles < 8)
    if not ends.size:
        return np.zeros(0, np.int32)
    starts = np.concatenate([[0], ends[:-1] + 1])
    lengths = ends - starts + 1
    if lengths.max() > 9:  # 27 bits, more than the pixels
        raise ValueError(f"RVL: expected numbers of at most 9 groups, got {lengths.max()}")
    numbers = (nibbles[starts] & 7).astype(np.int32)
    for group in range(1, int(lengths.max())):
        longer = np.flatnonzero(lengths > group)
        numbers[longer] |= (nibbles[starts[longer] + group] & 7).astype(np.int32) << (3 * group)
    return numbers
