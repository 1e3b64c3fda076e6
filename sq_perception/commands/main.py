"""The command ``sq-perception``; ``sq-perception --help`` lists what it can do.

Exit codes: 0 all went well, 1 a frame could not be read or something is missing, 2 wrong usage, 130 interrupted.
Heavy imports happen inside the commands, so that ``--help`` answers at once.
"""

from __future__ import annotations

import argparse
import importlib
import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sq_perception.commands import recover
from sq_perception.commands.recover import FAILURE, INTERRUPTED, SUCCESS, USAGE, complain, misused
from sq_perception.files import output_file

if TYPE_CHECKING:
    import numpy as np

    from sq_perception.geometry.superquadric import Superquadric
    from sq_perception.imaging.camera import Camera

PARAMETERS = ("a1", "a2", "a3", "e1", "e2", "t1", "t2", "t3", "qx", "qy", "qz", "qw")
_OTHER_COMMANDS = {
    "demo": ("sq_perception.nodes.demo", "live demonstration with real ROS 2 nodes (extra 'ros')"),
    "view": ("sq_perception.nodes.view", "a page in the browser: depth, bodies, parameters (extras 'ros', 'view')"),
    "train": ("sq_perception.learning.train", "train a network"),
    "dataset": ("sq_perception.learning.fixed_set_writer", "write a fixed set of training and test images"),
    "evaluate": ("sq_perception.evaluation.evaluate", "the thesis' tables and plots, for networks and fits"),
    "render-search": ("sq_perception.evaluation.render_search", "find the best s and tau of the soft renderer"),
    "gradient-search": ("sq_perception.evaluation.gradient_search", "watch a body walk down a loss, step by step"),
    "export": ("sq_perception.learning.onnx_export", "write a network as ONNX"),
}
"""Modules with a main of their own."""
_NEGATIVE_WITH_EXPONENT = re.compile(r"-(\d+\.?\d*|\.\d+)[eE][-+]?\d+")

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
  orthographic  .png (8 bit, or 16 with --bits 16), .bmp (8 bit), .npz
  pinhole       .png (16 bit, millimetres; the camera goes into a .yaml of the same name), .npz
  An NPZ also holds labels and the parameters (superquadrics, 1 x 12).
"""
_EPILOG = """\
examples:
  sq-perception recover table.npz --json out.json --pictures pictures/
  sq-perception render 0.25 0.15 0.1  0.2 0.8  0.5 0.5 0.5  0 0 0 1 --output view.png
  sq-perception demo
  sq-perception train --help
  sq-perception evaluate --help
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given and given[0] in _OTHER_COMMANDS:
        return _other_command(given[0], given[1:])
    parser = _parser()
    try:
        options = parser.parse_args([_plain_number(word) for word in given])
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else USAGE
    command: Callable[[argparse.Namespace], int] = options.command
    try:
        return command(options)
    except KeyboardInterrupt:
        complain("interrupted")
        return INTERRUPTED
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILURE


def _plain_number(word: str) -> str:
    """argparse takes -1e-3 for an option; -0.001 it understands."""
    return f"{float(word):.20f}" if _NEGATIVE_WITH_EXPONENT.fullmatch(word) else word


def _parser() -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        prog="sq-perception",
        description="Superquadrics from depth images: size, shape, pose and uncertainty of the objects in them.",
        epilog=_EPILOG,
        formatter_class=raw,
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    recovering = commands.add_parser(
        "recover",
        help="depth images in, superquadrics out",
        description=recover.HELP,
        epilog=recover.EPILOG,
        formatter_class=raw,
    )
    recover.add_arguments(recovering)
    recovering.set_defaults(command=recover.run)

    render = commands.add_parser(
        "render",
        help="draw a superquadric as a depth image",
        description=_RENDER_HELP,
        epilog=_RENDER_EPILOG,
        formatter_class=raw,
    )
    for name in PARAMETERS:
        render.add_argument(name, type=float)
    render.add_argument("--output", "-o", required=True, metavar="FILE", help=".png, .bmp or .npz")
    render.add_argument("--projection", choices=("orthographic", "pinhole"), default="orthographic")
    render.add_argument("--width", type=int, help="pixels (256 orthographic, 640 pinhole)")
    render.add_argument("--height", type=int, help="pixels (as the width orthographic, 480 pinhole)")
    render.add_argument("--focal", type=float, default=525.0, help="focal length in pixels of the pinhole camera (525)")
    render.add_argument("--camera-info", metavar="FILE", help="a pinhole camera from YAML instead")
    render.add_argument("--bits", type=int, choices=(8, 16), default=8, help="depth of an orthographic PNG")
    render.set_defaults(command=_render)

    for name, (_, text) in _OTHER_COMMANDS.items():
        commands.add_parser(name, help=text, add_help=False)
    return parser


