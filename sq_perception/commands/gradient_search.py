"""``sq-perception gradient-search``: watch a body walk down a loss, step by step."""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sq_perception.commands.console import SUCCESS, failed, parser, progress
from sq_perception.commands.render import PARAMETERS
from sq_perception.learning.choices import LOSSES, UNSUPERVISED

if TYPE_CHECKING:
    from sq_perception.evaluation.gradient_search import Subject, Walk

STARTS = ("network", "disturbed", "truth")
_FRAMES = 50
"""Pictures of a walk, evenly, the first and the last step among them."""
_HELP = "Walk down a loss: a superquadric's parameters move with the gradient, step by step, before one image."
_EPILOG = """\
Bodies are given and written in the cube frame: x right, y up, z towards the viewer, side 1.

examples:
  sq-perception gradient-search --seed 7 --loss occupancy_rotation --start truth --turn 0 0 90 --output walk.gif
  sq-perception gradient-search view.png --loss render --output frames/ --table walk.csv
"""


def main(arguments: Sequence[str]) -> int:
    """Entry of ``sq-perception gradient-search``; the exit code."""
    command = _parser()
    given = command.parse_args(arguments)
    _check(command, given)

    import numpy as np
    import torch

    from sq_perception.evaluation.gradient_search import Subject, WalkOptions, disturbed, walk
    from sq_perception.geometry import rotation as quaternions
    from sq_perception.geometry.superquadric import Superquadric
    from sq_perception.imaging import unit_cube
    from sq_perception.learning import checkpoint
    from sq_perception.learning.regressor import RegressorConfig
    from sq_perception.recordings.frame_file import FrameError, read

    try:
        options = WalkOptions(given.loss, given.steps, given.learning_rate, given.s and (given.s[0], given.s[-1]))
        truth = None if given.truth is None else Superquadric.from_flat(np.array(given.truth))
    except ValueError as error:
        command.error(f"--{str(error).replace('_', '-')}")
    try:
        network = checkpoint.load(given.model) if given.start == "network" else None
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
    try:
        if isinstance(given.start, tuple):
            body = Superquadric.from_flat(np.array(given.start))
            start = subject.view.to_canonical(unit_cube.optical_from_cube(body))
        elif network is not None:
            start = network.predict(subject.view.image[None])[0]
        else:
            assert subject.truth is not None
            start = subject.truth
            if given.start == "disturbed":
                start = disturbed(start, ranges, np.random.default_rng([given.seed or 0, 1]))
        ranges.encode(start)
    except ValueError as error:
        command.error(f"--start: in the object's view, {error}")
    turn = quaternions.from_rotation_vector(np.deg2rad(given.turn))
    start = replace(start, rotation=quaternions.multiply(start.rotation, turn))
    torch.set_num_threads(1)  # one body: threads cost more than they save
    found = walk(subject.view.image, start, options, subject.truth, ranges)
    try:
        if given.table is not None:
            _write_table(subject, found, given.table)
        if given.output is not None:
            _draw(subject, found, given.loss, given.output)
    except OSError as error:
        return failed(f"gradient-search: {error}")
    iou = "" if found.iou is None else f", IoU {100 * found.iou[0]:.1f} to {100 * found.iou[-1]:.1f} %"
    print(f"{given.loss}: loss {found.losses[0]:.4g} to {found.losses[-1]:.4g} in {len(found) - 1} steps{iou}")
    print("body: " + " ".join(f"{x:.4f}" for x in subject.to_cube(found.bodies[-1]).to_flat()))
    return SUCCESS


