"""Depth images as the compressedDepth transport of ROS packs them: a header of 12 bytes, then a 16 bit grey PNG.

The header holds an enumeration (int32) and two numbers A and B (float32, little endian).  The message's ``format``
names the encoding of the image before it was packed:

    16UC1   the PNG holds millimetres, 0 = nothing
    32FC1   the PNG holds q = A / z + B, a quantised inverse depth, so that z = A / (q - B) metres, 0 = nothing

A PNG can unpack to a thousand times its own length; its size is therefore read and checked before it is decoded.

Reference: compressed_depth_image_transport, https://github.com/ros-perception/image_transport_plugins
"""

from __future__ import annotations

import struct

import cv2
import numpy as np

TRANSPORT = "compressedDepth"
MOST_PIXELS = 2**25
"""Above any depth camera's, and 64 MB at 16 bit."""

_HEADER = struct.Struct("<iff")
_PNG = b"\x89PNG\r\n\x1a\n"
_IMAGE_HEADER = struct.Struct(">8xI4sIIBB")
"""Of a PNG: length and name of its first chunk, width, height, bits, colour type (0 is grey)."""
_MILLIMETRES = np.float32(1000.0)


def encoding(image_format: str) -> str | None:
    """16UC1 or 32FC1 of a CompressedImage's ``format`` ("16UC1; compressedDepth png"); None for anything else."""
    packed, _, transport = image_format.partition(";")
    if TRANSPORT not in transport or packed.strip() not in ("16UC1", "32FC1"):
        return None
    return packed.strip()


def decode(image_format: str, data: bytes | np.ndarray) -> np.ndarray:
    """Depth in metres, float32 (height, width), NaN where nothing was measured.

    Parameters
    ----------
    image_format, data
        ``format`` and ``data`` of the sensor_msgs/CompressedImage.

    Raises
    ------
    ValueError
        For another format, or data that is no such image, saying what was expected.
    """
    packed = encoding(image_format)
    if packed is None:
        raise ValueError(f"format: expected '16UC1; {TRANSPORT} png' or '32FC1; {TRANSPORT} png', got {image_format!r}")
    message = bytes(data)
    if len(message) < _HEADER.size + _IMAGE_HEADER.size:
        raise ValueError(f"data: expected a header and a PNG, got {len(message)} bytes")
    _, a, b = _HEADER.unpack_from(message)
    grey = _grey(message[_HEADER.size :])
    if packed == "16UC1":
        depth = grey / _MILLIMETRES
    else:
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            depth = np.float32(a) / (grey.astype(np.float32) - np.float32(b))
    depth[(grey == 0) | ~((depth > 0) & (depth < np.inf))] = np.nan
    return depth


def _grey(png: bytes) -> np.ndarray:
    """The PNG's pixels, uint16 (height, width)."""
    length, name, width, height, bits, colour = _IMAGE_HEADER.unpack_from(png)
    if not png.startswith(_PNG) or (length, name) != (13, b"IHDR"):
        raise ValueError("data: expected a PNG after the header of 12 bytes; RVL is not read")
    if (bits, colour) != (16, 0):
        raise ValueError(f"PNG: expected 16 bit grey, got {bits} bit of colour type {colour}")
    if not (width >= 1 and height >= 1 and width * height <= MOST_PIXELS):
        raise ValueError(f"PNG: expected at most {MOST_PIXELS} pixels, got {width} x {height}")
    try:
        image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ValueError(f"PNG: not readable: {error.err}") from error
    if image is None or image.shape != (height, width) or image.dtype != np.uint16:
        raise ValueError("PNG: not readable")
    return image
