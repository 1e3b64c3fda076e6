"""The command ``sq-perception``; ``sq-perception --help`` lists what it can do.

Exit codes: 0 all went well, 1 a frame could not be read or something is missing, 2 wrong usage.  Heavy imports happen
inside the commands, so that ``--help`` answers at once.
"""

from __future__ import annotations

import argparse
import importlib
import json
import math
import os
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

    from sq_perception.geometry.superquadric import Superquadric
    from sq_perception.imaging.camera import Camera
    from sq_perception.recorded_frame import RecordedFrame
    from sq_perception.recovery import FrameRecovery

SUCCESS, FAILURE, USAGE = 0, 1, 2
JSON_VERSION = 1
PARAMETERS = ("a1", "a2", "a3", "e1", "e2", "t1", "t2", "t3", "qx", "qy", "qz", "qw")
_OTHER_COMMANDS = {
    "demo": ("sq_perception.nodes.demo", "live demonstration with real ROS 2 nodes (extra 'ros')"),
    "train": ("sq_perception.learning.train", "train a network"),
    "dataset": ("sq_perception.learning.fixed_set_writer", "write a fixed set of training and test images"),
    "evaluate": ("sq_perception.evaluation.evaluate", "the thesis' tables and plots, for networks and fits"),
    "render-search": ("sq_perception.evaluation.render_search", "find the best s and tau of the soft renderer"),
    "gradient-search": ("sq_perception.evaluation.gradient_search", "watch a body walk down a loss, step by step"),
    "export": ("sq_perception.learning.onnx_export", "write a network as ONNX"),
}
"""Modules with a main of their own."""
_NEGATIVE_WITH_EXPONENT = re.compile(r"-(\d+\.?\d*|\.\d+)[eE][-+]?\d+")

_RECOVER_HELP = """\
Recover superquadrics from recorded depth images.

A FRAME is
  .npz           depth (float, metres, NaN = no reading) and K (3 x 3); optional labels = instance masks, which are
                 then used instead of an own segmentation
  .png, 16 bit   millimetres, 0 = no reading, with --camera-info
  .png, .bmp     with --projection orthographic: grey images of the unit cube, larger is nearer, 0 = background
"""
_RECOVER_EPILOG = """\
methods:
  auto       the network and central symmetry start an exact surface fit (best)
  symmetry   the same fit, without the network
  network    the network alone, unrefined (fastest)
  classic    Solina and Bajcsy's fit to the points

examples:
  sq-perception recover table.npz --json out.json --pictures pictures/
  sq-perception recover depth_*.png --camera-info camera.yaml --json out.json
  sq-perception recover views/*.bmp --projection orthographic --method network --json -
  sq-perception recover table.npz --ignore-masks --refine soft_render

output:
  {"frames": [{"file": ..., "ms": ..., "superquadrics": [{"size": [a1, a2, a3], "shape": [e1, e2],
   "translation": [x, y, z], "rotation": [x, y, z, w], "score": ..., "residual": ..., "sigma_size": [...],
   "status": "converged" | "weak" | "failed", "message": ..., "label": ...}, ...]}, ...]}
  Half sizes and positions are metres in the optical frame (x right, y down, z forward); for orthographic frames the
  unit cube (x right, y up, z to the viewer).  What is unknown is null.  A failed object is listed with its reason;
  its numbers only say where it is.  "label" is the mask's value, null without masks.
"""
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
        _complain("interrupted")
        return 130
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

    recover = commands.add_parser(
        "recover",
        help="depth images in, superquadrics out",
        description=_RECOVER_HELP,
        epilog=_RECOVER_EPILOG,
        formatter_class=raw,
    )
    recover.add_argument("frames", nargs="+", metavar="FRAME", help="recorded depth images")
    recover.add_argument("--json", metavar="OUT", help="write the results there; - is the standard output")
    recover.add_argument("--projection", choices=("pinhole", "orthographic"), default="pinhole")
    methods = ("auto", "network", "symmetry", "classic")
    recover.add_argument("--method", choices=methods, default="auto", help="see below")
    recover.add_argument(
        "--refine",
        choices=("surface", "soft_render", "none"),
        default="surface",
        help="what follows the start: the exact fit, descent on the soft-rendered depth, or nothing",
    )
    recover.add_argument("--camera-info", metavar="FILE", help="YAML with the intrinsics of 16 bit PNGs")
    recover.add_argument("--pictures", metavar="DIR", help="draw a picture per frame into this folder")
    recover.add_argument("--model", metavar="FILE", help="weights: a .safetensors file, or the name of shipped ones")
    recover.add_argument(
        "--consensus", action="store_true", help="average the network's answers to 8 positions of each view"
    )
    recover.add_argument("--ignore-masks", action="store_true", help="segment, even where a frame brings labels")
    recover.add_argument("--max-objects", type=int, default=20, metavar="N", help="largest ones first (default 20)")
    recover.set_defaults(command=_recover)

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


