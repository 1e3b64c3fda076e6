"""The support as a sensor shows it: a plane that its calibration bends and that stray light raises.

Equation
--------
With the height h of a point above the plane and the growth g(z) of the noise, a table is where

    | h / g - b(x, y) | < tolerance,    b = b_0 + b_1 x + b_2 y + b_3 x^2 + b_4 x y + b_5 y^2,

x = (u - cx)/fx and y = (v - cy)/fy.  b is fitted to a band about itself again and again, so that it grows from the part
of a table that lies in one plane over all of it.  It is bounded by what the calibration of a depth camera may be off, a
share of the depth.

Beside tall things a table seems to rise, as light reaches a time-of-flight camera by way of them and windows of a
stereo camera hold some of both.  Such a rise is a ramp; the side of a thing is steep or a step.  Support is therefore
also what is reached from it without a step, on a slope below a bound, up to some tolerances high.  Light raises it all
around a thing, and windows are short: a single long ramp is the face of a thing that leans on another one.

Metres and pixels.  Reference: P. J. Besl, R. C. Jain, Segmentation through variable-order surface fitting, IEEE PAMI 10
(1988).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from sq_perception.geometry.kernels import kernel
from sq_perception.geometry.quantiles import densest, deviation, quantile
from sq_perception.imaging import depth_steps, regions
from sq_perception.imaging.camera import Camera
from sq_perception.segmentation import coarse_grid
from sq_perception.segmentation.support_plane import (
    LEAST_GROWTH,
    TOLERANCE,
    Plane,
    noise_growth,
)

_ROUNDS = 6
"""Rounds of reweighting, at most: it ends when it is settled."""
_TERMS = 6
"""Coefficients of a quadratic surface."""
_DISTORTION = 0.02
"""Makers of depth cameras promise an error of at most 2 % of the depth."""
_GAIN = 1.05
"""A support is bent if that brings so many times the samples within half of the tolerance."""
_RAMP = float(np.sin(np.deg2rad(30)))
"""Slope against the support up to which it rises; sides of things are steeper where they meet it."""
HIGHEST = 5.0
"""Tolerances that such a rise is high at most."""
_WIDE = 0.1
"""Share of its largest part that a part of the support has at least."""
_RAMP_LENGTH = 0.08
"""Metres over which it goes on at most."""
_FOOT, _ALL_AROUND = 0.01, 0.4
"""Metres over which windows smear, and the share of the support within twice that of a tall thing that is raised at
least where light does it: 0.42 to 0.97 of 66 samples and more before a time-of-flight camera, at most 0.16 in 64 other
recorded frames, where a ramp is longer."""
_LEVELS = (0.5, 1.0, 2.0, 3.0, 4.0)
"""Tolerances above the support at which is looked for low things: from what counts as above it to the highest ramp."""
LEVEL_SHARE, _LEVEL_SAMPLES = 0.5, 8
"""Share of a part's samples that lie within half a tolerance of one height if it is level, and least samples of it.  Of
a ramp that is a tenth, or a third where it runs out."""


@dataclass(frozen=True, eq=False)
class SupportSurface:
    """A plane, and how the sensor bends it.

    Attributes
    ----------
    plane
        The support plane, with the noise about it.
    bend : (6,)
        Coefficients of the height at one metre, by 1, x, y, x^2, x y and y^2.
    limit
        The most that the surface bends, metres at one metre.
    sigma
        Standard deviation of the heights above the bent surface at a depth of one metre, metres.
    """

    plane: Plane
    bend: np.ndarray
    limit: float
    sigma: float

    @property
    def clear_height(self) -> float:
        """Height from which on something is clearly above the surface, metres at one metre of depth.

        Half of the tolerance is a compromise: bent depth of real cameras stays below, thin objects stay above.
        """
        return max(0.5 * TOLERANCE, 4 * self.sigma)

    def image_relative(self, depth: np.ndarray, camera: Camera) -> np.ndarray:
        """Height, float32 (height, width), above the bent surface as at one metre of depth, 0 for depth 0; of a pinhole
        camera's depth image."""
        x = (np.arange(camera.width) - camera.cx) / camera.fx
        y = (np.arange(camera.height) - camera.cy) / camera.fy
        return np.asarray(_relative(depth, x, y, self.plane.equation, self.bend, self.limit))


