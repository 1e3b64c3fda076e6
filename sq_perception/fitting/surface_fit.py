"""The fit of one superquadric to one object of a depth image.

Residuals run along the true rays of the pixels, so that one code serves orthographic and pinhole cameras: the object's
pixels pull the surface onto what they measured, the pixels beside the object keep the body out of the space they saw to
be empty.  docs/surface_fit.md derives the cost; :mod:`sq_perception.fitting.course` has its two models of an object,
:mod:`sq_perception.fitting.valleys` what other bodies the image allows.

Which model
-----------
If a model error is given, it decides: a superquadric for 0, a thing otherwise.  If none is given, both are held to be
equally probable, as far as the image does not tell:

- An object that stands on a plane, or whose hull is predicted, is fitted as a thing.  If that leaves less than the
  noise, or the noise is too fine to hide anything, a superquadric is sought from there.  One that leaves no more than
  the noise and no half size open is the result, the thing's body another one that the image allows.
- Any other is fitted as a superquadric, and as a thing where that leaves more than the noise; the thing strays by what
  it left.

What a camera sees has the standard deviations of things, whichever model its body is of.

Frames and units: optical frame, metres, radians.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Literal

import numpy as np

from sq_perception.fitting import course, starts, valleys
from sq_perception.fitting.fit import Fit
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.multistart import Problem, Solution
from sq_perception.fitting.observation import Crop, Observation
from sq_perception.fitting.options import MODEL_ERROR, FitOptions, check_plane
from sq_perception.fitting.priors import HullPrior
from sq_perception.fitting.quality import WEAK_SHARE, Alternative, assess, fail
from sq_perception.geometry.quantiles import deviation
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.geometry.union import DIRECTIONS
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera
from sq_perception.imaging.regions import box, fills

__all__ = ["FitOptions", "fit", "warm_up"]

_FINE_NOISE = 0.1
"""Noise, as a share of how far things stray from superquadrics, below which a superquadric is sought too: a thing's
body may then leave more than the noise even of a true superquadric.  Under more noise it left 0.5 to 0.8 of it on
true superquadrics, and 1.2 and more on things of benchmarks/household_things."""
_MODEL_SHARE = 0.04
"""How far a small thing may stray, as a share of the side of a square whose area is that of its pixels: household
things of 6 cm and more stray by :data:`~sq_perception.fitting.options.MODEL_ERROR`, and no more."""
_NOISE_ALONE = 1.09
"""Mean squared residual up to which a thing is taken for a superquadric: noise alone, which is known to 4 % where lines
are missing.  Things that left more got worse bodies as superquadrics; under a time-of-flight camera, which mixes depths
at edges, nearly all do."""
_UNFINISHED = 1.06
"""Mean squared residual up to which a search that the time budget ended has come near the noise: bodies above it
typically err by 5 to 40 standard deviations."""
_AS_A_THING = 0.5
"""Weight of the thing's body as an alternative to the superquadric: a thing that a superquadric explains may
stray from one where nothing was seen, or by less than the noise.  Without it, one in nine of the half sizes of
converged bodies errs by more than three standard deviations under 10 mm of noise."""


def fit(
    depth: np.ndarray, mask: np.ndarray, camera: Camera, *,
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
    depth, mask = _check_images(depth, mask, camera)
    later = cache(lambda: _read_starts(start())) if callable(start) else None
    given = [] if callable(start) else _read_starts(start)
    crop = Crop.around(depth, mask, camera, options.noise)
    if crop is None:
        raise ValueError("the mask holds no pixel with a depth: there is nothing to fit")
    fills_image = fills(box(mask), np.isfinite(depth) & (depth > 0))
    task = _Task(crop, fills_image, options, given, later, began)
    solution = _solve(task)
    if solution is None:
        observation = crop.observe(options.model_error or 0.0, options.nan_is_empty, options.plane)
        return fail(observation.points, observation.footprint, observation.sigma, _why_not(observation), began)
    return assess(solution, began)


@dataclass(frozen=True, eq=False)
class _Task:
    """An object to fit: the image near it, and whether it is all that was measured, as the unit cube's bodies and walls
    before a camera are; the caller's starts, ``later`` those that cost time; when the fit began."""

    crop: Crop
    fills_image: bool
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
        return self.crop.camera.is_pinhole and not self.fills_image and self.options.predicted_hull() is not None

    @cached_property
    def model_error(self) -> float:
        """How far the object strays from a superquadric if it is a thing, metres."""
        return min(MODEL_ERROR, _MODEL_SHARE * self.crop.footprint * math.sqrt(np.count_nonzero(self.crop.mask)))

    @property
    def is_fine(self) -> bool:
        """Whether the noise is too small to hide how far things stray."""
        return self.crop.noise.sigma < _FINE_NOISE * self.model_error

    def problem(self, model_error: float) -> Problem | None:
        """The problem of an object that strays so far; None if no body can be fitted to it."""
        observation = self.crop.observe(model_error, self.options.nan_is_empty, self.options.plane)
        if _why_not(observation):
            return None
        check_plane(observation.points, self.options.plane)
        return course.problem_of(observation, self.options, self.began + self.options.time_budget)


