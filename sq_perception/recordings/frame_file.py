"""Depth images from files: what one camera saw once, in metres of its optical frame.

| file | needs | depth |
| --- | --- | --- |
| ``.npz`` | ``depth`` float (h, w), ``K`` (3, 3) | metres, NaN = nothing |
| ``.npy``, ``.tif`` of floats, ``.exr`` | a camera_info | metres, NaN or 0 = nothing; rectified where it is raw |
| 16 bit ``.png``, ``.tif``, ``.npy`` | a camera_info | millimetres, 0 = nothing; likewise |
| ``.pcd``, ``.ply`` | nothing | points in metres, see :mod:`sq_perception.recordings.cloud_file` |
| 8 or 16 bit ``.png``, ``.bmp``, orthographic | nothing | grey values of the cube, 0 = nothing |
| ``.npz``, orthographic | ``depth`` | depth in the cube, 1 - z; NaN = nothing |

A file whose name is a time, such as 1305031102.160407.png, has that stamp in seconds.  Names of exactly this form are
those of the TUM RGB-D benchmark, whose PNGs have 5000 units a metre: they are read so, with a warning, unless the scale
is given.  ``Reading.scale`` goes before all of these units.  A camera_info is a YAML, or one of the forms of
:mod:`sq_perception.recordings.camera_file`.

The cube is the thesis' unit cube, :mod:`sq_perception.imaging.unit_cube`.  An NPZ may bring ``labels`` (h, w)
and the text "orthographic" as ``projection``, which goes before the caller's.  Nothing in a file is executed: no
pickle, plain YAML only; and nothing is unpacked that is larger than any camera's image.

Whether a PNG is raw and its distortion has to be undone is decided by :mod:`sq_perception.imaging.calibration`.

Whole folders and rosbags are read by :mod:`sq_perception.recordings.inputs`, frame by frame, into the same class.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np

from sq_perception.files.unpacking import UnpackingError, exr_image, grey_image, npy_array, npz_arrays
from sq_perception.imaging import unit_cube
from sq_perception.imaging.calibration import Treatment
from sq_perception.imaging.camera import GREATEST_MEDIAN, LEAST_MEDIAN, Camera, Projection
from sq_perception.recordings import cloud_file
from sq_perception.recordings.camera_file import FrameError, read_calibration

SUFFIXES = (".npz", ".npy", ".png", ".bmp", ".tif", ".tiff", ".exr", *cloud_file.SUFFIXES)
MILLIMETRES = 1000.0
"""Units a metre."""
TUM_SCALE = 5000.0
"""Units a metre in the TUM RGB-D benchmark, https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats"""
_TUM_NAME = re.compile(r"\d{10}\.\d{6}")
_TIME = re.compile(r"(\d{1,18})\.(\d{1,9})")


class Stamp(NamedTuple):
    """Seconds and nanoseconds, as ROS keeps a time: a float would lose the last digits."""

    sec: int
    nanosec: int

    def __str__(self) -> str:
        return f"{self.sec}.{self.nanosec:09d}"


@dataclass(frozen=True, eq=False)
class RecordedFrame:
    """One depth image with its camera.

    Attributes
    ----------
    depth : float32 (height, width)
        Metres in the optical frame, NaN where nothing was measured.
    camera : Camera
    labels : int32 (height, width) or None
        Instance masks, 0 for background.
    name : str
        The file's name; of a frame in a bag, the bag's and the stamp.
    stamp : Stamp or None
        When it was taken, where the recording knows.
    topic, frame_id : str
        Where it was published, and the name of its optical frame; empty for files.
    warning : str
        What should be known about the frame before its results are believed; empty if nothing.
    encoding : str
        Of the depth where it came from, as messages name it (16UC1, 32FC1, mono8, mono16); empty where it has none.
    received : int or None
        When a bag received it, nanoseconds.
    has_free_space : bool
        Whether a pixel beside an object shows that there is nothing before what it measured.
    """

    depth: np.ndarray
    camera: Camera
    labels: np.ndarray | None
    name: str
    stamp: Stamp | None = None
    topic: str = ""
    frame_id: str = ""
    warning: str = ""
    encoding: str = ""
    received: int | None = None
    has_free_space: bool = True

    @property
    def is_cube(self) -> bool:
        """Whether it is a view of the unit cube: results belong in the cube frame (:mod:`unit_cube`)."""
        return not self.camera.is_pinhole


@dataclass(frozen=True)
class Reading:
    """What is taken of an image, whatever it comes from.

    Attributes
    ----------
    scale : float or None
        Units a metre; None: 1000 for whole numbers, or as the file's name has it, and 1 for floats.
    nearest, farthest : float
        Readings beyond, metres, are none.
    region : (4,) of int or None
        Left column, top row, width and height of the part to look at, pixels of the rectified image.
    masks : Path or None
        A folder with a label image for each frame, of its name and ``.png``: 0 is background.
    ignore_masks : bool
        Whether no labels are read, wherever they are.

    Raises
    ------
    ValueError
        For a scale or depth that is not positive, limits that leave nothing, or an empty region.
    """

    scale: float | None = None
    nearest: float = 0.0
    farthest: float = math.inf
    region: tuple[int, int, int, int] | None = None
    masks: Path | None = None
    ignore_masks: bool = False

    def __post_init__(self) -> None:
        if self.scale is not None and not 0 < self.scale < math.inf:
            raise ValueError(f"scale: expected a positive number of units a metre, got {self.scale:g}")
        if not 0 <= self.nearest < self.farthest:
            raise ValueError(f"depths: expected 0 <= nearest < farthest, got {self.nearest:g} and {self.farthest:g}")
        if self.region is not None and (min(self.region[:2]) < 0 or min(self.region[2:]) < 1):
            raise ValueError(f"region: expected left, top >= 0 and width, height >= 1, got {self.region}")

    def labels(self, name: str, like: np.ndarray) -> np.ndarray | None:
        """The label image (height, width) of a frame, int32; None without a folder of them.

        Raises
        ------
        FrameError
            If it is missing, unreadable, or not of the size of the image ``like``.
        """
        if self.masks is None or self.ignore_masks:
            return None
        path = self.masks / f"{name}.png"
        if not path.is_file():
            raise FrameError(f"{path}: no such mask")
        try:
            labels = grey_image(path)
        except UnpackingError as error:
            raise FrameError(f"{path}: {error}") from error
        if labels.shape != like.shape:
            raise FrameError(f"{path}: expected labels of the depth's shape {like.shape}, got {labels.shape}")
        return labels.astype(np.int32)

    def of(self, frame: RecordedFrame) -> RecordedFrame:
        """The frame within the limits, with a warning where it seems to be another kind of image.

        Raises
        ------
        FrameError
            If the region is not within the image.
        """
        frame = replace(frame, warning="; ".join(filter(None, (frame.warning, _likely_mistake(frame)))))
        if self == Reading():
            return frame
        with np.errstate(invalid="ignore"):
            is_far = (frame.depth < self.nearest) | (frame.depth > self.farthest)
        depth = np.where(is_far, np.float32(np.nan), frame.depth) if is_far.any() else frame.depth
        if self.region is None:
            return replace(frame, depth=depth)
        left, top, width, height = self.region
        camera = frame.camera
        if left + width > camera.width or top + height > camera.height:
            raise FrameError(f"{frame.name}: region: expected one within {camera.width} x {camera.height} pixels")
        part = np.s_[top : top + height, left : left + width]
        camera = camera.cropped(left, top, width, height)
        labels = None if frame.labels is None else frame.labels[part]
        return replace(frame, depth=np.ascontiguousarray(depth[part]), camera=camera, labels=labels)


def read(
    path: str | Path,
    camera_info: str | Path | None = None,
    projection: Projection = "pinhole",
    distortion: Treatment = "auto",
    reading: Reading | None = None,
) -> RecordedFrame:
    """Read one frame.

    Parameters
    ----------
    path
        See the table above.
    camera_info
        Intrinsics of an image: YAML as camera_calibration writes it or as a camera_info message prints, or another
        form of :mod:`sq_perception.recordings.camera_file`.
    projection
        "pinhole" or "orthographic".
    distortion
        Of a PNG: "auto", "apply" or "ignore", see :mod:`sq_perception.imaging.calibration`; auto looks at the
        names of the file and its folder.
    reading
        What is taken of the image; all of it by default.

    Raises
    ------
    FrameError
        For anything wrong with a file.
    ValueError
        For an unknown projection or treatment of distortion.
    """
    if projection not in get_args(Projection):
        raise ValueError(f"projection: expected 'pinhole' or 'orthographic', got {projection!r}")
    if distortion not in get_args(Treatment):
        raise ValueError(f"distortion: expected {', '.join(get_args(Treatment))}, got {distortion!r}")
    path, reading = Path(path), reading or Reading()
    try:
        if not path.is_file():
            raise FrameError(f"{path}: no such file")
        frame = _read(path, camera_info, projection, distortion, reading)
        return reading.of(replace(frame, stamp=stamp_of(path)))
    except FrameError:
        raise
    except (ValueError, OSError, MemoryError) as error:
        raise FrameError(f"{path}: {error}") from error


def _read(
    path: Path, camera_info: str | Path | None, projection: Projection, distortion: Treatment, reading: Reading
) -> RecordedFrame:
    """The frame; a ValueError that is no FrameError is about the file."""
    suffix = path.suffix.lower()
    if suffix == ".npz":
        frame = _read_npz(path, projection, reading)
        labels = reading.labels(path.stem, frame.depth)
        return frame if labels is None else replace(frame, labels=labels)
    if suffix in cloud_file.SUFFIXES:
        return _read_cloud(path, reading)
    if suffix not in SUFFIXES:
        raise ValueError(f"expected a name that ends in {', '.join(SUFFIXES)}")
    image = _image(path)
    if projection == "orthographic":
        depth, camera = unit_cube.depth_from_grey(image), unit_cube.camera(image.shape[1], image.shape[0])
        encoding = "mono8" if image.dtype == np.uint8 else "mono16"
        return RecordedFrame(depth, camera, reading.labels(path.stem, image), path.name, encoding=encoding)
    return _of_pinhole(path, image, camera_info, distortion, reading)


def _image(path: Path) -> np.ndarray:
    """The pixels (height, width) of an image file, in the units and of the type that it has them."""
    image = {".npy": npy_array, ".exr": exr_image}.get(path.suffix.lower(), grey_image)(path)
    image = image.astype(image.dtype.newbyteorder("="), copy=False)
    if image.ndim == 3 and 1 in (image.shape[0], image.shape[2]):  # of one channel, as programs for networks have it
        image = image.reshape(image.shape[1:] if image.shape[0] == 1 else image.shape[:2])
    if image.ndim != 2 or not image.size:
        raise ValueError(f"expected an image (height, width), got {image.shape}")
    return image


def _of_pinhole(
    path: Path, image: np.ndarray, camera_info: str | Path | None, distortion: Treatment, reading: Reading
) -> RecordedFrame:
    """The frame of a pinhole camera's image, which is rectified."""
    is_metric = image.dtype.kind == "f"
    if not is_metric and image.dtype != np.uint16:
        raise ValueError(
            f"a pinhole depth image has 16 bit (millimetres) or floats (metres), this one {image.dtype}; "
            "for grey images of the thesis' kind choose the orthographic projection"
        )
    if camera_info is None:
        raise ValueError("a depth image needs a camera_info with the camera's intrinsics, a file or fx,fy,cx,cy")
    size = image.shape[1], image.shape[0]
    calibration = read_calibration(camera_info, distortion, path.absolute().with_suffix("").as_posix(), size)
    scale, warnings = 1.0 if is_metric else MILLIMETRES, [f"{camera_info}: {calibration.note}"] * bool(calibration.note)
    if reading.scale is not None:
        scale = reading.scale
    elif path.suffix.lower() == ".png" and _TUM_NAME.fullmatch(path.stem):
        scale = TUM_SCALE
        warnings.append(
            f"{path.parent}: names as in the TUM RGB-D benchmark, so {TUM_SCALE:g} units are a metre; "
            f"depth scale = {MILLIMETRES:g} takes them for millimetres"
        )
    camera = calibration.camera
    if not (-1 < camera.cx < camera.width and -1 < camera.cy < camera.height):
        middle, shape = f"{camera.cx:g}, {camera.cy:g}", f"{camera.width} x {camera.height}"
        warnings.append(f"{camera_info}: the middle {middle} is beside an image of {shape}: another resolution's?")
    depth, labels = calibration.rectified(_metres(image, scale)), reading.labels(path.stem, image)
    labels = None if labels is None else calibration.rectified_labels(labels)
    encoding = "16UC1" if scale == MILLIMETRES and not is_metric else "32FC1"
    warning = "; ".join(warnings)
    return RecordedFrame(depth, camera, labels, path.name, warning=warning, encoding=encoding)