def measured(plane: Plane, depth: np.ndarray, valid: np.ndarray, camera: Camera) -> SupportSurface:
    """The surface that a plane was seen as.

    Parameters
    ----------
    plane
        Found in this image.
    depth, valid : (height, width)
        Metres, and where they are a measurement.
    camera
        A pinhole camera.
    """
    points = coarse_grid.samples(depth, valid, camera)[3]
    z = points[:, 2]
    x, y, growth = points[:, 0] / z, points[:, 1] / z, noise_growth(z)
    height = plane.height(points) / growth
    flat = SupportSurface(plane, np.zeros(_TERMS), 0.0, plane.sigma)
    on = np.abs(height) < TOLERANCE
    if not on.any():
        return flat
    limit = _DISTORTION * quantile(z[on] / growth[on], 0.5)
    bend, off = flat.bend, height
    for _ in range(_ROUNDS):
        gram, right = _normal_equations(x, y, height, off)
        if gram[0, 0] < 10 * _TERMS:
            return flat
        bend = np.linalg.lstsq(gram, right, rcond=None)[0]
        off, is_settled = _off(x, y, height, bend, limit, off)
        if is_settled:
            break
    within = np.abs(off)
    gained = np.count_nonzero(within < 0.5 * TOLERANCE)
    if gained < _GAIN * np.count_nonzero(np.abs(height) < 0.5 * TOLERANCE):
        return flat
    return SupportSurface(plane, bend, limit, deviation(within[within < TOLERANCE]))


def risen(relative: np.ndarray, depth: np.ndarray, valid: np.ndarray, camera: Camera) -> np.ndarray:
    """Where the support was seen raised, bool (height, width): reached from it on a ramp.

    Parameters
    ----------
    relative
        Heights (height, width) above the support, metres at a depth of one metre.
    depth, valid : (height, width)
        Metres, and where they are a measurement; both images are 0 elsewhere.
    camera
        As in :func:`measured`.
    """
    k = coarse_grid.stride(depth.shape)
    share = _cells(valid.astype(np.float32), k)
    known = share > 0.5
    weight = 1 / np.maximum(share, np.float32(0.5))
    height, z = _cells(relative, k) * weight, _cells(depth, k) * weight
    width = z * np.float32(k / np.sqrt(camera.fx * camera.fy))
    # Only from where it is wide: the bottom of a bowl is as low.
    flat = depth_steps.components(known & (height < 0.5 * TOLERANCE))
    counts = np.bincount(flat.ravel())
    counts[0] = 0
    reached = (counts > _WIDE * counts.max())[flat] & (flat > 0)
    if not reached.any():
        return np.zeros(depth.shape, bool)
    passable = known & (height < HIGHEST * TOLERANCE) & _shallow(height * noise_growth(z), z, known, width)
    usual = max(quantile(width[reached], 0.5), 1e-4)
    foot, longest = math.ceil(_FOOT / usual), math.ceil(_RAMP_LENGTH / usual)
    reached, short = _climbed(reached, passable, z, k * depth_steps.STEP, foot, longest)
    reached &= ~_low_things(height, noise_growth(z), known, reached)
    near_tall = cv2.dilate((known & (height >= HIGHEST * TOLERANCE)).view(np.uint8), np.ones((4 * foot + 1,) * 2))
    raised, near = reached & (height > 0.5 * TOLERANCE), depth_steps.components(near_tall > 0)
    beside = np.bincount(near[reached], minlength=int(near.max()) + 1)
    is_lit = np.bincount(near[raised], minlength=len(beside)) > _ALL_AROUND * beside
    is_lit[0] = False
    reached &= ~_parts_with(raised, raised & ~short) | _parts_with(raised, raised & is_lit[near])
    return coarse_grid.in_pixels(reached.view(np.uint8), k, depth.shape)


