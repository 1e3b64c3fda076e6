"""Depth images from files: what one camera saw once, in metres of its optical frame.

| file | needs | depth |
| --- | --- | --- |
| ``.npz`` | ``depth`` (h, w), ``K`` (3, 3) | floats: metres; whole numbers: millimetres, or by ``depth_scale`` |
| ``.npy``, ``.tif`` of floats, ``.exr`` | a camera_info | metres; rectified where it is raw |
| ``.png``, ``.tif``, ``.npy`` of whole numbers | a camera_info | millimetres, or as it states; likewise |
| ``.pcd``, ``.ply``, ``.npz`` of ``points`` | nothing | metres: :mod:`sq_perception.recordings.cloud_file` |
| 8 or 16 bit ``.png``, ``.bmp``, orthographic | nothing | grey values of the cube, 0 = nothing |
| ``.npz``, orthographic | ``depth`` | depth in the cube, 1 - z; NaN = nothing |

What is no reading, and which units count, :mod:`sq_perception.imaging.depth_units` decides; ``Reading.scale`` goes
before all others.  A file whose name is a time, such as 1305031102.160407.png, has that stamp in seconds.  Names of
exactly this form are those of the TUM RGB-D benchmark, whose PNGs have 5000 units a metre.  A camera_info is a YAML, or
one of the forms of :mod:`sq_perception.recordings.camera_file`; where none is named, the one beside the image counts.

The cube is that of :mod:`sq_perception.imaging.unit_cube`.  An NPZ may bring ``labels`` (h, w) and the text
"orthographic" as ``projection``, which goes before the caller's.  Whether an image is raw and its distortion has to be
undone is decided by :mod:`sq_perception.imaging.calibration`.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np

from sq_perception.files.unpacking import exr_image, grey_image, label_image, npy_array, npz_arrays
from sq_perception.imaging import depth_units, unit_cube
from sq_perception.imaging.calibration import Treatment
from sq_perception.imaging.camera import Camera, Projection
from sq_perception.imaging.depth_units import MILLIMETRES, DepthKind, Metres, Stated
from sq_perception.recordings import cloud_file
from sq_perception.recordings.camera_file import FrameError, calibration, camera_beside, read_camera_info
from sq_perception.recordings.cloud_file import CloudFrame

SUFFIXES = (".npz", ".npy", ".png", ".bmp", ".tif", ".tiff", ".exr", *cloud_file.SUFFIXES)
TUM = Stated(5000.0, "the name is one of the TUM RGB-D benchmark")
"""https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats"""
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

    ``depth``: metres in the optical frame, NaN where nothing was measured.  ``labels`` int32 (height,
    width) or None: instance masks, 0 for background.  ``name``: the file's name; of a frame in a bag, the bag's and the
    stamp.  ``stamp`` Stamp or None: when it was taken, where the recording knows.  ``topic``, ``frame_id``: where it
    was published, and the name of its optical frame; empty for files.  ``warning``: what should be known about the
    frame before its results are believed; empty if nothing.  ``notes``: what was found out about its numbers: units,
    marks of nothing measured; likewise.  ``encoding``: of the depth where it came from, as messages name it (16UC1,
    32FC1, mono8, mono16); empty where it has none.  ``received`` int or None: when a bag received it, nanoseconds.
    ``has_free_space``: whether a pixel beside an object shows that there is nothing before what it measured.
    """

    depth: np.ndarray
    camera: Camera
    labels: np.ndarray | None
    name: str
    stamp: Stamp | None = None
    topic: str = ""
    frame_id: str = ""
    warning: str = ""
    notes: str = ""
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

    Raises ValueError for a scale or depth that is not positive, limits that leave nothing, an empty region, or another
    kind.

    ``scale`` float or None: units a metre; None: as a file states them, else 1000 for whole numbers and 1 for floats.
    ``nearest``, ``farthest``: readings beyond, metres, are none.  ``region`` (4,) of int or None: left column, top row,
    width and height of the part to look at, pixels of the rectified image.  ``masks`` Path or None: a folder with the
    masks of each frame, by its name (:func:`sq_perception.files.unpacking.label_image`).  ``ignore_masks``: whether no
    labels are read, wherever they are.  ``kind``: "z", or "range" for images of distances to the camera's centre.
    ``frame`` CloudFrame or None: where the camera is in the frame of clouds; None: in their origin, and looks along z.
    """

    scale: float | None = None
    nearest: float = 0.0
    farthest: float = math.inf
    region: tuple[int, int, int, int] | None = None
    masks: Path | None = None
    ignore_masks: bool = False
    kind: DepthKind = "z"
    frame: CloudFrame | None = None

    def __post_init__(self) -> None:
        if self.scale is not None and not 0 < self.scale < math.inf:
            raise ValueError(f"scale: expected a positive number of units a metre, got {self.scale:g}")
        if self.kind not in get_args(DepthKind):
            raise ValueError(f"kind: expected {' or '.join(get_args(DepthKind))}, got {self.kind!r}")
        if not 0 <= self.nearest < self.farthest:
            raise ValueError(f"depths: expected 0 <= nearest < farthest, got {self.nearest:g} and {self.farthest:g}")
        if self.region is not None and (min(self.region[:2]) < 0 or min(self.region[2:]) < 1):
            raise ValueError(f"region: expected left, top >= 0 and width, height >= 1, got {self.region}")

    def z(self, depth: np.ndarray, camera: Camera) -> np.ndarray:
        """Return depth along the optical axis of a rectified image of this kind; ValueError for an announced cloud."""
        if self.frame is not None:
            raise ValueError("frame: expected a cloud, got a depth image, which is in the frame of its camera")
        return depth_units.z_from_range(depth, camera) if self.kind == "range" else depth

    def labels(self, name: str, like: np.ndarray) -> np.ndarray | None:
        """Return the label image (height, width) of a frame, int32; None without a folder of them.  Raises FrameError
        if it is missing, unreadable, or not of the size of the image ``like``."""
        if self.masks is None or self.ignore_masks:
            return None
        try:
            labels = label_image(self.masks, name)
        except ValueError as error:
            raise FrameError(f"{self.masks / name}.png: {error}") from error
        if labels.shape != like.shape:
            raise FrameError(
                f"{self.masks / name}: expected labels of the depth's shape {like.shape}, got {labels.shape}"
            )
        return labels

    def of(self, frame: RecordedFrame) -> RecordedFrame:
        """Return the frame within the limits, with a warning where it seems to be another kind of image.  Raises
        FrameError if the region is not within the image."""
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
    path: str | Path, camera_info: str | Path | None = None, projection: Projection = "pinhole",
    distortion: Treatment = "auto", reading: Reading | None = None,
) -> RecordedFrame:
    """Read one frame.

    Raises FrameError for anything wrong with a file; ValueError for an unknown projection or treatment of distortion.

    ``path``: See the table above.  ``camera_info``: Intrinsics of an image: YAML as camera_calibration writes it or as
    a camera_info message prints, or another form of :mod:`sq_perception.recordings.camera_file`; None: what lies beside
    the image.  ``projection``: "pinhole" or "orthographic".  ``distortion``: of a PNG: "auto", "apply" or "ignore", see
    :mod:`sq_perception.imaging.calibration`; auto looks at the names of the file and its folder.  ``reading``: what is
    taken of the image; all of it by default.
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
    """Return the frame; a ValueError that is no FrameError is about the file."""
    suffix = path.suffix.lower()
    if suffix in cloud_file.SUFFIXES:
        return _read_cloud(path, reading)
    if suffix == ".npz":
        frame = _read_npz(path, projection, reading)
        labels = reading.labels(path.stem, frame.depth)
        return frame if labels is None else replace(frame, labels=labels)
    if suffix == ".bag":
        raise ValueError(f"a bag of ROS 1: convert it with: rosbags-convert --src {path} --dst {path.stem}")
    if suffix not in SUFFIXES:
        raise ValueError(f"expected a name that ends in {', '.join(SUFFIXES)}")
    image = _image(path)
    if projection == "orthographic":
        depth, camera = unit_cube.depth_from_grey(image), unit_cube.camera(image.shape[1], image.shape[0])
        encoding = "mono8" if image.dtype == np.uint8 else "mono16"
        return RecordedFrame(depth, camera, reading.labels(path.stem, image), path.name, encoding=encoding)
    return _of_pinhole(path, image, camera_info, distortion, reading)