def stamp_of(path: Path) -> Stamp | None:
    """The time in a name, seconds and their fraction."""
    parts = _TIME.fullmatch(path.stem)
    return Stamp(int(parts[1]), int(parts[2].ljust(9, "0"))) if parts else None


def _read_cloud(path: Path, reading: Reading) -> RecordedFrame:
    depth, camera, is_image = cloud_file.as_image(cloud_file.read_points(path) / (reading.scale or 1.0))
    if reading.masks is not None and not is_image:
        raise ValueError("a cloud that is no image has no pixels that a mask could be of")
    labels = reading.labels(path.stem, depth)
    warning = "" if is_image else cloud_file.UNORGANISED
    return RecordedFrame(depth, camera, labels, path.name, warning=warning, encoding="32FC1", has_free_space=is_image)


def _likely_mistake(frame: RecordedFrame) -> str:
    """What an image that no depth camera takes seems to be; empty for others."""
    shown = frame.depth[::4, ::4]
    shown = shown[np.isfinite(shown)]
    if not shown.size:
        return ""
    if frame.is_cube:
        is_within = shown.min() > -1.0 and shown.max() < 2.0
        return "" if is_within else "depths far outside of the unit cube: a metric image is not orthographic"
    if np.median(shown) > GREATEST_MEDIAN:
        return f"half of the image is farther than {GREATEST_MEDIAN:g} m: for millimetres the depth scale is 1000"
    if np.median(shown) < LEAST_MEDIAN:
        return f"half of the image is nearer than {LEAST_MEDIAN:g} m: for metres the depth scale is 1"
    return ""


