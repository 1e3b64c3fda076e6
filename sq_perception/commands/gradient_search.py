"""``sq-perception gradient-search``: watch a body walk down a loss, step by step."""

from __future__ import annotations

import argparse
import csv
import json
import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sq_perception.commands.console import SUCCESS, failed, parser
from sq_perception.commands.render import PARAMETERS
from sq_perception.evaluation.walk_options import WalkOptions
from sq_perception.learning.choices import LOSSES, UNSUPERVISED, WITHOUT_SHARPNESS

if TYPE_CHECKING:
    from sq_perception.evaluation.gradient_search import Subject, Walk
    from sq_perception.geometry.superquadric import Superquadric
    from sq_perception.learning.regressor import Regressor, RegressorConfig

STARTS = ("network", "disturbed", "moments", "truth")
_COLUMNS = ("step", "s", "loss", "iou", *PARAMETERS)
_DEFAULT = WalkOptions()
_HELP = "Walk down a loss: a superquadric's parameters move with the gradient, step by step, before one image."
_EPILOG = """\
Bodies are given and written in the cube frame: x right, y up, z towards the viewer, side 1.

examples:
  sq-perception gradient-search --seed 7 --loss occupancy_rotation --start truth --turn 0 0 90 --output walk.gif
  sq-perception gradient-search view.png --loss render --start moments --output frames/ --table walk.csv
"""


def main(arguments: Sequence[str]) -> int:
    """Entry of ``sq-perception gradient-search``; the exit code."""
    command = _parser()
    given = command.parse_args(arguments)
    options = _checked(command, given)
    truth_known = given.image is None or given.truth is not None
    if options.loss not in UNSUPERVISED and not truth_known:
        command.error(
            f"--loss {options.loss} compares with the true body, and an image does not tell it: give --truth "
            f"'a1 .. qw' or --seed K, or choose {', '.join(UNSUPERVISED)}"
        )
    if given.start in ("disturbed", "truth") and not truth_known:
        command.error(f"--start {given.start} needs the true body: give --truth 'a1 .. qw' or --seed K")
    return _search(command, given, options)


def _search(command: argparse.ArgumentParser, given: argparse.Namespace, options: WalkOptions) -> int:
    import numpy as np
    import torch

    from sq_perception.evaluation.gradient_search import Subject, walk
    from sq_perception.geometry import rotation as quaternions
    from sq_perception.learning import checkpoint
    from sq_perception.learning.regressor import RegressorConfig
    from sq_perception.recordings.frame_file import FrameError, read

    truth = _body(command, "--truth", given.truth)
    try:
        network = checkpoint.load(given.model) if given.start in (None, "network") else None
        ranges = network.config if network is not None else RegressorConfig()
        if given.image is None:
            subject = Subject.random(given.seed, ranges.pixels)
        else:
            frame = read(given.image, projection="orthographic")
            subject = Subject.of_image(frame.depth, frame.camera, truth, ranges.pixels)
    except (FrameError, checkpoint.CheckpointError) as error:
        return failed(f"gradient-search: {error}")
    except ValueError as error:
        return failed(f"gradient-search: {given.image}: {error}")
    start = _start(command, given, subject, network, ranges)
    if given.turn is not None:
        turn = quaternions.from_rotation_vector(np.deg2rad(given.turn))
        start = replace(start, rotation=quaternions.multiply(start.rotation, turn))
    torch.set_num_threads(1)  # one body: threads cost more than they save
    found = walk(subject.view.image, start, options, subject.truth, ranges)
    try:
        _write(subject, found, options, given)
    except OSError as error:
        return failed(f"gradient-search: {error}")
    iou = "" if found.iou is None else f", IoU {100 * found.iou[0]:.1f} to {100 * found.iou[-1]:.1f} %"
    print(f"{options.loss}: loss {found.losses[0]:.4g} to {found.losses[-1]:.4g} in {len(found) - 1} steps{iou}")
    print("body: " + " ".join(f"{x:.4f}" for x in subject.to_cube(found.bodies[-1]).to_flat()))
    return SUCCESS