def _solve(task: _Task) -> Solution | None:
    """The solution by the model that the image prefers, see the module; None if no body can be fitted to it."""
    given = task.options.model_error
    if given is not None:
        return _fit_thing(task, given, task.starts()) if given else _fit_superquadric(task, [])
    if task.is_thing():
        thing = _fit_thing(task, task.model_error, task.starts())
        if thing is None or thing.problem.late or not (task.is_fine or _is_explained(thing, task.crop.noise.sigma)):
            return thing
        exactly = _fit_superquadric(task, [thing.state], patient=False)
        if exactly is None or exactly.misfit >= _NOISE_ALONE or exactly.unsure().max() > WEAK_SHARE:
            return thing
        more = (*exactly.alternatives, Alternative(thing.state, _AS_A_THING))
        return exactly.annotate(alternatives=more, spread_factor=course.SPREAD)
    exactly = _fit_superquadric(task, [])
    if exactly is None or exactly.problem.late:
        return exactly
    may_stray = task.crop.camera.is_pinhole and not task.is_fine and not task.fills_image
    if exactly.misfit < (_NOISE_ALONE if may_stray else course.EXPLAINS):
        return exactly.annotate(spread_factor=course.SPREAD) if may_stray else exactly
    left = deviation(np.abs(exactly.distances))
    return _fit_thing(task, task.model_error if may_stray else left, [exactly.state, *task.starts()])


def _fit_thing(task: _Task, model_error: float, starts_: list[State]) -> Solution | None:
    """The most probable body of a thing, from given bodies and boxes."""
    problem = task.problem(model_error)
    if problem is None:
        return None
    points, plane = problem.observation.points, task.options.plane
    boxes = starts.principal(points) if plane is None else starts.on_plane(points, plane)
    solution = course.fit_thing(problem, [*starts_, *boxes])
    if not solution.problem.has_hull and not problem.late:
        solution = valleys.add_oval(valleys.weigh_open_sizes(solution))
    return solution if problem.late else valleys.lengthen_open_ends(solution)


def _fit_superquadric(task: _Task, first: list[State], patient: bool = True) -> Solution | None:
    """The best superquadric; if not ``patient``, None where its cheapest starts explain the image not."""
    problem = task.problem(0.0)
    if problem is None:
        return None
    observation = problem.observation
    groups: list[Callable[[], Sequence[State]]] = [lambda: [*first, *task.given]]
    symmetric = starts.groups(observation)
    groups.append(lambda: next(symmetric))
    if task.later is not None:
        groups.append(task.later)
    if patient:
        groups += [lambda: next(symmetric, [])] * 4
    solution = course.fit_superquadric(problem, groups, patient)
    if solution is None:
        return None
    for step in (valleys.explore, valleys.weigh_depths, valleys.lengthen_open_ends, valleys.weigh_open_sizes):
        if solution.problem.late or solution.misfit > course.EXPLAINS:
            break
        solution = step(solution)
    return solution.annotate(is_unfinished=solution.problem.late and solution.misfit > _UNFINISHED)


def _is_explained(solution: Solution, noise: float) -> bool:
    """Return whether a thing's body leaves less than the noise, so that a superquadric may explain the image."""
    return deviation(np.abs(solution.distances)) < noise


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


def _check_images(depth: np.ndarray, mask: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    depth, mask = camera.readings(depth), np.asarray(mask)
    if mask.shape != depth.shape or mask.dtype != bool:
        raise ValueError(f"mask: expected a bool image of shape {depth.shape}, got {mask.dtype} {mask.shape}")
    return depth, mask


def _read_starts(start: Superquadric | Literal["auto"] | Iterable[Superquadric]) -> list[State]:
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


def _why_not(observation: Observation) -> str:
    return starts.reason_to_fail(observation.points, len(observation.pixels), "pixels with a depth")
