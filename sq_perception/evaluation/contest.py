"""Networks alone and the fits on the same images, each from the 256 x 256 image to a body of the cube frame.

A network sees the canonical view of the image's largest object; its prediction is not refined.
Predictions are made in batches, which changes no body.  Times are those of :meth:`Recoverer.recover`, image by image:
segmentation, view, network or fit, and score, all that a user waits for.  Networks are timed on the first 300
images, fits on every image they get.

The loss that a network was trained by, from its file's header, decides its row of the thesis' tables and what
was given to it: under occupancy_rotation, size, shape and place are those of the label.  Labels list their axes as a
training listed them, with a1 >= a2 for ``canonical_labels`` and for the fits, whose results are in canonical form.

The test set has bodies of the thesis' protocol (chapter 5.1; :mod:`sq_perception.simulation.scenes`), which no training
has seen: images of 256 x 256 pixels whose grey value is the floor of 255 z.  Bodies come in blocks of 500, block b from
the generator of ``SeedSequence(seed, spawn_key=(6, b))``, so that the first n are the same however many are drawn.
Training draws from ``[seed, step]`` and validates on ``0``: no spawn key, hence other numbers for every seed.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sq_perception.evaluation import DEFAULT_SEED, FITS
from sq_perception.evaluation.figures_of_merit import FiguresOfMerit
from sq_perception.files.output_file import free_name
from sq_perception.fitting.fit import Status
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast, unit_cube
from sq_perception.learning import checkpoint, inference
from sq_perception.learning.choices import LOSSES
from sq_perception.learning.inference import Predictor
from sq_perception.learning.losses import Objective
from sq_perception.recovery.recoverer import FrameRecovery, Method, Recoverer
from sq_perception.segmentation import segments
from sq_perception.simulation.scenes import thesis_bodies

CAMERA = unit_cube.camera()  # the orthographic camera of all images
CHUNK = 200  # images in memory at a time, 50 MB; changes no result


@dataclass(frozen=True)
class ThesisImages:
    """The test set of ``count`` bodies; a ValueError for fewer than one, or a negative seed."""

    count: int
    seed: int = DEFAULT_SEED

    def __post_init__(self) -> None:
        if self.count < 1 or self.seed < 0:
            raise ValueError(f"expected at least 1 body and a seed of at least 0, got {self.count}, seed {self.seed}")

    @cached_property
    def truth(self) -> Superquadric:
        """All bodies (count,) in the cube frame."""
        block_size = 500
        blocks = []
        for block in range(-(-self.count // block_size)):
            seeds = np.random.SeedSequence(self.seed, spawn_key=(6, block))
            blocks.append(thesis_bodies(block_size, np.random.default_rng(seeds)).to_flat())
        return Superquadric.from_flat(np.concatenate(blocks)[: self.count])

    def image(self, number: int) -> np.ndarray:
        """Depth float32 (256, 256) of one body, NaN for background."""
        depth, _ = raycast.render(unit_cube.optical_from_cube(self.truth[number]), CAMERA)
        return unit_cube.depth_from_grey(unit_cube.grey_from_depth(depth))

    def chunks(self) -> Iterator[tuple[int, np.ndarray]]:
        """All images, some at a time: the number of the first body, and depth (n, 256, 256)."""
        for first in range(0, self.count, CHUNK):
            yield first, np.stack([self.image(number) for number in range(first, min(first + CHUNK, self.count))])


class Answers(NamedTuple):
    """What a contestant recovered from n images.  ``bodies`` (n, 12) are flat in the cube frame, NaN where nothing was
    recovered; ``milliseconds`` (n,) the time of each image, NaN where it was not measured."""

    bodies: np.ndarray
    milliseconds: np.ndarray


@dataclass(frozen=True, eq=False)
class Contestant:
    """A network alone, or a method of the recovery with a fit."""

    name: str  # short, unique within a comparison; also names files
    description: str  # one line for the reader
    loss: str  # what a network was trained by; empty where its file does not name it, and for fits
    recover: Callable[[int, np.ndarray], Answers]
    """Answers for depth images (n, 256, 256), given the number of the first within the test set."""
    has_canonical_labels: bool = True  # whether labels are in canonical form
    notes: dict[str, Any] = field(default_factory=dict)
    """JSON values: of a network its file, and the notes of its header."""

    def labels(self, truth: Superquadric) -> Superquadric:
        """The true bodies, each in the parameter vector with which rotations are to be compared."""
        return truth.canonical_form() if self.has_canonical_labels else truth

    def with_given(self, prediction: Superquadric, labels: Superquadric) -> Superquadric:
        """The prediction as it is compared with the labels, from which it takes whatever its loss was given."""
        return Objective(self.loss).with_given(prediction, labels) if self.loss else prediction


def network(path: Path, name: str | None = None) -> Contestant:
    """The network of a weights file.  Raises CheckpointError if the file is missing, damaged or of another kind, or its
    header names a loss that is not known."""
    model = inference.load(path)
    header = checkpoint.read_header(path)
    try:
        training, metrics = (dict(json.loads(header.get(key, "{}"))) for key in ("training", "metrics"))
    except (ValueError, TypeError) as error:
        raise checkpoint.CheckpointError(f"{path}: expected objects as the header's notes: {error}") from error
    if training.get("loss", LOSSES[0]) not in LOSSES:
        raise checkpoint.CheckpointError(f"{path}: the header names an unknown loss: {training['loss']!r}")
    # Headers without a loss are of the time when there was one only.
    loss = str(training.get("loss", "occupancy")) if training else ""
    parts = [f"network alone, mean of four positions of a view, loss {loss or 'not in the file'}"]
    parts.append(f"views of {model.config.pixels} x {model.config.pixels}")
    if "step" in metrics:
        parts.append(f"{metrics['step']} steps in its last training")
    if training.get("start"):
        parts.append("started from another network")
    if loss == "occupancy_rotation":
        parts.append("size, shape and place given")
    if loss == "mse":
        parts.append("the rotation was not learned")
    return Contestant(
        name or default_name(path), ", ".join(parts), loss, partial(_predict, model, Recoverer(path, method="network")),
        training.get("canonical_labels", False), {"model": str(path), "training": training, "metrics": metrics},
    )


def fit(method: Method) -> Contestant:
    """A method of the recovery with a fit; raises CheckpointError if its network is needed and cannot be read."""
    return Contestant(method, FITS[method], "", partial(_fit, Recoverer(method=method)))


def _predict(model: Predictor, recoverer: Recoverer, first: int, images: np.ndarray) -> Answers:
    bodies, views = np.full((len(images), 12), np.nan), {}
    for k, depth in enumerate(images):
        found = segments.segment(depth, CAMERA)
        if found.ids:  # what a network is shown of the largest object, as in a recovery
            views[k] = model.config.view_of(depth, found.labels == found.ids[0], CAMERA)
    if views:
        predicted = model.predict(np.stack([view.marked for view in views.values()]))
        for (k, view), body in zip(views.items(), predicted, strict=True):
            bodies[k] = unit_cube.cube_from_optical(view.from_canonical(body)).to_flat()
    milliseconds = np.full(len(images), np.nan)
    timed = images[: max(0, 300 - first)]
    milliseconds[: len(timed)] = [frame.milliseconds["total"] for frame in _frames(recoverer, first, timed)]
    return Answers(bodies, milliseconds)


def _fit(recoverer: Recoverer, first: int, images: np.ndarray) -> Answers:
    bodies, milliseconds = np.full((len(images), 12), np.nan), np.empty(len(images))
    for k, frame in enumerate(_frames(recoverer, first, images)):
        milliseconds[k] = frame.milliseconds["total"]
        if frame.bodies and frame.bodies[0].status != Status.FAILED:
            bodies[k] = unit_cube.cube_from_optical(frame.bodies[0].superquadric).canonical_form().to_flat()
    return Answers(bodies, milliseconds)


def _frames(recoverer: Recoverer, first: int, images: np.ndarray) -> Iterator[FrameRecovery]:
    if first == 0:
        recoverer.warm_up(CAMERA)
    for depth in images:
        yield recoverer.recover(depth, CAMERA)


@dataclass(frozen=True, eq=False)
class Outcome:
    """A contestant, its figures, and the bodies (n,) they are of, with the labels they were compared with."""

    contestant: Contestant
    figures: FiguresOfMerit
    bodies: Superquadric
    labels: Superquadric


def compare(
    contestants: Sequence[tuple[Contestant, int]], images: ThesisImages,
    advance: Callable[[str, int], None] | None = None,
) -> list[Outcome]:
    """Have every contestant recover so many of the first bodies of the test set; ``advance`` is called with its name
    and the number done.  Raises ValueError for no body, or more than there are."""
    for contestant, count in contestants:
        if not 1 <= count <= images.count:
            raise ValueError(f"{contestant.name}: expected 1 to {images.count} bodies, got {count}")
    answers: list[list[Answers]] = [[] for _ in contestants]
    for first, depth in images.chunks():
        for (contestant, count), mine in zip(contestants, answers, strict=True):
            shown = depth[: max(0, count - first)]
            if len(shown):
                mine.append(contestant.recover(first, shown))
                if advance:
                    advance(contestant.name, first + len(shown))
    outcomes = []
    for (contestant, count), mine in zip(contestants, answers, strict=True):
        flat, milliseconds = (np.concatenate(parts) for parts in zip(*mine, strict=True))
        recovered = np.isfinite(flat).all(axis=1)
        labels = contestant.labels(images.truth[:count])
        # Placeholder where nothing was recovered, outside of the cube.
        nobody = np.array([1e-3, 1e-3, 1e-3, 1.0, 1.0, -1.0, -1.0, -1.0, 0.0, 0.0, 0.0, 1.0])
        bodies = Superquadric.from_flat(np.where(recovered[:, None], flat, nobody))
        bodies = contestant.with_given(bodies, labels)
        outcomes.append(Outcome(contestant, FiguresOfMerit.of(bodies, labels, recovered, milliseconds), bodies, labels))
    return outcomes


def default_name(path: Path) -> str:
    """A file's own name, or that of its folder where all are called model.safetensors."""
    name = path.resolve().parent.name if path.stem == "model" else path.stem
    return re.sub(r"[^\w.+-]+", "_", name) or "network"


def unique_names(paths: Sequence[Path]) -> list[str]:
    """A name for each file, none of them twice and none of a fit."""
    taken = set[str](FITS)
    return [free_name(default_name(path), taken) for path in paths]
