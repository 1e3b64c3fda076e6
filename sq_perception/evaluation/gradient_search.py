"""Walks down a loss: a superquadric's parameters move with the gradient, step by step, before one image.

The thesis' tool for looking at what a network got wrong (chapter 6.5.3): from a given start, is there a way down to the
true body, or does the loss hold the body in a saddle or a local minimum (figures 6.3, 6.4 and 6.7)?

    y_0 = encode(start),    y_k+1 = y_k - Adam(dL/dy at y_k),    body_k = decode(y_k)

with the parametrisation of the network's own output (:meth:`RegressorConfig.decode`), so that a walk moves as a
training moves the network's last layer, and stays within the same ranges.  Losses, comparison points and lines of sight
are those of :mod:`sq_perception.learning.objective`, with two differences.  The points are the same in every step: a
walk is about one landscape, not about chance.  And the curriculum of least squares is over (progress 1).  The step
width falls with the cosine.  Adam scales any gradient up to a full step, rounding errors on an optimum included; the
walk is therefore in double precision, and rests where no component of the gradient exceeds 1e-7.

Bodies live in the canonical view of the object (:mod:`sq_perception.imaging.canonical_view`), as in training; files
name them in the cube frame (:mod:`sq_perception.imaging.unit_cube`).

    sq-perception gradient-search --seed 7 --loss occupancy_rotation --start truth --turn 0 0 90 --output walk.gif
    sq-perception gradient-search view.png --loss render --start moments --output frames/ --table walk.csv
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import sys
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sq_perception.fitting import solina_bajcsy
from sq_perception.geometry import rotation as quaternions
from sq_perception.geometry.metrics import volume_iou
from sq_perception.geometry.superquadric import FLAT_LENGTH, Superquadric
from sq_perception.imaging import canonical_view, raycast, unit_cube
from sq_perception.imaging.camera import Camera
from sq_perception.imaging.canonical_view import CanonicalView
from sq_perception.learning import checkpoint
from sq_perception.learning.objective import LOSSES, UNSUPERVISED, Objective
from sq_perception.learning.regressor import RegressorConfig
from sq_perception.recordings.frame_file import FrameError, read
from sq_perception.segmentation import segments
from sq_perception.simulation.scenes import thesis_bodies

STARTS = ("network", "disturbed", "moments", "truth")
WITHOUT_SHARPNESS = ("parameters", "least_squares", "least_squares_free")
_DISTURBANCE = {"size": 0.25, "shape": 0.2, "translation": 0.06, "rotation": 0.3}
"""Standard deviations: of log sizes, exponents, the centre in sides of the view, and of each angle in radians."""
_SHAPE_ROOM = 0.05
_REST = 1e-7
_COLUMNS = ("step", "s", "loss", "iou", "a1", "a2", "a3", "e1", "e2", "t1", "t2", "t3", "qx", "qy", "qz", "qw")


@dataclass(frozen=True)
class WalkOptions:
    """How to walk.

    Raises
    ------
    ValueError
        For an unknown loss, a loss without s that is given one, or numbers that are not positive.
    """

    loss: str = "occupancy"
    """By its name in :mod:`sq_perception.learning.objective`."""
    steps: int = 200
    learning_rate: float = 0.05
    """Of Adam, at the first step."""
    sharpness: tuple[float, float] | None = None
    """s at the first and at the last step, geometric in between; None is the s with which trainings end, throughout."""
    points: int = 1024
    """Comparison points, or about so many lines of sight."""
    seed: int = 0
    """Of the points."""

    def __post_init__(self) -> None:
        Objective(self.loss)
        for name in ("steps", "points", "learning_rate"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name}: expected a positive number, got {getattr(self, name)}")
        if self.sharpness is not None:
            if self.loss in WITHOUT_SHARPNESS:
                raise ValueError(f"sharpness: the loss {self.loss} has no s")
            if not all(math.isfinite(s) and s > 0 for s in self.sharpness):
                raise ValueError(f"sharpness: expected positive numbers, got {self.sharpness}")

    def objective(self, step: int, pixels: int) -> Objective:
        """The loss of one step, before a view of so many pixels a side."""
        start, end = self.sharpness or (Objective(self.loss).sharpness(1.0),) * 2
        s = start * (end / start) ** (step / self.steps)
        stride = max(1, round(pixels / math.sqrt(self.points)))
        return Objective(self.loss, self.points, sharpness_start=s, sharpness_end=s, stride=stride)


@dataclass(frozen=True, eq=False)
class Walk:
    """The stations of a walk, the start first.

    Attributes
    ----------
    bodies : Superquadric
        NumPy batch (n,), n = steps + 1, in the frame of the view.  Parameters that a loss is given (all but the
        rotation for ``occupancy_rotation``) are the true ones.
    losses : (n,)
        What was descended on, at the s of the step.
    sharpness : (n,)
        That s; meaningless for losses without one.
    iou : (n,) or None
        Volume IoU with the true body, where that is known.
    """

    bodies: Superquadric
    losses: np.ndarray
    sharpness: np.ndarray
    iou: np.ndarray | None

    def __len__(self) -> int:
        return len(self.losses)


def walk(
    view: np.ndarray,
    start: Superquadric,
    options: WalkOptions | None = None,
    truth: Superquadric | None = None,
    ranges: RegressorConfig | None = None,
) -> Walk:
    """Walk down a loss.

    Parameters
    ----------
    view : (p, p)
        Canonical view of the object, 0 for background.
    start, truth : Superquadric
        Single NumPy bodies in the frame of the view.
    ranges : RegressorConfig, optional
        Whose ranges the parameters stay in; the defaults of the network.

    Returns
    -------
    Walk
        Shorter than asked for where the gradient was not finite any more.

    Raises
    ------
    ValueError
        For a view that is not square and finite, a start outside of the ranges, or a loss that compares with the true
        body where there is none.
    """
    options, ranges = options or WalkOptions(), ranges or RegressorConfig()
    view = np.asarray(view, dtype=float)
    if view.ndim != 2 or view.shape[0] != view.shape[1] or not np.isfinite(view).all():
        raise ValueError(f"view: expected a finite square image, got {view.shape}")
    if truth is None and Objective(options.loss).needs_labels:
        raise ValueError(f"the loss {options.loss} compares with the true body, which is not known here")
    image = torch.from_numpy(view)[None, None]
    given = None if truth is None else Superquadric.from_flat(torch.from_numpy(np.array(truth.to_flat())[None]))
    raw = torch.from_numpy(ranges.encode(start)[None]).requires_grad_()
    optimiser = torch.optim.Adam([raw], lr=options.learning_rate)
    flats, losses, sharpness = [], [], []
    for step in range(options.steps + 1):
        objective = options.objective(step, len(view))
        body = ranges.decode(raw)
        generator = torch.Generator().manual_seed(options.seed)
        loss = objective.loss(body, image, given, 1.0, generator)[0]
        optimiser.zero_grad()
        loss.backward()
        if not (torch.isfinite(loss) and raw.grad is not None and torch.isfinite(raw.grad).all()):
            break
        judged = body if given is None else objective.judged(body, given)
        flats.append(judged.to_flat()[0].detach().numpy())
        losses.append(loss.item())
        sharpness.append(objective.sharpness_end)
        for group in optimiser.param_groups:
            group["lr"] = options.learning_rate * 0.5 * (1 + math.cos(math.pi * step / options.steps))
        if raw.grad.abs().max() > _REST:
            optimiser.step()
    if not flats:
        raise ValueError(f"start: the loss {options.loss} is not finite there")
    bodies = Superquadric.from_flat(np.array(flats))
    iou = None
    if truth is not None:
        iou = volume_iou(bodies, Superquadric.from_flat(np.broadcast_to(truth.to_flat(), (len(flats), FLAT_LENGTH))))
    return Walk(bodies, np.array(losses), np.array(sharpness), iou)


# What is walked before, and from where


@dataclass(frozen=True, eq=False)
class Subject:
    """The object of an image.

    Attributes
    ----------
    depth : float32 (height, width)
        In the optical frame of ``camera``, NaN for background.
    view : CanonicalView
    truth : Superquadric or None
        In the frame of the view.
    """

    depth: np.ndarray
    camera: Camera
    view: CanonicalView
    truth: Superquadric | None

    @classmethod
    def of_image(
        cls, depth: np.ndarray, camera: Camera, truth: Superquadric | None = None, pixels: int = 64
    ) -> Subject:
        """The largest object of a depth image of the unit cube; ``truth`` in the cube frame.

        Raises
        ------
        ValueError
            If there is no object.
        """
        found = segments.segment(depth, camera)
        if not found.ids:
            raise ValueError("the image shows no object")
        view = canonical_view.from_mask(depth, found.labels == found.ids[0], camera, pixels)
        known = None if truth is None else view.to_canonical(unit_cube.optical_from_cube(truth))
        return cls(depth, camera, view, known)

    @classmethod
    def random(cls, seed: int, pixels: int = 64) -> Subject:
        """A body of the thesis' protocol in its image of 256 x 256 pixels and 8 bit."""
        body = thesis_bodies(1, np.random.default_rng(seed))[0]
        camera = unit_cube.camera()
        depth, _ = raycast.render(unit_cube.optical_from_cube(body), camera)
        return cls.of_image(unit_cube.depth_from_grey(unit_cube.grey_from_depth(depth)), camera, body, pixels)

    def to_cube(self, bodies: Superquadric) -> Superquadric:
        """Bodies of the view's frame in the cube frame."""
        return unit_cube.cube_from_optical(self.view.from_canonical(bodies))


