"""The fit of one superquadric to one object of a depth image.

Residuals run along the true rays of the pixels, so that one code serves orthographic and pinhole cameras: the object's
pixels pull the surface onto what they measured, the pixels beside the object keep the body out of the space they saw to
be empty.  docs/surface_fit.md derives the cost, :mod:`sq_perception.fitting.multistart` states it for an object and
searches, :mod:`sq_perception.fitting.valleys` tells what other bodies the image allows.

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

How much a thing misfits is estimated with its body: with c the mean loss of its rays it counts as INDEPENDENT / max(1,
c / EXPLAINED) of them, since the likelihood maximised over an unknown variance divides by the variance found.  For the
covariance they count as fewer by the same factor once more: larger errors extend over larger parts, such as a neck, a
spout or a dent.

The outline
-----------
Free rays beside the mask show where a body ends.  If the mask lost its edge (sensors lose what they see at grazing
angles), the body covers pixels that were taken for free all around it: those are left out.  What the body then still
covers tells the outline's standard deviation.

Frames and units: optical frame, metres, radians.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Literal

import numpy as np

from sq_perception.fitting import starts, valleys
from sq_perception.fitting.cost import SAMPLE, Rays
from sq_perception.fitting.fit import INLIER, Fit
from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.multistart import (
    FINAL_TOLERANCE,
    HUBER,
    SLACK,
    SUPERQUADRIC,
    THING,
    Problem,
    Solution,
    by_cost,
    within_doubt,
)
from sq_perception.fitting.observation import BAND_PIXELS, Crop, Observation
from sq_perception.fitting.options import MODEL_ERROR, FitOptions, check_plane
from sq_perception.fitting.priors import HullPrior
from sq_perception.fitting.quality import WEAK_SHARE, Alternative, assess, fail
from sq_perception.fitting.residuals import mean_loss, penetration
from sq_perception.geometry.quantiles import deviation, quantile
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
_NOISE_ALONE = 1.09
"""Mean squared residual up to which a thing is taken for a superquadric: noise alone, which is known to 4 % where lines
are missing.  Things that left more got worse bodies as superquadrics; under a time-of-flight camera, which mixes depths
at edges, nearly all do."""
EXPLAINS = 1.4
"""Mean squared residual up to which a body explains an image: 1, but for a sample of few rays and a search that is
not finished.  Chosen on benchmarks/single_body."""
_EXPLAINED = 0.5
"""Mean loss up to which a thing counts as INDEPENDENT rays: what cartons and cans leave."""
SPREAD = 2.5**2
"""Factor of the covariance of what a camera saw where no hull is predicted: errors of residuals are alike."""
_FINAL_RAYS, _MOST_FINAL_RAYS = 3000, 6000
"""Object rays of the last stage, and most of them under much noise: a depth error of a third of a pixel's width
averages out to a two hundredth.  Chosen on benchmarks/single_body."""
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
    depth, mask = camera.readings(depth), np.asarray(mask)
    if mask.shape != depth.shape or mask.dtype != bool:
        raise ValueError(f"mask: expected a bool image of shape {depth.shape}, got {mask.dtype} {mask.shape}")
    later = cache(lambda: _read_starts(start())) if callable(start) else None
    given = [] if callable(start) else _read_starts(start)
    crop = Crop.around(depth, mask, camera, options.noise)
    if crop is None:
        raise ValueError("the mask holds no pixel with a depth: there is nothing to fit")
    task = _Task(crop, fills(box(mask), np.isfinite(depth) & (depth > 0)), options, given, later, began)
    if (solution := _solve(task)) is None:
        observation = crop.observe(options.model_error or 0.0, options.nan_is_empty, options.plane)
        return fail(observation.points, observation.footprint, observation.sigma, _why_not(observation), began)
    return assess(solution, began)


@dataclass(frozen=True, eq=False)
class _Task:
    """An object to fit: the image near it, and whether it fills that, as the unit cube's bodies and walls before a
    camera do; the caller's starts, ``later`` those that cost time; when the fit began."""

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
        """How far the object strays from a superquadric if it is a thing, metres.

        Household things of 6 cm and more stray by no more than ``MODEL_ERROR``, small ones by a share of the side of a
        square whose area is that of their pixels.
        """
        return min(MODEL_ERROR, 0.04 * self.crop.footprint * math.sqrt(np.count_nonzero(self.crop.mask)))

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
        return Problem.of(observation, self.options, self.began + self.options.time_budget)


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
        return exactly.annotate(alternatives=more, spread_factor=SPREAD)
    exactly = _fit_superquadric(task, [])
    if exactly is None or exactly.problem.late:
        return exactly
    may_stray = task.crop.camera.is_pinhole and not task.is_fine and not task.fills_image
    if exactly.misfit < (_NOISE_ALONE if may_stray else EXPLAINS):
        return exactly.annotate(spread_factor=SPREAD) if may_stray else exactly
    left = deviation(np.abs(exactly.distances))
    return _fit_thing(task, task.model_error if may_stray else left, [exactly.state, *task.starts()])