def _start(
    command: argparse.ArgumentParser,
    given: argparse.Namespace,
    subject: Subject,
    network: Regressor | None,
    ranges: RegressorConfig,
) -> Superquadric:
    """The body to begin with, in the frame of the object's view."""
    import numpy as np

    from sq_perception.evaluation.gradient_search import clamped, disturbed, moments
    from sq_perception.imaging import unit_cube

    body = _body(command, "--start", given.start if isinstance(given.start, tuple) else None)
    try:
        if body is not None:
            start = subject.view.to_canonical(unit_cube.optical_from_cube(body))
        elif network is not None:
            start = network.predict(subject.view.image[None])[0]
        elif given.start == "moments":
            start = clamped(moments(subject.view.image), ranges)
        else:
            assert subject.truth is not None
            start = subject.truth
            if given.start == "disturbed":
                start = clamped(disturbed(start, np.random.default_rng([given.seed or 0, 1])), ranges)
        ranges.encode(start)
    except ValueError as error:
        command.error(f"--start: in the object's view, {error}")
    return start


def _body(command: argparse.ArgumentParser, option: str, values: tuple[float, ...] | None) -> Superquadric | None:
    if values is None:
        return None
    import numpy as np

    from sq_perception.geometry.superquadric import Superquadric

    try:
        return Superquadric.from_flat(np.array(values))
    except ValueError as error:
        command.error(f"{option}: {' '.join(PARAMETERS)}: {error}")


# Arguments


def _parser() -> argparse.ArgumentParser:
    command = parser("gradient-search", _HELP, _EPILOG)
    command.add_argument("image", nargs="?", metavar="IMAGE", help="grey image of the unit cube (.png, .bmp, .npz)")
    command.add_argument("--seed", type=int, metavar="K", help="a random body instead; also seeds the disturbance")
    command.add_argument("--truth", type=_numbers, metavar="'A1 .. QW'", help="the true body of an image, if known")
    command.add_argument("--loss", choices=LOSSES, default=_DEFAULT.loss, help="default %(default)s")
    command.add_argument(
        "--start", type=_start_argument, metavar="START", help=f"{', '.join(STARTS)} or 'a1 .. qw' (default network)"
    )
    command.add_argument(
        "--turn",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="turn the start: rotation vector in its own frame, deg",
    )
    command.add_argument("--steps", type=int, default=_DEFAULT.steps, help="gradient steps (default %(default)s)")
    command.add_argument(
        "--learning-rate",
        type=float,
        default=_DEFAULT.learning_rate,
        help="of Adam, at the first (default %(default)s)",
    )
    command.add_argument("--s", type=float, nargs="+", metavar="S", help="sharpness, or its first and its last value")
    command.add_argument(
        "--points", type=int, default=_DEFAULT.points, help="comparison points or lines of sight (default %(default)s)"
    )
    command.add_argument("--model", metavar="FILE", help="weights of --start network: a file or a shipped name")
    command.add_argument(
        "--output", type=Path, action="append", default=[], metavar="OUT", help=".gif or folder of PNGs"
    )
    command.add_argument("--frames", type=int, default=50, help="pictures drawn of the walk (default 50)")
    command.add_argument("--table", type=Path, metavar="FILE", help="every step as .csv or .json")
    return command


def _numbers(text: str) -> tuple[float, ...]:
    """The parameters of a body from 12 numbers in one word."""
    try:
        values = tuple(float(word) for word in text.replace(",", " ").split())
        if len(values) != len(PARAMETERS):
            raise ValueError(f"expected {len(PARAMETERS)} numbers, got {len(values)}")
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{' '.join(PARAMETERS)}: {error}") from error
    return values


def _start_argument(text: str) -> str | tuple[float, ...]:
    if text in STARTS:
        return text
    if text[:1].isalpha():
        raise argparse.ArgumentTypeError(f"expected one of {', '.join(STARTS)} or 12 numbers, got {text!r}")
    return _numbers(text)


