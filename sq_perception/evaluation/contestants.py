"""What is compared: networks alone, and the fits, each from the 256 x 256 image to a body of the cube frame.

A network sees the canonical view of the image's largest object; its prediction is carried back and not refined.
Predictions are made in batches, which changes no body.  Times are those of :meth:`Recoverer.recover`, image by image:
segmentation, view, network or fit, and score, everything that a user waits for.  Networks are timed on the first 300
images, fits on every image they get.

The loss that a network was trained by, from its file's header, decides its row of the thesis' tables and what
was given to it: under occupancy_rotation, size, shape and place are those of the label.  Labels list their axes as a
training listed them, with a1 >= a2 for ``canonical_labels`` and for the fits, whose results are in canonical form.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sq_perception.evaluation.protocol import FITS
from sq_perception.evaluation.thesis_images import ImageChunk
from sq_perception.files.output_file import free_name
from sq_perception.fitting.fit import Status
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import unit_cube
from sq_perception.learning import checkpoint, inference
from sq_perception.learning.choices import LOSSES
from sq_perception.learning.inference import Predictor
from sq_perception.learning.objective import Objective
from sq_perception.recovery.recoverer import Method, Recoverer, RecoveryOptions

TIMED_IMAGES = 300
_IDENTITY = (0.0, 0.0, 0.0, 1.0)
_NOBODY = np.array([1e-3, 1e-3, 1e-3, 1.0, 1.0, -1.0, -1.0, -1.0, *_IDENTITY])
"""Stands where nothing was recovered: outside of the cube."""


@dataclass(frozen=True, eq=False)
class Answers:
    """What was made of n images.

    Attributes
    ----------
    bodies : Superquadric
        Batch (n,) in the cube frame.
    recovered : bool (n,)
        False where there is no body; the one in ``bodies`` then means nothing.
    milliseconds : (n,)
        Execution time of each image, NaN where it was not measured.
    """

    bodies: Superquadric
    recovered: np.ndarray
    milliseconds: np.ndarray


@dataclass(frozen=True, eq=False)
class Network:
    """A network alone.

    Attributes
    ----------
    name : str
        Short, unique within a comparison; also names files.
    training, metrics : dict
        The notes of its file's header.
    """

    name: str
    path: Path
    model: Predictor
    training: dict[str, Any]
    metrics: dict[str, Any]
    recoverer: Recoverer

    @classmethod
    def read(cls, path: Path, name: str | None = None) -> Network:
        """Load a weights file.

        Raises
        ------
        CheckpointError
            If the file is missing, damaged or of another kind, or its header names a loss that is not known.
        """
        predictor = inference.load(path)
        header = checkpoint.read_header(path)
        training, found = (_note(header, key, path) for key in ("training", "metrics"))
        if training.get("loss", LOSSES[0]) not in LOSSES:
            raise checkpoint.CheckpointError(f"{path}: the header names an unknown loss: {training['loss']!r}")
        return cls(name or default_name(path), path, predictor, training, found, Recoverer(path, method="network"))

    @property
    def loss(self) -> str:
        """What it was trained by; empty where its file does not name it."""
        # Headers without a loss are of the time when there was one only.
        return str(self.training.get("loss", "occupancy")) if self.training else ""

    @property
    def description(self) -> str:
        """One line for the reader."""
        parts = [f"network alone, loss {self.loss or 'not in the file'}"]
        parts.append(f"views of {self.model.config.pixels} x {self.model.config.pixels}")
        if "step" in self.metrics:
            parts.append(f"{self.metrics['step']} steps in its last training")
        if self.training.get("start"):
            parts.append("started from another network")
        if self.loss == "occupancy_rotation":
            parts.append("size, shape and place given")
        return ", ".join(parts)

    def recover(self, images: ImageChunk) -> Answers:
        """One body an image; the truth in the chunk is not looked at."""
        views = images.views(self.model.config)
        there = [k for k, view in enumerate(views) if view is not None]
        flat, recovered = np.tile(_NOBODY, (len(views), 1)), np.zeros(len(views), bool)
        if there:
            predicted = self.model.predict(np.stack([views[k].marked for k in there]))  # type: ignore[union-attr]
            for k, body in zip(there, predicted, strict=True):
                back = views[k].from_canonical(body)  # type: ignore[union-attr]
                flat[k] = unit_cube.cube_from_optical(back).to_flat()
            recovered[there] = True
        milliseconds = np.full(len(views), np.nan)
        for k in range(min(len(views), TIMED_IMAGES - images.first)):
            if images.first + k == 0:
                self.recoverer.warm_up(images.camera)
            milliseconds[k] = self.recoverer.recover(images.depth[k], images.camera).milliseconds["total"]
        return Answers(Superquadric.from_flat(flat), recovered, milliseconds)

    def labels(self, truth: Superquadric) -> Superquadric:
        """The true bodies, each in the parameter vector with which rotations are to be compared."""
        return truth.canonical_form() if self.training.get("canonical_labels", False) else truth

    def with_given(self, prediction: Superquadric, labels: Superquadric) -> Superquadric:
        """What is compared with the labels: the prediction, with whatever was given to the contestant."""
        return Objective(self.loss).with_given(prediction, labels) if self.loss else prediction


@dataclass(frozen=True, eq=False)
class FittingMethod:
    """A method of the recovery with a fit: auto, symmetry or classic.  As :class:`Network`; nothing is given to it."""

    name: str
    recoverer: Recoverer
    loss: str = ""

    @classmethod
    def of(cls, method: Method) -> FittingMethod:
        """Raises CheckpointError if the method needs the shipped network and it cannot be read."""
        if method not in FITS:
            raise ValueError(f"method: expected one of {', '.join(FITS)}, got {method!r}")
        return cls(method, Recoverer(method=method))

    @property
    def description(self) -> str:
        return {
            "auto": "surface fit, started by central symmetry and the shipped network",
            "symmetry": "surface fit, started by central symmetry alone",
            "classic": "Solina and Bajcsy's iterative fit to the points",
        }[self.name]

    def recover(self, images: ImageChunk) -> Answers:
        if images.first == 0:
            self.recoverer.warm_up(images.camera)
        flat, recovered = np.tile(_NOBODY, (len(images), 1)), np.zeros(len(images), bool)
        milliseconds = np.empty(len(images))
        options = RecoveryOptions(method=self.name)  # type: ignore[arg-type]
        for k, depth in enumerate(images.depth):
            frame = self.recoverer.recover(depth, images.camera, options=options)
            milliseconds[k] = frame.milliseconds["total"]
            if frame.bodies and frame.bodies[0].status != Status.FAILED:
                found = unit_cube.cube_from_optical(frame.bodies[0].superquadric)
                flat[k], recovered[k] = found.canonical_form().to_flat(), True
        return Answers(Superquadric.from_flat(flat), recovered, milliseconds)

    def labels(self, truth: Superquadric) -> Superquadric:
        return truth.canonical_form()

    def with_given(self, prediction: Superquadric, labels: Superquadric) -> Superquadric:
        return prediction


Contestant = Network | FittingMethod


def default_name(path: Path) -> str:
    """A file's own name, or that of its folder where all are called model.safetensors."""
    name = path.resolve().parent.name if path.stem == "model" else path.stem
    return re.sub(r"[^\w.+-]+", "_", name) or "network"


def unique_names(paths: Sequence[Path]) -> list[str]:
    """A name for each file, none of them twice and none of a fit."""
    taken = set[str](FITS)
    return [free_name(default_name(path), taken) for path in paths]


def _note(header: dict[str, str], key: str, path: Path) -> dict[str, Any]:
    try:
        note = json.loads(header.get(key, "{}"))
    except json.JSONDecodeError as error:
        raise checkpoint.CheckpointError(f"{path}: the header's {key!r} is no JSON: {error}") from error
    if not isinstance(note, dict):
        raise checkpoint.CheckpointError(f"{path}: expected an object as the header's {key!r}, got {note!r}")
    return note