def _fit_thing(task: _Task, model_error: float, starts_: list[State]) -> Solution | None:
    """The most probable body of a thing, its misfit estimated with it, from given bodies and boxes."""
    problem = task.problem(model_error)
    if problem is None:
        return None
    points, plane = problem.observation.points, task.options.plane
    boxes = starts.principal(points) if plane is None else starts.on_plane(points, plane)
    found = problem.straight().search([*starts_, *boxes], THING)
    misfit = max(1.0, _mean_loss(problem, found[0]) / _EXPLAINED)
    if misfit > 1.0 and problem.has_hull:
        problem = replace(problem, independent=(problem.independent or 0.0) / misfit)
        found = found if problem.late else problem.search(found, THING[1:])
    rays = problem.draw(task.options.pixels or SAMPLE, 0.3)
    state = problem.descend(found[0], rays, 30)
    solution = Solution(problem, state, rays, spread_factor=1.0 if problem.has_hull else SPREAD)
    if problem.has_hull and not problem.late:
        solution = _straighten(solution)
    left = _mean_loss(problem, solution.state)
    solution = replace(solution, rays=rays.scale(1 / max(1.0, left / _EXPLAINED)))
    # As far off as noise reaches at most: points of a bowl or a pair of pliers typically are.
    if left > HUBER * (2 * INLIER - HUBER):
        solution = solution.annotate(notes=("like the convex hull of the object",), as_hull=True)
    if not problem.has_hull and not problem.late:
        solution = valleys.add_oval(valleys.weigh_open_sizes(solution))
    return solution if problem.late else valleys.lengthen_open_ends(solution)


def _straighten(solution: Solution) -> Solution:
    """The solution without a taper that hardly lowers its cost."""
    straight = solution.problem.straight()
    state = straight.descend(solution.state, solution.rays, 30)
    is_as_good = state.cost < solution.state.cost + SLACK
    return replace(solution, problem=straight, state=state) if is_as_good else solution


def _mean_loss(problem: Problem, body: State) -> float:
    """Mean loss of the object's rays: c of the module."""
    return mean_loss(problem.observation.sample, problem.terms.huber, body.parameters, body.rotation)


def _fit_superquadric(task: _Task, first: list[State], patient: bool = True) -> Solution | None:
    """The best superquadric from groups of starts, as many as it takes to explain the image; where none does the
    nearest one, or None if not ``patient``: then only the cheapest are tried."""
    problem = task.problem(0.0)
    if problem is None:
        return None
    enough = EXPLAINS * problem.floor(SUPERQUADRIC[-1].rays)
    finalists: list[State] = []
    for group in filter(None, _groups(task, first, problem.observation, patient)):
        finalists = within_doubt([*finalists, *problem.search(group, SUPERQUADRIC)])[: SUPERQUADRIC[-1].kept]
        if problem.late or finalists[0].cost < enough:
            solution = _finish(problem, finalists)
            break
    else:
        return Solution(problem, finalists[0], problem.draw(SAMPLE, 0.3)) if patient else None
    for step in (valleys.explore, valleys.weigh_depths, valleys.lengthen_open_ends, valleys.weigh_open_sizes):
        if solution.problem.late or solution.misfit > EXPLAINS:
            break
        solution = step(solution)
    return solution.annotate(is_unfinished=solution.problem.late and solution.misfit > _UNFINISHED)


