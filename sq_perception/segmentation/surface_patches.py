"""Smooth patches of what is seen: cut at depth steps and where the surface folds.

Equation
--------
The inverse depth w = 1/z of a plane is linear in the pixel coordinates of a pinhole camera, and the noise of a
triangulating camera is constant in it.  With two pixels rho to either side of p along a line,

    s(p) = [(w(p - rho) + w(p + rho)) / 2 - w(p)] / (w(p) rho / f)

is therefore 0 on every plane, however it is turned.  The sign is that of the convexity: s < 0 where p lies nearer
than the chord (the edge of a box), s > 0 where it lies behind it (a box on a table).  Seen in the direction of its
bisector, an edge at which the normal turns by theta has |s| = tan(theta / 2), and a surface of curvature radius R has
|s| = r / (2 R) with r = z rho / f, the chord's radius in metres.  s is the strongest over four directions.

The radius r is a length of the world, so that a body looks the same near and far; images are sampled on a grid that
makes it some four samples long, or fewer where bodies fill the image.  Chords that cross a depth step or a hole say
nothing.  Their noise is measured on the support, which is a plane: that of a sensor is alike over windows of pixels, so
that no formula for single ones tells it.

Grid images are float32 (rows, columns), every ``stride``-th pixel.
Reference: S. C. Stein et al., Object Partitioning using Local Convexity, CVPR 2014 (patches and signs of convexity).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sq_perception.geometry.kernels import inline_kernel, kernel
from sq_perception.geometry.quantiles import ranked
from sq_perception.imaging import depth_steps, regions
from sq_perception.imaging.camera import Camera

_RADIUS = 0.01
"""Half length of the chord, metres; up to twice as long where noise would hide the fold."""
_FOLD = float(np.tan(np.deg2rad(33) / 2))
"""A fold turns the normal by 33 degrees at least."""
_STEEPEST = float(np.deg2rad(80))
"""A surface turned farther from the line of sight shows steps, radians."""
_NOISE_MARGIN = 1.5
"""A fold is that many standard deviations of the noise; few, since the whole border of two patches is added up before
they are parted.  Of 411 things of :mod:`~sq_perception.simulation.things_on_table` through four sensors 1.5 joined 61
and cut 48, 2 joined 74 and cut 46."""
_BENT_MARGIN = 0.5
"""So is a curved patch off its plane, on average; less, as hundreds of samples tell it."""
_LEAST_AREA = 1e-4
"""Of a patch, square metres across the line of sight."""
_RADIUS_SAMPLES = 4
_MOST_SAMPLES = 50_000
"""Beyond so many, the grid is made coarser, down to ``_LEAST_RADIUS`` samples of a chord: this bounds the time."""
_LEAST_RADIUS = 2.0
"""Pixels of a chord's half length below which there are no folds to see."""
_CHORD_NOISE = float(np.sqrt(1.5))
"""Of (a + b) / 2 - c, the three independent and of deviation 1."""
_DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))
_SHAPE_TERMS = 6
"""Of a quadratic surface; twice as many samples tell its shape."""
_FEWEST_CHORDS = 100
"""Of which a median is taken."""
_FULL = np.float32(0.9)
"""Share of a square that is measured and wanted; with 0.999, the border of each hole is lost, and 1 % of the IoU."""
_MOST_PATCHES = 150
"""Bounds the time of frames that are noise alone; those of things have some 30."""
_CONCAVE_BAND = 0.3
"""Of a fold's threshold, from which on patches grow into what is concave last."""
_GAP = 0.1
"""Share of the depth by which samples of what is left over differ at most: a side that is seen at a grazing angle has
steps, what lies behind a fringe is farther."""
_NEAREST, _FARTHEST = np.float32(1e-3), np.float32(1e3)
"""Metres between which depths are inverted."""
_FAR_RADII = 2.0
"""Chords are at most so many times longer where there is noise: 2 found 86.1 % of the same things, 3 84.7 %."""


@dataclass(frozen=True, eq=False)
class Patches:
    """Patches on a grid over a part of the image.

    Attributes
    ----------
    labels : int32 (rows, columns)
        1..count, 0 where nothing is wanted.
    count
        Of patches.
    depth : float32 (rows, columns)
        Of the grid's pixels, wanted or not, metres, 0 where there is none.
    stepped : bool (rows, columns)
        Samples with a depth step beside them.
    fold : float32 (rows, columns)
        s divided by its threshold: below -1 a convex edge, above 1 a concave one, NaN where no chord tells.
    curvature : float (count + 1,)
        Of each patch, the sum of the two directions, 1 / metres, positive where it is hollow.
    planes : float (count + 1, 3)
        w = a (u - cx)/fx + b (v - cy)/fy + c of each patch, by least squares; NaN for those too small.
    stride
        Pixels per sample.
    depth_step
        Share of the depth by which neighbouring samples of one surface differ at most.
    """

    labels: np.ndarray
    count: int
    depth: np.ndarray
    stepped: np.ndarray
    fold: np.ndarray
    curvature: np.ndarray
    planes: np.ndarray
    stride: int
    depth_step: float


