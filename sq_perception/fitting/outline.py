"""The outline of a body against the mask's: whether the mask shrank, and how exact the outline is.

Free rays beside the mask show where the body ends.  If the mask lost its edge (sensors lose what they see at grazing
angles), the body covers pixels that were taken for free all around it: those are left out.  What the body then still
covers determines the standard deviation of the outline.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.multistart import SETTLE, Problem
from sq_perception.fitting.observation import BAND_PIXELS
from sq_perception.fitting.rays import Rays
from sq_perception.fitting.residuals import penetration
from sq_perception.geometry.quantiles import quantile

_RAYS, _STEPS = 3000, 5
"""Rays that tell whether a mask shrank, and steps of a body once its outline is read."""
_SHARP = 0.3
"""Standard deviation of a perfect outline, in pixels: the body covers exactly the centres of the mask's pixels, a
uniform error of up to half a pixel (1 / sqrt(12))."""
_SHRUNK = 0.25
"""Depth, in pixels: a body that covers half of the free pixels beside the mask this deep is larger than its mask."""
_SHARPER = 0.7
"""Factor of the last estimate of the outline's standard deviation that a new one must fall below for another round."""


def without_shrunk_edge(problem: Problem, state: State) -> tuple[Problem, State]:
    """Forget the free rays next to the mask if the mask turns out to be smaller than the body."""
    full = problem.observation
    if _depth_inside(problem, state, full.ring(1)) < _SHRUNK:
        return problem, state
    problem = replace(problem, observation=full.beyond(BAND_PIXELS))
    state = problem.refine(state, problem.draw(_RAYS, 0.6), SETTLE.steps)
    rings = (k for k in range(1, BAND_PIXELS + 1) if _depth_inside(problem, state, full.ring(k)) < _SHRUNK)
    band = next(rings, BAND_PIXELS + 1) - 1
    return replace(problem, observation=full.beyond(band) if band > 0 else full), state


def sharpened(problem: Problem, state: State, free: np.ndarray, rays: Rays) -> tuple[Problem, State]:
    """Estimate the outline's precision from a body's misfit to free rays, and again from the better body it allows.

    The precision does not fall: else pixels that miss a body would cost next to nothing, and it might leave them.
    """
    state, sigma = _pulled_in(problem, state, free, rays)
    before = math.inf
    while True:
        sigma = min(sigma, problem.observation.outline)
        if not sigma < _SHARPER * before or problem.late:  # so that it ends for any sigma
            return problem, state
        problem = problem.with_terms(outline_stiffness=1 / sigma)
        state = problem.settle(state, rays, _STEPS)
        before, sigma = sigma, _sigma(problem, state, free)


def _pulled_in(problem: Problem, state: State, free: np.ndarray, rays: Rays) -> tuple[State, float]:
    """The body, refitted with its outline known to a pixel if it sticks out farther than assumed and that helps; and
    how far the one returned sticks out, metres."""
    sigma = _sigma(problem, state, free)
    if not sigma > problem.observation.outline or problem.late:
        return state, sigma
    pixel = problem.with_terms(outline_stiffness=1 / problem.observation.footprint)
    other = pixel.settle(state, rays)
    nearer = _sigma(problem, other, free)
    return (other, nearer) if nearer < _SHARPER * sigma else (state, sigma)


def _depth_inside(problem: Problem, state: State, pixels: np.ndarray) -> float:
    """Depth, in pixels, to which the body covers half of these free pixels.

    Half: a body that is merely too long covers those around the mask on one side only.
    """
    rays = problem.observation.free_rays_of(pixels)
    if len(rays) == 0:
        return 0.0
    depth = penetration(rays, problem.terms, state.parameters, state.rotation)
    return quantile(depth, 0.5) / problem.observation.footprint


def _sigma(problem: Problem, state: State, free: np.ndarray) -> float:
    """Standard deviation of the outline, metres, from how far the body reaches into free rays beside the mask."""
    sharp = _SHARP * problem.observation.footprint
    if len(free) == 0:
        return sharp
    depth = penetration(free, problem.terms, state.parameters, state.rotation)
    reached = depth[depth > 0]
    return max(sharp, float(np.sqrt(np.mean(reached**2)))) if len(reached) else sharp
