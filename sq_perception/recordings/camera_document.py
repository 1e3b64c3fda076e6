"""What a file about a camera holds, as mappings of plain data, whatever its format.

YAML, JSON, OpenCV's FileStorage, COLMAP's cameras.txt, lines of ``name: value`` or ``name = value``, NPZ and NPY; a
text of nothing but 4, 9, 12 or 16 numbers is fx fy cx cy, or a matrix K row by row, or a larger one around it.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from sq_perception.files.unpacking import LONGEST_TEXT, UnpackingError, npy_array, npz_arrays, yaml_documents

_COLMAP = re.compile(r"\s*(\d+)\s+([A-Z]\w+)\s+(\d+)\s+(\d+)((?:\s+[-+.\deE]+)+)\s*")
_COLMAP_PARAMETERS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
}
"""https://colmap.github.io/cameras.html"""


def read(path: Path) -> Any:
    """Return the document: a mapping if it is of a known form.

    Raises ValueError if the file is missing, too large, or damaged.
    """
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return {name: array.tolist() for name, array in npz_arrays(path).items() if array.size <= 64}
    if suffix == ".npy":
        return _matrix(npy_array(path))
    try:
        with path.open("rb") as file:
            data = file.read(LONGEST_TEXT + 1)
    except OSError as error:
        raise ValueError(str(error)) from error
    if len(data) > LONGEST_TEXT:
        raise ValueError(f"expected at most {LONGEST_TEXT} bytes")
    text = data.decode("utf-8", errors="replace")
    for form in (_of_numbers, _of_colmap):
        if (found := form(text)) is not None:
            return found
    if suffix == ".json" or text.lstrip().startswith("{"):
        try:
            return json.loads(data)
        except (ValueError, RecursionError) as error:
            if suffix == ".json":
                raise ValueError(f"not JSON: {error}") from error
    # OpenCV's own directive and tags are no YAML that others know.
    plain = re.sub(r"^%YAML.*|!!opencv-\S+", "", text, flags=re.MULTILINE)
    try:
        found = next((entry for entry in yaml_documents(plain.encode()) if entry is not None), None)
    except UnpackingError:
        if lines := _of_lines(text):
            return lines
        raise
    return found if isinstance(found, dict) else _of_lines(text) or found


def _of_numbers(text: str) -> dict[str, Any] | None:
    try:
        numbers = [float(word) for word in re.split(r"[\s,;\[\]]+", text) if word]
    except ValueError:
        return None
    return _matrix(np.array(numbers)) if numbers else None


def _matrix(numbers: np.ndarray) -> dict[str, Any]:
    """Return K, or the larger matrix around it, or four numbers."""
    shape = {4: (4,), 9: (3, 3), 12: (3, 4), 16: (4, 4)}.get(numbers.size)
    if shape is None or numbers.dtype.kind not in "fiu" or numbers.shape not in (shape, (numbers.size,)):
        raise ValueError(f"expected four numbers (fx fy cx cy) or 3 x 3 of them, got {numbers.dtype} {numbers.shape}")
    return {"k": numbers.reshape(shape).tolist()}


def _of_colmap(text: str) -> dict[str, Any] | None:
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    found = [_COLMAP.fullmatch(line) for line in lines]
    if not found or not all(found):
        return None
    cameras = {}
    for number, model, width, height, parameters in (match.groups() for match in found if match):
        names = _COLMAP_PARAMETERS.get(model, "").split()
        numbers = [float(word) for word in parameters.split()]
        if len(names) != len(numbers):
            raise ValueError(f"camera {number}: expected a model of {', '.join(_COLMAP_PARAMETERS)}, got {model}")
        cameras[f"camera {number}"] = {"model": model, "width": int(width), "height": int(height)} | dict(
            zip(names, numbers, strict=True)
        )
    return cameras


def _of_lines(text: str) -> dict[str, Any]:
    """``name: value`` and ``name = value``; another line is the title of those that follow.  Empty without numbers."""
    has_numbers = False
    top: dict[str, Any] = {}
    section = top
    for line in filter(str.strip, text.splitlines()):
        mark = re.search("[:=]", line)
        name, value = (line, "") if mark is None else (line[: mark.start()].strip(), line[mark.end() :].strip())
        if not value:
            section = top.setdefault(name.strip(), {})
            continue
        words = re.split(r"[\s,;]+", value.strip("[]() "))
        try:
            values = [int(word) if word.isdigit() else float(word) for word in words]
            section[name], has_numbers = values if len(values) > 1 else values[0], True
        except ValueError:
            section[name] = value
    return {name: value for name, value in top.items() if value != {}} if has_numbers else {}
