"""The outline of a body against the mask's: whether the mask shrank, and how exact the outline is.

Free rays beside the mask say where the body ends.  If something ate the mask's edge (sensors lose what they see at
grazing angles), all around it the body covers pixels that were taken for free: those are let go.  What the body then
still covers tells the standard deviation of the outline.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from sq_perception.fitting.levenberg_marquardt import State
from sq_perception.fitting.problem import BASIN_STEPS, FINAL_RAYS, Problem, draw, refine, settle
from sq_perception.fitting.rays import Rays
from sq_perception.fitting.residuals import penetration

_SHARP = 0.3
"""Standard deviation of a perfect outline, in pixels: the body covers exactly the centres of the mask's pixels, a
uniform error of up to half a pixel (1 / sqrt(12))."""
_SHRUNK, _MOST = 0.25, 0.7
"""A body that covers this share of the free pixels beside the mask this deep, in pixels, is larger than its mask."""
_WIDEST_BAND = 4
"""Pixels of a mask's edge that may be missing."""
_RING_RAYS = 200
"""Of a ring around the mask: its quantiles are known to 3 %."""
_FEWEST = 3
"""Covered rays that it takes to tell a standard deviation."""
_READINGS, _STEPS, _SHARPER = 4, 6, 0.7
"""Readings of the outline's precision at most, steps after each, and how much smaller than the one before it has to be
for another one."""


def without_shrunk_edge(problem: Problem, state: State) -> tuple[Problem, State]:
    """Forget the free rays next to the mask if the mask turns out to be smaller than the body."""
    full = problem.observation
    if _depth_inside(problem, state, full.rim()) < _SHRUNK:
        return problem, state
    problem = replace(problem, observation=full.beyond(_WIDEST_BAND))
    state = refine(problem, state, draw(problem, FINAL_RAYS, 0.6), BASIN_STEPS)
    rings = (k for k in range(1, _WIDEST_BAND + 1) if _depth_inside(problem, state, full.ring(k)) < _SHRUNK)
    band = next(rings, _WIDEST_BAND + 1) - 1
    return replace(problem, observation=full.beyond(band) if band > 0 else full), state


def sharpened(problem: Problem, state: State, free: np.ndarray, rays: Rays) -> tuple[Problem, State]:
    """Read the outline's precision from a body's misfit to free rays, and again from the better body it allows."""
    sigma = math.inf
    for _ in range(_READINGS):
        before, sigma = sigma, _sigma(problem, state, free)
        if sigma > _SHARPER * before:
            break
        problem = problem.with_terms(outline_stiffness=1 / sigma)
        state = settle(problem, state, rays, _STEPS)
    return problem, state


def _depth_inside(problem: Problem, state: State, pixels: np.ndarray) -> float:
    """Depth, in pixels, to which the body covers most of these free pixels.

    Most: a body that is merely too long covers those around the mask on one side only.
    """
    rays = problem.observation.free_rays_of(pixels, _RING_RAYS)
    if len(rays) == 0:
        return 0.0
    depth = penetration(rays, problem.terms, state.parameters, state.rotation)
    return float(np.quantile(depth, 1 - _MOST)) / problem.observation.footprint


def _sigma(problem: Problem, state: State, free: np.ndarray) -> float:
    """Standard deviation of the outline, metres, from how far the body reaches into free rays beside the mask."""
    sharp = _SHARP * problem.observation.footprint
    if len(free) == 0:
        return sharp
    depth = penetration(free, problem.terms, state.parameters, state.rotation)
    reached = depth[depth > 0]
    if len(reached) < _FEWEST:
        return sharp
    return max(sharp, float(np.sqrt(np.mean(reached**2))))