def _groups(task: _Task, first: list[State], observation: Observation, patient: bool) -> Iterator[list[State]]:
    """Groups of starts of a superquadric, the cheapest first."""
    yield [*first, *task.given]
    symmetric = starts.groups(observation)
    yield next(symmetric)
    if task.later is not None:
        yield task.later()
    if patient:
        yield from symmetric


def _finish(problem: Problem, finalists: Sequence[State]) -> Solution:
    """The best of the finalists on all rays, enough that the noise of their mean is well below a pixel's width; the
    precision of the outline is read from the misfit of their favourite."""
    favourite, *others = finalists
    if not problem.late:
        problem, favourite = drop_lost_edge(problem, favourite)
    # The fewest rays average out a noise of 0.3 pixel widths; their number grows with its square.
    ratio = problem.observation.sigma / (0.3 * problem.observation.footprint)
    enough = int(np.clip(_FINAL_RAYS * ratio**2, _FINAL_RAYS, _MOST_FINAL_RAYS))
    rays = problem.draw(problem.options.pixels or enough, 0.3)
    few = problem.draw(enough // 4, 0.3)
    problem, favourite = sharpen_outline(problem, favourite, rays.free, few)
    settled = by_cost(problem.descend(state, few) for state in [favourite, *others])
    # Few rays do not tell these apart.
    near = [state for state in settled if state.cost <= settled[0].cost + SLACK]
    refined = by_cost(problem.refine(state, rays) for state in (near[:1] if problem.late else near))
    return Solution(problem, refined[0], rays)


def _is_explained(thing: Solution, noise: float) -> bool:
    """Whether a thing's body leaves less than the noise, so that a superquadric may explain the image."""
    return deviation(np.abs(thing.distances)) < noise


def warm_up() -> None:
    """Compile, or load from disk, every kernel of the fit."""
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


# The outline of a superquadric


def drop_lost_edge(problem: Problem, state: State) -> tuple[Problem, State]:
    """Forget the free rays next to the mask if the mask turns out to be smaller than the body."""
    full = problem.observation
    if not _covers(problem, state, full.ring(1)):
        return problem, state
    problem = replace(problem, observation=full.beyond(BAND_PIXELS))
    state = problem.descend(state, problem.draw(_FINAL_RAYS, 0.6), tolerance=FINAL_TOLERANCE)
    rings = (k for k in range(1, BAND_PIXELS + 1) if not _covers(problem, state, full.ring(k)))
    band = next(rings, BAND_PIXELS + 1) - 1
    return replace(problem, observation=full.beyond(band) if band > 0 else full), state


def sharpen_outline(problem: Problem, state: State, free: np.ndarray, rays: Rays) -> tuple[Problem, State]:
    """Estimate the outline's precision from a body's misfit to free rays, and again from the better body it allows.

    It does not fall below a pixel: else pixels that miss a body would cost next to nothing, and it might leave them.
    """
    sigma, before = _outline_sigma(problem, state, free), math.inf
    while True:
        sigma = min(sigma, problem.observation.footprint)
        if not sigma < 0.7 * before or problem.late:  # so that it ends for any sigma
            return problem, state
        problem = problem.with_terms(outline_stiffness=1 / sigma)
        state = problem.descend(state, rays)
        before, sigma = sigma, _outline_sigma(problem, state, free)


def _covers(problem: Problem, state: State, pixels: np.ndarray) -> bool:
    """Whether the body covers half of these free pixels a quarter of a pixel deep, and so is larger than its mask.

    Half: a body that is merely too long covers those around the mask on one side only.
    """
    rays = problem.observation.free_rays_of(pixels)
    depth = penetration(rays, problem.terms, state.parameters, state.rotation)
    return len(rays) > 0 and quantile(depth, 0.5) >= 0.25 * problem.observation.footprint


def _outline_sigma(problem: Problem, state: State, free: np.ndarray) -> float:
    """Standard deviation of the outline, metres, from how far the body reaches into free rays beside the mask."""
    # A perfect one covers exactly the centres of the mask's pixels: a uniform error of up to half a pixel.
    sharp = 0.3 * problem.observation.footprint
    if len(free) == 0:
        return sharp
    depth = penetration(free, problem.terms, state.parameters, state.rotation)
    reached = depth[depth > 0]
    return max(sharp, float(np.sqrt(np.mean(reached**2)))) if len(reached) else sharp


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
