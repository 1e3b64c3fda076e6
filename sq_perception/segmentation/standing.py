"""Which segments are things that stand on the support, and not the room around it.

    foot of a point p = p - h(p) n,    h(p) = n.p + d

A thing rises above the support, by more than the noise of the support beside it.  The support is under it: at the foot
of each of its points, and a little below, the camera sees the support, or the thing itself or another one in front of
the support, but nothing lower than the support.  Chairs and walls behind a table have their feet beyond the table's
edge, where the camera looks past the table and sees what is lower.  Walls that reach down to the support are planes of
their own, and larger than things.

Metres, optical frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from sq_perception.geometry.kernels import kernel
from sq_perception.geometry.quantiles import deviation, quantile
from sq_perception.imaging import depth_steps, regions
from sq_perception.imaging.camera import Camera, Lens
from sq_perception.segmentation import coarse_grid
from sq_perception.segmentation.options import SegmentationOptions, largest_edge
from sq_perception.segmentation.support_plane import (
    LEAST_GROWTH,
    TOLERANCE,
    Plane,
    noise_growth,
)
from sq_perception.segmentation.support_surface import HIGHEST, LEVEL_SHARE, SupportSurface

ObjectTest = Callable[[np.ndarray, np.ndarray], bool]
"""Whether a segment is an object, by the rows and columns of its pixels."""

MIN_HEIGHT, _LEAST_HEIGHT = 0.012, 0.008
"""Metres that a thing reaches above the support at least, a metre away and farther, and nearer as the noise falls: one
and a half tolerances of a plane, and a book's thickness, as cloths have folds."""
_SAMPLES = 400
"""Pixels of a segment, evenly taken: the 5 % above a height are a few still."""
_SPARSE, _STRAY = 8, 0.001
"""Every so many pixels tell the nearest depth of an image, but for that share of them, which may be stray readings."""
_FEWEST = 30
"""Samples that a surface has at least."""
_BUMP, _ON_WALL = 6.0, 3.5
"""A thing rises so many deviations of the support's own points above it, as they are beside the thing, and is that far
off any other plane; pixels within so many of another plane are a part of that.  Of normal noise 0.05 % lies beyond 3.5;
a bump of correlated noise seldom reaches 6, and of 374 simulated things that were found one does not."""
_LOWER_SIDE = 0.1
"""Share of the heights beside a thing, at least, that tell the noise from below.  Of 25 simulated things that were
missed it finds two, 0.25 none."""
_WAVE = 0.5
"""Share of what the support beside a thing lies lower than the base, that counts as a deviation: a thing is three times
as high.  It changes nothing in 288 simulated scenes, and finds two things in 34 recorded frames."""
_SMEARED, _BESIDE = 2, 12
"""Pixels about a segment that a sensor smears, and up to which the support is beside it; 5 to 20 do as well."""
_IN_SEGMENTS = 0.5
"""Share of a plane's points in segments from which on it is the faces of things, and no wall: the larger part decides.
Of 72 simulated scenes of furniture this leaves 10 more segments of it, of which the network of masks drops all."""
_FACE_SHARE = 0.5
"""What makes up this share of a plane's points is no part of it: the plane is a face of the thing.  The larger part
decides; without it 3 of 81 recorded and simulated frames lose a body."""
_UNDER, _BELOW = 3.0, 2.0
"""Tolerances below the support: where a foot is looked at, and from where on a reading there is lower than the support.
"""
_SPECKLE = 4
"""Pixels to the sides of a foot where nothing was measured: readings there tell in its place; 2 to 6 do as well.  Of
188 things before a D435 and a Kinect v1 3 to 14 degrees above the table 22 are missed, not 48."""
_GRAZING, _UPRIGHT, _FLAT = 0.25, 0.5, 0.15
"""Cosines of a wall's normal with the rays and with the support's normal, at most, and how far it reaches along it, as
a share of its width.  Such are 43 of 286 segments of no thing in 215 simulated scenes, most of them bits of bins and
shelves, and 1 of 992 of things, which show another side as well."""
_SUPPORTED = 1 / 4
"""Share of the feet that must be seen to have the support, or something before it, under them.  Not of what reaches the
nearest depth of the image: it goes on where the sensor measures nothing, and may itself hide its feet.  Of tables seen
at a grazing angle half is not measured: with a third low cameras miss a few things more, with a sixth a recorded frame
shows one more that is none."""


