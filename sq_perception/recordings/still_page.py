"""Results of recorded frames as one HTML file: points, bodies and numbers, for any browser, without a server.

The scene is drawn by the viewer that trimesh brings, three.js within; nothing is loaded from elsewhere.  It is turned
half about x, as its y axis points up.  The file grows frame by frame and takes its name when it is closed.
"""

from __future__ import annotations

import base64
import html
import json
import math
from pathlib import Path

import numpy as np
import trimesh
from trimesh.viewer.notebook import scene_to_html
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from sq_perception.files.output_file import OutputFile, named
from sq_perception.fitting.fit import Status
from sq_perception.geometry.mesh import COLOURS, HALF_TURN_ABOUT_X, triangles
from sq_perception.recordings.frame_file import RecordedFrame
from sq_perception.recordings.result_json import in_result_frame
from sq_perception.recovery.recovery import FrameRecovery, edges_as_text, place_as_text
from sq_perception.viewing import drawings

_MOST_POINTS = 30000
_SCENE = "$SCENE"
_LIT, _UNLIT = 0.32, 0.45
"""Shares of a body's colour: the viewer has one lamp, of intensity 1.75, and no light where that does not shine."""
_TEMPLATE = Path(__file__).with_name("still_page.html")


class StillPage:
    """One file; raises OSError where it cannot be written."""

    def __init__(self, path: str | Path) -> None:
        self._output = OutputFile(path)
        self._file = self._output.partial.open("w", encoding="utf-8")
        self._count = 0
        nothing = trimesh.Scene(trimesh.creation.box())
        scene_to = scene_to_html(nothing)
        there = base64.b64encode(nothing.export(file_type="glb")).decode()
        beginning, self._end = _TEMPLATE.read_text(encoding="utf-8").split("<!-- frames -->\n")
        self._beginning = beginning.replace("$VIEWER", _as_script(scene_to.replace(there, _SCENE)))
        """Until the first frame is written."""

    def add(self, frame: RecordedFrame, recovery: FrameRecovery) -> None:
        """Write a frame and what was recovered from it."""
        glb = base64.b64encode(_scene(frame, recovery).export(file_type="glb")).decode()
        name = f"{self._count}: {frame.name}"
        content = _as_script({"name": name, "glb": glb, "numbers": _numbers(frame, recovery)})
        with named(self._output.path):
            self._file.write(f"{self._beginning}<script>frames.push({content});</script>\n")
        self._count, self._beginning = self._count + 1, ""

    def close(self, whole: bool = True) -> Path | None:
        """Finish the file; where it is, None without a frame.  See :meth:`OutputFile.commit`."""
        if self._file.closed:
            return None
        try:
            with named(self._output.path):
                with self._file:
                    self._file.write(self._end)
                return self._output.commit(whole) if self._count else None
        finally:
            self._output.discard()


def _as_script(value: object) -> str:
    """JSON that may stand within a script element."""
    return json.dumps(value).replace("<", "\\u003c")


def _scene(frame: RecordedFrame, recovery: FrameRecovery) -> trimesh.Scene:
    """Points and bodies, with a camera behind the one that took the image."""
    span = drawings.depth_span(frame.depth) or (0.0, 1.0)
    cloud = drawings.cloud(frame.depth, frame.camera, span, _MOST_POINTS)
    whole = trimesh.Scene()
    points, colours = cloud.points, cloud.colours
    if not len(points):  # of a covered lens one black point, as no GLB is empty
        points, colours = np.array([[0.0, 0.0, span[0]]]), np.array([[0, 0, 0, 255]], np.uint8)
    middle = np.median(points, axis=0).astype(float)
    whole.add_geometry(trimesh.PointCloud(points, colours), node_name="points")
    for k, body in enumerate(recovery.bodies):
        if body.status == Status.FAILED:
            continue
        vertices, faces = triangles(body.superquadric)
        colour = COLOURS[k % len(COLOURS)]
        lit, unlit = np.append(_LIT * colour, 1.0), _UNLIT * colour
        matt = PBRMaterial(baseColorFactor=lit, emissiveFactor=unlit, metallicFactor=0.0)
        whole.add_geometry(
            trimesh.Trimesh(vertices, faces, visual=TextureVisuals(material=matt), process=False), node_name=f"body_{k}"
        )
    whole.apply_transform(HALF_TURN_ABOUT_X)
    distance = 0.4 * float(np.linalg.norm(middle))
    target = middle * [1, -1, -1]
    eye = np.array([0.7 * distance, distance, distance]) * (1.0 if frame.camera.is_pinhole else 2.0)
    whole.camera = trimesh.scene.Camera(fov=(60, 45), z_near=1e-3)
    whole.camera_transform = _looking(eye, target)
    return whole


def _looking(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Pose (4, 4) of a camera of OpenGL: x right, y up, looking along -z."""
    back = (eye - target) / max(float(np.linalg.norm(eye - target)), 1e-9)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= max(float(np.linalg.norm(right)), 1e-9)
    pose = np.eye(4)
    pose[:3] = np.column_stack([right, np.cross(back, right), back, eye])
    return pose


def _numbers(frame: RecordedFrame, recovery: FrameRecovery) -> str:
    """The bodies as an HTML table."""
    remark = f"<p>{html.escape(recovery.message)}</p>" if recovery.message else ""
    if not recovery.bodies:
        return remark
    titles = ("", "status", "full edges", "centre", "exponents", "score", "why")
    rows = ["".join(f"<th>{title}</th>" for title in titles)]
    for k, body in enumerate(recovery.bodies):
        shown = in_result_frame(body.superquadric, frame.is_cube)
        red, green, blue = (round(255 * channel) for channel in COLOURS[k % len(COLOURS)])
        is_failed = body.status == Status.FAILED
        cells = [
            body.status.name.lower(),
            "" if is_failed else edges_as_text(shown.size, body.sigma_size, frame.is_cube),
            place_as_text(shown.translation, frame.is_cube),
            "" if is_failed else " ".join(f"{value:.2f}" for value in shown.shape),
            f"{body.score:.2f}" if math.isfinite(body.score) else "",
            body.message,
        ]
        chip = f'<td><span class="chip" style="background:rgb({red},{green},{blue})"></span>{k}</td>'
        rows.append(chip + "".join(f"<td>{html.escape(cell)}</td>" for cell in cells))
    return remark + "<table>" + "".join(f"<tr>{row}</tr>" for row in rows) + "</table>"
