"""The camera of recorded images: a camera_info YAML, or intrinsics as other tools write them.

Whatever the format (:mod:`sq_perception.recordings.camera_document`), K is looked for by its usual names: in one
number each (fx, fl_x, Camera.fx ...; cx, ppx ...), in four (``intrinsics`` of Kalibr), or in a matrix (K, cam_K,
camera_matrix, intrinsic_matrix ...), row by row or, as the last row of K shows, column by column.  That reads
camera_calibration's YAML and printed camera_info messages, OpenCV's FileStorage, librealsense, Open3D, BOP
(camera.json, and scene_camera.json by the number of the image), Kalibr, NeRF's transforms.json, COLMAP, ORB-SLAM,
ScanNet, Record3D, ``.intr`` and texts.  Of several cameras the one of the image's size counts, and depth before colour.
Beside files, ``525,525,319.5,239.5`` is fx, fy, cx, cy.

Where no size is stated, it is the image's.  A stated unit of depths (depth_scale, DepthMapFactor ...) comes along.

A pixel's centre has integer coordinates, in all of them.
"""

from __future__ import annotations

import os
import re
import reprlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sq_perception.imaging import depth_units
from sq_perception.imaging.calibration import Calibration, Treatment
from sq_perception.imaging.depth_units import Stated
from sq_perception.recordings import camera_document

CAMERA_FILES = (
    "camera_info.yaml",
    "camera_info.yml",
    "scene_camera.json",  # BOP's, of each image; camera.json of all
    "camera.yaml",
    "camera.yml",
    "camera.json",
    "intrinsics.json",
    "camera_intrinsic.json",  # Open3D's
    "intrinsics.txt",
    "cam_K.txt",
    "transforms.json",
)
"""Names of the camera beside images."""

_NAMES = {
    **dict.fromkeys(("fx", "fl x", "f x", "focal x", "focal length x", "fu"), "fx"),
    **dict.fromkeys(("fy", "fl y", "f y", "focal y", "focal length y", "fv"), "fy"),
    **dict.fromkeys(("cx", "c x", "ppx", "center x", "principal point x"), "cx"),
    **dict.fromkeys(("cy", "c y", "ppy", "center y", "principal point y"), "cy"),
    **dict.fromkeys(("f", "focal", "focal length"), "f"),
    **dict.fromkeys(("pp", "principal point"), "pp"),
    **dict.fromkeys(("matrix", "k", "intrinsic", "intrinsics", "intrinsic matrix", "intrinsics matrix", "mtx"),
                    "matrix"),
    **dict.fromkeys(("projection matrix", "p"), "projection matrix"),
    **dict.fromkeys(("width", "w"), "width"),
    **dict.fromkeys(("height", "h"), "height"),
    **dict.fromkeys(("resolution", "size"), "size"),
    **dict.fromkeys(("distortion coefficients", "distortion coeffs", "distortion", "d", "coeffs", "dist coeffs",
                     "dist coefs", "dist"),
                    "distortion"),
    **dict.fromkeys(("scale", "map factor", "factor", "shift", "unit scale factor", "unit", "units"), "unit"),
    **{name: name for name in ("distortion model", "model", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "roi",
                               "binning x", "binning y")},
}  # fmt: skip
"""What a name means, without the words that say of what it is."""
_WORDS = re.compile(r"[A-Z]?[a-z]+\d*|[A-Z]+(?![a-z])\d*|\d+")
_OF_WHAT = ("m", "camera", "cam", "image", "img", "calibration", "rgbd", "integer", "ir")
_COLOUR = ("color", "colour", "rgb")
_LENSES = {
    **dict.fromkeys(("", "none", "pinhole", "simple pinhole", "plumb bob", "radtan", "opencv", "simple radial",
                     "radial", "perspective", "brown conrady", "inverse brown conrady", "modified brown conrady"),
                    "plumb_bob"),
    **dict.fromkeys(("rational polynomial", "full opencv"), "rational_polynomial"),
    **dict.fromkeys(("equidistant", "equi", "fisheye", "opencv fisheye", "kannala brandt", "kannala brandt4",
                     "kannala brandt8"), "equidistant"),
}  # fmt: skip
"""Distortion models by their names.  Depth images of librealsense have coefficients of zero; others are taken for
plumb_bob's."""


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
    """The fields of a sensor_msgs/CameraInfo, from a file, with flat matrices; ``unit``: that of depths, if stated."""

    width: int
    height: int
    distortion_model: str
    d: tuple[float, ...]
    k: tuple[float, ...]
    p: tuple[float, ...]
    binning_x: int = 0
    binning_y: int = 0
    roi: Region = Region()
    unit: Stated | None = None


