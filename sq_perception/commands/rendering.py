"""``sq-perception sample`` and ``render``: simulated frames with their cameras."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sq_perception.commands import console
from sq_perception.files import output_file

if TYPE_CHECKING:
    import numpy as np

    from sq_perception.geometry.superquadric import Superquadric
    from sq_perception.imaging.camera import Camera


_SAMPLE_HELP = """\
Write a simulated RealSense D435 depth image of four objects on a table, and print their true sizes.
The NPZ holds what `sq-perception recover` reads of one: depth (metres, NaN = no reading) and K (3 x 3).
"""
_SAMPLE_EPILOG = """\
examples:
  sq-perception sample table.npz
  sq-perception recover table.npz --html page.html
"""


def sample(arguments: Sequence[str]) -> int:
    """Run ``sq-perception sample``; return the exit code."""
    command = console.parser("sample", _SAMPLE_HELP, _SAMPLE_EPILOG)
    command.add_argument("output", type=console.target, metavar="FILE", help="an .npz")
    output = command.parse_args(arguments).output
    if output.suffix.lower() != ".npz":
        return console.complain(f"{output}: expected a name that ends in .npz", console.USAGE)

    import numpy as np

    from sq_perception.recovery.recovery import edges_as_text, place_as_text
    from sq_perception.simulation import scenes

    made = scenes.sample()
    with output_file.writing(output) as partial, partial.open("wb") as file:
        np.savez_compressed(file, depth=made.depth, K=made.camera.matrix)
    unknown = [np.nan] * 3
    print(f"{output}: {made.camera.width} x {made.camera.height}, a simulated RealSense D435; true full edges")
    for name, body in zip(made.names, made.bodies, strict=True):
        edges = edges_as_text(body.size, unknown, is_cube=False)
        print(f"  {name:8}{edges:22} at {place_as_text(body.translation, is_cube=False)}")
    return console.SUCCESS


PARAMETERS = ("a1", "a2", "a3", "e1", "e2", "t1", "t2", "t3", "qx", "qy", "qz", "qw")
_RENDER_HELP = """\
Draw one superquadric as a depth image.

The 12 parameters: half sizes a1 a2 a3, exponents e1 e2 in (0, 2], centre t1 t2 t3, rotation quaternion x y z w (object
to frame).  Orthographic: in the unit cube (x right, y up, z to the viewer).  Pinhole: metres in the optical frame
(x right, y down, z forward).
"""
_RENDER_EPILOG = """\
examples:
  sq-perception render 0.25 0.15 0.1  0.2 0.8  0.5 0.5 0.5  0.2 0.3 0.1 0.9 --output view.png
  sq-perception render 0.05 0.04 0.1  0.1 1.0  0 0 0.8  0.7 0 0 0.7 --projection pinhole --output can.npz
  sq-perception recover view.png --projection orthographic --json -

files:
  orthographic  .png and .bmp (8 bit), .npz
  pinhole       .png (16 bit, millimetres; its camera goes into a .yaml of the same name, where recover finds it), .npz
  An NPZ also holds labels and the parameters (superquadrics, 1 x 12).