def find(
    depth: np.ndarray,
    wanted: np.ndarray,
    camera: Camera,
    sigma: float,
    flat: np.ndarray | None = None,
) -> Patches | None:
    """Patches of the wanted pixels of a pinhole camera.

    Parameters
    ----------
    depth : float32 (height, width)
        Metres, 0 where nothing was measured; those are not wanted.
    wanted : bool (height, width)
    sigma
        Noise of the depth at one metre, metres.
    flat : bool (height, width), optional
        Measured pixels of a plane, where all that chords tell is noise.

    Returns
    -------
    Patches or None
        None where nothing as large as a patch is wanted, or bodies are too far to show the chord in two pixels.
    """
    filled = cv2.copyTo(depth, wanted.view(np.uint8))  # and 0 elsewhere
    some = filled[::4, ::4]
    some = some[some > 0]
    if some.size == 0:
        return None
    focal = float(np.sqrt(camera.fx * camera.fy))
    middle = float(np.median(some))
    if flat is not None and (under := depth[::4, ::4][flat[::4, ::4]]).size:
        # Things stand where the support is seen; behind them a wall may fill more pixels than they do.
        middle = min(middle, float(np.median(under)))
    longest = min(depth.shape) / 8
    pixels = min(_RADIUS * focal / middle, longest)
    if pixels < _LEAST_RADIUS:
        return None
    chord = _Chord.of(pixels, int(np.count_nonzero(wanted)))
    noise = _chord_noise(depth, flat, chord, sigma)
    # The noise of a triangulating camera is alike over windows: longer chords see less of it as an angle.
    hidden = _NOISE_MARGIN * noise * middle * focal / pixels / _FOLD
    if hidden > 1:
        pixels = max(pixels, min(pixels * min(hidden, _FAR_RADII), longest))
        chord = _Chord.of(pixels, int(np.count_nonzero(wanted)))
        noise = _chord_noise(depth, flat, chord, sigma)
    stride, rho = chord.stride, chord.rho
    inverse, known = _mean(depth, wanted, chord.half, stride)
    coarse = filled[::stride, ::stride]
    step = max(depth_steps.STEP, float(np.tan(_STEEPEST)) * stride / focal)
    stepped = _steps(filled, wanted, stride)
    known &= coarse > 0
    fold = _fold(inverse, known & ~stepped, rho, stride / focal)
    angular = noise * focal / (rho * stride) * coarse
    limit = np.maximum(_FOLD, _NOISE_MARGIN * angular)
    with np.errstate(invalid="ignore"):
        fold /= limit
        smooth = known & ~stepped & (np.abs(fold) < 1)
    least = max(6, round(_LEAST_AREA * (focal / middle / stride) ** 2))
    opened = cv2.morphologyEx(smooth.astype(np.uint8), cv2.MORPH_OPEN, depth_steps.CROSS)
    seeds = _large(depth_steps.components(opened), least)
    free = (coarse > 0) & (seeds == 0)
    # Concave bands come last, so that two patches meet in the middle of theirs, even if the other edge of a narrow
    # ledge lies within the chord.
    with np.errstate(invalid="ignore"):
        concave = fold > _CONCAVE_BAND
    labels = depth_steps.grown(seeds, free & ~concave, coarse, 2 * rho, step)
    labels = depth_steps.grown(labels, free & (labels == 0), coarse, 2 * rho, step)
    # A fringe of something near touches what is seen beside it, however far.
    left = _large(depth_steps.separated(coarse, (coarse > 0) & (labels == 0), _GAP), least)
    count = int(seeds.max())
    labels = np.where(left > 0, left + count, labels)
    count += int(left.max())
    if count == 0:
        return None
    curvature, planes = _shapes(seeds, count, inverse, camera, stride, _BENT_MARGIN * sigma)
    return Patches(labels, count, depth[::stride, ::stride], stepped, fold, curvature, planes, stride, step)


@dataclass(frozen=True)
class _Chord:
    """Half side of the squares, pixels, pixels per sample, and half length of the chord, samples."""

    half: int
    stride: int
    rho: int

    @classmethod
    def of(cls, pixels: float, wanted: int) -> _Chord:
        """For a half length in pixels, and so many pixels."""
        stride = max(1, round(pixels / _RADIUS_SAMPLES))
        while wanted > _MOST_SAMPLES * stride**2 and pixels >= _LEAST_RADIUS * (stride + 1):
            stride += 1
        return cls(max(1, round(pixels / _RADIUS_SAMPLES)), stride, max(2, round(pixels / stride)))


