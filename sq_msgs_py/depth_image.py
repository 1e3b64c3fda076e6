"""sensor_msgs/Image and CameraInfo to NumPy and back.

Depth follows REP 118: 16UC1 holds millimetres with 0 for "no reading", 32FC1 holds metres with NaN; what is read are
the numbers as they stand (:mod:`sq_perception.imaging.depth_units` makes metres of them), in place, through their row
stride (``step``) and byte order (``is_bigendian``).

Readers look at fields alone, so that they read messages of rosbags without a ROS installation too.

Reference: REP 118, Depth Images, https://www.ros.org/reps/rep-0118.html
"""

from __future__ import annotations

import array
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sq_msgs_py.message_types import MessageTypes, find_type

if TYPE_CHECKING:
    from sensor_msgs.msg import CameraInfo, Image

DEPTH_ENCODINGS = ("16UC1", "32FC1")
GREY_ENCODINGS = ("mono8", "mono16")
LABEL_ENCODINGS = ("mono8", "8UC1", "mono16", "16UC1", "32SC1")

_DTYPES: dict[str, type[Any]] = {
    "mono8": np.uint8, "8UC1": np.uint8, "mono16": np.uint16, "16UC1": np.uint16, "32SC1": np.int32, "32FC1": np.float32
}


class ImageError(ValueError):
    """A message that is no image of the expected kind; its text names what was expected and what arrived."""


def pixels_from_message(message: Image, encodings: tuple[str, ...] = tuple(_DTYPES)) -> np.ndarray:
    """Return the pixels (height, width) of a single-channel image as they lie in the message: a view, no copy.

    Rows may be padded (``step``) and bytes may be swapped (``is_bigendian``); the array's strides and dtype follow.
    Raises ImageError if the encoding is none of ``encodings``, the image is empty, the step is shorter than a row, or
    the data is not height x step bytes long.
    """
    if message.encoding not in encodings:
        raise ImageError(f"encoding: expected {' or '.join(encodings)}, got {message.encoding!r}")
    height, width, step = int(message.height), int(message.width), int(message.step)
    if height < 1 or width < 1:
        raise ImageError(f"image size: expected at least 1 x 1, got {width} x {height}")
    dtype = np.dtype(_DTYPES[message.encoding]).newbyteorder(">" if message.is_bigendian else "<")
    if step < width * dtype.itemsize:
        raise ImageError(
            f"step: expected at least {width * dtype.itemsize} bytes for a row of {width} {message.encoding} pixels, "
            f"got {step}"
        )
    if len(message.data) != height * step:
        raise ImageError(
            f"data: expected height x step = {height} x {step} = {height * step} bytes, got {len(message.data)}"
        )
    return np.ndarray((height, width), dtype, buffer=memoryview(message.data), strides=(step, dtype.itemsize))


def grey_from_message(message: Image) -> np.ndarray:
    """Return grey values, uint8 or uint16 (height, width), of a mono8 or mono16 image; a copy in native byte order.
    Raises ImageError as :func:`pixels_from_message`."""
    pixels = pixels_from_message(message, GREY_ENCODINGS)
    return pixels.astype(pixels.dtype.newbyteorder("="))


def labels_from_message(message: Image) -> np.ndarray:
    """Return instance labels, int32 (height, width); 0 and everything below it is background.  Raises ImageError as
    :func:`pixels_from_message`; the encodings are those of ``LABEL_ENCODINGS``."""
    labels = pixels_from_message(message, LABEL_ENCODINGS).astype(np.int32)
    return np.maximum(labels, 0, out=labels)


def depth_to_message(depth: np.ndarray, header: Any, encoding: str = "32FC1", types: MessageTypes = find_type) -> Image:
    """Return an image message of depth (height, width) in metres.

    32FC1 holds the values as they are.  16UC1 holds the nearest millimetre; what is not finite, below half a
    millimetre, or beyond 65.535 m becomes 0.  Raises ImageError if the array has not two dimensions with at least one
    pixel, is no floating point array, or the encoding is neither 16UC1 nor 32FC1.
    """
    depth = np.asarray(depth)
    if not np.issubdtype(depth.dtype, np.floating):
        raise ImageError(f"depth: expected floating point metres, got {depth.dtype}")
    if encoding == "32FC1":
        return _to_message(depth.astype(np.float32, copy=False), header, encoding, types)
    if encoding == "16UC1":
        millimetres = np.rint(depth.astype(np.float64) * 1000.0)
        valid = (millimetres > 0) & (millimetres <= np.iinfo(np.uint16).max)
        return _to_message(np.where(valid, millimetres, 0).astype(np.uint16), header, encoding, types)
    raise ImageError(f"encoding: expected {' or '.join(DEPTH_ENCODINGS)}, got {encoding!r}")