@dataclass(frozen=True, eq=False)
class Seen:
    """An image of a pinhole camera, and what is known of its planes.

    Attributes
    ----------
    depth : float32 (height, width)
        Metres, 0 where nothing was measured.
    known : float32 (height, width)
        ``depth``, 0 also where objects are not looked for.
    walls
        Planes that are no support.
    options
        What counts as an object.
    """

    depth: np.ndarray
    known: np.ndarray
    camera: Camera
    walls: list[Plane]
    options: SegmentationOptions


def _top(values: np.ndarray) -> float:
    """The 95 % quantile of some values, as sensors smear edges."""
    k = int(0.95 * len(values))
    return float(np.partition(values, k)[k])


def furniture(seen: Seen, valid: np.ndarray) -> np.ndarray:
    """Valid pixels, bool (height, width), of surfaces in one of the walls that are larger than a thing."""
    if not seen.walls:
        return np.zeros(valid.shape, bool)
    k, rows, columns, points = coarse_grid.samples(seen.known, valid, seen.camera)
    large = np.zeros(valid[::k, ::k].shape, np.uint8)
    for wall in seen.walls:
        parts = coarse_grid.connected_parts(rows, columns, _lie_on(wall, points), large.shape)
        for part in np.flatnonzero(np.bincount(parts) > _FEWEST):
            if part > 0 and largest_edge(points[parts == part], wall.equation[:3]) > seen.options.max_size:
                large[rows[parts == part], columns[parts == part]] = 1
    return coarse_grid.in_pixels(large, k, valid.shape)


def _lie_on(wall: Plane, points: np.ndarray) -> np.ndarray:
    """Which points (n, 3) lie on a wall, by its own noise."""
    reach = max(0.5 * TOLERANCE, _ON_WALL * wall.sigma) * noise_growth(points[:, 2])
    return np.asarray(np.abs(wall.height(points)) < reach)


def _of_no_segments(seen: Seen, labels: np.ndarray) -> list[Plane]:
    """The walls whose points are mostly in no segment.

    The tops or the fronts of equal things lie in one plane, too, and most of its points are in segments.  Surfaces that
    are larger than a thing are in none (:func:`furniture`).
    """
    if not seen.walls:
        return []
    k, rows, columns, points = coarse_grid.samples(seen.depth, seen.depth > 0, seen.camera)
    in_segment = labels[::k, ::k][rows, columns] > 0
    found = []
    for wall in seen.walls:
        on = _lie_on(wall, points)
        if np.count_nonzero(on & in_segment) < _IN_SEGMENTS * np.count_nonzero(on):
            found.append(wall)
    return found


def alone(seen: Seen) -> ObjectTest:
    """The test of a segment in an image without a support: no larger than a thing, and not out of the image on opposite
    sides, as a surface is that fills the image."""
    measured = seen.depth > 0

    def is_thing(rows: np.ndarray, columns: np.ndarray) -> bool:
        left, top = int(columns.min()), int(rows.min())
        if regions.fills((left, top, int(columns.max()) - left + 1, int(rows.max()) - top + 1), measured):
            return False
        return seen.options.hold(regions.some_points(rows, columns, seen.known, seen.camera, _SAMPLES))

    return is_thing