def _read_npz(path: Path, projection: Projection, reading: Reading) -> RecordedFrame:
    wanted = ("depth", "K", "projection") + ("labels",) * (not reading.ignore_masks)
    fields = npz_arrays(path, wanted)
    if "depth" not in fields:
        raise ValueError("expected a field 'depth' in metres")
    depth, labels = fields["depth"], fields.get("labels")
    if depth.ndim != 2 or depth.dtype.kind != "f" or depth.size == 0:
        raise ValueError(f"depth: expected floats (height, width) in metres, got {depth.dtype} {depth.shape}")
    if labels is not None:
        if labels.shape != depth.shape or labels.dtype.kind not in "iub":
            expected = f"expected integers of the depth's shape {depth.shape}"
            raise ValueError(f"labels: {expected}, got {labels.dtype} {labels.shape}")
        if labels.max() > np.iinfo(np.int32).max:
            raise ValueError(f"labels: expected numbers below 2^31, got {labels.max()}")
        labels = np.maximum(labels, 0).astype(np.int32)
    height, width = depth.shape
    is_cube = str(fields.get("projection", "")) == "orthographic"
    if projection == "orthographic" or is_cube:
        has_camera = "K" in fields and not is_cube
        warning = "orthographic was asked for, and a file has the matrix K of a pinhole camera" if has_camera else ""
        return RecordedFrame(_single(depth), unit_cube.camera(width, height), labels, path.name, warning=warning)
    if "K" not in fields:
        raise ValueError("expected a field 'K', the 3 x 3 camera matrix")
    try:
        camera = Camera.from_matrix(fields["K"], width, height)
    except (ValueError, TypeError) as error:
        raise ValueError(f"K: {error}") from error
    return RecordedFrame(_metres(depth, reading.scale or 1.0), camera, labels, path.name, encoding="32FC1")


def _metres(values: np.ndarray, scale: float) -> np.ndarray:
    """Depth of values in ``scale`` units a metre, as :func:`_single`; what is not before the camera is none either."""
    with np.errstate(all="ignore"):  # of what is no number, or none that a float holds
        depth = (values if scale == 1 else np.divide(values, scale, dtype=float)).astype(np.float32)
    return np.where((depth > 0) & (depth < np.inf), depth, np.float32(np.nan))


def _single(depth: np.ndarray) -> np.ndarray:
    """Depth as float32, NaN where it is no reading: some programs write the largest number that their type holds."""
    with np.errstate(over="ignore"):
        found = depth.astype(np.float32)
    return np.where(np.isfinite(found), found, np.float32(np.nan))
