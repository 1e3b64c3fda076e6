"""The fit of one superquadric to one object of a depth image.

Residuals run along the true rays of the pixels, so that one code serves orthographic and pinhole cameras: the object's
pixels pull the surface onto what they measured, the pixels beside the object keep the body out of the space they saw to
be empty.  See :mod:`sq_perception.fitting.residuals` for the equations, :mod:`sq_perception.fitting.problem` for a fit
as data, and :mod:`sq_perception.fitting.quality` for the status and accuracy of the result.

Which course fits
-----------------
There are two courses, :mod:`sq_perception.fitting.exact` and :mod:`sq_perception.fitting.tolerant`.  If a model error
is given, it decides: exact for 0, tolerant otherwise.  If none is given, what is known of the object decides:

thing       It stands on a plane, or its hull is predicted: tolerant, unless a cheap exact search finds a body that
            leaves no more than the noise: before, where readings are fine or no plane is known, else after, from the
            tolerant course's body.  That one stays as another body that the image allows.
may stray   Neither, but a pinhole camera saw it, and noise may hide how far it strays from a superquadric: exact; a
            body that leaves more than the noise is passed on to the tolerant course.
else        Such as the bodies of the thesis: exact.

Objects of the first two kinds get the standard deviations of things, whichever course found their bodies; but for
those that an orthographic camera shows and the exact course explains: renderings, without noise.

Frames and units: optical frame, metres, radians.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Literal

import numpy as np

from sq_perception.fitting import exact, starts, tolerant
from sq_perception.fitting.covariance import Alternative
from sq_perception.fitting.fit import Fit
from sq_perception.fitting.hull_prior import HullPrior
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.observation import Crop, Observation
from sq_perception.fitting.options import MIN_PIXELS, MODEL_ERROR, FitOptions
from sq_perception.fitting.problem import Problem, Solution
from sq_perception.fitting.quality import assessed, failed
from sq_perception.geometry.quantiles import deviation
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.geometry.support_directions import DIRECTIONS
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera
from sq_perception.imaging.regions import box, fills

__all__ = ["FitOptions", "fit", "warm_up"]

_FINE_NOISE = 0.1
"""Noise, as a share of how far things stray from superquadrics, below which the exact course goes first: the tolerant
one may then leave more than the noise even of a true superquadric.  Under more, it left 0.5 to 0.8 of the noise on true
superquadrics, and 1.2 and more on things of benchmarks/household_things."""
_MODEL_SHARE = 0.04
"""How far a small thing may stray, as a share of the side of a square whose area is that of its pixels: household
things of 6 cm and more stray by :data:`~sq_perception.fitting.options.MODEL_ERROR`, and no more."""
_NOISE_ALONE = 1.06
"""Mean squared residual up to which a thing is taken for a superquadric.  19 in 20 superquadrics under independent
noise left less.  Things that left more got worse bodies from the exact course; under a time-of-flight camera, which
mixes depths at edges, nearly all do."""
_AS_A_THING = 0.5
"""Weight of the tolerant course's body as an alternative to an exact one: a thing that a superquadric explains may
stray from one where nothing was seen, or by less than the noise.  Chosen: on 217 things of benchmarks/household_things
(60 scenes from seed 54200 on) under 10 mm of noise, 11 % of the half sizes of converged bodies erred by more than three
standard deviations, with this weight 3 %."""


def fit(
    depth: np.ndarray,
    mask: np.ndarray,
    camera: Camera,
    *,
    start: Superquadric | Literal["auto"] | Sequence[Superquadric] | Callable[[], Superquadric] = "auto",
    options: FitOptions | None = None,
) -> Fit:
    """The superquadric that explains the masked pixels of a depth image, and contradicts none beside them.

    Parameters
    ----------
    depth : float (height, width)
        z in the optical frame, metres; NaN, infinite or (pinhole) not positive where nothing was measured.
    mask : bool (height, width)
        Pixels of the object.
    camera : Camera
    start : "auto", one body, a batch of bodies or a sequence of bodies, in the optical frame
        Where to begin.  A function that returns starts, meant for those that cost time, is not called where the
        cheapest automatic ones explain the image down to a fine noise.
    options : FitOptions

    Returns
    -------
    Fit
        Hard images give status FAILED with a best-effort box.  The body is always finite; the covariance of a failed
        fit, and of one that the time budget ended far above the noise, may be NaN.

    Raises
    ------
    ValueError
        For images of another size than the camera's, a mask that is not boolean, starts that are not finite, or an
        object without a single measured pixel.
    """
    began = time.perf_counter()
    options = options or FitOptions()
    depth, mask = _checked_images(depth, mask, camera)
    later = cache(lambda: _checked_starts(start())) if callable(start) else None
    given = [] if callable(start) else _checked_starts(start)
    crop = Crop.around(depth, mask, camera, options.noise)
    if crop is None:
        raise ValueError("the mask holds no pixel with a depth: there is nothing to fit")
    task = _Task(depth, mask, camera, crop, options, given, later, began)
    solution = _undecided(task) if options.model_error is None else _solved(task, options)
    if solution is None:
        observation = task.observed(options)
        body = starts.enclosing_box(observation.points, observation.footprint)
        return failed(body, observation, _hopeless(observation), began)
    return assessed(solution, began)


@dataclass(frozen=True, eq=False)
class _Task:
    """An object to fit, and what the choice of its course depends on.

    Attributes
    ----------
    depth, mask, camera
    crop
        The part of these images that is near the object.
    options
    given, later
        The caller's starts; ``later`` returns those that cost time.
    began
        When the fit began, by :func:`time.perf_counter`.
    """

    depth: np.ndarray
    mask: np.ndarray
    camera: Camera
    crop: Crop
    options: FitOptions
    given: list[State]
    later: Callable[[], list[State]] | None
    began: float

    def starts(self) -> list[State]:
        return self.given if self.later is None else self.later()

    def is_thing(self) -> bool:
        """Whether more is known of the object than its pixels: it stands on something, or its hull is predicted."""
        if self.options.plane is not None:
            return True
        return not self.fills_image and self.options.predicted_hull() is not None

    @cached_property
    def model_error(self) -> float:
        """How far the object strays from a superquadric if it is a thing, metres."""
        return min(MODEL_ERROR, _MODEL_SHARE * self.crop.footprint * math.sqrt(np.count_nonzero(self.crop.mask)))

    @property
    def of_things(self) -> FitOptions:
        """The options for a thing."""
        return replace(self.options, model_error=self.model_error)

    @property
    def is_fine(self) -> bool:
        """Whether the noise is too small to hide how far things stray."""
        return self.crop.noise.sigma < _FINE_NOISE * self.model_error

    @property
    def may_stray(self) -> bool:
        """Whether the object may be a thing though the caller does not say so, as most objects before a camera are."""
        return self.camera.is_pinhole and not self.is_fine and not self.fills_image

    @cached_property
    def fills_image(self) -> bool:
        """Whether the object is all that was measured, as the unit cube's bodies and walls before a camera are."""
        return fills(box(self.mask), np.isfinite(self.depth) & (self.depth > 0))

    def observed(self, options: FitOptions) -> Observation:
        return self.crop.observed(options.model_error or 0.0, options.nan_is_empty, options.plane)