def _parser() -> argparse.ArgumentParser:
    command = parser("gradient-search", _HELP, _EPILOG)
    command.add_argument("image", nargs="?", metavar="IMAGE", help="grey image of the unit cube (.png, .bmp, .npz)")
    command.add_argument("--seed", type=int, metavar="K", help="a random body instead; also seeds the disturbance")
    command.add_argument("--truth", type=_numbers, metavar="'A1 .. QW'", help="the true body of an image, if known")
    command.add_argument("--loss", choices=LOSSES, default="occupancy", help="default %(default)s")
    command.add_argument(
        "--start",
        type=lambda text: text if text in STARTS else _numbers(text),
        default="network",
        metavar="START",
        help=f"{', '.join(STARTS)} or 'a1 .. qw' (default %(default)s)",
    )
    command.add_argument("--turn", type=float, nargs=3, default=(0.0, 0.0, 0.0), metavar=("X", "Y", "Z"),
                         help="turn the start: rotation vector in its own frame, deg")  # fmt: skip
    command.add_argument("--steps", type=int, default=200, help="gradient steps (default %(default)s)")
    command.add_argument("--learning-rate", type=float, default=0.05, help="of Adam, at the first (%(default)s)")
    command.add_argument("--s", type=float, nargs="+", metavar="S", help="sharpness, or its first and its last value")
    command.add_argument("--model", metavar="FILE", help="weights of --start network: a file or a shipped name")
    command.add_argument("--output", type=Path, metavar="OUT", help="a film, .gif, or a folder of PNGs")
    command.add_argument("--table", type=Path, metavar="CSV", help="every step as CSV")
    return command


def _numbers(text: str) -> tuple[float, ...]:
    """The parameters of a body from 12 numbers in one word."""
    try:
        values = tuple(float(word) for word in text.replace(",", " ").split())
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    if len(values) != len(PARAMETERS):
        raise argparse.ArgumentTypeError(f"{' '.join(PARAMETERS)}: expected 12 numbers, got {len(values)}")
    return values


def _check(command: argparse.ArgumentParser, given: argparse.Namespace) -> None:
    if (given.image is None) == (given.seed is None) and not (given.image and given.start == "disturbed"):
        command.error("expected an IMAGE, or --seed K for a random body")
    if given.seed is not None and given.seed < 0:
        command.error(f"--seed: expected at least 0, got {given.seed}")
    if given.image is None and given.truth is not None:
        command.error("--truth: the true body of --seed is known; give it with an IMAGE")
    if given.image is not None and given.truth is None:
        remedy = "give --truth 'a1 .. qw' or --seed K"
        if given.loss not in UNSUPERVISED:
            command.error(
                f"--loss {given.loss} compares with the true body, and an image does not tell it: {remedy}, or choose "
                f"{', '.join(UNSUPERVISED)}"
            )
        if given.start in ("disturbed", "truth"):
            command.error(f"--start {given.start} needs the true body: {remedy}")
    if given.s is not None and len(given.s) > 2:
        command.error(f"--s: expected one or two numbers, got {len(given.s)}")
    for path in filter(None, (given.output, given.table)):
        if not path.resolve().parent.is_dir():
            command.error(f"the folder of {path} does not exist")
    if given.output and given.output.suffix and not (_is_film(given.output) or given.output.is_dir()):
        command.error(f"--output: expected a .gif or a folder, got {given.output}")


def _is_film(path: Path) -> bool:
    return path.suffix.lower() == ".gif"


def _draw(subject: Subject, found: Walk, loss: str, output: Path) -> None:
    import numpy as np

    from sq_perception.evaluation import walk_figure

    steps = np.unique(np.round(np.linspace(0, len(found) - 1, _FRAMES)).astype(int)).tolist()
    pictures = {}
    with progress() as bar:
        for step in bar.track(steps, description="drawing"):
            title = f"{loss}: step {step} of {len(found) - 1}"
            pictures[step] = walk_figure.picture(walk_figure.walk_figure(subject, found, step, title))
    if _is_film(output):
        walk_figure.save_film(list(pictures.values()), output)
        return
    output.mkdir(exist_ok=True)
    for step, picture in pictures.items():
        picture.save(output / f"step_{step:05d}.png")


def _write_table(subject: Subject, found: Walk, path: Path) -> None:
    """Every step, bodies in the cube frame; the IoU is empty where the true body is not known."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(("step", "s", "loss", "iou", *PARAMETERS))
        for k, flat in enumerate(subject.to_cube(found.bodies).to_flat().tolist()):
            iou = "" if found.iou is None else found.iou[k]
            writer.writerow((k, found.sharpness[k], found.losses[k], iou, *flat))
