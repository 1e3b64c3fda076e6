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
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from sq_perception.geometry.metrics import volume_iou
from sq_perception.geometry.superquadric import FLAT_LENGTH, Superquadric
from sq_perception.imaging import canonical_view, raycast, unit_cube
from sq_perception.imaging.camera import Camera
from sq_perception.imaging.canonical_view import CanonicalView
from sq_perception.learning.network_config import RegressorConfig
from sq_perception.learning.objective import Objective
from sq_perception.segmentation import segments
from sq_perception.simulation.scenes import thesis_bodies

_REST = 1e-7
_POINTS = 1024
"""Comparison points, or about so many lines of sight."""


@dataclass(frozen=True, eq=False)
class Walk:
    """The stations of a walk, the start first.

    Attributes
    ----------
    bodies : Superquadric
        NumPy batch (n,), n = steps + 1, in the frame of the view.  Parameters that a loss is given (all but the
        rotation for ``occupancy_rotation``) are the true ones.
    losses : (n,)
        What was descended on.
    iou : (n,) or None
        Volume IoU with the true body, where that is known.
    """

    bodies: Superquadric
    losses: np.ndarray
    iou: np.ndarray | None

    def __len__(self) -> int:
        return len(self.losses)


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


def walk(
    subject: Subject,
    start: Superquadric,
    loss: str,
    steps: int,
    learning_rate: float = 0.05,
    ranges: RegressorConfig | None = None,
) -> Walk:
    """Walk down a loss.

    Parameters
    ----------
    subject
        The object.
    start : Superquadric
        A single NumPy body in the frame of the view.
    loss
        By its name in :mod:`sq_perception.learning.objective`, with the s with which trainings end.
    steps, learning_rate
        Of Adam; the rate is that of the first step.
    ranges : RegressorConfig, optional
        Whose ranges the parameters stay in; the defaults of the network.

    Returns
    -------
    Walk
        Shorter than asked for where the gradient was not finite any more.

    Raises
    ------
    ValueError
        For a loss that is unknown or compares with a true body that is not, a start outside of the ranges, or one at
        which the loss is not finite.
    """
    ranges = ranges or RegressorConfig()
    view = np.asarray(subject.view.image, dtype=float)
    objective = Objective(loss, _POINTS, stride=max(1, round(len(view) / math.sqrt(_POINTS))))
    truth = subject.truth
    if truth is None and objective.needs_labels:
        raise ValueError(f"the loss {loss} compares with the true body, which is not known here")
    image = torch.from_numpy(view)[None, None]
    given = None if truth is None else Superquadric.from_flat(torch.from_numpy(np.array(truth.to_flat())[None]))
    raw = torch.from_numpy(ranges.encode(start)[None]).requires_grad_()
    optimiser = torch.optim.Adam([raw], lr=learning_rate)
    flats, losses = [], []
    for step in range(steps + 1):
        body = ranges.decode(raw)
        generator = torch.Generator().manual_seed(0)
        value = objective.loss(body, image, given, 1.0, generator)[0]
        optimiser.zero_grad()
        value.backward()
        if not (torch.isfinite(value) and raw.grad is not None and torch.isfinite(raw.grad).all()):
            break
        compared = body if given is None else objective.with_given(body, given)
        flats.append(compared.to_flat()[0].detach().numpy())
        losses.append(value.item())
        for group in optimiser.param_groups:
            group["lr"] = learning_rate * 0.5 * (1 + math.cos(math.pi * step / steps))
        if raw.grad.abs().max() > _REST:
            optimiser.step()
    if not flats:
        raise ValueError(f"start: the loss {loss} is not finite there")
    bodies = Superquadric.from_flat(np.array(flats))
    iou = None
    if truth is not None:
        iou = volume_iou(bodies, Superquadric.from_flat(np.broadcast_to(truth.to_flat(), (len(flats), FLAT_LENGTH))))
    return Walk(bodies, np.array(losses), iou)