def grey_to_message(grey: np.ndarray, header: Any, types: MessageTypes = find_type) -> Image:
    """Return a mono8 or mono16 message of uint8 or uint16 grey values (height, width).  Raises ImageError for another
    dtype or not two dimensions."""
    grey = np.asarray(grey)
    encoding = {np.dtype(np.uint8): "mono8", np.dtype(np.uint16): "mono16"}.get(grey.dtype)
    if encoding is None:
        raise ImageError(f"grey image: expected uint8 or uint16, got {grey.dtype}")
    return _to_message(grey, header, encoding, types)


def labels_to_message(
    labels: np.ndarray, header: Any, encoding: str = "16UC1", types: MessageTypes = find_type
) -> Image:
    """Return a label image message of integer labels (height, width).  Raises ImageError if the labels are not
    integers, do not fit the encoding, or the encoding is none of ``LABEL_ENCODINGS``."""
    labels = np.asarray(labels)
    if encoding not in LABEL_ENCODINGS:
        raise ImageError(f"encoding: expected {' or '.join(LABEL_ENCODINGS)}, got {encoding!r}")
    if not (np.issubdtype(labels.dtype, np.integer) or labels.dtype == bool):
        raise ImageError(f"labels: expected integers, got {labels.dtype}")
    limits = np.iinfo(_DTYPES[encoding])
    if labels.size and (labels.min() < limits.min or labels.max() > limits.max):
        raise ImageError(
            f"labels: expected {limits.min} to {limits.max} for {encoding}, got {labels.min()} to {labels.max()}"
        )
    return _to_message(labels.astype(_DTYPES[encoding]), header, encoding, types)


