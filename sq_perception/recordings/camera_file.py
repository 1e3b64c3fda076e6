"""The camera of recorded images: a camera_info YAML, or intrinsics as other tools write them.

| form | from |
| --- | --- |
| YAML | camera_calibration, or a printed camera_info message |
| ``525,525,319.5,239.5`` | papers and data sets: fx, fy, cx, cy in pixels, of an image without distortion |
| JSON with ``ppx``, ``ppy`` | librealsense (``rs-enumerate-devices``, ``rs2_intrinsics``) |
| JSON with ``intrinsic_matrix`` | Open3D: nine numbers, COLUMN by column |
| JSON or YAML with ``fx``, ``fy``, ``cx``, ``cy``, or ``cam_K`` | BOP's camera.json, and many programs |
| 3 x 3 numbers, row by row: text, NPY | ``cam_K.txt`` of FoundationPose, ``intrinsics.txt``, NumPy's savetxt |

Forms without a size are of the images' size.

A pixel's centre has integer coordinates, in all of them.
"""

from __future__ import annotations

import json
import os
import re
import reprlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sq_perception.files import plain_yaml
from sq_perception.files.unpacking import UnpackingError, npy_array
from sq_perception.imaging.calibration import Calibration, Treatment

LARGEST = 2**20
"""Bytes of a file."""
_LONGEST = 2**12
"""Bytes of a file that holds nothing but a matrix."""
_SKEW = 1e-6
"""Skew as a share of fx; no depth camera in use has any."""
_WIDTH, _HEIGHT = ("image_width", "width"), ("image_height", "height")
_MATRIX, _PROJECTION = ("camera_matrix", "k", "K", "cam_K"), ("projection_matrix", "p", "P")
_NO_DISTORTION = ("none", "")
_BROWN_CONRADY = ("brown conrady", "inverse brown conrady", "modified brown conrady")
"""Names of librealsense.  Of depth images the coefficients are zero; others are taken for plumb_bob's."""


class FrameError(ValueError):
    """A file that is missing, damaged, or does not hold what it should; the message names what was expected."""


@dataclass(frozen=True)
class Region:
    """The fields of a sensor_msgs/RegionOfInterest that count."""

    x_offset: int = 0
    y_offset: int = 0
    width: int = 0
    height: int = 0


@dataclass(frozen=True)
class CameraInfo:
    """The fields of a sensor_msgs/CameraInfo, from a file; matrices are flat."""

    width: int
    height: int
    distortion_model: str
    d: tuple[float, ...]
    k: tuple[float, ...]
    p: tuple[float, ...]
    binning_x: int
    binning_y: int
    roi: Region


def read_calibration(
    source: str | Path, distortion: Treatment = "auto", name: str = "", size: tuple[int, int] | None = None
) -> Calibration:
    """The calibration of images called ``name``, as :func:`read_camera_info` has it.

    Raises
    ------
    FrameError
        As :func:`read_camera_info`, or if the camera is not calibrated or its distortion not known.
    """
    info = read_camera_info(source, size)
    try:
        return Calibration.of(info, name, distortion)
    except ValueError as error:
        raise FrameError(f"{source}: {error}") from error


def read_camera_info(source: str | Path, size: tuple[int, int] | None = None) -> CameraInfo:
    """A YAML file in the layout of camera_calibration, or of a printed camera_info message; or JSON, see the module.

    A file that does not name its distortion model means plumb_bob; what else it does not name is zero.  Where the
    ``size`` of the images is given, width and height, four numbers do for a file.

    Raises
    ------
    FrameError
    """
    try:
        four = None if size is None or os.path.exists(source) else _four_numbers(str(source))
        return _camera_info(_mapping(Path(source)) if four is None else four, size)
    except (plain_yaml.YamlError, FrameError) as error:
        raise FrameError(f"{source}: cannot read the camera_info: {error}") from error


def _camera_info(info: Any, size: tuple[int, int] | None) -> CameraInfo:
    if not isinstance(info, dict):
        raise FrameError("expected a camera_info as a YAML mapping, or 3 x 3 numbers")
    if info.keys() >= {"fx", "fy", "cx", "cy"}:
        info = {**info, "k": [info["fx"], 0, info["cx"], 0, info["fy"], info["cy"], 0, 0, 1]}
    has_matrix = bool(info.keys() & {*_MATRIX, *_PROJECTION})
    if size is not None and has_matrix and not info.keys() & {*_WIDTH, *_HEIGHT}:
        info = {**info, "width": size[0], "height": size[1]}
    width, height = _size(info, _WIDTH), _size(info, _HEIGHT)
    matrix = _matrix(info, _MATRIX, 9)
    distortion = _matrix(info, ("distortion_coefficients", "d", "D"), None)
    projection = _matrix(info, _PROJECTION, 12)
    if not has_matrix:
        raise FrameError("expected a camera_matrix (or k) of 9 numbers, or a projection_matrix (or p) of 12")
    if matrix[6:8].any() and not matrix[[2, 5]].any():
        raise FrameError("camera matrix: expected 0 0 1 in its last row; it seems to be transposed")
    if abs(matrix[1]) > _SKEW * abs(matrix[0]):
        raise FrameError(f"camera matrix: expected no skew, got {matrix[1]:g}")
    region = info.get("roi", {})
    if not isinstance(region, dict):
        raise FrameError(f"roi: expected a mapping, got {reprlib.repr(region)}")
    return CameraInfo(
        width,
        height,
        str(info.get("distortion_model", info.get("camera_model", "plumb_bob"))),
        tuple(distortion.tolist()),
        tuple(matrix.tolist()),
        tuple(projection.tolist()),
        _count(info, "binning_x"),
        _count(info, "binning_y"),
        Region(*(_count(region, name) for name in ("x_offset", "y_offset", "width", "height"))),
    )


