"""Depth images packed as compressed_depth_image_transport does it."""

import struct

import cv2
import numpy as np

FARTHEST, QUANTIZATION = 10.0, 100.0
"""Metres up to which inverse depth is quantised, and where a level is 1 % of the depth; the transport's own values."""
MOST_LEVELS = np.iinfo(np.uint16).max


def pack(depth: np.ndarray, encoding: str = "16UC1") -> tuple[str, bytes]:
    """``format`` and ``data`` of the message of a depth image (height, width) in metres, NaN or inf for nothing.

    16UC1 keeps the nearest millimetre up to 65.535 m.  32FC1 keeps inverse depth of 0.16 to 10 m to the nearest of
    10100 levels for each 1/m: 0.05 mm at 1 m and 5 mm at 10 m.  What is beyond becomes nothing.
    """
    depth = np.asarray(depth, dtype=float)
    a = b = 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        if encoding == "16UC1":
            levels = 1e3 * depth
        else:
            a = QUANTIZATION * (QUANTIZATION + 1)
            b = 1 - a / FARTHEST
            levels = np.where(depth > 0, a / depth + b, 0)
        levels = np.rint(levels)
        grey = np.where((levels >= 1) & (levels <= MOST_LEVELS), levels, 0).astype(np.uint16)
    _, png = cv2.imencode(".png", grey)
    return f"{encoding}; compressedDepth png", struct.pack("<iff", 0, a, b) + png.tobytes()