"""


def render(arguments: Sequence[str]) -> int:
    """Run ``sq-perception render``; return the exit code."""
    command = console.parser("render", _RENDER_HELP, _RENDER_EPILOG)
    add = command.add_argument
    for name in PARAMETERS:
        add(name, type=float)
    add("--output", "-o", type=console.target, required=True, metavar="FILE", help=".png, .bmp or .npz")
    add("--projection", choices=("orthographic", "pinhole"), default="orthographic")
    add("--width", type=console.at_least(1), help="pixels (256 orthographic, 640 pinhole)")
    add("--height", type=console.at_least(1), help="pixels (as the width orthographic, 480 pinhole)")
    add("--focal", type=float, help="focal length of the pinhole camera, pixels (525)")
    return _render(command.parse_args(console.mark_negatives(arguments)))


def _render(options: argparse.Namespace) -> int:
    output: Path = options.output
    suffix = output.suffix.lower()
    pinhole = options.projection == "pinhole"
    if suffix not in ((".png", ".npz") if pinhole else (".png", ".bmp", ".npz")):
        kinds = ".png or .npz" if pinhole else ".png, .bmp or .npz"
        return console.complain(f"--output: {output.name}: an image of this projection is a {kinds}", console.USAGE)
    beside = output.with_suffix(".yaml")
    if pinhole and suffix == ".png" and beside.exists() and not output.exists():
        return console.complain(f"{beside}: the camera of {output.name} goes there, but something else has that name")
    if not pinhole and options.focal is not None:
        return console.complain("--focal: of a pinhole camera; see --projection", console.USAGE)

    import numpy as np

    from sq_perception.files.unpacking import MOST_PIXELS
    from sq_perception.geometry.superquadric import Superquadric
    from sq_perception.imaging import raycast, unit_cube

    try:
        given = np.array([getattr(options, name) for name in PARAMETERS])
        if not np.isfinite(given).all():
            raise ValueError(f"expected finite parameters, got {' '.join(f'{value:g}' for value in given)}")
        body = Superquadric.from_flat(given)
        seen = body if pinhole else unit_cube.optical_from_cube(body)
        camera = _camera(options)
    except ValueError as error:
        return console.complain(str(error), console.USAGE)
    width, height = camera.width, camera.height
    longest = 10**6  # that OpenCV and libpng write and read
    if width * height > MOST_PIXELS or max(width, height) > longest:  # nor would any command read it
        expected = f"expected an image of at most {MOST_PIXELS} pixels, sides of at most {longest}"
        return console.complain(f"{expected}, got {width} x {height}", console.USAGE)
    depth, index = raycast.render(seen, camera)
    if not (index >= 0).any():
        console.complain("the camera does not see the body: the image is empty")
    _write_depth(output, depth, index, camera, body)
    return console.SUCCESS


def _camera(options: argparse.Namespace) -> Camera:
    from sq_perception.imaging import unit_cube
    from sq_perception.imaging.camera import Camera

    if options.projection != "pinhole":
        return unit_cube.camera(options.width or unit_cube.THESIS_PIXELS, options.height)
    width, height = options.width or 640, options.height or 480
    focal = 525.0 if options.focal is None else options.focal
    return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def _write_depth(output: Path, depth: np.ndarray, index: np.ndarray, camera: Camera, body: Superquadric) -> None:
    import cv2
    import numpy as np
    import yaml

    from sq_perception.imaging import unit_cube

    if output.suffix.lower() == ".npz":
        fields: dict[str, Any] = {
            "depth": np.where(np.isfinite(depth), depth, np.nan).astype(np.float32),
            "labels": (index + 1).astype(np.int16),
            "superquadrics": np.asarray(body.to_flat())[None],
            "projection": camera.projection,
        }
        if camera.is_pinhole:
            fields["K"] = camera.matrix
        with output_file.writing(output) as partial, partial.open("wb") as file:
            np.savez_compressed(file, **fields)
        return
    if camera.is_pinhole:
        millimetres, most = np.round(1e3 * depth), np.iinfo(np.uint16).max
        image = np.where(millimetres <= most, millimetres, 0).astype(np.uint16)
        if (millimetres[index >= 0] > most).any():
            console.complain(f"what is beyond 65.535 m is left out: {output.name} holds no more, an .npz does")
        numbers = {"rows": 3, "cols": 3, "data": camera.matrix.ravel().tolist()}
        info = {"image_width": camera.width, "image_height": camera.height, "camera_matrix": numbers}
        output_file.write(output.with_suffix(".yaml"), yaml.safe_dump(info, sort_keys=False).encode())
    else:
        image = unit_cube.grey_from_depth(depth)
    _, encoded = cv2.imencode(output.suffix.lower(), image)
    output_file.write(output, encoded.tobytes())
