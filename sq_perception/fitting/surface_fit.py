"""The exact fit of one superquadric to one object of a depth image.

Course
------
1. Starts, cheap ones first: given bodies, central symmetry, boxes on the support plane.
2. A few Levenberg-Marquardt steps on the Sampson residual and free space from every start, on some 150 rays: the wide
   basin.  More starts only while the best residual stays above the noise floor.
3. The best few again on more rays, then on the rendered depth residual with the full budget of rays: the exact answer.
4. Noise, inliers, covariance (J^T J)^-1 times the residual variance, and a verdict in words.

Frames, units and residuals as in :mod:`sq_perception.fitting.residuals`: optical frame, metres, one code for orthographic
and pinhole cameras.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from sq_perception.fitting import box_start, symmetry_start, uncertainty
from sq_perception.fitting.bounds import Bounds
from sq_perception.fitting.fit import Fit
from sq_perception.fitting.levenberg_marquardt import State, minimize
from sq_perception.fitting.observation import Observation, draw, observe
from sq_perception.fitting.residuals import RENDERED, SAMPSON, Scene
from sq_perception.geometry.superquadric import Superquadric
from sq_perception.imaging.camera import Camera

MIN_PIXELS = 12

_COARSE_RAYS, _COARSE_FREE, _COARSE_STEPS = 150, 50, 8
_BASIN_RAYS, _BASIN_FREE, _BASIN_STEPS = 300, 80, 15
_FREE_SHARE = 0.2
_COARSE_GATE = 3.6
"""Mean squared coarse residual, in noise levels, above which more starts are tried."""
_FINAL_GATE = 1.4
"""The same after the last stage; the floor is 1."""
_FINALISTS = 3
_ESCALATED_FINALISTS = 6
_TOLERANCE = 1e-3
_FINAL_TOLERANCE = 1e-4
_PLANE_SIGMA = 0.001
_REST_SIGMA = 0.05
_FAILED_SHARE = 0.2
"""A typical distance to the surface above this share of the smallest half size is no fit."""


@dataclass(frozen=True)
class Options:
    """How to fit.

    Attributes
    ----------
    bounds
        Limits of sizes and exponents.
    noise
        Standard deviation of the depth noise, metres; None estimates it from the image.
    plane
        (4,) support plane n.x + d = height in the optical frame, n the unit normal away from the support; None if the
        object floats.
    nan_is_empty
        Whether a pixel without depth beside the mask saw nothing up to infinity (rendered images) or says nothing
        (sensors).  None: true for orthographic cameras only.
    pixels
        Budget of object rays in the last stage; a fifth as many free rays come on top.
    max_iterations
        Levenberg-Marquardt steps in the last stage.
    time_budget
        Seconds after which no further start is tried; the best body so far is returned.
    fall_back
        Whether given starts that stay above the noise floor are joined by the automatic ones.
    """

    bounds: Bounds = field(default_factory=Bounds)
    noise: float | None = None
    plane: np.ndarray | None = None
    nan_is_empty: bool | None = None
    pixels: int = 1500
    max_iterations: int = 15
    time_budget: float = math.inf
    fall_back: bool = True

    def __post_init__(self) -> None:
        if self.noise is not None and not (np.isfinite(self.noise) and self.noise > 0):
            raise ValueError(f"noise: expected a positive number of metres, got {self.noise}")
        if self.plane is not None:
            plane = np.asarray(self.plane, dtype=float)
            if plane.shape != (4,) or not np.isfinite(plane).all() or not np.linalg.norm(plane[:3]) > 0:
                raise ValueError(f"plane: expected 4 finite numbers n d with a normal, got {self.plane}")
            object.__setattr__(self, "plane", plane / np.linalg.norm(plane[:3]))
        if self.pixels < MIN_PIXELS or self.max_iterations < 1 or not self.time_budget > 0:
            raise ValueError(
                f"expected pixels >= {MIN_PIXELS}, max_iterations >= 1 and a positive time_budget, got "
                f"{self.pixels}, {self.max_iterations} and {self.time_budget}"
            )


def fit(
    depth: np.ndarray,
    mask: np.ndarray,
    camera: Camera,
    *,
    start: Superquadric | Literal["auto"] | Sequence[Superquadric] = "auto",
    options: Options | None = None,
) -> Fit:
    """The superquadric that explains the masked pixels of a depth image, and contradicts none beside them.

    Parameters
    ----------
    depth : float (height, width)
        z in the optical frame, metres; NaN, infinite or not positive (pinhole) where nothing was measured.
    mask : bool (height, width)
        Pixels of the object.
    camera : Camera
    start : "auto", one body, a batch of bodies or a sequence of bodies, in the optical frame
        Where to begin.
    options : Options

    Returns
    -------
    Fit
        Hard images give status FAILED with a best-effort box; nothing in the result but the covariance is ever NaN.

    Raises
    ------
    ValueError
        For images of another size than the camera's, a mask that is not boolean, starts that are not finite, or an
        object without a single measured pixel.
    """
    began = time.perf_counter()
    options = options or Options()
    depth, mask, given = _checked(depth, mask, camera, start)
    empty = not camera.is_pinhole if options.nan_is_empty is None else options.nan_is_empty
    observation = observe(depth, mask, camera, options.noise, empty)
    if observation is None:
        raise ValueError("the mask holds no pixel with a depth: there is nothing to fit")
    reason = _hopeless(observation)
    if reason:
        body = box_start.enclosing_box(observation.points, observation.footprint)
        return uncertainty.failed(body, observation, reason, began)
    search = _Search(observation, options, began)
    search.run(given)
    return uncertainty.judged(search.best, observation, search.scene, search.limits, options.pixels, began)


def warm_up() -> None:
    """Compile, or load from disk, every kernel of the fit by running it once on a small synthetic scene."""
    from sq_perception.imaging import raycast

    body = Superquadric([0.05, 0.04, 0.03], [0.5, 0.5], [0.0, 0.0, 0.5], [0.3, 0.2, 0.1, 0.9])
    for projection in ("pinhole", "orthographic"):
        focal = 60.0 if projection == "pinhole" else 200.0
        camera = Camera(48, 48, focal, focal, 23.5, 23.5, projection)  # type: ignore[arg-type]
        rendered, _ = raycast.render(body, camera)
        mask = np.isfinite(rendered)
        depth = np.where(mask, rendered, 0.7).astype(np.float32)
        fit(depth, mask, camera, options=Options(plane=np.array([0.0, 0.0, -1.0, 0.7])))
        fit(depth, mask, camera, start=body)


class _Search:
    """The course of one fit: candidates, the rays drawn for each stage, and the best body so far."""

    def __init__(self, observation: Observation, options: Options, began: float) -> None:
        self.observation = observation
        self.options = options
        self.began = began
        self.scene = scene_of(observation, options)
        self.limits = options.bounds.limits(observation.points)
        self.best = State.of(box_start.enclosing_box(observation.points, observation.footprint))
        self.rays = draw(observation.object_rays, options.pixels, 0.3)
        self.free = draw(observation.free_rays, int(_FREE_SHARE * options.pixels), 0.3)

    def run(self, given: list[State]) -> None:
        """Try given starts, then automatic ones, until the residual reaches the noise floor."""
        if given:
            self._finish(self._coarse(given), _FINALISTS)
            if self._good_enough() or not self.options.fall_back:
                return
        self._finish(self._automatic(), _FINALISTS)
        if self._good_enough() or self._late():
            return
        self._finish(self._coarse(self._everything()), _ESCALATED_FINALISTS)

    def _automatic(self) -> list[State]:
        found: list[State] = []
        for tier in self._tiers():
            found += self._coarse(tier)
            found.sort(key=lambda state: state.cost)
            if found and found[0].cost < _COARSE_GATE * _COARSE_RAYS:
                break
            if self._late():
                break
        return found

    def _tiers(self) -> list[list[State]]:
        """Groups of starts, in the order in which to try them."""
        tiers: list[list[State]] = []
        if self.options.plane is not None:
            tiers.append(box_start.on_plane(self.observation.points, self.options.plane))
        completed = symmetry_start.completed_moments(self.observation)
        if completed is not None:
            centre, moments = completed
            axes = symmetry_start.principal_axes(moments)
            tiers.append(symmetry_start.states(centre, moments, axes))
            for turned in symmetry_start.eighth_turns(axes):
                tiers.append(symmetry_start.states(centre, moments, turned))
        if not tiers:
            tiers.append(box_start.principal(self.observation.points))
        return tiers

    def _everything(self) -> list[State]:
        """All starts at once, for images on which the first ones failed."""
        found = [self.best._replace(iterations=0)]
        completed = symmetry_start.completed_moments(self.observation)
        if completed is not None:
            centre, moments = completed
            axes = symmetry_start.principal_axes(moments)
            away = self.observation.camera.rays(np.array(0.0), np.array(0.0))[1] * 0 + [0, 0, 1.0]
            deeper = centre + away * math.sqrt(float(np.trace(moments)) / 3) * 0.5
            for middle in (centre, deeper):
                for exponent in (0.3, 0.8):
                    turns = [axes, *symmetry_start.eighth_turns(axes), *symmetry_start.double_turns(axes)]
                    for turned in turns:
                        found += symmetry_start.states(middle, moments, turned, exponent)
        found += box_start.principal(self.observation.points)
        return found

    def _coarse(self, states: list[State]) -> list[State]:
        rays = draw(self.observation.object_rays, _COARSE_RAYS)
        free = draw(self.observation.free_rays, _COARSE_FREE)
        found = []
        for state in states:
            found.append(minimize(SAMPSON, rays, free, self.scene, state, self.limits, _COARSE_STEPS, _TOLERANCE))
            if self._late():
                break
        return found

    def _finish(self, candidates: list[State], finalists: int) -> None:
        """Refine the best candidates and keep the winner if it beats what is there."""
        candidates = sorted(candidates, key=lambda state: state.cost)[:finalists]
        if not candidates:
            return
        if candidates[0].cost < 0.5 * _COARSE_GATE * _COARSE_RAYS:
            candidates = candidates[:1]
        rays = draw(self.observation.object_rays, _BASIN_RAYS, 0.7)
        free = draw(self.observation.free_rays, _BASIN_FREE, 0.7)
        for candidate in candidates:
            state = minimize(SAMPSON, rays, free, self.scene, candidate, self.limits, _BASIN_STEPS, _TOLERANCE)
            state = minimize(
                RENDERED,
                self.rays,
                self.free,
                self.scene,
                state,
                self.limits,
                self.options.max_iterations,
                _FINAL_TOLERANCE,
            )
            if state.cost < self.best.cost:
                self.best = state
            if self._good_enough() or self._late():
                break

    def _good_enough(self) -> bool:
        return self.best.cost < _FINAL_GATE * len(self.rays)

    def _late(self) -> bool:
        return time.perf_counter() - self.began > self.options.time_budget


def scene_of(observation: Observation, options: Options) -> Scene:
    """The constants that the residuals share."""
    pinhole = 1.0 if observation.camera.is_pinhole else 0.0
    if options.plane is None:
        return Scene(pinhole=pinhole)
    x, y, z, offset = (float(value) for value in options.plane)
    return Scene(
        pinhole=pinhole,
        normal_x=x,
        normal_y=y,
        normal_z=z,
        offset=offset,
        plane_stiffness=1 / _PLANE_SIGMA,
        rest_stiffness=1 / _REST_SIGMA,
    )


def _checked(
    depth: np.ndarray, mask: np.ndarray, camera: Camera, start: object
) -> tuple[np.ndarray, np.ndarray, list[State]]:
    depth, mask = np.asarray(depth), np.asarray(mask)
    if depth.ndim != 2 or not np.issubdtype(depth.dtype, np.floating):
        raise ValueError(f"depth: expected a float image (height, width) in metres, got {depth.dtype} {depth.shape}")
    if mask.shape != depth.shape or mask.dtype != bool:
        raise ValueError(f"mask: expected a bool image of shape {depth.shape}, got {mask.dtype} {mask.shape}")
    camera.check_image(depth)
    if isinstance(start, str):
        if start != "auto":
            raise ValueError(f"start: expected 'auto' or superquadrics, got {start!r}")
        return depth, mask, []
    if isinstance(start, Superquadric):
        bodies = list(start) if start.batch_shape else [start]
    else:
        bodies = list(start)  # type: ignore[call-overload]
    states = []
    for body in bodies:
        if not isinstance(body, Superquadric) or body.batch_shape:
            raise ValueError(f"start: expected single superquadrics, got {type(body).__name__}")
        flat = np.asarray(body.to_flat(), dtype=float)
        if not np.isfinite(flat).all():
            raise ValueError(f"start: expected finite parameters, got {flat}")
        states.append(State.of(Superquadric.from_flat(flat)))
    return depth, mask, states


def _hopeless(observation: Observation) -> str:
    """Why no body can be fitted to these pixels; empty if one can."""
    count = len(observation.object_rays)
    if count < MIN_PIXELS:
        return f"{count} pixels with a depth; a fit needs {MIN_PIXELS}"
    points = observation.points
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if spread[1] < 1e-3 * spread[0] or spread[1] == 0:
        return "the measured points lie on one line"
    return ""