def read_calibration(
    source: str | Path, distortion: Treatment = "auto", size: tuple[int, int] | None = None
) -> Calibration:
    """Return the calibration of images without a name, of a camera as :func:`read_camera_info` has it.  Raises
    FrameError as that does, or if the camera is not calibrated or its distortion not known."""
    return calibration(read_camera_info(source, size), source, distortion, "")


def calibration(info: CameraInfo, source: str | Path, distortion: Treatment, name: str) -> Calibration:
    """Return the calibration of images called ``name``; a FrameError names the ``source`` of the camera_info."""
    try:
        return Calibration.of(info, name, distortion)
    except ValueError as error:
        raise FrameError(f"{source}: {error}") from error


def read_camera_info(source: str | Path, size: tuple[int, int] | None = None, name: str | None = None) -> CameraInfo:
    """Return the camera of a file, or of four numbers; see the module.  ``size``: width and height where nothing states
    them; ``name`` of the image, whose number tells the camera of a scene, None for any."""
    try:
        if not os.path.exists(source) and (numbers := _numbers(str(source))) is not None:
            if len(numbers) != 4:
                raise FrameError(f"expected four numbers, fx,fy,cx,cy, got {len(numbers)}")
            document: Any = dict(zip(("fx", "fy", "cx", "cy"), numbers, strict=True))
        else:
            document = camera_document.read(Path(source))
        found = _choose(document, size, name)
        if found.unit is None:
            return found
        return replace(found, unit=replace(found.unit, source=f"{Path(source).name}: {found.unit.source}"))
    except ValueError as error:
        raise FrameError(f"{source}: cannot read the camera_info: {error}") from error


def camera_beside(path: Path) -> Path | None:
    """Find the camera of an image: a file of its folder, of its name, or, of a folder of depth images, above it."""
    beside = path.with_suffix(".yaml")  # as sq-perception render writes it
    if found := camera_in(path.parent) or (beside if beside.is_file() else None):
        return found
    folder = path.absolute().parent
    return camera_in(folder.parent) if "depth" in folder.name.lower() else None


def camera_in(folder: Path) -> Path | None:
    """Return the camera of a folder's images."""
    return next((folder / name for name in CAMERA_FILES if (folder / name).is_file()), None)


def _numbers(text: str) -> list[float] | None:
    """Return the numbers of a text such as ``525,525,319.5,239.5``; None if it is another text, such as a path."""
    try:
        return [float(word) for word in text.split(",")] if "," in text else None
    except ValueError:
        return None


@dataclass(frozen=True)
class _Found:
    """A camera of a document: the names on the way to it, and its fields, each with its name in the file."""

    way: tuple[str, ...]
    fields: Mapping[str, tuple[str, Any]]
    is_colour: bool
    is_depth: bool

    def get(self, field: str) -> Any:
        return self.fields[field][1] if field in self.fields else None


def _choose(document: Any, size: tuple[int, int] | None, name: str | None) -> CameraInfo:
    """Return the camera of a document that is meant: of the image's number and size, and of depth."""
    if not isinstance(document, dict | list):
        raise FrameError("expected a camera_info as a YAML mapping, JSON, or 3 x 3 numbers")
    found = list(_cameras(document))
    whole = [one for one in found if _has_camera(one)]
    if not whole:
        wanted = ("fx", "fy", "cx", "cy")
        if has := max(([field for field in wanted if field in one.fields] for one in found), key=len, default=None):
            missing = ", ".join(field for field in wanted if field not in has)
            raise FrameError(f"expected {missing} (or other names for them) beside {', '.join(has)}")
        raise FrameError("expected fx, fy, cx, cy, a camera_matrix (K) of 9 numbers, or a projection_matrix (P) of 12")
    if isinstance(document, dict) and all(str(key).isdigit() for key in document):
        if name is None:
            whole = whole[:1]
        elif len({_camera_info(one, size) for one in whole}) > 1:
            whole = [one for one in whole if name.isdigit() and int(one.way[0]) == int(name)]
            if not whole:
                raise FrameError(f"no camera for image {name} among those of {len(document)} images")
    for is_wanted in (
        lambda one: size is None or _sides(one, None) in (None, size),
        lambda one: one.is_depth,
        lambda one: not one.is_colour,
    ):
        whole = [one for one in whole if is_wanted(one)] or whole
    first, *others = {_camera_info(one, size) for one in whole}
    if others:
        names = ", ".join(" ".join(one.way) for one in whole[:8])
        raise FrameError(f"expected one camera, got {len(whole)}: {names}: write the one of the images by itself")
    return first