def disturbed(body: Superquadric, rng: np.random.Generator) -> Superquadric:
    """Another single body nearby: sizes by about a quarter, exponents by 0.2, angles by 17 degrees an axis."""
    noise = {name: sigma * rng.standard_normal(getattr(body, name).shape) for name, sigma in _DISTURBANCE.items()}
    turn = quaternions.from_rotation_vector(noise["rotation"][:3])
    shape = np.clip(body.shape + noise["shape"], 0.1, 1.0)
    rotation = quaternions.multiply(body.rotation, turn)
    return Superquadric(body.size * np.exp(noise["size"]), shape, body.translation + noise["translation"], rotation)


def moments(view: np.ndarray) -> Superquadric:
    """The classic start of Solina and Bajcsy: the ellipsoid along the principal axes of what is seen in a view."""
    rows, columns = np.nonzero(view > 0)
    if rows.size == 0:
        raise ValueError("the view shows nothing")
    pixels = len(view)
    points = np.stack([(columns + 0.5) / pixels, 1 - (rows + 0.5) / pixels, view[rows, columns]], axis=-1)
    return solina_bajcsy.moment_start(points.astype(float)).body


def _clamped(body: Superquadric, ranges: RegressorConfig) -> Superquadric:
    """The body within the ranges, its exponents clear of their limits: on them the parametrisation is all but level."""
    low, high = ranges.shape_range
    room = _SHAPE_ROOM * (high - low)
    return Superquadric(
        np.clip(body.size, *ranges.size_range),
        np.clip(body.shape, low + room, high - room),
        np.clip(body.translation, *ranges.translation_range),
        body.rotation,
    )