# recover


def _recover(options: argparse.Namespace) -> int:
    if options.max_objects < 1:
        return _misused(f"--max-objects: expected at least 1, got {options.max_objects}")
    to_stdout = options.json == "-"
    if options.json and not to_stdout and not Path(options.json).resolve().parent.is_dir():
        return _misused(f"--json: the folder of {options.json} does not exist")
    if options.pictures:
        try:
            Path(options.pictures).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            return _misused(f"--pictures: {error}")

    import torch

    from sq_perception.learning.checkpoint import CheckpointError
    from sq_perception.recorded_frame import FrameError, read
    from sq_perception.recovery import Recoverer, RecoveryOptions

    torch.set_num_threads(1)  # the network's layers are so small that threads cost more than they save
    settings = RecoveryOptions(method=options.method, refine=options.refine, max_objects=options.max_objects)
    try:
        recoverer = Recoverer(options.model, method=options.method, consensus=options.consensus)
    except CheckpointError as error:
        _complain(str(error))
        return FAILURE

    results: list[dict[str, Any]] = []
    names: set[str] = set()
    failed = 0
    warm: set[Camera] = set()
    for name in _progress(options.frames):
        try:
            frame = read(name, options.camera_info, options.projection)
        except (FrameError, OSError) as error:
            _complain(str(error))
            failed += 1
            continue
        if frame.camera not in warm:
            recoverer.warm_up(frame.camera)
            warm.add(frame.camera)
        labels = None if options.ignore_masks else frame.labels
        recovery = recoverer.recover(frame.depth, frame.camera, labels, settings)
        results.append(_frame_entry(name, frame, recovery, has_masks=labels is not None))
        if options.pictures:
            _draw(_free_name(Path(options.pictures), Path(name).stem, names), frame, recovery)
    document = {"format": "sq_perception.recovery", "version": JSON_VERSION, "frames": results}
    if to_stdout:
        print(json.dumps(document, indent=1, allow_nan=False))
    else:
        if options.json:
            try:
                _write_json(Path(options.json), document)
            except OSError as error:
                _complain(f"--json: {error}")
                return FAILURE
        _print_table(results)
    return FAILURE if failed else SUCCESS


def _frame_entry(name: str, frame: RecordedFrame, recovery: FrameRecovery, has_masks: bool) -> dict[str, Any]:
    """One element of ``frames`` in the output."""
    bodies = []
    for body in recovery.bodies:
        superquadric = _in_result_frame(body.superquadric, frame.is_cube)
        bodies.append(
            {
                "size": _numbers(superquadric.size),
                "shape": _numbers(superquadric.shape),
                "translation": _numbers(superquadric.translation),
                "rotation": _numbers(superquadric.rotation),
                "score": _number(body.score),
                "residual": _number(body.residual),
                "sigma_size": _numbers(body.sigma_size),
                "status": body.status.name.lower(),
                "message": body.message,
                "label": int(body.label) if has_masks else None,
            }
        )
    return {
        "file": name,
        "ms": _number(recovery.milliseconds["total"]),
        "superquadrics": bodies,
        "coordinates": "cube" if frame.is_cube else "optical",
        "message": recovery.message,
        "ms_by_stage": {stage: _number(value) for stage, value in recovery.milliseconds.items()},
        "plane": None if recovery.plane is None else _numbers(recovery.plane),
    }


def _in_result_frame(body: Superquadric, is_cube: bool) -> Superquadric:
    from sq_perception.imaging import unit_cube

    return unit_cube.cube_from_optical(body).canonical_form() if is_cube else body


def _numbers(values: Iterable[float]) -> list[float | None]:
    return [_number(value) for value in values]


def _number(value: float) -> float | None:
    """JSON knows neither NaN nor infinity."""
    return float(value) if math.isfinite(value) else None


def _write_json(path: Path, document: dict[str, Any]) -> None:
    """Whole or not at all."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    partial.replace(path)


def _draw(path: Path, frame: RecordedFrame, recovery: FrameRecovery) -> None:
    from sq_perception.evaluation import plots

    unit = "of the cube" if frame.is_cube else "m"
    plots.save(plots.recovery_figure(frame.depth, frame.camera, recovery, frame.name, unit), path)


def _free_name(folder: Path, stem: str, taken: set[str]) -> Path:
    """A picture's name that no other frame of this call has."""
    name, k = stem, 2
    while name in taken:
        name, k = f"{stem}_{k}", k + 1
    taken.add(name)
    return folder / f"{name}.png"