def _cameras(node: Any, way: tuple[str, ...] = (), left: list[int] | None = None) -> Iterator[_Found]:
    """Yield everything in a document that has a field of a camera."""
    left = [10_000] if left is None else left  # a scene of BOP has 3 for each of a thousand images
    left[0] -= 1
    if left[0] < 0:
        return
    if isinstance(node, dict):
        groups: dict[str, dict[str, tuple[str, Any]]] = {"": {}, "depth": {}, "colour": {}}
        for name, value in node.items():
            words = [word.lower() for word in _WORDS.findall(str(name))]
            group = "depth" if "depth" in words else "colour" if any(word in _COLOUR for word in words) else ""
            words = [word for word in words if word.rstrip("0123456789") not in (*_OF_WHAT, *_COLOUR, "depth")]
            field = _NAMES.get(" ".join(words))
            field = "distortion model" if field == "distortion" and isinstance(value, str) else field
            if field is not None and (field != "unit" or group == "depth" or "map" in words):
                groups[group].setdefault(field, (str(name), value))
        of_way = {word.lower() for part in way for word in _WORDS.findall(part)}
        is_colour, is_depth = not of_way.isdisjoint(_COLOUR), "depth" in of_way
        if any(_has_camera(_Found(way, groups[name], False, False)) for name in ("depth", "colour")):
            for group in ("depth", "colour"):
                fields = {**groups[""], **groups[group], **{k: v for k, v in groups["depth"].items() if k == "unit"}}
                yield _Found((*way, group), fields, group == "colour", group == "depth")
        elif fields := {**groups["colour"], **groups[""], **groups["depth"]}:
            yield _Found(way, fields, is_colour, is_depth)
    inner = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in inner:
        if isinstance(value, dict | list):
            yield from _cameras(value, (*way, str(key)), left)


def _has_camera(one: _Found) -> bool:
    fields = one.fields
    return (
        _is_matrix(one.get("matrix"))
        or _is_matrix(one.get("projection matrix"))
        or ((fields.keys() >= {"fx", "fy"} or "f" in fields) and (fields.keys() >= {"cx", "cy"} or "pp" in fields))
    )


def _is_matrix(value: Any) -> bool:
    return isinstance(value, list | dict) and bool(value)


def _camera_info(one: _Found, size: tuple[int, int] | None) -> CameraInfo:
    width, height = _sides(one, size) or (0, 0)
    if not width or not height:
        raise FrameError("expected image_width and image_height (or width and height)")
    has_projection = _is_matrix(one.get("projection matrix"))
    projection = _numbers_of(one, "projection matrix", (12,)) if has_projection else np.zeros(12)
    matrix = _matrix(one)
    lens = _lens(one)
    coefficients = _numbers_of(one, "distortion", None)
    if not coefficients.size and (lens == "equidistant" or "k1" in one.fields):
        order = "k1 k2 k3 k4" if lens == "equidistant" else "k1 k2 p1 p2 k3 k4 k5 k6"
        coefficients = np.array([_number(one, name) for name in order.split()])
    name, unit = one.fields.get("unit", ("", None))
    if isinstance(unit, list) and len(unit) == 1:
        unit = unit[0]
    is_unit = isinstance(unit, int | float) and not isinstance(unit, bool)
    region = one.get("roi") or {}
    if not isinstance(region, dict):
        raise FrameError(f"roi: expected a mapping, got {reprlib.repr(region)}")
    return CameraInfo(
        width, height, lens, tuple(coefficients.tolist()), tuple(matrix.tolist()), tuple(projection.tolist()),
        _count(one.get("binning x"), "binning_x"), _count(one.get("binning y"), "binning_y"),
        Region(*(_count(region.get(part), part) for part in ("x_offset", "y_offset", "width", "height"))),
        depth_units.parse_scale(float(unit), name) if is_unit else None,
    )