# The command


def save_table(subject: Subject, found: Walk, path: Path, options: WalkOptions) -> None:
    """Every step as .csv or .json, bodies in the cube frame; what is not known is empty or null."""
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


def _numbers(text: str) -> Superquadric:
    """A body from 12 numbers in one word."""
    try:
        values = [float(word) for word in text.replace(",", " ").split()]
        if len(values) != FLAT_LENGTH:
            raise ValueError(f"expected {FLAT_LENGTH} numbers, got {len(values)}")
        return Superquadric.from_flat(np.array(values))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"a1 a2 a3 e1 e2 t1 t2 t3 qx qy qz qw: {error}") from error


def _start(text: str) -> str | Superquadric:
    if text in STARTS:
        return text
    if text[:1].isalpha():
        raise argparse.ArgumentTypeError(f"expected one of {', '.join(STARTS)} or 12 numbers, got {text!r}")
    return _numbers(text)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sq-perception gradient-search",
        description=__doc__.split("\n\n")[0],
        epilog="Bodies are given and written in the cube frame: x right, y up, z towards the viewer, side 1.",
    )
    parser.add_argument("image", nargs="?", metavar="IMAGE", help="grey image of the unit cube (.png, .bmp, .npz)")
    parser.add_argument("--seed", type=int, metavar="K", help="a random body instead; also seeds the disturbance")
    parser.add_argument("--truth", type=_numbers, metavar="'A1 .. QW'", help="the true body of an image, if known")
    parser.add_argument("--loss", choices=LOSSES, default="occupancy", help="default occupancy")
    parser.add_argument(
        "--start", type=_start, metavar="START", help=f"{', '.join(STARTS)} or 'a1 .. qw' (default network)"
    )
    parser.add_argument(
        "--turn",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="turn the start: rotation vector in its own frame, deg",
    )
    parser.add_argument("--steps", type=int, default=200, help="gradient steps (default 200)")
    parser.add_argument("--learning-rate", type=float, default=0.05, help="of Adam, at the first step (default 0.05)")
    parser.add_argument("--s", type=float, nargs="+", metavar="S", help="sharpness, or its first and its last value")
    parser.add_argument("--points", type=int, default=1024, help="comparison points or lines of sight (default 1024)")
    parser.add_argument("--model", metavar="FILE", help="weights of --start network: a file or a shipped name")
    parser.add_argument(
        "--output", type=Path, action="append", default=[], metavar="OUT", help=".gif or folder of PNGs"
    )
    parser.add_argument("--frames", type=int, default=50, help="pictures drawn of the walk (default 50)")
    parser.add_argument("--table", type=Path, metavar="FILE", help="every step as .csv or .json")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Entry of ``sq-perception gradient-search``."""
    parser = _parser()
    given = parser.parse_args(arguments)
    options = _checked(parser, given)
    truth_known = given.image is None or given.truth is not None
    if Objective(options.loss).needs_labels and not truth_known:
        parser.error(
            f"--loss {options.loss} compares with the true body, and an image does not tell it: give --truth "
            f"'a1 .. qw' or --seed K, or choose {', '.join(UNSUPERVISED)}"
        )
    if given.start in ("disturbed", "truth") and not truth_known:
        parser.error(f"--start {given.start} needs the true body: give --truth 'a1 .. qw' or --seed K")
    try:
        network = checkpoint.load(given.model) if given.start in (None, "network") else None
        ranges = network.config if network is not None else RegressorConfig()
        if given.image is None:
            subject = Subject.random(given.seed, ranges.pixels)
        else:
            frame = read(given.image, projection="orthographic")
            subject = Subject.of_image(frame.depth, frame.camera, given.truth, ranges.pixels)
    except (FrameError, checkpoint.CheckpointError) as error:
        return _failed(str(error))
    except ValueError as error:
        return _failed(f"{given.image}: {error}")
    try:
        if isinstance(given.start, Superquadric):
            start = subject.view.to_canonical(unit_cube.optical_from_cube(given.start))
        elif network is not None:
            start = network.predict(subject.view.image[None])[0]
        elif given.start == "moments":
            start = _clamped(moments(subject.view.image), ranges)
        else:
            assert subject.truth is not None
            start = subject.truth
            if given.start == "disturbed":
                start = _clamped(disturbed(start, np.random.default_rng([given.seed or 0, 1])), ranges)
        ranges.encode(start)
    except ValueError as error:
        parser.error(f"--start: in the object's view, {error}")
    if given.turn is not None:
        turn = quaternions.from_rotation_vector(np.deg2rad(given.turn))
        start = replace(start, rotation=quaternions.multiply(start.rotation, turn))
    torch.set_num_threads(1)  # one body: threads cost more than they save
    found = walk(subject.view.image, start, options, subject.truth, ranges)
    try:
        _write(subject, found, options, given)
    except OSError as error:
        return _failed(str(error))
    iou = "" if found.iou is None else f", IoU {100 * found.iou[0]:.1f} to {100 * found.iou[-1]:.1f} %"
    print(f"{options.loss}: loss {found.losses[0]:.4g} to {found.losses[-1]:.4g} in {len(found) - 1} steps{iou}")
    print("body: " + " ".join(f"{x:.4f}" for x in subject.to_cube(found.bodies[-1]).to_flat()))
    return 0


def _checked(parser: argparse.ArgumentParser, given: argparse.Namespace) -> WalkOptions:
    if (given.image is None) == (given.seed is None) and not (given.image and given.start == "disturbed"):
        parser.error("expected an IMAGE, or --seed K for a random body")
    if given.seed is not None and given.seed < 0:
        parser.error(f"--seed: expected at least 0, got {given.seed}")
    if given.image is None and given.truth is not None:
        parser.error("--truth: the true body of --seed is known; give it with an IMAGE")
    if given.s is not None and len(given.s) > 2:
        parser.error(f"--s: expected one or two numbers, got {len(given.s)}")
    if given.turn is not None and not np.isfinite(given.turn).all():
        parser.error("--turn: expected finite numbers")
    if given.frames < 2:
        parser.error(f"--frames: expected at least 2, got {given.frames}")
    for path in [*given.output, *([given.table] if given.table else [])]:
        if not path.resolve().parent.is_dir():
            parser.error(f"the folder of {path} does not exist")
    for path in given.output:
        if path.suffix and path.suffix.lower() != ".gif" and not path.is_dir():
            parser.error(f"--output: expected a .gif or a folder, got {path}")
    if given.table is not None and given.table.suffix.lower() not in (".csv", ".json"):
        parser.error(f"--table: expected a .csv or a .json, got {given.table}")
    sharpness = None if given.s is None else (given.s[0], given.s[-1])
    try:
        return WalkOptions(given.loss, given.steps, given.learning_rate, sharpness, given.points)
    except ValueError as error:
        parser.error(f"--{str(error).replace('_', '-')}".replace("--sharpness", "--s"))


def _write(subject: Subject, found: Walk, options: WalkOptions, given: argparse.Namespace) -> None:
    if given.table is not None:
        save_table(subject, found, given.table, options)
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


def _progress(steps: list[int]) -> Iterable[int]:
    if not sys.stderr.isatty():
        return steps
    from rich.console import Console
    from rich.progress import track

    return track(steps, description="drawing", console=Console(stderr=True), transient=True)


def _failed(message: str) -> int:
    print(f"sq-perception gradient-search: {message}", file=sys.stderr)
    return 1