def _undecided(task: _Task) -> Solution | None:
    """The solution by the course that explains the object, see the module; None if no body can be fitted to it."""
    options = task.options
    exact_first = task.later is not None if options.plane is None else task.is_fine
    if exact_first:
        exactly = _exactly(task, task.given, task.later)
        if exactly is not None and not (task.may_stray or (task.camera.is_pinhole and task.is_thing())):
            return exactly
        if (thing := _as_thing(exactly)) is not None:
            strayed = _solved(task, task.of_things) if task.is_thing() else None
            return thing if strayed is None else _or_else(thing, strayed.state)
    if not task.is_thing():
        solution = _solved(task, options)
        if solution is not None and task.may_stray:
            return _as_thing(solution) or _strayed(task, solution)
        return solution
    # Tolerant first, without a plane too: an exact search from all starts takes six times as long and gains nothing
    # (benchmarks/ablation, "no plane, exactly") but 0.3 % of IoU where things are noisy superquadrics.
    solution = _solved(task, task.of_things)
    was_tried = options.plane is not None and task.is_fine
    if solution is None or was_tried or not _is_explained(solution, task.crop.noise.sigma):
        return solution
    exactly = _as_thing(_exactly(task, [solution.state, *task.starts()], None))
    return solution if exactly is None else _or_else(exactly, solution.state)