@dataclass(frozen=True)
class Intrinsics:
    """What a camera_info holds of the image that comes with it: pixels, u = fx x / z + cx, v = fy y / z + cy."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


@dataclass(frozen=True)
class RawIntrinsics:
    """What a camera_info holds of the image before rectification.

    ``intrinsics``: of K: the pixel of a ray whose image the lens puts at (x', y') is (fx x' + cx, fy y' + cy).
    ``distortion_model``: as it stands in the message.  ``distortion``: D.
    """

    intrinsics: Intrinsics
    distortion_model: str
    distortion: tuple[float, ...]


def intrinsics_from_message(message: CameraInfo) -> Intrinsics:
    """Return intrinsics of the rectified image of a camera_info; region of interest and binning are applied.

    The projection matrix P counts, and K where P is not set; both describe the full resolution.  For an image that is
    not rectified see :func:`raw_intrinsics_from_message`.  Raises ImageError if the camera is not calibrated (K and P
    zero or not finite), no camera could have such intrinsics, or the image size is below 1 x 1.
    """
    fx, cx, fy, cy = (float(message.p[i]) for i in (0, 2, 5, 6))
    if fx == 0.0 and fy == 0.0:
        fx, cx, fy, cy = (float(message.k[i]) for i in (0, 2, 4, 5))
    return _of_part(message, fx, fy, cx, cy)


def raw_intrinsics_from_message(message: CameraInfo) -> RawIntrinsics:
    """Return K and distortion of the raw image of a camera_info; region of interest and binning are applied.

    K describes the full resolution.  Distortion acts on rays before they become pixels, so that a part of the image or
    binned pixels have the same.  Raises ImageError if the camera is not calibrated (K zero or not finite), the image
    size is below 1 x 1, or D is not finite.
    """
    fx, cx, fy, cy = (float(message.k[i]) for i in (0, 2, 4, 5))
    distortion = tuple(float(value) for value in message.d)
    if not all(math.isfinite(value) for value in distortion):
        raise ImageError(f"camera_info: expected finite d, got {' '.join(f'{value:g}' for value in distortion)}")
    return RawIntrinsics(_of_part(message, fx, fy, cx, cy), str(message.distortion_model), distortion)


def size_mismatch(image: tuple[int, int], info: tuple[int, int]) -> str:
    """Return the complaint where an image (width, height) has not the size in its camera_info; empty if it has."""
    if image == info:
        return ""
    text = f"the image has {image[0]} x {image[1]} pixels, its camera_info is for {info[0]} x {info[1]}"
    if image == info[::-1]:
        return f"{text}: width and height are swapped, as if the image had been rotated and its camera_info had not"
    for part in (2, 3, 4, 6, 8):
        if image == (info[0] // part, info[1] // part):
            return f"{text}: the image is {part} times smaller, which its camera_info should have as binning"
    if image[0] <= info[0] and image[1] <= info[1]:
        return f"{text}: an image that was cut out should have its region of interest (roi) in the camera_info"
    return text


def _of_part(message: CameraInfo, fx: float, fy: float, cx: float, cy: float) -> Intrinsics:
    """Return intrinsics of the region of interest in its binned pixels from those of the full resolution."""
    if not all(math.isfinite(number) for number in (fx, fy, cx, cy)):
        raise ImageError(f"camera_info: expected finite fx fy cx cy, got {fx} {fy} {cx} {cy}")
    if fx <= 0.0 or fy <= 0.0:
        raise ImageError(
            f"camera_info: expected focal lengths above 0, got fx = {fx:g}, fy = {fy:g}"
            + (" (the camera is not calibrated)" if fx == 0.0 and fy == 0.0 else "")
        )
    least, most = 1e-2, 1e6  # beyond, lines of sight are no longer numbers
    if min(fx, fy) < least or max(fx, fy, abs(cx), abs(cy)) > most:
        raise ImageError(
            f"camera_info: expected focal lengths of {least:g} to {most:g} pixels and a "
            f"principal point within {most:g}, got fx = {fx:g}, fy = {fy:g}, cx = {cx:g}, cy = {cy:g}"
        )
    width, height = int(message.width), int(message.height)
    region = message.roi
    if region.width and region.height:
        width, height = int(region.width), int(region.height)
    across, down = max(int(message.binning_x), 1), max(int(message.binning_y), 1)
    if width // across < 1 or height // down < 1:
        raise ImageError(f"camera_info: expected an image of at least 1 x 1, got {message.width} x {message.height}")
    return Intrinsics(
        width=width // across, height=height // down, fx=fx / across, fy=fy / down, cx=(cx - region.x_offset) / across,
        cy=(cy - region.y_offset) / down,
    )


def intrinsics_to_message(intrinsics: Intrinsics, header: Any, types: MessageTypes = find_type) -> CameraInfo:
    """Return a camera_info without distortion: K, R = I and P of the intrinsics."""
    fx, fy, cx, cy = (float(x) for x in (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy))
    return types("sensor_msgs/msg/CameraInfo")(
        header=header, width=intrinsics.width, height=intrinsics.height, distortion_model="plumb_bob", d=[0.0] * 5,
        k=[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        r=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p=[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    )


def byte_array(pixels: np.ndarray) -> array.array[int]:
    """Return an array's bytes as array.array('B'), the one type that message setters take over without a look."""
    data = array.array("B")
    data.frombytes(np.ascontiguousarray(pixels).reshape(-1).view(np.uint8).data)
    return data


def _to_message(pixels: np.ndarray, header: Any, encoding: str, types: MessageTypes) -> Image:
    if pixels.ndim != 2 or pixels.size == 0:
        raise ImageError(f"image: expected (height, width) with at least one pixel, got {pixels.shape}")
    little = pixels.astype(pixels.dtype.newbyteorder("<"), copy=False)
    height, width = pixels.shape
    message: Image = types("sensor_msgs/msg/Image")(
        header=header, height=height, width=width, encoding=encoding, is_bigendian=0, step=width * pixels.dtype.itemsize
    )
    message.data = byte_array(little)  # the constructor of rclpy's class would copy it twice
    return message