def _mapping(path: Path) -> Any:
    """What a file holds, by the names of a camera_info; a mapping if it is one of the forms that are known."""
    if (rows := _rows(path)) is not None:
        return {"k": rows}
    if path.suffix.lower() == ".json":
        return _read_json(path)
    return next((entry for entry in plain_yaml.read_all(path) if entry is not None), None)


def _rows(path: Path) -> list[float] | None:
    """The nine numbers of a file that holds nothing but a matrix, 3 x 3, or a larger one around it; else None."""
    if path.suffix.lower() == ".npy":
        try:
            matrix = npy_array(path)
        except UnpackingError as error:
            raise FrameError(str(error)) from error
    else:
        try:
            with path.open("rb") as file:
                words = re.split(r"[\s,;\[\]]+", file.read(_LONGEST + 1).decode("ascii"))
            matrix = np.array([float(word) for word in words if word])
        except (OSError, ValueError):
            return None
        shape = {9: (3, 3), 12: (3, 4), 16: (4, 4)}.get(matrix.size)
        if shape is None:
            return None
        matrix = matrix.reshape(shape)
    if matrix.shape not in ((3, 3), (3, 4), (4, 4)) or matrix.dtype.kind not in "fiu":
        raise FrameError(f"expected 3 x 3 numbers, got {matrix.dtype} {matrix.shape}")
    return [float(number) for number in matrix[:3, :3].ravel()]


def _four_numbers(text: str) -> dict[str, float] | None:
    """fx, fy, cx, cy of a text such as ``525,525,319.5,239.5``; None if it is another text, such as a path."""
    try:
        return dict(zip(("fx", "fy", "cx", "cy"), map(float, text.split(",")), strict=True))
    except ValueError:
        return None


def _read_json(path: Path) -> dict[str, Any]:
    """The mapping of a file.

    Raises
    ------
    FrameError
        If it is missing, too large, no JSON, or of another form.
    """
    try:
        with path.open("rb") as file:
            data = file.read(LARGEST + 1)
        found = json.loads(data)
    except (OSError, ValueError, RecursionError) as error:
        raise FrameError(f"not JSON: {error}") from error
    if len(data) > LARGEST:
        raise FrameError(f"expected at most {LARGEST} bytes")
    if not isinstance(found, dict):
        raise FrameError("expected a JSON object with intrinsics")
    if "ppx" in found and "ppy" in found:
        return _of_librealsense(found)
    if "intrinsic_matrix" in found:
        return _of_open3d(found)
    return found


def _of_librealsense(found: dict[str, Any]) -> dict[str, Any]:
    missing = [name for name in ("width", "height", "fx", "fy") if name not in found]
    if missing:
        raise FrameError(f"expected {', '.join(missing)} beside ppx and ppy")
    model = str(found.get("model", "")).lower().replace("_", " ").removeprefix("distortion.")
    if model not in _NO_DISTORTION + _BROWN_CONRADY:
        raise FrameError(f"model: expected Brown Conrady or none, got {found['model']!r}")
    distortion = found.get("coeffs", []) if model in _BROWN_CONRADY else []
    return {**found, "cx": found["ppx"], "cy": found["ppy"], "d": distortion}


def _of_open3d(found: dict[str, Any]) -> dict[str, Any]:
    columns = found["intrinsic_matrix"]
    if not isinstance(columns, list) or len(columns) != 9:
        raise FrameError("intrinsic_matrix: expected 9 numbers, column by column")
    rows = [columns[3 * column + row] for row in range(3) for column in range(3)]
    return {"width": found.get("width"), "height": found.get("height"), "k": rows}


def _size(info: dict[Any, Any], names: tuple[str, ...]) -> int:
    name = next((name for name in names if name in info), None)
    if name is None:
        raise FrameError(f"expected {names[0]} (or {names[1]})")
    value = _count(info, name)
    if value < 1:
        raise FrameError(f"{name}: expected a positive integer, got {value!r}")
    return value


def _count(info: dict[Any, Any], name: str) -> int:
    value = info.get(name, 0)
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise FrameError(f"{name}: expected a positive integer or 0, got {value!r}")
    return value


def _matrix(info: dict[Any, Any], names: tuple[str, ...], length: int | None) -> np.ndarray:
    """The numbers of the first of the names that is there; zeros, or none, where none is."""
    for name in names:
        if name not in info:
            continue
        entry = info[name]
        values = entry.get("data") if isinstance(entry, dict) else entry
        try:
            numbers = np.array(values, dtype=float).ravel()
        except (TypeError, ValueError, OverflowError) as error:  # the last of whole numbers that no float holds
            raise FrameError(f"{name}: expected numbers, got {reprlib.repr(values)}") from error
        if not np.isfinite(numbers).all() or (length is not None and numbers.size != length):
            wanted = "finite numbers" if length is None else f"{length} finite numbers"
            raise FrameError(f"{name}: expected {wanted}, got {reprlib.repr(values)}")
        return numbers
    return np.zeros(length or 0)