def _solved(task: _Task, options: FitOptions) -> Solution | None:
    """The solution by the course for the model error of the options; None if no body can be fitted."""
    observation = task.observed(options)
    if _hopeless(observation):
        return None
    course = tolerant if options.model_error else exact
    return course.solve(Problem.of(observation, options, task.began), task.starts())


def _exactly(task: _Task, given: list[State], later: Callable[[], list[State]] | None) -> Solution | None:
    """The exact solution that explains the image down to its noise; None if a cheap search finds none."""
    options = replace(task.options, model_error=0.0)
    observation = task.observed(options)
    if _hopeless(observation):
        return None
    return exact.solve_cheaply(Problem.of(observation, options, task.began), given, later)


def _as_thing(exactly: Solution | None) -> Solution | None:
    """The exact solution with the standard deviations of things; None if it leaves more than the noise."""
    if exactly is None or exactly.state.cost >= _NOISE_ALONE * exactly.rays.weight:
        return None
    return replace(exactly, spread_factor=tolerant.SPREAD)


def _strayed(task: _Task, exactly: Solution) -> Solution:
    """The tolerant solution for an object of which the exact course left more than the noise."""
    problem = exactly.problem
    if problem.independent is not None or problem.late:  # the tolerant course was reached already, or time is up
        return replace(exactly, spread_factor=tolerant.SPREAD)
    options = task.of_things
    strayed = replace(Problem.of(task.observed(options), options, 0.0), deadline=problem.deadline)
    return tolerant.solve(strayed, [exactly.state, *task.starts()])


def _is_explained(solution: Solution, noise: float) -> bool:
    """Whether a tolerant solution leaves less than the noise, so that an exact one may exist."""
    return deviation(np.abs(solution.distances)) < noise


def _or_else(exactly: Solution, thing: State) -> Solution:
    """The exact solution, with the tolerant course's body as another one that the image allows."""
    return replace(exactly, alternatives=(*exactly.alternatives, Alternative(thing, _AS_A_THING)))


def warm_up() -> None:
    """Compile, or load from disk, every kernel of the fit by running it once on a small synthetic scene."""
    body = Superquadric([0.05, 0.04, 0.03], [0.5, 0.5], [0.0, 0.0, 0.5], [0.3, 0.2, 0.1, 0.9])
    plane = np.array([0.0, 0.0, -1.0, 0.7])
    reach = DIRECTIONS @ body.translation + body.support(DIRECTIONS)
    hull = HullPrior(DIRECTIONS, reach, 1e-5 * np.eye(len(reach)), 0.1)
    cameras = (Camera(48, 48, 60.0, 60.0, 23.5, 23.5), Camera(48, 48, 200.0, 200.0, 23.5, 23.5, "orthographic"))
    for camera in cameras:
        rendered, _ = raycast.render(body, camera)
        mask = np.isfinite(rendered)
        depth = np.where(mask, rendered, 0.7).astype(np.float32)
        fit(depth, mask, camera)
        fit(depth, mask, camera, options=FitOptions(plane=plane))
        fit(depth, mask, camera, options=FitOptions(plane=plane, model_error=0.0025, hull=hull))
        fit(depth, mask, camera, start=body)


def _checked_images(depth: np.ndarray, mask: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    depth, mask = camera.readings(depth), np.asarray(mask)
    if mask.shape != depth.shape or mask.dtype != bool:
        raise ValueError(f"mask: expected a bool image of shape {depth.shape}, got {mask.dtype} {mask.shape}")
    return depth, mask


def _checked_starts(start: Superquadric | Literal["auto"] | Iterable[Superquadric]) -> list[State]:
    if isinstance(start, str) and start == "auto":
        return []
    is_one = isinstance(start, Superquadric) and not start.batch_shape
    is_several = isinstance(start, Iterable) and not isinstance(start, str) and not is_one
    states = []
    for body in start if is_several else [start]:
        if not isinstance(body, Superquadric) or body.batch_shape:
            raise ValueError(f"start: expected 'auto' or single superquadrics, got {body!r}")
        states.append(State.of(Superquadric.from_flat(np.asarray(body.to_numbers(), dtype=float))))
    return states


def _hopeless(observation: Observation) -> str:
    """Why no body can be fitted to these pixels; empty if one can."""
    count = len(observation.pixels)
    if count < MIN_PIXELS:
        return f"{count} pixels with a depth; a fit needs {MIN_PIXELS}"
    return "the measured points lie on one line" if starts.on_one_line(observation.points) else ""
