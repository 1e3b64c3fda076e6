"""Lines of sight between samples of segments, walked in a depth image: which are crossed, and where pixels go.

Equation
--------
Two points of a convex body are joined by a straight line inside it.  In a pinhole image that line is straight again,
and the inverse depth w = 1/z is linear along it:

    w(t) = (1 - t) w_i + t w_j    at the pixel    (1 - t) (u, v)_i + t (u, v)_j,    0 < t < 1.

Where a pixel on the way measured something farther than the line, by more than the noise, the line crosses empty space,
and the two points belong to two bodies, or to one that is not convex.  Something nearer hides the line and says
nothing.

A line is crossed where what was seen lies behind it by ``noise`` times the square of the depth, and by ``least``
metres, or a hundredth of the depth where that is less.  Samples are pixels on a grid.  Metres and pixels; depth is 0
where there is none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sq_perception.geometry.kernels import inline_kernel, kernel
from sq_perception.geometry.quantiles import quantile
from sq_perception.imaging import regions
from sq_perception.imaging.camera import Camera
from sq_perception.imaging.depth_steps import STEP

LEAST_SAMPLES = 4
"""Fewest samples of a segment: six pairs."""
_LEAST_GAP = 0.005
"""Metres that a crossed line lies before what was seen."""
_STEPS = 16
"""Steps in which a line is walked: gaps between round things that touch are narrow."""
_FINE_STEPS = 24
"""Steps of a line that passes behind something: a nearer thing of a tenth of it is met by two of them."""
_SHARE = 0.01
"""Share of the depth beyond which the least distance behind a line does not go."""
_HOME = 0.1
"""A pixel leaves the part of its nearest sample only if another one's lines are so much freer."""