def _climbed(
    reached: np.ndarray, passable: np.ndarray, z: np.ndarray, step: float, foot: int, longest: int
) -> tuple[np.ndarray, np.ndarray]:
    """Samples, bool (rows, columns), that are reached from some over passable ones without a step in depth.

    First those within ``longest`` samples, then those within ``foot`` of them; ``step`` is a share of the depth.
    """
    across, along = slice(1, None), slice(None, -1)
    pairs = [((across, slice(None)), (along, slice(None))), ((slice(None), across), (slice(None), along))]
    joined = [(here, there, np.abs(z[here] - z[there]) < step * z[here]) for here, there in pairs]
    short = reached
    for round_ in range(longest):
        before = np.count_nonzero(reached)
        for here, there, near in joined:
            reached[here] |= reached[there] & near & passable[here]
            reached[there] |= reached[here] & near & passable[there]
        if round_ < foot:
            short = reached.copy()
        if np.count_nonzero(reached) == before:
            break
    return reached, short


def _parts_with(mask: np.ndarray, marked: np.ndarray) -> np.ndarray:
    """Connected parts of a mask, bool (height, width), that hold marked ones of its samples."""
    parts = depth_steps.components(mask)
    is_marked = np.zeros(int(parts.max()) + 1, bool)
    is_marked[parts[marked]] = True
    return is_marked[parts]


def _cells(image: np.ndarray, k: int) -> np.ndarray:
    """Means over cells of k by k pixels; at the right and at the bottom, of what repeats the last ones."""
    down, right = -image.shape[0] % k, -image.shape[1] % k
    whole = cv2.copyMakeBorder(image, 0, down, 0, right, cv2.BORDER_REPLICATE) if down or right else image
    return cv2.resize(whole, None, fx=1 / k, fy=1 / k, interpolation=cv2.INTER_AREA)


def _low_things(height: np.ndarray, growth: np.ndarray, known: np.ndarray, reached: np.ndarray) -> np.ndarray:
    """Samples of what is no ramp although it was reached, as it does not lead up to anything.

    A ramp belongs to the tall thing beside which it rises.  Where the samples above some level hold together and what
    is highest of them was reached, they are a thing of their own, such as a book or a bag, whose sides the windows of a
    sensor smooth into ramps.  So are those that are level, a book under a box: a ramp has all heights up to what it
    leads to.
    """
    own = _level(height, growth, reached)
    for level in _LEVELS:
        parts = depth_steps.components(known & (height > level * TOLERANCE))
        _add_reached_tops(parts, reached, height, int(parts.max()), own)
    return own


def _level(height: np.ndarray, growth: np.ndarray, reached: np.ndarray) -> np.ndarray:
    """Parts of what was reached of which most samples lie at one height, a tolerance above the support or higher.

    Both are lengths, and grow with the part's distance, not within it: a book that is near is level too.
    """
    parts = depth_steps.components(reached & (height > 0.5 * TOLERANCE))
    extents = regions.extents(parts)
    level = np.zeros(len(extents), bool)
    for part in np.flatnonzero(extents[:, 0] >= _LEVEL_SAMPLES):
        if part > 0:
            pixels = regions.pixels(parts, int(part), extents[part])
            heights = height[pixels] * growth[pixels] / quantile(growth[pixels], 0.5)
            high, fewest = heights[heights > 0.75 * TOLERANCE], LEVEL_SHARE * len(heights)
            level[part] = len(high) > fewest and len(high[densest(np.sort(high), 0.5 * TOLERANCE)]) > fewest
    return level[parts]