def _sides(one: _Found, size: tuple[int, int] | None) -> tuple[int, int] | None:
    """Width and height of a camera's images; ``size`` where they are not stated."""
    given = one.get("size")
    if isinstance(given, list) and len(given) == 2:
        width, height = given
    elif "width" not in one.fields and "height" not in one.fields:
        return size
    else:
        if "width" not in one.fields or "height" not in one.fields:
            raise FrameError("expected both image_width and image_height (or width and height)")
        width, height = one.get("width"), one.get("height")
    sides = []
    for name, value in (("width", width), ("height", height)):
        value = int(value) if isinstance(value, float) and value.is_integer() else value
        side = _count(value, name)
        if side < 1:
            raise FrameError(f"{name}: expected a positive integer, got {value!r}")
        sides.append(side)
    return sides[0], sides[1]


def _matrix(one: _Found) -> np.ndarray:
    """Return K, flat, row by row; zeros where only a projection matrix is given."""
    fields = one.fields
    if fields.keys() >= {"cx", "cy"} and (fields.keys() >= {"fx", "fy"} or "f" in fields):
        fx, fy = (_number(one, name if name in fields else "f") for name in ("fx", "fy"))
        return np.array([fx, 0, _number(one, "cx"), 0, fy, _number(one, "cy"), 0, 0, 1])
    if "pp" in fields and "f" in fields:
        (fx, fy), (cx, cy) = np.broadcast_to(_numbers_of(one, "f", (1, 2)), 2), _numbers_of(one, "pp", (2,))
        return np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1])
    if not _is_matrix(one.get("matrix")):
        return np.zeros(9)
    numbers = _numbers_of(one, "matrix", (4, 9, 12, 16))
    if numbers.size == 4:
        fx, fy, cx, cy = numbers
        return np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1])
    name = fields["matrix"][0]
    matrix = numbers.reshape(-1, 3 if numbers.size == 9 else 4)
    if matrix[2, :2].any() and not matrix[:2, 2].any() and numbers.size != 12:  # column by column
        matrix = matrix.T
    matrix = matrix[:3, :3]
    if abs(matrix[0, 1]) > 1e-6 * abs(matrix[0, 0]):
        raise FrameError(f"{name}: expected no skew, got {matrix[0, 1]:g}")
    if matrix.any() and not np.allclose(matrix[2], [0, 0, 1]):
        raise FrameError(f"{name}: expected 0 0 1 in its last row, got {matrix[2].tolist()}")
    return matrix.ravel()


def _lens(one: _Found) -> str:
    """Return the distortion model of a camera, by the name that messages have for it."""
    for field in ("distortion model", "model"):
        given = one.get(field)
        if given is None:
            continue
        words = [word.lower() for word in _WORDS.findall(str(given))]
        known = _LENSES.get(" ".join(word for word in words if word != "distortion"))
        if known is not None and known != "plumb_bob":
            return known
        if known is None and field == "distortion model":
            return str(given)  # which Calibration refuses where there is a distortion
        if "theta" in words:
            raise FrameError(f"{one.fields[field][0]}: expected {', '.join(set(_LENSES.values()))}, got {given!r}")
    return "plumb_bob"


def _number(one: _Found, field: str) -> float:
    return float(_numbers_of(one, field, (1,))[0]) if field in one.fields else 0.0


def _numbers_of(one: _Found, field: str, lengths: tuple[int, ...] | None) -> np.ndarray:
    """Return the finite numbers of a field, flat; none where it is not there."""
    if field not in one.fields:
        return np.zeros(0)
    name, values = one.fields[field]
    values = values.get("data") if isinstance(values, dict) else values
    try:
        numbers = np.array([] if values is None else values, dtype=float).ravel()
    except (TypeError, ValueError, OverflowError) as error:  # the last of whole numbers that no float holds
        raise FrameError(f"{name}: expected numbers, got {reprlib.repr(values)}") from error
    if not np.isfinite(numbers).all() or (lengths is not None and numbers.size not in lengths):
        wanted = "finite numbers" if lengths is None else f"{' or '.join(map(str, lengths))} finite numbers"
        raise FrameError(f"{name}: expected {wanted}, got {reprlib.repr(values)}")
    return numbers


def _count(value: Any, name: str) -> int:
    value = 0 if value is None else value
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise FrameError(f"{name}: expected a positive integer or 0, got {value!r}")
    return value
