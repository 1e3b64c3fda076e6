"""Results of recorded frames as one HTML file: points, bodies and numbers, for any browser, without a server.

Its script draws with WebGL, and its content security policy forbids the browser to load anything.  A frame is one line
of JSON; bodies are written as their parameters and meshed by the page.  What is drawn is in metres in the optical
frame.  Points are quantised to 16 bits along each axis of the box around them: 0.1 mm in a scene of six metres.
"""

from __future__ import annotations

import base64
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from sq_perception.files.output_file import OutputFile, name_in_errors
from sq_perception.fitting.fit import Status
from sq_perception.geometry.mesh import COLOURS
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.recordings.frame_file import RecordedFrame
from sq_perception.recordings.result_json import in_result_frame
from sq_perception.recovery.recovery import FrameRecovery, edges_as_text, place_as_text

_TITLES = ("body", "status", "full edges", "centre", "exponents", "score", "why")
_TEMPLATE = Path(__file__).with_name("html_page.html")


class HtmlPage:
    """One file, which takes its name when it is closed; raises OSError where it cannot be written."""

    def __init__(self, path: str | Path) -> None:
        self._output = OutputFile(path)
        self._file = self._output.partial.open("w", encoding="utf-8")
        self._count = 0
        self._beginning, self._end = _TEMPLATE.read_text(encoding="utf-8").split("<!-- frames -->\n")

    def add(self, frame: RecordedFrame, recovery: FrameRecovery) -> None:
        """Write a frame and what was recovered from it."""
        content = {"name": f"{self._count}: {frame.name}", **_scene(frame, recovery), **_numbers(frame, recovery)}
        # Without "<" no text in it can end the script.
        text = json.dumps(content, allow_nan=False).replace("<", "\\u003c")
        with name_in_errors(self._output.path):
            self._file.write(f"{'' if self._count else self._beginning}<script>frames.push({text});</script>\n")
        self._count += 1

    def close(self, whole: bool = True) -> Path | None:
        """Finish the file; where it is, None without a frame.  See :meth:`OutputFile.commit`."""
        if self._file.closed:
            return None
        try:
            with name_in_errors(self._output.path):
                with self._file:
                    self._file.write(self._end)
                return self._output.commit(whole) if self._count else None
        finally:
            self._output.discard()


def _scene(frame: RecordedFrame, recovery: FrameRecovery) -> dict[str, Any]:
    """Return what the page draws of a frame, and from where it looks at it."""
    camera, depth = frame.camera, frame.depth
    stride = max(1, math.ceil(math.sqrt(depth.size / 40000)))
    rows, columns = np.nonzero(np.isfinite(depth[::stride, ::stride]))
    rows, columns = stride * rows, stride * columns
    points = camera.unproject(columns, rows, depth[rows, columns]).astype(float)
    numbers = np.zeros(int(recovery.labels.max(initial=0)) + 1, np.uint16)
    bodies = []
    up = np.array([0.0, -1.0, 0.0]) if recovery.plane is None else recovery.plane[:3]
    for k, body in enumerate(recovery.bodies):
        if 0 <= body.label < len(numbers):
            numbers[body.label] = k + 1
        if body.status != Status.FAILED:
            fits = (body.fit,) if body.parts is None else body.parts.fits
            bodies += [_body(k, fit.superquadric, fit.sigma_size, up) for fit in fits]
    low = points.min(axis=0) if len(points) else np.zeros(3)
    step = np.maximum((points.max(axis=0) if len(points) else low) - low, 1e-9) / np.iinfo(np.uint16).max
    middle = np.median(points, axis=0) if len(points) else np.array([0.0, 0.0, 1.0])
    if bodies:
        middle = np.mean([body["translation"] for body in bodies], axis=0)
    pixel = (float(middle[2]) if camera.is_pinhole else 1.0) / min(camera.fx, camera.fy)
    return {
        "points": {
            "low": low.tolist(),
            "step": step.tolist(),
            "steps": _pack(np.rint((points - low) / step)),
            "bodies": _pack(numbers[np.maximum(recovery.labels[rows, columns], 0)]),
        },
        "bodies": bodies,
        "colours": COLOURS[np.arange(len(recovery.bodies)) % len(COLOURS)].tolist(),
        "middle": middle.tolist(),
        "up": up.tolist(),
        "dot": 0.7 * stride * pixel,
        "field": 2 * math.atan(0.5 * camera.height / camera.fy) if camera.is_pinhole else 0.0,
        "aspect": camera.width / camera.height * camera.fy / camera.fx,
    }


def _body(number: int, body: Superquadric, sigma_size: np.ndarray, up: np.ndarray) -> dict[str, Any]:
    """Return a body's parameters, the half sizes of its shell if they are known, and the height of its label."""
    sigma = np.nan_to_num(sigma_size, posinf=np.inf)
    outer = np.minimum(body.size + 2 * sigma, 3 * body.size)  # a shell that is hardly known would hide the rest
    return {
        "number": number,
        **{name: np.asarray(getattr(body, name)).tolist() for name in ("size", "shape", "translation", "rotation")},
        "outer": outer.tolist() if (sigma > 0).any() else None,
        "height": float(body.support(up[None])[0]),
    }


def _pack(values: np.ndarray) -> str:
    """Return numbers as base64 of unsigned 16 bit, little endian."""
    return base64.b64encode(values.astype("<u2").tobytes()).decode()


def _numbers(frame: RecordedFrame, recovery: FrameRecovery) -> dict[str, Any]:
    """Return the bodies as rows of text, and what is to be said of the frame."""
    rows = []
    for body in recovery.bodies:
        shown = in_result_frame(body.superquadric, frame.is_cube)
        is_failed = body.status == Status.FAILED
        rows.append(
            [
                body.status.name.lower(),
                "" if is_failed else edges_as_text(shown.size, body.sigma_size, frame.is_cube),
                place_as_text(shown.translation, frame.is_cube),
                "" if is_failed else " ".join(f"{value:.2f}" for value in shown.shape),
                f"{body.score:.2f}" if math.isfinite(body.score) else "",
                "" if body.status == Status.CONVERGED else body.message,
            ]
        )
    return {"remark": recovery.message, "titles": _TITLES, "rows": rows}