def standing(seen: Seen, relative: np.ndarray, labels: np.ndarray, support: SupportSurface) -> ObjectTest:
    """The test of whether a segment is a thing that stands on the support, to be asked of the largest ones first.

    The noise of the support is taken from the readings beside a segment.  Every thing that was accepted is left out of
    them when the next segment is asked about.

    Parameters
    ----------
    relative : (height, width)
        Heights above the support as at one metre of depth, 0 where nothing was measured.
    labels : int32 (height, width)
        The segments.
    support
        What things stand on.
    """
    depth, camera, options = seen.depth, seen.camera, seen.options
    last_row, last_column = camera.height - 1, camera.width - 1
    around = depth > 0
    measured = np.count_nonzero(around)
    sparse = depth[::_SPARSE, ::_SPARSE]
    nearest = quantile(sparse[sparse > 0], _STRAY) * (1 + depth_steps.STEP) if sparse.any() else 0.0
    plane = support.plane
    walls = _of_no_segments(seen, labels)

    def is_thing(rows: np.ndarray, columns: np.ndarray) -> bool:
        step = max(1, rows.size // _SAMPLES)
        r, c = rows[::step], columns[::step]
        points = camera.unproject(c, r, depth[r, c])
        growth = noise_growth(points[:, 2])
        height = relative[r, c]
        beside = _beside(relative, around, rows, columns)
        least = max(_LEAST_HEIGHT, MIN_HEIGHT * min(1.0, float(quantile(growth, 0.5))))
        if _top(height * growth) < least or not _rises(_top(height), beside, support.sigma):
            return False
        borders = sum((rows.min() == 0, columns.min() == 0, rows.max() == last_row, columns.max() == last_column))
        for wall in walls:
            is_face = bool(rows.size >= _FACE_SHARE * wall.share * measured)
            if _is_part(wall, np.abs(wall.height(points)) / growth, is_face, borders):
                return False
        if not options.hold(points, plane.equation[:3]) or _is_wall(points, plane.equation[:3]):
            return False
        least_share = _SUPPORTED if points[:, 2].min() > nearest else 0.0
        if not _stands(points, least_share, depth, relative, camera, plane):
            return False
        around[rows, columns] = False
        return True

    return is_thing


def _is_part(wall: Plane, off: np.ndarray, is_face: bool, borders: int) -> bool:
    """Whether a segment is a part of a wall, by the distances (n,) of its points, as at one metre of depth.

    ``is_face``: whether the plane may be a face of the segment itself; ``borders``: how many of the image's it touches.
    """
    if not is_face and _top(off) < _BUMP * wall.sigma:
        return True
    # A carton's face may be cut by one border; a wall of which little is seen leaves by two.
    return bool(borders > (1 if is_face else 0) and np.mean(off < 2 * TOLERANCE) > 0.5)


def _is_wall(points: np.ndarray, up: np.ndarray) -> bool:
    """Whether points (n, 3) are one flat and upright face at a grazing angle, and nothing else."""
    variances, axes = np.linalg.eigh(np.cov(points.T))
    middle = points.mean(axis=0)
    off = np.abs(axes[:, 0] @ np.stack([middle / np.linalg.norm(middle), up], axis=1))
    return bool((off < (_GRAZING, _UPRIGHT)).all() and variances[0] < _FLAT**2 * variances[1])


def _rises(top: float, beside: np.ndarray, sigma: float) -> bool:
    """Whether the top of a segment is above the noise of the support.

    That noise has the deviation ``sigma`` at least, and the one that the heights (n,) beside the segment show: about
    the support, or, where these heights are level, about their own level, as the height of a board or a mat on the
    support is no noise.
    """
    noise = {0.0: _noise(beside, 0.0, top)}
    if beside.size >= _FEWEST:
        level = quantile(beside, 0.5)
        if np.mean(np.abs(beside - level) < 0.5 * TOLERANCE) > LEVEL_SHARE:
            noise[level] = _noise(beside, level, top)
        elif top > HIGHEST * TOLERANCE and np.mean(beside < 0) < _LOWER_SIDE:
            # Noise about the support would be below it, too: these are low things, the foot of a wall, a rim.
            noise[level] = beside[beside > level]
    return any(top - base >= _BUMP * max(sigma, _spread(heights, base)) for base, heights in noise.items())


def _noise(heights: np.ndarray, base: float, top: float) -> np.ndarray:
    """The heights (n,) beside a thing that tell of noise about a base.

    Below the base there is nothing but noise, above it there may be low things or a wall behind.  So the heights below
    tell of it alone, if there are enough, for a thing that is higher than a support is ever seen raised.
    """
    below = heights[heights < base]
    is_high = top - base > HIGHEST * TOLERANCE
    return below if is_high and below.size >= max(_FEWEST, _LOWER_SIDE * heights.size) else heights


def _spread(heights: np.ndarray, base: float) -> float:
    """Deviation of heights (n,) from a base; 0 for too few of them.

    Where most of them lie below the base, as where a table is bent or a sensor shows it lower beside things, that
    offset is a wave of the surface: a share of it counts (``_WAVE``), and the noise is that about the wave.
    """
    if heights.size < _FEWEST:
        return 0.0
    low = min(quantile(heights, 0.5) - base, 0.0)
    return max(_WAVE * -low, deviation(np.abs(heights - base - low)))


def _beside(relative: np.ndarray, around: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Heights (n,) of the support beside a segment, where its noise is that under the segment.

    It is larger near the rims of an image and where light is reflected several times.  ``around``, bool
    (height, width), is false where nothing was measured and on other things.
    """
    top, left = max(int(rows.min()) - _BESIDE, 0), max(int(columns.min()) - _BESIDE, 0)
    window = slice(top, int(rows.max()) + _BESIDE + 1), slice(left, int(columns.max()) + _BESIDE + 1)
    mask = np.zeros(relative[window].shape, np.uint8)
    mask[rows - top, columns - left] = 1
    near, ring = (cv2.dilate(mask, np.ones((2 * k + 1, 2 * k + 1), np.uint8)) for k in (_SMEARED, _BESIDE))
    height = relative[window]
    is_support = np.abs(height) < np.float64(HIGHEST * TOLERANCE)
    return np.asarray(height[(ring > near) & around[window] & is_support])


def _stands(
    points: np.ndarray, least: float, depth: np.ndarray, relative: np.ndarray, camera: Camera, plane: Plane
) -> bool:
    """Whether the support is seen under at least a share ``least`` of points (n, 3), and nothing lower under more of
    them.  Points whose feet the image cuts off count as supported."""
    feet, past, held, cut_off = _feet(points, plane.equation, depth, relative, camera.lens)
    return past <= held and held + cut_off >= least * feet


@kernel
def _feet(
    points: np.ndarray, plane: np.ndarray, depth: np.ndarray, relative: np.ndarray, lens: Lens
) -> tuple[int, int, int, int]:
    """How many feet of points (n, 3) are in front of the camera; and of these, how many are at a pixel that shows
    something lower than the support, how many at one that shows the support or what stands on it, and how many are
    beyond the image."""
    rows, columns = depth.shape
    count, past, held, cut_off = 0, 0, 0, 0
    for i in range(len(points)):
        x, y, z = points[i]
        height = plane[0] * x + plane[1] * y + plane[2] * z + plane[3]
        under = height + _UNDER * TOLERANCE * max(z * z, LEAST_GROWTH)
        z -= under * plane[2]
        if not z > 0:
            continue
        count += 1
        u = np.rint(lens.fx * (x - under * plane[0]) / z + lens.cx)
        v = np.rint(lens.fy * (y - under * plane[1]) / z + lens.cy)
        if not (0 <= u < columns and 0 <= v < rows):
            cut_off += 1
            continue
        row, column = int(v), int(u)
        if depth[row, column] > 0:
            is_past = relative[row, column] < -_BELOW * TOLERANCE
            past += is_past
            held += not is_past
            continue
        # Of a table seen at a grazing angle single pixels are measured: those around tell of one that is not.
        lower, on = 0, 0
        for down in range(-_SPECKLE, _SPECKLE + 1, _SPECKLE):
            for right in range(-_SPECKLE, _SPECKLE + 1, _SPECKLE):
                r, c = min(max(row + down, 0), rows - 1), min(max(column + right, 0), columns - 1)
                if depth[r, c] > 0:
                    lower += relative[r, c] < -_BELOW * TOLERANCE
                    on += abs(relative[r, c]) <= _BELOW * TOLERANCE
        past += lower > on
        held += on >= lower and on > 0
    return count, past, held, cut_off