@kernel
def _add_reached_tops(parts: np.ndarray, reached: np.ndarray, height: np.ndarray, count: int, own: np.ndarray) -> None:
    """Add to ``own`` the parts whose highest samples, but for half a tolerance, were reached."""
    tops = np.zeros((2, count + 1), np.float32)
    for v in range(parts.shape[0]):
        for u in range(parts.shape[1]):
            if parts[v, u] > 0:
                side = 1 if reached[v, u] else 0
                tops[side, parts[v, u]] = max(tops[side, parts[v, u]], height[v, u])
    for v in range(parts.shape[0]):
        for u in range(parts.shape[1]):
            part = parts[v, u]
            own[v, u] |= part > 0 and tops[1, part] > tops[0, part] - 0.5 * TOLERANCE


@kernel
def _normal_equations(
    x: np.ndarray, y: np.ndarray, height: np.ndarray, off: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The normal equations of b by least squares, from the heights of samples within the tolerance of the last b."""
    gram, right = np.zeros((_TERMS, _TERMS)), np.zeros(_TERMS)
    for i in range(len(x)):
        if abs(off[i]) < TOLERANCE:
            term = (1.0, x[i], y[i], x[i] * x[i], x[i] * y[i], y[i] * y[i])
            for j in range(_TERMS):
                right[j] += term[j] * height[i]
                for k in range(_TERMS):
                    gram[j, k] += term[j] * term[k]
    return gram, right


@kernel
def _off(
    x: np.ndarray, y: np.ndarray, height: np.ndarray, bend: np.ndarray, limit: float, last: np.ndarray
) -> tuple[np.ndarray, bool]:
    """Heights above a bent support, and whether those within the tolerance are the same as last time."""
    off, is_same = np.empty_like(height), True
    for i in range(len(x)):
        b = bend[0] + x[i] * (bend[1] + bend[3] * x[i] + bend[4] * y[i]) + y[i] * (bend[2] + bend[5] * y[i])
        off[i] = height[i] - min(max(b, -limit), limit)
        is_same &= (abs(off[i]) < TOLERANCE) == (abs(last[i]) < TOLERANCE)
    return off, is_same


def _shallow(height: np.ndarray, z: np.ndarray, known: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Samples whose surface is turned from the support by less than a ramp, by chords along rows and columns.

    With the chords' rises h_u, h_v and their inner products G, the squared sine of the slope is h^T G^-1 h.
    """
    ok = np.zeros(height.shape, bool)
    here = slice(1, -1)
    rise_u, rise_v = height[here, 2:] - height[here, :-2], height[2:, here] - height[:-2, here]
    away_u, away_v = z[here, 2:] - z[here, :-2], z[2:, here] - z[:-2, here]
    side = (2 * width[here, here]) ** 2
    uu, vv, uv = side + away_u**2, side + away_v**2, away_u * away_v
    sine = (vv * rise_u**2 - 2 * uv * rise_u * rise_v + uu * rise_v**2) / np.maximum(uu * vv - uv**2, 1e-12)
    ends = known[here, 2:] & known[here, :-2] & known[2:, here] & known[:-2, here]
    ok[here, here] = ends & (sine < _RAMP**2)
    return ok


@kernel
def _relative(
    depth: np.ndarray, x: np.ndarray, y: np.ndarray, plane: np.ndarray, bend: np.ndarray, limit: float
) -> np.ndarray:
    """The rest of a row is constant, and no pixel branches: a row becomes vector code."""
    height = np.empty(depth.shape, np.float32)
    for v in range(depth.shape[0]):
        slope, first = plane[1] * y[v] + plane[2], bend[0] + y[v] * (bend[2] + bend[5] * y[v])
        second = bend[1] + bend[4] * y[v]
        for u in range(depth.shape[1]):
            z = np.float64(depth[v, u])
            above = z * (plane[0] * x[u] + slope) + plane[3]
            off = first + x[u] * (second + bend[3] * x[u])
            relative = above / max(z * z, LEAST_GROWTH) - min(max(off, -limit), limit)
            height[v, u] = relative if z > 0 else 0.0
    return height