# render


def _render(options: argparse.Namespace) -> int:
    output = Path(options.output)
    suffix = output.suffix.lower()
    pinhole = options.projection == "pinhole"
    if suffix not in ((".png", ".npz") if pinhole else (".png", ".bmp", ".npz")):
        kinds = ".png or .npz" if pinhole else ".png, .bmp or .npz"
        return misused(f"--output: {output.name}: an image of this projection is a {kinds}")
    try:
        output_file.check(output)
    except OSError as error:
        return misused(f"--output: {error}")
    if options.bits == 16 and (pinhole or suffix != ".png"):
        return misused("--bits: only orthographic PNGs have a choice")

    import numpy as np

    from sq_perception.geometry.superquadric import Superquadric
    from sq_perception.imaging import raycast, unit_cube
    from sq_perception.imaging.camera import Camera
    from sq_perception.recordings.frame_file import read_calibration

    try:
        body = Superquadric.from_flat(np.array([getattr(options, name) for name in PARAMETERS]))
        if not pinhole:
            width = options.width or unit_cube.THESIS_PIXELS
            camera = unit_cube.camera(width, options.height)
            seen = unit_cube.optical_from_cube(body)
        else:
            seen = body
            if options.camera_info:
                camera = read_calibration(options.camera_info, distortion="ignore").camera
            else:
                width, height = options.width or 640, options.height or 480
                focal = options.focal
                camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    except ValueError as error:
        return misused(str(error))
    depth, index = raycast.render(seen, camera)
    if not (index >= 0).any():
        complain("the camera does not see the body: the image is empty")
    try:
        _write_depth(output, depth, index, camera, body, options.bits)
    except OSError as error:
        complain(str(error))
        return FAILURE
    return SUCCESS


def _write_depth(
    output: Path, depth: np.ndarray, index: np.ndarray, camera: Camera, body: Superquadric, bits: int
) -> None:
    import cv2
    import numpy as np

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
        with output_file.writing(output) as partial:
            np.savez_compressed(partial, **fields)
        return
    if camera.is_pinhole:
        image = np.where(np.isfinite(depth), np.clip(np.round(1e3 * depth), 0, 65535), 0).astype(np.uint16)
        _write_camera_info(output.with_suffix(".yaml"), camera)
    else:
        image = unit_cube.grey_from_depth(depth, np.uint16 if bits == 16 else np.uint8)
    _, encoded = cv2.imencode(output.suffix.lower(), image)
    output_file.write(output, encoded.tobytes())


def _write_camera_info(path: Path, camera: Camera) -> None:
    import numpy as np
    import yaml

    k = camera.matrix
    info = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": "depth",
        "camera_matrix": {"rows": 3, "cols": 3, "data": k.ravel().tolist()},
        "distortion_model": "plumb_bob",
        "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.0] * 5},
        "rectification_matrix": {"rows": 3, "cols": 3, "data": np.eye(3).ravel().tolist()},
        "projection_matrix": {"rows": 3, "cols": 4, "data": np.hstack([k, np.zeros((3, 1))]).ravel().tolist()},
    }
    output_file.write(path, yaml.safe_dump(info, sort_keys=False).encode())


# all other commands


def _other_command(name: str, arguments: list[str]) -> int:
    try:
        module = importlib.import_module(_OTHER_COMMANDS[name][0])
    except ModuleNotFoundError as error:
        if name != "demo":
            raise
        complain(
            f"the demonstration needs ROS 2 in Python, and the module {error.name!r} is missing: "
            "pip install 'sq_perception[ros]', or source a ROS 2 Jazzy installation"
        )
        return FAILURE
    result = module.main(arguments)
    return result if isinstance(result, int) else SUCCESS


if __name__ == "__main__":
    raise SystemExit(main())
