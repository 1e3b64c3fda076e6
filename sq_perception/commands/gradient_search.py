"""``sq-perception gradient-search``: watch a body walk down a loss, step by step."""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sq_perception.commands.console import SUCCESS, at_least, failed, parser, positive, progress, target
from sq_perception.commands.render import PARAMETERS
from sq_perception.learning.choices import LOSSES, UNSUPERVISED

if TYPE_CHECKING:
    from sq_perception.evaluation.gradient_search import Subject, Walk

_FRAMES = 50
"""Pictures of a walk, evenly, the first and the last step among them."""
_HELP = "Walk down a loss: a superquadric's parameters move with the gradient, step by step, before one image."
_EPILOG = """\
Bodies are written in the cube frame: x right, y up, z towards the viewer, side 1.

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

    from sq_perception.evaluation.gradient_search import Subject, walk
    from sq_perception.geometry import rotation as quaternions
    from sq_perception.learning import checkpoint
    from sq_perception.recordings.frame_file import FrameError, read

    try:
        network = checkpoint.load(given.model)
        if given.image is None:
            subject = Subject.random(given.seed, network.config.pixels)
        else:
            frame = read(given.image, projection="orthographic")
            subject = Subject.of_image(frame.depth, frame.camera, pixels=network.config.pixels)
    except (FrameError, checkpoint.CheckpointError) as error:
        return failed(f"gradient-search: {error}")
    except ValueError as error:
        return failed(f"gradient-search: {given.image}: {error}")
    start = network.predict(subject.view.image[None])[0]
    if given.start == "truth" and subject.truth is not None:
        start = subject.truth
    turn = quaternions.from_rotation_vector(np.deg2rad(given.turn))
    start = replace(start, rotation=quaternions.multiply(start.rotation, turn))
    torch.set_num_threads(1)  # one body: threads cost more than they save
    found = walk(subject, start, given.loss, given.steps, given.learning_rate, network.config)
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
    add = command.add_argument
    add("image", nargs="?", metavar="IMAGE", help="grey image of the unit cube (.png, .bmp, .npz)")
    add("--seed", type=at_least(0), metavar="K", help="a random body of the thesis' protocol instead")
    add("--loss", choices=LOSSES, default="occupancy", help="default %(default)s")
    starts = ("network", "truth")
    add("--start", choices=starts, default="network", help="what a network predicts, or the true body")
    add(
        "--turn",
        type=float,
        nargs=3,
        default=(0.0, 0.0, 0.0),
        metavar=("X", "Y", "Z"),
        help="turn the start: rotation vector in its own frame, deg",
    )
    add("--steps", type=at_least(1), default=200, help="gradient steps (default %(default)s)")
    add("--learning-rate", type=positive, default=0.05, help="of Adam, at the first (%(default)s)")
    add("--model", metavar="FILE", help="the network's weights: a file or a shipped name")
    add("--output", type=Path, metavar="OUT", help="a film, .gif, or a folder of PNGs")
    add("--table", type=target, metavar="CSV", help="every step as CSV")
    return command


def _check(command: argparse.ArgumentParser, given: argparse.Namespace) -> None:
    if (given.image is None) == (given.seed is None):
        command.error("expected an IMAGE, or --seed K for a random body")
    if given.image is not None and given.loss not in UNSUPERVISED:
        command.error(
            f"--loss {given.loss} compares with the true body, and an image does not tell it: give --seed K, or choose "
            f"{', '.join(UNSUPERVISED)}"
        )
    if given.image is not None and given.start == "truth":
        command.error("--start truth needs the true body: give --seed K")
    if given.output and not given.output.resolve().parent.is_dir():
        command.error(f"the folder of {given.output} does not exist")
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
        writer.writerow(("step", "loss", "iou", *PARAMETERS))
        for k, flat in enumerate(subject.to_cube(found.bodies).to_flat().tolist()):
            iou = "" if found.iou is None else found.iou[k]
            writer.writerow((k, found.losses[k], iou, *flat))
