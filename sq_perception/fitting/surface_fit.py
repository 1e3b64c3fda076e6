"""The exact fit of one superquadric to one object of a depth image.

Residuals run along the true rays of the pixels, so that one code serves orthographic and pinhole cameras: the object's
pixels pull the surface onto what they measured, the pixels beside it keep the body out of the space they saw to be
empty.  See :mod:`sq_perception.fitting.residuals` for the equations, :mod:`sq_perception.fitting.problem` for a fit as
data, :mod:`sq_perception.fitting.exact` and :mod:`sq_perception.fitting.tolerant` for its two courses, and
:mod:`sq_perception.fitting.quality` for the status and accuracy of the result.

Frames and units: optical frame, metres, radians.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cache
from typing import Literal

import numpy as np

from sq_perception.fitting import exact, starts, tolerant
from sq_perception.fitting.covariance import Alternative
from sq_perception.fitting.depth_noise import MEDIAN_TO_SIGMA
from sq_perception.fitting.fit import Fit
from sq_perception.fitting.hull_prior import HullPrior
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.observation import Crop, Observation
from sq_perception.fitting.options import MIN_PIXELS, MODEL_ERROR, FitOptions
from sq_perception.fitting.problem import Problem, Solution
from sq_perception.fitting.quality import assessed, failed
from sq_perception.geometry.quantiles import quantile
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.geometry.support_directions import DIRECTIONS
from sq_perception.imaging import raycast
from sq_perception.imaging.camera import Camera
from sq_perception.imaging.regions import box, fills

__all__ = ["FitOptions", "fit", "warm_up"]

_FINE_NOISE = 0.1
"""Of what things stray from superquadrics: under less noise the exact course goes first, as what the tolerant one
leaves of a true superquadric may then be more than the noise.  Under more, true superquadrics were left 0.5 to 0.8 of
it, and things of benchmarks/household_things 1.2 and more."""
_MODEL_SHARE = 0.04
"""How far a small thing may stray, as a share of the side of a square as large as what is seen of it: of 6 cm and more
things of a household stray by :data:`~sq_perception.fitting.options.MODEL_ERROR`, and no more."""
_NOISE_ALONE = 1.06
"""Mean squared residual up to which a thing is taken for a superquadric.  19 in 20 superquadrics under independent
noise left less.  Things that left more were worse by the exact course; of a time-of-flight camera, whose edges mix,
nearly all do."""
_AS_A_THING = 0.5
"""Weight of the tolerant course's body beside an exact one: noise that a superquadric explains hides how a thing strays
from one.  Chosen; of 217 things of benchmarks/household_things (60 scenes from seed 54200 on) under 10 mm of noise 11 %
of the half sizes of converged bodies erred by more than three deviations, with it 3 %."""


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
        Where to begin.  A function that returns them is not called where the cheapest automatic starts explain the
        image down to a fine noise: for starts that cost time.
    options : FitOptions

    Returns
    -------
    Fit
        Hard images give status FAILED with a best-effort box.  The body is always finite; the covariance of a failed
        fit, and of one that time ended far above the noise, may be NaN.

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
    undecided = options.model_error is None
    model_error = min(MODEL_ERROR, _MODEL_SHARE * crop.footprint * math.sqrt(np.count_nonzero(crop.mask)))
    fine = crop.noise.sigma < _FINE_NOISE * model_error
    # Who calls may know no plane and no hull, and what a camera measured is mostly a thing all the same.
    is_doubtful = camera.is_pinhole and not fine and not _fills(mask, depth)
    if undecided and (later is not None if options.plane is None else fine):
        exactly = _exactly(crop, options, given, later, began)
        if exactly is not None and not (is_doubtful or (camera.is_pinhole and _is_thing(mask, depth, options))):
            return assessed(exactly, began)
        if (thing := _as_thing(exactly)) is not None:
            return assessed(thing, began)
    is_thing = undecided and _is_thing(mask, depth, options)
    if is_thing:
        # Also without a plane: to look for a superquadric from everywhere first takes six times as long, and gains none
        # (benchmarks/ablation, "no plane, exactly") but 0.3 % of IoU where things are noisy superquadrics.
        options = replace(options, model_error=model_error)
    observation = crop.observed(options.model_error or 0.0, options.nan_is_empty, options.plane)
    reason = _hopeless(observation)
    if reason:
        body = starts.enclosing_box(observation.points, observation.footprint)
        return failed(body, observation, reason, began)
    course = tolerant if options.model_error else exact
    given = given if later is None else later()
    solution = course.solve(Problem.of(observation, options, began), given)
    if undecided and course is exact and is_doubtful:
        solution = _as_thing(solution) or _strayed(crop, replace(options, model_error=model_error), solution, given)
    untried = options.plane is None or not fine
    if is_thing and untried and _is_explained(solution, crop.noise.sigma):
        exactly = _as_thing(_exactly(crop, options, [solution.state, *given], None, began))
        solution = solution if exactly is None else _or_else(exactly, solution.state)
    return assessed(solution, began)


def _is_thing(mask: np.ndarray, depth: np.ndarray, options: FitOptions) -> bool:
    """Whether more is known of the object than its pixels: it stands on something, or its hull is predicted."""
    if options.plane is not None:
        return True
    return not _fills(mask, depth) and options.predicted_hull() is not None


def _fills(mask: np.ndarray, depth: np.ndarray) -> bool:
    """Whether the object fills what was measured, as the unit cube's bodies and walls before a camera do."""
    return fills(box(mask), np.isfinite(depth) & (depth > 0))