def _checked(command: argparse.ArgumentParser, given: argparse.Namespace) -> WalkOptions:
    if (given.image is None) == (given.seed is None) and not (given.image and given.start == "disturbed"):
        command.error("expected an IMAGE, or --seed K for a random body")
    if given.seed is not None and given.seed < 0:
        command.error(f"--seed: expected at least 0, got {given.seed}")
    if given.image is None and given.truth is not None:
        command.error("--truth: the true body of --seed is known; give it with an IMAGE")
    if given.s is not None and len(given.s) > 2:
        command.error(f"--s: expected one or two numbers, got {len(given.s)}")
    if given.turn is not None and not all(map(math.isfinite, given.turn)):
        command.error("--turn: expected finite numbers")
    if given.frames < 2:
        command.error(f"--frames: expected at least 2, got {given.frames}")
    for path in [*given.output, *([given.table] if given.table else [])]:
        if not path.resolve().parent.is_dir():
            command.error(f"the folder of {path} does not exist")
    for path in given.output:
        if path.suffix and path.suffix.lower() != ".gif" and not path.is_dir():
            command.error(f"--output: expected a .gif or a folder, got {path}")
    if given.table is not None and given.table.suffix.lower() not in (".csv", ".json"):
        command.error(f"--table: expected a .csv or a .json, got {given.table}")
    sharpness = None if given.s is None else (given.s[0], given.s[-1])
    try:
        return WalkOptions(given.loss, given.steps, given.learning_rate, sharpness, given.points)
    except ValueError as error:
        command.error(f"--{str(error).replace('_', '-')}".replace("--sharpness", "--s"))


# Results


def _write(subject: Subject, found: Walk, options: WalkOptions, given: argparse.Namespace) -> None:
    if given.table is not None:
        _save_table(subject, found, given.table, options)
    if not given.output:
        return
    folders = [path for path in given.output if path.suffix.lower() != ".gif"]
    films = [path for path in given.output if path.suffix.lower() == ".gif"]
    for folder in folders:
        folder.mkdir(exist_ok=True)
    from sq_perception.evaluation import walk_figure

    kept = []
    for step in _progress(walk_figure.chosen_steps(found, given.frames)):
        s = "" if options.loss in WITHOUT_SHARPNESS else f", s = {found.sharpness[step]:.3g}"
        title = f"{options.loss}{s}: step {step} of {len(found) - 1}"
        picture = walk_figure.picture(walk_figure.walk_figure(subject, found, step, title))
        for folder in folders:
            picture.save(folder / f"step_{step:05d}.png")
        if films:
            kept.append(picture)
    for film in films:
        walk_figure.save_film(kept, film)


def _save_table(subject: Subject, found: Walk, path: Path, options: WalkOptions) -> None:
    """Every step as .csv or .json, bodies in the cube frame; what is not known is empty or null."""
    import numpy as np

    flats = np.asarray(subject.to_cube(found.bodies).to_flat())
    rows: list[dict[str, Any]] = []
    for k, flat in enumerate(flats):
        s = None if options.loss in WITHOUT_SHARPNESS else float(found.sharpness[k])
        iou = None if found.iou is None else float(found.iou[k])
        values = [k, s, float(found.losses[k]), iou, *(float(x) for x in flat)]
        rows.append(dict(zip(_COLUMNS, values, strict=True)))
    if path.suffix.lower() == ".json":
        document = {"format": "sq_perception.walk", "version": 1, "loss": options.loss, "coordinates": "cube"}
        path.write_text(json.dumps({**document, "steps": rows}, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        return
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, _COLUMNS)
        writer.writeheader()
        writer.writerows(rows)


def _progress(steps: list[int]) -> Iterable[int]:
    if not sys.stderr.isatty():
        return steps
    from rich.console import Console
    from rich.progress import track

    return track(steps, description="drawing", console=Console(stderr=True), transient=True)