def _image(path: Path) -> np.ndarray:
    """Return the pixels (height, width) of an image file, in the units and of the type that it has them."""
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
    """Return the frame of a pinhole camera's image, which is rectified."""
    camera_info = camera_info or camera_beside(path)
    if camera_info is None:
        raise ValueError("a depth image needs a camera_info with the camera's intrinsics, a file or fx,fy,cx,cy")
    info = read_camera_info(camera_info, (image.shape[1], image.shape[0]), path.stem)
    known = info.unit or (TUM if path.suffix.lower() == ".png" and _TUM_NAME.fullmatch(path.stem) else None)
    found = _metres(image, reading, known)
    way = calibration(info, camera_info, distortion, path.absolute().with_suffix("").as_posix())
    warnings = [f"{camera_info}: {way.note}"] * bool(way.note)
    camera = way.camera
    if not (-1 < camera.cx < camera.width and -1 < camera.cy < camera.height):
        middle, shape = f"{camera.cx:g}, {camera.cy:g}", f"{camera.width} x {camera.height}"
        warnings.append(f"{camera_info}: the middle {middle} is beside an image of {shape}: another resolution's?")
    depth, labels = reading.z(way.rectify(found.depth), camera), reading.labels(path.stem, image)
    labels = None if labels is None else way.rectify_labels(labels)
    encoding = "16UC1" if found.scale == MILLIMETRES and image.dtype == np.uint16 and reading.kind == "z" else "32FC1"
    return RecordedFrame(
        depth, camera, labels, path.name, warning="; ".join(warnings), notes="; ".join(found.notes), encoding=encoding
    )