def _progress(names: list[str]) -> Iterable[str]:
    if len(names) < 2 or not sys.stderr.isatty():
        return names
    from rich.console import Console
    from rich.progress import track

    return track(names, description="recovering", console=Console(stderr=True), transient=True)


def _print_table(results: list[dict[str, Any]]) -> None:
    for entry in results:
        cube = entry["coordinates"] == "cube"
        print(f"{entry['file']}  {entry['ms']:.0f} ms  {entry['message']}".rstrip())
        scale, unit, digits = (1.0, "", 4) if cube else (1e3, " mm", 1)
        for body in entry["superquadrics"]:
            label = "" if body["label"] is None else f"mask {body['label']}: "
            if body["status"] == "failed":
                print(f"  {label}failed: {body['message']}")
                continue
            size = " x ".join(f"{scale * value:.{digits}f}" for value in body["size"])
            shape = " ".join(f"{value:.2f}" for value in body["shape"])
            note = f"  ({body['message']})" if body["status"] == "weak" else ""
            print(f"  {label}half sizes {size}{unit}, exponents {shape}, score {body['score']:.3f}{note}")


# render


def _render(options: argparse.Namespace) -> int:
    output = Path(options.output)
    suffix = output.suffix.lower()
    pinhole = options.projection == "pinhole"
    if suffix not in ((".png", ".npz") if pinhole else (".png", ".bmp", ".npz")):
        kinds = ".png or .npz" if pinhole else ".png, .bmp or .npz"
        return _misused(f"--output: {output.name}: an image of this projection is a {kinds}")
    if not output.resolve().parent.is_dir():
        return _misused(f"--output: the folder of {output} does not exist")
    if options.bits == 16 and (pinhole or suffix != ".png"):
        return _misused("--bits: only orthographic PNGs have a choice")

    import numpy as np

    from sq_perception.geometry.superquadric import Superquadric
    from sq_perception.imaging import raycast, unit_cube
    from sq_perception.imaging.camera import Camera
    from sq_perception.recorded_frame import read_camera_info

    try:
        body = Superquadric.from_flat(np.array([getattr(options, name) for name in PARAMETERS]))
        if not pinhole:
            width = options.width or unit_cube.THESIS_PIXELS
            camera = unit_cube.camera(width, options.height)
            seen = unit_cube.optical_from_cube(body)
        else:
            seen = body
            if options.camera_info:
                camera = read_camera_info(options.camera_info)
            else:
                width, height = options.width or 640, options.height or 480
                focal = options.focal
                camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    except ValueError as error:
        return _misused(str(error))
    depth, index = raycast.render(seen, camera)
    if not (index >= 0).any():
        _complain("the camera does not see the body: the image is empty")
    try:
        _write_depth(output, depth, index, camera, body, options.bits)
    except OSError as error:
        _complain(str(error))
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
        with output.open("wb") as file:
            np.savez_compressed(file, **fields)
        return
    if camera.is_pinhole:
        image = np.where(np.isfinite(depth), np.clip(np.round(1e3 * depth), 0, 65535), 0).astype(np.uint16)
        _write_camera_info(output.with_suffix(".yaml"), camera)
    else:
        image = unit_cube.grey_from_depth(depth, np.uint16 if bits == 16 else np.uint8)
    _, encoded = cv2.imencode(output.suffix.lower(), image)
    output.write_bytes(encoded.tobytes())


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
    path.write_text(yaml.safe_dump(info, sort_keys=False), encoding="utf-8")


# all other commands


def _other_command(name: str, arguments: list[str]) -> int:
    try:
        module = importlib.import_module(_OTHER_COMMANDS[name][0])
    except ModuleNotFoundError as error:
        if name != "demo":
            raise
        _complain(
            f"the demonstration needs ROS 2 in Python, and the module {error.name!r} is missing: "
            "pip install 'sq_perception[ros]', or source a ROS 2 Jazzy installation"
        )
        return FAILURE
    result = module.main(arguments)
    return result if isinstance(result, int) else SUCCESS


def _complain(message: str) -> None:
    print(f"sq-perception: {message}", file=sys.stderr)


def _misused(message: str) -> int:
    _complain(message)
    return USAGE


if __name__ == "__main__":
    raise SystemExit(main())
