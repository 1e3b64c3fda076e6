"""What a recovery answers: the objects of a frame and their bodies.

And a body as text, alike in lines, tables and pictures: FULL edges, as a ruler measures them, and how sure they are.
Lengths come in metres and are printed in millimetres; those of an orthographic image are shares of the unit cube.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from sq_perception.fitting.fit import Fit, Parts, Status
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera
from sq_perception.recovery.cavities import Cavity
from sq_perception.recovery.readings import Readings
from sq_perception.segmentation.evidence import FrameEvidence


@dataclass(frozen=True, eq=False)
class Recovery:
    """One recovered object.

    Attributes
    ----------
    fit : Fit
        The body in the optical frame, how well it explains the image, and how sure it is.
    score : float
        Agreement of the soft-rendered body with the canonical view, 0 to 1 (:mod:`soft_agreement`).
    label : int
        The object's value in the label image.
    pixels : int
        Measured pixels of the object.
    objectness : float
        Probability that it is a thing (:mod:`sq_perception.segmentation.objectness`); 1 for masks from outside.
    repeats : int
        Frames before this one whose readings the body was recovered from, as these are the same but for noise
        (:mod:`sq_perception.recovery.still_scene`): an answer given before, with the same error.  0: from this frame.
    parts : Parts or None
        The bodies that it is made of, if they were asked for and explain the image better than one body does.
    cavity : Cavity or None
        The cavity of an open vessel, if parts were asked for and the camera sees into it.
    """

    fit: Fit
    score: float
    label: int
    pixels: int
    objectness: float = 1.0
    repeats: int = 0
    parts: Parts | None = None
    cavity: Cavity | None = None

    @property
    def superquadric(self) -> Superquadric:
        """A single body in the optical frame, in its canonical form."""
        return self.fit.superquadric

    @property
    def fits(self) -> tuple[Fit, ...]:
        """What it looks like: its parts, or its body where it has none."""
        return (self.fit,) if self.parts is None else self.parts.fits

    @property
    def solids(self) -> tuple[Superquadric, ...]:
        """The bodies of ``fits``."""
        return tuple(fit.superquadric for fit in self.fits)

    @property
    def residual(self) -> float:
        """Root mean square distance of the object's points to the surface, metres; NaN where there is no body."""
        return self.fit.residual

    @property
    def status(self) -> Status:
        """How far the body can be trusted."""
        return self.fit.status

    @property
    def message(self) -> str:
        """The reason for the status."""
        return self.fit.message

    @property
    def covariance(self) -> np.ndarray:
        """(11, 11), as in the fit; NaN for methods that do not compute it."""
        return self.fit.covariance

    @property
    def sigma_size(self) -> np.ndarray:
        """Standard deviations (3,) of the half sizes, metres; NaN for methods that do not compute them."""
        return self.fit.sigma_size

    @property
    def is_predicted(self) -> bool:
        """Whether a predicted hull weighs in, as in the fit."""
        return self.fit.is_predicted

    @property
    def seen(self) -> np.ndarray:
        """Share (3,) of each size that was seen, as in the fit; the rest is inferred."""
        return self.fit.seen


@dataclass(frozen=True, eq=False)
class FrameRecovery:
    """All objects of one frame.

    Attributes
    ----------
    bodies
        One entry per object, the one with most pixels first, failed ones among them.
    milliseconds
        By stage: segmentation, network, fit, score, total.
    labels : int32 (height, width)
        The masks that were used.
    plane : (4,) or None
        Support plane, height above it = n.p + d.
    message
        Why there are no objects, that some were left out, and ``doubt``; empty otherwise.
    doubt
        Why the image seems to be in another unit or of another kind, and with it all bodies wrong; empty otherwise.
    """

    bodies: tuple[Recovery, ...]
    milliseconds: dict[str, float]
    labels: np.ndarray
    plane: np.ndarray | None
    message: str
    doubt: str = ""

    @property
    def recovered(self) -> tuple[Recovery, ...]:
        """The bodies that did not fail."""
        return tuple(body for body in self.bodies if body.status != Status.FAILED)


def render_recovery(frame: FrameRecovery, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Depth, float64 (height, width), of the recovered bodies or their parts, +inf where there is none, and their index
    in ``frame.bodies``, int32, -1 where there is none; failed bodies are not drawn."""
    shown = [(k, solid) for k, body in enumerate(frame.bodies) if body.status != Status.FAILED for solid in body.solids]
    depth, index = raycast.render(Superquadric.stack([solid for _, solid in shown]), camera)
    return depth, np.append(np.array([k for k, _ in shown], dtype=np.int32), np.int32(-1))[index]


def what_is_left_out(readings: Readings, found: FrameEvidence, bodies: int, fragments: int) -> list[str]:
    """Return what was seen and is not among a number of bodies, and why, in words.  ``fragments`` is the number of
    objects that were left out by their bodies."""
    options, said = readings.options, []
    if not bodies:
        said.append(_why_empty(readings, found))
    elif readings.labels is None and found.plane is None and readings.camera.is_pinhole:
        said.append("no support plane found")
    if found.larger:
        objects = "1 object is" if found.larger == 1 else f"{found.larger} objects are"
        said.append(f"{objects} larger than max_size = {options.max_size:g} m and left out")
    if found.outside:
        said.append(f"{found.outside} outside of the workspace left out")
    if fragments:
        said.append(f"{fragments} left out, each a fragment of an object or of the background by its body")
    if found.is_cut:
        said.append(f"there are more objects than max_objects = {options.max_objects}: smaller ones are left out")
    return said


def _why_empty(readings: Readings, found: FrameEvidence) -> str:
    if not np.isfinite(readings.within_range(found.labels)).any():
        return "the image holds no depth"
    if readings.labels is not None and readings.labels.max() <= 0:
        return "the masks hold no object"
    if found.larger or found.outside:
        return "no object of the wanted size and place"
    return "no support plane and no object found" if found.plane is None else "nothing stands on the plane"


@contextmanager
def timed(milliseconds: dict[str, float], stage: str) -> Iterator[None]:
    """Enter the duration of the block, by the clock on the wall."""
    started = time.perf_counter()
    try:
        yield
    finally:
        milliseconds[stage] = 1e3 * (time.perf_counter() - started)


def edges_as_text(size: Iterable[float], sigma_size: Iterable[float], is_cube: bool) -> str:
    """``480 x 196 x 214 mm (+-5 +-11 +-7)`` of half sizes and their standard deviations, NaN where unknown."""
    lengths = " x ".join(_length(2 * half, is_cube, 10) for half in size)
    unit = "of the cube" if is_cube else "mm"
    doubts = [f"+-{_length(2 * sigma, is_cube, 1)}" if math.isfinite(sigma) else "+-?" for sigma in sigma_size]
    return f"{lengths} {unit}" + ("" if set(doubts) == {"+-?"} else f" ({' '.join(doubts)})")


def place_as_text(translation: Iterable[float], is_cube: bool) -> str:
    """``0.12 0.03 0.84 m``: a centre."""
    return " ".join(f"{value:.2f}" for value in translation) + ("" if is_cube else " m")


def _length(metres: float, is_cube: bool, whole: int) -> str:
    """A length in whole millimetres, or thousandths of the cube; in tenths of them below ``whole``."""
    digits = 0 if 1e3 * metres >= whole else 1
    return f"{metres:.{3 + digits}f}" if is_cube else f"{1e3 * metres:.{digits}f}"
