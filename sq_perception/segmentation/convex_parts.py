"""Convex bodies among the segments of a depth image, told by lines of sight within them.

Equation
--------
Two points of a convex body are joined by a straight line inside it.  In a pinhole image that line is straight again,
and the inverse depth w = 1/z is linear along it:

    w(t) = (1 - t) w_i + t w_j    at the pixel    (1 - t) (u, v)_i + t (u, v)_j,    0 < t < 1.

Where a pixel on the way measured something farther than the line, by more than the noise, the line crosses empty space,
and the two points belong to two bodies, or to one that is not convex.  Something nearer hides the line and says
nothing.  Within a body next to no pair of samples is crossed; among bodies that touch, half of the pairs or more.
That holds over the whole width of the bodies: noise that bends the surface where they touch is outvoted.

Steps
-----
1. A segment of whose pairs many are crossed is taken apart: its samples are clustered by average linkage, the distance
   being the share of crossed pairs (and a little of the metric one, which orders those that nothing parts).  The parts
   must be convex; those of a vessel, whose inner wall lies behind its own lines, are not, and it stays whole.
2. Neighbouring segments between which few pairs are crossed are one body.
3. Pixels go to the part of the nearest sample; where near ones disagree, to the part to which most lines are free.

Metres and pixels; depth is 0 where there is none.
Reference: S. Asafi, A. Goren, D. Cohen-Or, Weak Convex Decomposition by Lines-of-sight, SGP 2013.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage

from sq_perception.geometry.kernels import inline_kernel, kernel
from sq_perception.imaging.camera import Camera

_STEPS = 8
_FEW, _MANY, _MOST_SEGMENTS = 30, 160, 25
_FEWEST_PIXELS = 30
_LEAST_SAMPLES = 4
_LEAST_SHARE = 0.04
_METRIC = 0.3
_HOME = 0.1
_NEVER = 9.0


@dataclass(frozen=True)
class SightOptions:
    """When segments are taken apart and put together.

    Attributes
    ----------
    noise_margin, least_gap
        A line is crossed where what was seen lies behind it by so many standard deviations of the noise, and by so many
        metres.
    suspicious
        Share of crossed pairs from which on a segment may be several bodies.
    convex
        Share of crossed pairs that the parts of a segment have on average, at most, and each of them at most twice.
    apart
        Share of crossed pairs, on average, between parts of a segment: more than half, as between bodies that touch.
    one_body
        Segments with a smaller share of crossed pairs between them are one body.
    hollow
        A part whose surface lies behind its own lines, on average by that many standard deviations of the noise, is the
        inside of a vessel.
    hollow_vessel
        The same for segments that look hollow by other signs.
    least_area
        Of a part, square metres across the line of sight.
    near
        Neighbouring segments are no farther apart, metres, beyond the distance of their samples.
    """

    noise_margin: float = 3.0
    least_gap: float = 0.005
    suspicious: float = 0.12
    convex: float = 0.12
    apart: float = 0.55
    one_body: float = 0.3
    hollow: float = 0.7
    hollow_vessel: float = 0.1
    least_area: float = 8e-4
    near: float = 0.03

    def __post_init__(self) -> None:
        for name in ("noise_margin", "least_gap", "hollow", "hollow_vessel", "least_area", "near"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: expected a positive number, got {getattr(self, name)}")
        for name in ("suspicious", "convex", "apart", "one_body"):
            if not 0 < getattr(self, name) < 1:
                raise ValueError(f"{name}: expected a share between 0 and 1, got {getattr(self, name)}")


def corrected(
    labels: np.ndarray,
    depth: np.ndarray,
    camera: Camera,
    sigma: float,
    vessels: np.ndarray | None = None,
    options: SightOptions | None = None,
) -> np.ndarray:
    """Segments taken apart where they are several convex bodies, and joined where they are one.

    Parameters
    ----------
    labels : int32 (height, width)
        Segments from 1, 0 for nothing; each has a depth.
    depth : float32 (height, width)
        Metres, 0 where nothing was measured.
    camera
        A pinhole camera.
    sigma
        Noise of the depth at one metre, metres; it grows with the square of the depth.
    vessels : bool (count + 1,), optional
        Labels whose surface looks hollow by other signs; these stay whole if one of their parts is only a little so.

    Returns
    -------
    labels : int32 (height, width)
        From 1, in no order; of the same pixels.
    """
    options = options or SightOptions()
    depth, labels = _plain(depth), np.ascontiguousarray(labels)
    segments = _segments(labels)
    if not segments:
        return labels
    result, count = labels.copy(), int(labels.max())
    parts: list[_Part] = []
    for label, pixels in segments:
        part = _Part.of(pixels, depth, camera, label)
        if part is None:
            continue
        crossed, _ = part.lines(depth, labels, sigma, options)
        if crossed.mean() < options.suspicious:
            parts.append(part)
            continue
        hollow = options.hollow_vessel if vessels is not None and vessels[label] else options.hollow
        pieces = _pieces(label, pixels, labels, depth, camera, sigma, hollow, options)
        if not pieces:
            parts.append(part)
        for number, piece_pixels in enumerate(pieces):
            if number > 0:
                count += 1
                result[piece_pixels[:, 0], piece_pixels[:, 1]] = count
            piece = _Part.of(piece_pixels, depth, camera, count if number > 0 else label)
            if piece is not None:
                parts.append(piece)
    number_of = _joined(parts, depth, sigma, options, count)
    return number_of[result]


def parts(
    mask: np.ndarray, depth: np.ndarray, camera: Camera, sigma: float, options: SightOptions | None = None
) -> list[np.ndarray]:
    """Masks (height, width) of the convex parts of a mask; none where it is one, or has no such parts.

    ``depth``, ``camera`` and ``sigma`` as in :func:`corrected`.
    """
    options = options or SightOptions()
    depth, labels = _plain(depth), mask.astype(np.int32)
    pixels = np.stack(np.nonzero(mask & (depth > 0)), axis=-1)
    whole = _Part.of(pixels, depth, camera, 1)
    if whole is None or whole.lines(depth, labels, sigma, options)[0].mean() < options.suspicious:
        return []
    found = []
    for piece in _pieces(1, pixels, labels, depth, camera, sigma, options.hollow, options):
        found.append(np.zeros(mask.shape, bool))
        found[-1][piece[:, 0], piece[:, 1]] = True
    return found


def free_pairs(
    labels: np.ndarray, depth: np.ndarray, camera: Camera, sigma: float, options: SightOptions | None = None
) -> list[tuple[int, int]]:
    """Pairs of labels, the smaller first, between which few lines are crossed, wherever they are in the image.

    Parameters as in :func:`corrected`.  As an object casts lines over the table, which is seen to be farther, such
    segments touch, or something nearer hides all that is between them.
    """
    options = options or SightOptions()
    depth = _plain(depth)
    known = [_Part.of(pixels, depth, camera, label) for label, pixels in _segments(np.where(depth > 0, labels, 0))]
    found = [part for part in known if part is not None]
    return [
        (min(a.label, b.label), max(a.label, b.label))
        for k, a in enumerate(found)
        for b in found[:k]
        if a.crossed_towards(b, depth, sigma, options) < options.one_body
    ]


def warm_up() -> None:
    """Compile, or load from disk, every kernel by parting and joining two balls."""
    camera = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
    v, u = np.indices((camera.height, camera.width))
    radius = np.hypot(np.abs(u - camera.cx) - 12, v - camera.cy) / 12
    depth = np.where(radius < 1, 0.7 - 0.13 * np.sqrt(np.maximum(1 - radius**2, 0)), 1.0)
    corrected((radius < 1).astype(np.int32), depth, camera, 1e-3)


def _plain(depth: np.ndarray) -> np.ndarray:
    """The one layout that kernels are compiled for."""
    return np.ascontiguousarray(depth, dtype=np.float32)


@dataclass(frozen=True, eq=False)
class _Part:
    """A segment's samples: pixels (n, 2) as row and column, points (n, 3), and their distance in metres."""

    label: int
    pixels: np.ndarray
    points: np.ndarray
    spacing: float

    @classmethod
    def of(cls, pixels: np.ndarray, depth: np.ndarray, camera: Camera, label: int, count: int = _FEW) -> _Part | None:
        """Some ``count`` samples on a grid; None where they are too few to say anything."""
        stride = max(1, int(np.sqrt(len(pixels) / count)))
        z = depth[pixels[:, 0], pixels[:, 1]]
        chosen = pixels[(pixels % stride == stride // 2).all(1) & (z > 0)]
        if len(chosen) < _LEAST_SAMPLES:
            return None
        z = depth[chosen[:, 0], chosen[:, 1]].astype(float)
        spacing = stride * float(np.median(z)) / float(np.sqrt(camera.fx * camera.fy))
        return cls(label, chosen, camera.unproject(chosen[:, 1], chosen[:, 0], z), spacing)

    def lines(
        self, depth: np.ndarray, labels: np.ndarray, sigma: float, options: SightOptions
    ) -> tuple[np.ndarray, np.ndarray]:
        """Of each pair of samples (n, n): 1 where its line is crossed, and the mean gap behind it, metres."""
        return _within(self.pixels, self.points[:, 2], depth, labels, *_limits(sigma, options))

    def crossed_towards(self, other: _Part, depth: np.ndarray, sigma: float, options: SightOptions) -> float:
        """Share of crossed lines to the samples of another one."""
        return float(
            _between(self.pixels, self.points[:, 2], other.pixels, other.points[:, 2], depth, *_limits(sigma, options))
        )


def _limits(sigma: float, options: SightOptions) -> tuple[float, float]:
    return options.noise_margin * sigma, options.least_gap


def _segments(labels: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """The largest segments with their pixels (n, 2)."""
    flat = np.flatnonzero(labels)
    numbers = labels.ravel()[flat]
    order = np.argsort(numbers.astype(np.uint16) if numbers.size and numbers.max() < 2**16 else numbers, kind="stable")
    counts = np.bincount(numbers, minlength=1)
    ends = np.cumsum(counts)
    largest = np.argsort(-counts, kind="stable")[:_MOST_SEGMENTS]
    found = []
    for label in largest[counts[largest] >= _FEWEST_PIXELS]:
        rows, columns = np.divmod(flat[order[ends[label] - counts[label] : ends[label]]], labels.shape[1])
        found.append((int(label), np.stack([rows, columns], axis=-1)))
    return found


def _pieces(
    label: int,
    pixels: np.ndarray,
    labels: np.ndarray,
    depth: np.ndarray,
    camera: Camera,
    sigma: float,
    hollow: float,
    options: SightOptions,
) -> list[np.ndarray]:
    """Pixels (n, 2) of each convex part of a segment; nothing where it has no such parts."""
    whole = _Part.of(pixels, depth, camera, label, _MANY)
    if whole is None:
        return []
    crossed, gap = whole.lines(depth, labels, sigma, options)
    far = np.linalg.norm(whole.points[:, None] - whole.points[None], axis=-1)
    upper = np.triu_indices(len(far), 1)
    tree = linkage((crossed + _METRIC * far / max(far.max(), 1e-9))[upper], "average")
    part = fcluster(tree, options.apart, "distance") - 1
    large = np.bincount(part) >= max(_LEAST_SAMPLES, _LEAST_SHARE * len(part), options.least_area / whole.spacing**2)
    if np.count_nonzero(large) < 2:
        return []
    # What is too small for a part joins the one that it is nearest to.
    keep = np.flatnonzero(large[part])
    part = part[keep[np.argmin(far[:, keep], axis=1)]]
    part = np.unique(part, return_inverse=True)[1]
    same = part[:, None] == part[None]
    within = np.array([crossed[np.ix_(part == k, part == k)].mean() for k in range(part.max() + 1)])
    if crossed[same].mean() > options.convex or within.max() > 2 * options.convex:
        return []
    behind = np.array([gap[np.ix_(part == k, part == k)].mean() for k in range(part.max() + 1)])
    level = sigma * float(np.median(whole.points[:, 2])) ** 2
    if (behind > hollow * level).any():
        return []
    focal = float(np.sqrt(camera.fx * camera.fy))
    limits = _limits(sigma, options)
    chosen = _assigned(
        pixels, whole.pixels, whole.points[:, 2], part, int(part.max()) + 1, depth, focal, whole.spacing, *limits
    )
    pieces = [pixels[chosen == k] for k in range(part.max() + 1)]
    return [piece for piece in pieces if len(piece) >= _FEWEST_PIXELS]


def _joined(parts: list[_Part], depth: np.ndarray, sigma: float, options: SightOptions, count: int) -> np.ndarray:
    """New label (count + 1,) of each label."""
    number = np.arange(count + 1)
    n = len(parts)
    if n < 2:
        return number
    crossed = np.full((n, n), _NEVER)
    size = np.array([len(part.pixels) for part in parts], float)
    middle = np.array([part.points.mean(0) for part in parts])
    reach = np.array([np.linalg.norm(part.points - m, axis=1).max() for part, m in zip(parts, middle, strict=True)])
    for i in range(n):
        for j in range(i):
            a, b = parts[i], parts[j]
            allowed = options.near + 0.7 * (a.spacing + b.spacing)
            if np.linalg.norm(middle[i] - middle[j]) > reach[i] + reach[j] + allowed:
                continue
            square = ((a.points[:, None] - b.points[None]) ** 2).sum(-1).min()
            if square > allowed**2:
                continue
            crossed[i, j] = crossed[j, i] = a.crossed_towards(b, depth, sigma, options)
    while True:
        i, j = divmod(int(np.argmin(crossed)), n)
        if crossed[i, j] >= options.one_body:
            return number
        number[number == parts[j].label] = parts[i].label
        # Shares between the joined one and others, weighted by samples; where one of both is no neighbour, the other's.
        a, b = crossed[i], crossed[j]
        mixed = (size[i] * a + size[j] * b) / (size[i] + size[j])
        mixed = np.where(a >= _NEVER, b, np.where(b >= _NEVER, a, mixed))
        crossed[i], crossed[:, i] = mixed, mixed
        crossed[j], crossed[:, j], crossed[i, i] = _NEVER, _NEVER, _NEVER
        size[i] += size[j]


@inline_kernel
def _crossed(
    v0: float, u0: float, z0: float, v1: float, u1: float, z1: float, depth: np.ndarray, noise: float, least: float
) -> bool:
    """Whether something lies behind the line between two pixels."""
    for k in range(1, _STEPS):
        t = k / _STEPS
        seen = np.float64(depth[int((1 - t) * v0 + t * v1 + 0.5), int((1 - t) * u0 + t * u1 + 0.5)])
        line = 1.0 / ((1 - t) / z0 + t / z1)
        if seen - line > max(noise * line * line, least):
            return True
    return False


@kernel
def _between(
    pixels: np.ndarray,
    z: np.ndarray,
    others: np.ndarray,
    z_others: np.ndarray,
    depth: np.ndarray,
    noise: float,
    least: float,
) -> float:
    """Share of crossed lines between the samples (n, 2) of two segments."""
    count = 0
    for i in range(pixels.shape[0]):
        for j in range(others.shape[0]):
            if _crossed(pixels[i, 0], pixels[i, 1], z[i], others[j, 0], others[j, 1], z_others[j], depth, noise, least):
                count += 1
    return count / (pixels.shape[0] * others.shape[0])


@kernel
def _within(
    pixels: np.ndarray, z: np.ndarray, depth: np.ndarray, labels: np.ndarray, noise: float, least: float
) -> tuple[np.ndarray, np.ndarray]:
    """Of each pair of samples (n, n): 1 where the line is crossed, and the mean gap behind it over its own segment."""
    n = pixels.shape[0]
    crossed, gaps = np.zeros((n, n), np.float32), np.zeros((n, n), np.float32)
    for i in range(n):
        own = labels[pixels[i, 0], pixels[i, 1]]
        for j in range(i):
            total, count, over = 0.0, 0, 0.0
            for k in range(1, _STEPS):
                t = k / _STEPS
                v = int((1 - t) * pixels[i, 0] + t * pixels[j, 0] + 0.5)
                u = int((1 - t) * pixels[i, 1] + t * pixels[j, 1] + 0.5)
                seen = np.float64(depth[v, u])
                line = 1.0 / ((1 - t) / z[i] + t / z[j])
                gap = seen - line
                if gap > max(noise * line * line, least):
                    over = 1.0
                if seen > 0.0 and labels[v, u] == own:
                    total += gap
                    count += 1
            crossed[i, j] = crossed[j, i] = over
            if count > 0:
                gaps[i, j] = gaps[j, i] = total / count
    return crossed, gaps


@kernel
def _assigned(
    pixels: np.ndarray,
    samples: np.ndarray,
    z: np.ndarray,
    part: np.ndarray,
    parts: int,
    depth: np.ndarray,
    focal: float,
    spacing: float,
    noise: float,
    least: float,
) -> np.ndarray:
    """The part (n,) of each pixel (n, 2): that of the nearest sample, or, of those almost as near, of the one to whose
    samples most lines are free."""
    chosen = np.zeros(pixels.shape[0], np.int64)
    nearest = np.empty(parts)
    over, count = np.empty(parts), np.empty(parts)
    for i in range(pixels.shape[0]):
        v, u = pixels[i, 0], pixels[i, 1]
        here = np.float64(depth[v, u])
        nearest[:] = np.inf
        for j in range(samples.shape[0]):
            down, right = (samples[j, 0] - v) * here / focal, (samples[j, 1] - u) * here / focal
            square = down * down + right * right + (z[j] - here) ** 2
            if square < nearest[part[j]]:
                nearest[part[j]] = square
        best = int(np.argmin(nearest))
        chosen[i] = best
        limit = (math.sqrt(nearest[best]) + spacing) ** 2
        rivals = 0
        for k in range(parts):
            rivals += 1 if nearest[k] <= limit else 0
        if rivals < 2:
            continue
        over[:] = 0.0
        count[:] = 0.0
        for j in range(samples.shape[0]):
            k = part[j]
            if nearest[k] > limit:
                continue
            count[k] += 1
            if _crossed(v, u, here, samples[j, 0], samples[j, 1], z[j], depth, noise, least):
                over[k] += 1
        least_share = over[best] / count[best] - _HOME
        for k in range(parts):
            if nearest[k] <= limit and over[k] / count[k] < least_share:
                least_share = over[k] / count[k]
                chosen[i] = k
    return chosen