def stride(pixels: int, count: int) -> int:
    """The stride of a grid that takes about ``count`` of so many pixels, at most twice as many."""
    step = max(1, math.isqrt(pixels // count))
    return step + 1 if pixels > 2 * count * step**2 else step


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of a segment: pixels (n, 2) as row and column, points (n, 3), their spacing on the grid and their median
    depth, metres, and the area of the whole segment across the line of sight, square metres."""

    label: int
    pixels: np.ndarray
    points: np.ndarray
    spacing: float
    distance: float
    area: float

    @property
    def z(self) -> np.ndarray:
        return self.points[:, 2]


@dataclass(frozen=True, eq=False)
class SampledImage:
    """Depth float32 and labels int32 (height, width), a pinhole camera, and the ``noise`` and ``least`` by which a line
    is crossed."""

    depth: np.ndarray
    labels: np.ndarray
    camera: Camera
    noise: float
    least: float = _LEAST_GAP

    @property
    def focal(self) -> float:
        return math.sqrt(self.camera.fx * self.camera.fy)

    def sample(self, label: int, extent: np.ndarray, count: int) -> Samples | None:
        """Take some ``count`` samples of a segment; None where they are too few to say anything."""
        size, top, bottom, left, right = extent.tolist()
        step = stride(size, count)
        top, left = (first + (step // 2 - first) % step for first in (top, left))
        window = slice(top, bottom, step), slice(left, right, step)
        rows, columns = np.nonzero((self.labels[window] == label) & (self.depth[window] > 0))
        if len(rows) < LEAST_SAMPLES:
            return None
        rows, columns = top + step * rows, left + step * columns
        points = self.camera.unproject(columns, rows, self.depth[rows, columns].astype(float))
        distance = quantile(points[:, 2], 0.5)
        width = distance / self.focal
        return Samples(label, np.stack([rows, columns], axis=-1), points, step * width, distance, size * width**2)

    def within(self, samples: Samples) -> tuple[np.ndarray, np.ndarray]:
        """For each pair of samples (n, n), 1 where the line between them is crossed, else 0, and their distance,
        metres."""
        return _within(samples.pixels, samples.points, self.depth, self.noise, self.least)

    def pieces(
        self, extent: np.ndarray, samples: Samples, group: np.ndarray, count: int
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Rows and columns of each piece of a segment, by groups (n,) of its samples, of which there are about
        ``count``."""
        rows, columns = regions.pixels(self.labels, samples.label, extent)
        block = max(1, stride(len(rows), count) // 4)
        chosen = _assign(
            rows, columns, samples.pixels, samples.z, group, int(group.max()) + 1, self.depth, self.focal,
            samples.spacing, block, self.noise, self.least,
        )
        pieces = [(rows[chosen == k], columns[chosen == k]) for k in range(int(group.max()) + 1)]
        return [piece for piece in pieces if len(piece[0])]


@inline_kernel
def _crossed(
    v0: float, u0: float, z0: float, v1: float, u1: float, z1: float, depth: np.ndarray, noise: float, least: float
) -> bool:
    """Whether something lies behind the line between two pixels."""
    w0, w1 = 1.0 / z0, 1.0 / z1
    for k in range(1, _STEPS):
        t = k / _STEPS
        seen = np.float64(depth[int((1 - t) * v0 + t * v1 + 0.5), int((1 - t) * u0 + t * u1 + 0.5)])
        line = 1.0 / ((1 - t) * w0 + t * w1)
        if seen - line > max(noise * line * line, min(least, _SHARE * line)):
            return True
    return False


@kernel
def between(
    pixels: np.ndarray, points: np.ndarray, ends: np.ndarray, reach: np.ndarray, beside: np.ndarray, depth: np.ndarray,
    noise: float, least: float,
) -> np.ndarray:
    """Share (n, n) of crossed lines between the samples of each two of n segments.

    The samples of segment k are the rows ``ends[k]`` to ``ends[k + 1]``.  inf for two that are neither ``beside`` each
    other, bool (n, n), nor have samples nearer to each other than the sum of their reaches (n,), metres.
    """
    n = len(ends) - 1
    share = np.full((n, n), np.inf)
    for a in range(n):
        for b in range(a):
            nearest, count = np.inf, 0
            for i in range(ends[a], ends[a + 1]):
                for j in range(ends[b], ends[b + 1]):
                    x, y, z = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2]
                    nearest = min(nearest, x * x + y * y + z * z)
            if not beside[a, b] and nearest > (reach[a] + reach[b]) ** 2:
                continue
            lines = (ends[a + 1] - ends[a]) * (ends[b + 1] - ends[b])
            for i in range(ends[a], ends[a + 1]):
                for j in range(ends[b], ends[b + 1]):
                    p, q = pixels[i], pixels[j]
                    count += _crossed(p[0], p[1], points[i, 2], q[0], q[1], points[j, 2], depth, noise, least)
            share[a, b] = share[b, a] = count / lines
    return share


@kernel
def hidden(
    pixels: np.ndarray, points: np.ndarray, ends: np.ndarray, names: np.ndarray, wanted: np.ndarray, depth: np.ndarray,
    labels: np.ndarray, noise: float, least: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Two shares (n, n) of the lines between the samples of each two of n segments, labelled ``names`` (n,).

    First that of the lines which leave one segment along its surface, pass behind a third one, and enter the other one
    along its surface; then that of crossed lines.  For the ``wanted`` pairs, bool (n, n), by every second sample; 0 for
    others.
    """
    n = len(names)
    along, crossed = np.zeros((n, n)), np.zeros((n, n))
    for a in range(n):
        for b in range(a):
            if not wanted[a, b]:
                continue
            lines, found, over = 0, 0, 0
            for i in range(ends[a], ends[a + 1], 2):
                if lines > 60 and found == 0:  # most pairs have nothing before them
                    break
                for j in range(ends[b], ends[b + 1], 2):
                    lines += 1
                    w0, w1 = 1.0 / points[i, 2], 1.0 / points[j, 2]
                    on_a, on_b, behind, is_off = 0, 0, 0, False
                    for k in range(1, _FINE_STEPS):
                        t = k / _FINE_STEPS
                        v = int((1 - t) * pixels[i, 0] + t * pixels[j, 0] + 0.5)
                        u = int((1 - t) * pixels[i, 1] + t * pixels[j, 1] + 0.5)
                        line = 1.0 / ((1 - t) * w0 + t * w1)
                        beyond = np.float64(depth[v, u]) - line
                        limit = max(noise * line * line, min(least, _SHARE * line))
                        if beyond > limit:
                            is_off = True
                            over += 1
                            break
                        is_nearer = beyond < -limit
                        if labels[v, u] == names[a]:
                            on_a += 1
                            is_off |= is_nearer
                        elif labels[v, u] == names[b]:
                            on_b += 1
                            is_off |= is_nearer
                        elif labels[v, u] > 0:
                            behind += is_nearer
                    found += not is_off and on_a > 0 and on_b > 0 and behind > 1
            along[a, b] = along[b, a] = found / lines
            crossed[a, b] = crossed[b, a] = over / lines
    return along, crossed


@kernel
def _within(
    pixels: np.ndarray, points: np.ndarray, depth: np.ndarray, noise: float, least: float
) -> tuple[np.ndarray, np.ndarray]:
    """As :meth:`SampledImage.within`."""
    n = pixels.shape[0]
    crossed, far = np.zeros((n, n)), np.zeros((n, n))
    for i in range(n):
        for j in range(i):
            p, q = pixels[i], pixels[j]
            if _crossed(p[0], p[1], points[i, 2], q[0], q[1], points[j, 2], depth, noise, least):
                crossed[i, j] = crossed[j, i] = 1.0
            x, y, z = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2]
            far[i, j] = far[j, i] = math.sqrt(x * x + y * y + z * z)
    return crossed, far


@kernel
def _assign(
    rows: np.ndarray, columns: np.ndarray, samples: np.ndarray, z: np.ndarray, part: np.ndarray, parts: int,
    depth: np.ndarray, focal: float, spacing: float, block: int, noise: float, least: float,
) -> np.ndarray:
    """The part (n,) of each pixel: that of the nearest sample, or, of those almost as near, of the one to whose
    samples most lines are free.  The first pixel of each block that is so many pixels wide speaks for those at its
    depth."""
    # Samples part by part, in rows: to look for the nearest one of a part is vector code.
    order = np.argsort(part, kind="mergesort")
    down, right, away = samples[order, 0].astype(np.float64), samples[order, 1].astype(np.float64), z[order]
    ends = np.searchsorted(part[order], np.arange(parts + 1))
    chosen = np.zeros(rows.size, np.int64)
    nearest = np.empty(parts)
    first = np.full((depth.shape[0] // block + 1, depth.shape[1] // block + 1), -1)
    for i in range(rows.size):
        v, u = rows[i], columns[i]
        here = np.float64(depth[v, u])
        other = first[v // block, u // block]
        if other >= 0 and abs(depth[rows[other], columns[other]] - here) < STEP * here:
            chosen[i] = chosen[other]
            continue
        first[v // block, u // block] = i
        width = here / focal
        for k in range(parts):
            least_square = np.inf
            for j in range(ends[k], ends[k + 1]):
                vertical, across, along = (down[j] - v) * width, (right[j] - u) * width, away[j] - here
                least_square = min(least_square, vertical * vertical + across * across + along * along)
            nearest[k] = least_square
        best = int(np.argmin(nearest))
        chosen[i] = best
        limit = (math.sqrt(nearest[best]) + spacing) ** 2
        if np.count_nonzero(nearest <= limit) < 2:
            continue
        least_share = np.inf
        for k in range(parts):
            if nearest[k] <= limit:
                over = 0
                for j in range(ends[k], ends[k + 1]):
                    over += _crossed(v, u, here, down[j], right[j], away[j], depth, noise, least)
                share = over / (ends[k + 1] - ends[k]) + (0.0 if k == best else _HOME)
                if share < least_share or (share == least_share and k == best):
                    least_share, chosen[i] = share, k
    return chosen
