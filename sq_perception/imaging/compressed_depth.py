"""Depth images as the compressedDepth transport of ROS packs them: a header of 12 bytes, then a PNG or RVL.

The header holds an enumeration (int32) and two numbers A and B (float32, little endian).  The message's ``format``
names the encoding of the image before it was packed, and the packing; where it names none, it is PNG:

    16UC1; compressedDepth png    16 bit grey holds millimetres, 0 = nothing
    32FC1; compressedDepth png    it holds q = A / z + B, a quantised inverse depth, so that z = A / (q - B) metres,
                                  0 = nothing
    ...; compressedDepth rvl      the same numbers as RVL (:mod:`sq_perception.imaging.rvl`), after width and height
                                  (uint32, little endian)

A PNG can unpack to a thousand times its own length; its size is therefore read and checked before it is decoded.

Reference: compressed_depth_image_transport, https://github.com/ros-perception/image_transport_plugins
"""

from __future__ import annotations

import struct

import cv2
import numpy as np

from sq_perception.files.unpacking import MOST_PIXELS
from sq_perception.imaging import rvl

TRANSPORT = "compressedDepth"
_HEADER = struct.Struct("<iff")
_PNG = b"\x89PNG\r\n\x1a\n"
_IMAGE_HEADER = struct.Struct(">8xI4sIIBB")
"""The beginning of a PNG: length and name of its first chunk, width, height, bits, colour type (0 is grey)."""
_RVL_HEADER = struct.Struct("<II")


def encoding(image_format: str) -> str | None:
    """16UC1 or 32FC1 of a CompressedImage's ``format`` ("16UC1; compressedDepth png"); None for anything else."""
    packed, _, transport = image_format.partition(";")
    if TRANSPORT not in transport or packed.strip() not in ("16UC1", "32FC1"):
        return None
    return packed.strip()


def size(image_format: str, data: bytes | np.ndarray) -> tuple[int, int]:
    """Width and height of a packed image, without unpacking it.

    Raises ValueError as :func:`decode`.
    """
    _known(image_format)
    head = bytes(data[: _HEADER.size + _IMAGE_HEADER.size])
    return _rvl_size(head) if _is_rvl(image_format) else _png_size(head)


def decode(image_format: str, data: bytes | np.ndarray) -> np.ndarray:
    """The numbers (height, width) of the image before it was packed: uint16 of 16UC1, 0 for nothing, or float32 metres
    of 32FC1, NaN for nothing.

    Parameters
    ----------
    image_format, data
        ``format`` and ``data`` of the sensor_msgs/CompressedImage.

    Raises ValueError for another format, or data that is no such image; the message names what was expected.
    """
    packed = _known(image_format)
    message = bytes(data)
    if _is_rvl(image_format):
        width, height = _rvl_size(message)
        grey = rvl.decode(message[_HEADER.size + _RVL_HEADER.size :], width, height)
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
    if not (width >= 1 and height >= 1 and width * height <= rvl.MOST_PIXELS):
        raise ValueError(f"RVL: expected at most {rvl.MOST_PIXELS} pixels, got {width} x {height}")
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