def _metres(image: np.ndarray, reading: Reading, known: Stated | None) -> Metres:
    if image.dtype.kind not in "fiu" or (image.dtype.itemsize == 1 and reading.scale is None and known is None):
        raise ValueError(
            f"a pinhole depth image has 16 bit (millimetres) or floats (metres), this one {image.dtype}; "
            "for grey images of the thesis' kind choose the orthographic projection"
        )
    return depth_units.metres(image, reading.scale, known)


def stamp_of(path: Path) -> Stamp | None:
    """Return the time in a name, seconds and their fraction."""
    parts = _TIME.fullmatch(path.stem)
    return Stamp(int(parts[1]), int(parts[2].ljust(9, "0"))) if parts else None


def _read_cloud(path: Path, reading: Reading) -> RecordedFrame:
    if reading.kind != "z":
        raise ValueError("a cloud has points, and no distances in place of z")
    points, labels = cloud_file.read_cloud(path)
    points, notes = points / (reading.scale or 1.0), []
    if reading.frame is not None:
        points, said = reading.frame.to_optical(points)
        notes.append(said)
    found = cloud_file.as_image(points, None if reading.ignore_masks else labels)
    if reading.masks is not None and not found.is_image:
        raise ValueError("a cloud that is no image has no pixels that a mask could be of")
    given = reading.labels(path.stem, found.depth)
    if given is None and found.labels is not None:
        given = found.labels
        notes.append(cloud_file.LABELLED)
    warning = "" if found.is_image else cloud_file.UNORGANISED
    return RecordedFrame(
        found.depth, found.camera, given, path.name, warning=warning, notes="; ".join(notes), encoding="32FC1",
        has_free_space=found.is_image,
    )


def _likely_mistake(frame: RecordedFrame) -> str:
    """Return what an image that no depth camera takes seems to be; empty for others."""
    if not frame.is_cube:
        return depth_units.wrong_unit(frame.depth)
    shown = frame.depth[::4, ::4]
    is_within = np.all(np.isnan(shown) | ((shown > -1.0) & (shown < 2.0)))
    return "" if is_within else "depths far outside of the unit cube: a metric image is not orthographic"


def _read_npz(path: Path, projection: Projection, reading: Reading) -> RecordedFrame:
    wanted = ("depth", "K", "projection", "depth_scale") + ("labels",) * (not reading.ignore_masks)
    fields = npz_arrays(path, wanted)
    if "depth" not in fields:
        if npz_arrays(path, ["points"]):
            return _read_cloud(path, reading)
        raise ValueError("expected a field 'depth' in metres, or 'points' of a cloud")
    depth, labels = fields["depth"], fields.get("labels")
    if depth.ndim != 2 or depth.dtype.kind not in "fiu" or depth.size == 0:
        raise ValueError(f"depth: expected numbers (height, width), got {depth.dtype} {depth.shape}")
    if labels is not None:
        if labels.shape != depth.shape or labels.dtype.kind not in "iub":
            expected = f"expected integers of the depth's shape {depth.shape}"
            raise ValueError(f"labels: {expected}, got {labels.dtype} {labels.shape}")
        labels = cloud_file.labels_of(labels)
    height, width = depth.shape
    is_cube = str(fields.get("projection", "")) == "orthographic"
    if projection == "orthographic" or is_cube:
        has_camera = "K" in fields and not is_cube
        warning = "orthographic was asked for, and a file has the matrix K of a pinhole camera" if has_camera else ""
        with np.errstate(over="ignore"):  # some programs write the largest number that their type holds
            single = depth.astype(np.float32)
        single = np.where(np.isfinite(single), single, np.float32(np.nan))
        return RecordedFrame(single, unit_cube.camera(width, height), labels, path.name, warning=warning)
    if "K" not in fields:
        raise ValueError("expected a field 'K', the 3 x 3 camera matrix")
    try:
        camera = Camera.from_matrix(fields["K"], width, height)
    except (ValueError, TypeError) as error:
        raise ValueError(f"K: {error}") from error
    unit = fields.get("depth_scale")
    known = None if unit is None else depth_units.parse_scale(float(unit), "depth_scale")
    found = _metres(depth, reading, known)
    return RecordedFrame(
        reading.z(found.depth, camera), camera, labels, path.name, notes="; ".join(found.notes), encoding="32FC1"
    )
