"""Intrinsics as other tools write them, as the mapping of a camera_info YAML.

| form | from |
| --- | --- |
| ``525,525,319.5,239.5`` | papers and data sets: fx, fy, cx, cy in pixels, of an image without distortion |
| JSON with ``ppx``, ``ppy`` | librealsense (``rs-enumerate-devices``, ``rs2_intrinsics``) |
| JSON with ``intrinsic_matrix`` | Open3D: nine numbers, COLUMN by column |

A pixel's centre has integer coordinates, in all of them.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

LARGEST = 2**20
"""Bytes of a file."""
_NO_DISTORTION = ("none", "")
_BROWN_CONRADY = ("brown conrady", "inverse brown conrady", "modified brown conrady")
"""Names of librealsense.  Of depth images the coefficients are zero; others are taken for plumb_bob's."""


class IntrinsicsError(ValueError):
    """Text that holds no intrinsics; says what was expected."""


def four_numbers(text: str) -> tuple[float, float, float, float] | None:
    """fx, fy, cx, cy of a text such as ``525,525,319.5,239.5``; None if it is another text, such as a path."""
    parts = text.split(",")
    try:
        numbers = [float(part) for part in parts]
    except ValueError:
        return None
    return (numbers[0], numbers[1], numbers[2], numbers[3]) if len(numbers) == 4 else None


def read_json(path: Path) -> dict[str, Any]:
    """The mapping of a file.

    Raises
    ------
    IntrinsicsError
        If it is missing, too large, no JSON, or of another form.
    """
    try:
        with path.open("rb") as file:
            data = file.read(LARGEST + 1)
        found = json.loads(data)
    except (OSError, ValueError, RecursionError) as error:
        raise IntrinsicsError(f"not JSON: {error}") from error
    if len(data) > LARGEST:
        raise IntrinsicsError(f"expected at most {LARGEST} bytes")
    if not isinstance(found, dict):
        raise IntrinsicsError("expected a JSON object with intrinsics")
    if "ppx" in found and "ppy" in found:
        return _of_librealsense(found)
    if "intrinsic_matrix" in found:
        return _of_open3d(found)
    return found


def _of_librealsense(found: dict[str, Any]) -> dict[str, Any]:
    missing = [name for name in ("width", "height", "fx", "fy") if name not in found]
    if missing:
        raise IntrinsicsError(f"expected {', '.join(missing)} beside ppx and ppy")
    model = str(found.get("model", "")).lower().replace("_", " ").removeprefix("distortion.")
    if model not in _NO_DISTORTION + _BROWN_CONRADY:
        raise IntrinsicsError(f"model: expected Brown Conrady or none, got {found['model']!r}")
    return {
        "width": found["width"],
        "height": found["height"],
        "k": [found["fx"], 0, found["ppx"], 0, found["fy"], found["ppy"], 0, 0, 1],
        "d": found.get("coeffs", []) if model in _BROWN_CONRADY else [],
    }


def _of_open3d(found: dict[str, Any]) -> dict[str, Any]:
    columns = found["intrinsic_matrix"]
    if not isinstance(columns, list) or len(columns) != 9:
        raise IntrinsicsError("intrinsic_matrix: expected 9 numbers, column by column")
    rows = [columns[3 * column + row] for row in range(3) for column in range(3)]
    return {"width": found.get("width"), "height": found.get("height"), "k": rows}