def _chord_noise(depth: np.ndarray, flat: np.ndarray | None, chord: _Chord, sigma: float) -> float:
    """Standard deviation of (w(p - rho) + w(p + rho)) / 2 - w(p) on a plane, 1 / metres.

    It is measured where there is one, since noise that is alike over a window of pixels is no smaller in the mean of
    a square; else it is that of independent noise.
    """
    if flat is not None:
        inverse, known = _mean(depth, flat, chord.half, chord.stride)
        both = (_bends(inverse, known, 0, chord.rho), _bends(inverse, known, chord.rho, 0))
        enough = [bends for bends in both if bends.size >= _FEWEST_CHORDS]
        if enough:
            return 1.4826 * max(ranked(bends, bends.size // 2) for bends in enough)
    return _CHORD_NOISE * sigma / (2 * chord.half + 1)


@kernel
def _bends(inverse: np.ndarray, known: np.ndarray, down: int, right: int) -> np.ndarray:
    """|(w(p - rho) + w(p + rho)) / 2 - w(p)|, float32 (n,), of all known chords in one direction."""
    rows, columns = inverse.shape
    found, n = np.empty(inverse.size, np.float32), 0
    for v in range(down, rows - down):
        for u in range(right, columns - right):
            if known[v, u] and known[v - down, u - right] and known[v + down, u + right]:
                ends = inverse[v - down, u - right] + inverse[v + down, u + right]
                found[n] = abs(np.float32(0.5) * ends - inverse[v, u])
                n += 1
    return found[:n]


@kernel
def _mean(depth: np.ndarray, wanted: np.ndarray, half: int, stride: int) -> tuple[np.ndarray, np.ndarray]:
    """1 / depth, float32 on the grid, averaged over the wanted pixels of a square, and where nearly all are wanted.

    Sums of columns go down the image with the squares, and sums of these along its rows.
    """
    height, width = depth.shape
    mean = np.zeros(((height + stride - 1) // stride, (width + stride - 1) // stride), np.float32)
    known = np.zeros(mean.shape, np.bool_)
    totals, counts = np.zeros(width), np.zeros(width)
    share = 1.0 / ((2 * half + 1) * (2 * half + 1))
    top = bottom = 0
    for i in range(mean.shape[0]):
        while bottom < min(i * stride + half + 1, height):
            _add_row(depth[bottom], wanted[bottom], 1.0, totals, counts)
            bottom += 1
        while top < i * stride - half:
            _add_row(depth[top], wanted[top], -1.0, totals, counts)
            top += 1
        total, count, left, right = 0.0, 0.0, 0, 0
        for j in range(mean.shape[1]):
            while right < min(j * stride + half + 1, width):
                total, count, right = total + totals[right], count + counts[right], right + 1
            while left < j * stride - half:
                total, count, left = total - totals[left], count - counts[left], left + 1
            full = np.float32(count * share)
            if full > _FULL:
                mean[i, j], known[i, j] = np.float32(total * share) / full, True
    return mean, known


@inline_kernel
def _add_row(depth: np.ndarray, wanted: np.ndarray, sign: float, totals: np.ndarray, counts: np.ndarray) -> None:
    """Add what is wanted of a row of pixels to the sums of their columns."""
    for u in range(len(totals)):
        known = sign if wanted[u] else 0.0
        totals[u] += known * np.float32(1.0 / min(max(depth[u], _NEAREST), _FARTHEST))
        counts[u] += known


def _steps(filled: np.ndarray, wanted: np.ndarray, stride: int) -> np.ndarray:
    """Grid samples that have the near side of a depth step in their square or beside it."""
    near = depth_steps.edges(filled, wanted, depth_steps.STEP).astype(np.uint8)
    size = 2 * (stride // 2) + 3
    return cv2.dilate(near, np.ones((size, size), np.uint8))[::stride, ::stride] > 0


@kernel
def _fold(inverse: np.ndarray, known: np.ndarray, rho: int, pixel: float) -> np.ndarray:
    """s (rows, columns), the strongest over the directions; NaN where no chord lies within the known."""
    rows, columns = inverse.shape
    strongest = np.full(inverse.shape, np.nan, np.float32)
    for down, right in _DIRECTIONS:
        reach = rho if down * right == 0 else max(1, round(rho / np.sqrt(2)))
        length = np.float32(reach * np.hypot(down, right) * pixel)
        margin = reach * abs(right)
        for v in range(reach * down, rows - reach * down):
            for u in range(margin, columns - margin):
                if not known[v, u]:
                    continue
                is_known = True
                for t in range(-reach, reach + 1):
                    is_known &= known[v + t * down, u + t * right]
                if is_known:
                    a, b = inverse[v - reach * down, u - reach * right], inverse[v + reach * down, u + reach * right]
                    s = (np.float32(0.5) * (a + b) - inverse[v, u]) / (inverse[v, u] * length)
                    if not abs(s) <= abs(strongest[v, u]):
                        strongest[v, u] = s
    return strongest


def _large(labels: np.ndarray, least: int) -> np.ndarray:
    """Those with at least so many samples, the largest ones if there are very many; labels from 1."""
    counts = regions.extents(labels)[:, 0]
    kept = counts >= least
    if np.count_nonzero(kept) > _MOST_PATCHES:
        kept = np.zeros(len(counts), bool)
        kept[np.argsort(-counts, kind="stable")[:_MOST_PATCHES]] = True
    number = np.zeros(len(counts), np.int32)
    number[kept] = np.arange(1, np.count_nonzero(kept) + 1)
    return regions.renumbered(labels, number)


def _shapes(
    seeds: np.ndarray, count: int, inverse: np.ndarray, camera: Camera, stride: int, least_bend: float
) -> tuple[np.ndarray, np.ndarray]:
    """Curvature (count + 1,) and plane (count + 1, 3) of the smooth part of each patch; 0 and NaN for small ones.

    With x = (u - cx)/fx and y = (v - cy)/fy, the second derivative of w in x or y is the curvature of a surface seen
    frontally, 1 / metres, positive where it is hollow.  What may be noise counts as 0.
    """
    samples = np.bincount(seeds.ravel(), minlength=count + 1)
    scale = np.array([stride / camera.fx, stride / camera.fy])
    middle = np.array([camera.cx, camera.cy]) / stride
    centre, gram = _grams(seeds, inverse, scale, middle, count)
    curvature, planes = np.zeros(count + 1), np.full((count + 1, 3), np.nan)
    large = np.flatnonzero(samples[1:] >= 2 * _SHAPE_TERMS) + 1
    gram, centre = gram[large], centre[large]
    flat = _solved(gram, 3)
    planes[large] = flat
    planes[large, 2] -= np.einsum("ij,ij->i", flat[:, :2], centre)
    bent = _solved(gram, _SHAPE_TERMS)
    # What the curvature explains, w - w_plane, may be noise if it is small beside that of single pixels.
    explained = np.einsum("ij,ij->i", bent, gram[:, :6, 6]) - np.einsum("ij,ij->i", flat, gram[:, :3, 6])
    curvature[large] = np.where(explained > samples[large] * least_bend**2, 2 * (bent[:, 3] + bent[:, 5]), 0)
    return curvature, planes


def _solved(gram: np.ndarray, terms: int) -> np.ndarray:
    """Least squares (n, terms) by the first terms, of normal equations (n, 7, 7) whose last column is the right side.

    Terms that the samples do not tell apart are shared out, as by the pseudoinverse.
    """
    scale = 1 / np.sqrt(np.maximum(np.einsum("ijj->ij", gram[:, :terms, :terms]), 1e-300))
    normal = gram[:, :terms, :terms] * scale[:, :, None] * scale[:, None, :]
    inverse = np.linalg.pinv(normal, rcond=1e-12, hermitian=True)
    return scale * np.einsum("ijk,ik->ij", inverse, scale * gram[:, :terms, 6])


@kernel
def _grams(
    seeds: np.ndarray, inverse: np.ndarray, scale: np.ndarray, middle: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Of each patch the middle (count + 1, 2), and the sums of the products (count + 1, 7, 7) of p, q, 1, p p, p q, q q
    and w, p and q counted from there."""
    rows, columns = seeds.shape
    centre, number = np.zeros((count + 1, 2)), np.zeros(count + 1)
    for r in range(rows):
        for c in range(columns):
            label = seeds[r, c]
            if label > 0:
                number[label] += 1
                centre[label, 0] += scale[0] * (c - middle[0])
                centre[label, 1] += scale[1] * (r - middle[1])
    for label in range(count + 1):
        centre[label] /= max(number[label], 1.0)
    gram = np.zeros((count + 1, 7, 7))
    for r in range(rows):
        for c in range(columns):
            label = seeds[r, c]
            if label > 0:
                p, q = scale[0] * (c - middle[0]) - centre[label, 0], scale[1] * (r - middle[1]) - centre[label, 1]
                term = (p, q, 1.0, p * p, p * q, q * q, np.float64(inverse[r, c]))
                for i in range(7):
                    for j in range(7):
                        gram[label, i, j] += term[i] * term[j]
    return centre, gram