def _strayed(crop: Crop, options: FitOptions, exactly: Solution, given: list[State]) -> Solution:
    """What the tolerant course makes of an object of which the exact one left more than the noise."""
    problem = exactly.problem
    if exactly.spread_factor > 1 or problem.late:  # it is of that course already
        return replace(exactly, spread_factor=tolerant.SPREAD)
    observation = crop.observed(options.model_error or 0.0, options.nan_is_empty, options.plane)
    strayed = replace(Problem.of(observation, options, 0.0), deadline=problem.deadline)
    return tolerant.solve(strayed, [exactly.state, *given])


def _as_thing(exactly: Solution | None) -> Solution | None:
    """What the exact course found of a thing, with the deviations of things; None if it leaves more than the noise."""
    if exactly is None or exactly.state.cost >= _NOISE_ALONE * exactly.rays.weight:
        return None
    return replace(exactly, spread_factor=tolerant.SPREAD)


def _or_else(exactly: Solution, thing: State) -> Solution:
    """The same, with what the tolerant course makes of it as another body that the image allows."""
    return replace(exactly, alternatives=(*exactly.alternatives, Alternative(thing, _AS_A_THING)))


def _exactly(
    crop: Crop, options: FitOptions, given: list[State], later: Callable[[], list[State]] | None, began: float
) -> Solution | None:
    """The body that explains the image down to its noise, if one is cheaply found."""
    trusted = crop.observed(0.0, options.nan_is_empty, options.plane)
    if _hopeless(trusted):
        return None
    return exact.solve_cheaply(Problem.of(trusted, replace(options, model_error=0.0), began), given, later)


def _is_explained(solution: Solution, noise: float) -> bool:
    """Whether a body of the tolerant course leaves no more than the noise, so that an exact one may be there."""
    return MEDIAN_TO_SIGMA * quantile(np.abs(solution.distances), 0.5) < noise


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
        states.append(State.of(Superquadric.from_flat(np.asarray(body.to_flat(), dtype=float))))
    return states


def _hopeless(observation: Observation) -> str:
    """Why no body can be fitted to these pixels; empty if one can."""
    count = len(observation.pixels)
    if count < MIN_PIXELS:
        return f"{count} pixels with a depth; a fit needs {MIN_PIXELS}"
    return "the measured points lie on one line" if starts.on_one_line(observation.points) else ""
