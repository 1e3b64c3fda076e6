"""Numbers of a depth image to metres: the one place that knows units, marks of "nothing measured" and ranges.

    z = number / scale              scale: units a metre
    z = range / |((u - cx) / fx, (v - cy) / fy, 1)|

The scale is the caller's; else the one that a file or camera states; else 1000 for whole numbers and 1 for floats (REP
118).  No reading are 0, negative numbers, NaN, what is beyond 100 km, and

- the largest number that an integer, or half precision, holds;
- a number that many pixels share exactly, beyond all other readings by a fifth, if programs use it for this (2^k - 1,
  10 000 or 100 000, as it stands, or in millimetres), or a tenth of its pixels are holes in surfaces.

So a flat wall, a floor seen from straight above, quantised depths and readings that a sensor clips at its range stay
what they are: the first two lie around things and not in them, the others have readings just before them.

A Kinect's raw disparities (11 bit, 2047 = nothing) look like millimetres.  They are linear in the pixels of a plane,
where a depth image has a linear 1/z; an image of them is refused.

An image of distances to the camera's centre in place of z has planes that bend like spheres around it.  With r the ray
(x, y, 1) of a pixel and a plane n.p + d = 0, the number v of its pixels is, for a and k,

    1/v = a.r / |r|^k            k = 0: z,   k = 1: range,   a = -n / d

linear in a for each k.  The plane with most readings is sought for both; ranges are those where k = 1 has clearly more
of them and k, fitted to them, is 1.  A table that itself bends by 1 or 2 % of its length is none of them, and where the
support spans so little of the image that such a bend would do, nothing is said.

Reference: REP 118; https://openkinect.org/wiki/Imaging_Information for the disparities.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from sq_perception.geometry.kernels import inline_kernel, kernel
from sq_perception.imaging.camera import GREATEST_DEPTH, Camera

DepthKind = Literal["z", "range"]
"""What a depth image holds: z along the optical axis, or the distance to the camera's centre along each ray."""
MILLIMETRES = 1000.0  # units a metre
_STRAYS = 0.01  # share of the readings that may lie in between, as where an image was scaled down
_NO_DISPARITY = 2047  # raw number of a Kinect that measured nothing
_TOLERANCE = 0.006  # of a plane, as a share of the distance
_LEVER = 0.01  # root mean square of log |r| on the plane, beside what a tilt explains


class UnitsError(ValueError):
    """Numbers that are no depths; the message says what they seem to be and what to do."""


@dataclass(frozen=True)
class Stated:
    """Units a metre of whole numbers, and the words for where that stands."""

    scale: float
    source: str


@dataclass(frozen=True, eq=False)
class Metres:
    """A depth image, float32 (height, width) in metres, NaN where nothing was measured; the units a metre that were
    used; and ``notes`` on what the numbers alone do not show, in the same words for each image of a camera."""

    depth: np.ndarray
    scale: float = 1.0
    notes: tuple[str, ...] = ()


def parse_scale(value: float, where: str) -> Stated:
    """The unit of a ``depth_scale``, whose convention shows in its magnitude; ValueError unless it is positive."""
    if not 0 < value < math.inf:
        raise ValueError(f"{where}: expected a positive number, got {value:g}")
    # A stated depth_scale up to the first is metres a unit (librealsense: 0.001, 0.000125), up to the second
    # millimetres a unit (BOP: 0.1, 1), beyond it units a metre (TUM: 5000): no known one is within a factor of 2 of
    # either.
    if value <= 0.005:
        return Stated(1 / value, f"{where} = {value:g} (metres a unit)")
    if value <= 50.0:
        return Stated(MILLIMETRES / value, f"{where} = {value:g} (millimetres a unit)")
    return Stated(value, f"{where} = {value:g} (units a metre)")


def metres(numbers: np.ndarray, scale: float | None = None, known: Stated | None = None) -> Metres:
    """Depth of the numbers (height, width) of an image, by the units a metre of the caller, ``scale``, or those
    ``known`` of its file, which of floats only count where they can hardly be metres.  Raises UnitsError for raw
    disparities."""
    is_whole = numbers.dtype.kind in "iu"
    notes: list[str] = []
    used = scale or (MILLIMETRES if is_whole else 1.0)
    if scale is None and known is not None and (is_whole or wrong_unit(numbers)):
        used = known.scale
        notes.append(f"{used:.6g} units are a metre: {known.source}")
    with np.errstate(all="ignore"):  # of what is no number, or none that a float holds
        depth = (numbers if used == 1 else np.divide(numbers, used, dtype=float)).astype(np.float32)
        none = ~((depth > 0) & (depth <= GREATEST_DEPTH))
    if is_whole or numbers.dtype.itemsize == 2:
        largest = np.iinfo(numbers.dtype).max if is_whole else np.finfo(numbers.dtype).max
        saturated = numbers == largest
        if saturated.any():
            none |= saturated
            notes.append(f"{largest:g} is taken for no reading, as it is the largest number of {numbers.dtype.name}")
    depth[none] = np.nan
    while mark := _mark(depth, used):
        if is_whole and scale is None and known is None and round(mark * used) == _NO_DISPARITY:
            _refuse_disparities(numbers)
        depth[depth == mark] = np.nan
        notes.append(
            f"{mark * used:.6g}{' m' * (used == 1)} is taken for no reading, as many pixels have just this number, "
            "beyond all others"
        )
    return Metres(depth, used, tuple(notes))


def z_from_range(ranges: np.ndarray, camera: Camera) -> np.ndarray:
    """Depth z, float32 (height, width), of distances to the centre of a pinhole camera, metres."""
    if not camera.is_pinhole:
        return ranges
    x = (np.arange(camera.width) - camera.cx) / camera.fx
    y = (np.arange(camera.height) - camera.cy) / camera.fy
    return (ranges / np.sqrt(1 + x**2 + y[:, None] ** 2)).astype(np.float32)


def wrong_unit(depth: np.ndarray) -> str:
    """The complaint where depths (height, width), metres, are those of no camera; empty for others."""
    some = depth[::8, ::8]
    some = some[(some > 0) & (some < np.inf)]
    middle = float(np.median(some)) if some.size else 1.0
    if middle > 100:
        found, unit = "farther than 100 m", "millimetres the depth scale is 1000"
    elif middle < 0.01:
        found, unit = "nearer than 0.01 m", "metres the depth scale is 1"
    else:
        return ""
    return f"half of the image is {found}: for {unit} (--depth-scale of commands, depth_scale of nodes)"


def _mark(depth: np.ndarray, scale: float) -> float | None:
    """The greatest reading, if it is a mark of pixels without one; None if it is not."""
    top = np.fmax.reduce(depth, axis=None)
    held = depth == top
    count = np.count_nonzero(held)
    # Share of an image's pixels, and their number, that stray readings do not reach.
    if count < max(1e-4 * depth.size, 10):  # of NaN, too
        return None
    others = depth[depth < top]
    # Ratio of a mark to the readings before it.
    if np.count_nonzero(others > top / 1.2) > _STRAYS * others.size or not others.size:
        return None
    if any(_is_code(float(top) * unit) for unit in (scale, MILLIMETRES)):
        return float(top)
    none = (held | np.isnan(depth)).astype(np.uint8)
    _, parts, boxes, _ = cv2.connectedComponentsWithStats(none, connectivity=4)
    left, upper, width, height, _ = boxes.T
    is_hole = (left > 0) & (upper > 0) & (left + width < depth.shape[1]) & (upper + height < depth.shape[0])
    # Share of a mark's pixels in holes, which have readings all around.
    return float(top) if np.count_nonzero(is_hole[parts[held]]) >= 0.1 * count else None


def _is_code(value: float) -> bool:
    """Whether a number is one that programs write where they have none."""
    whole = round(value)
    is_full = whole >= 1023 and (whole + 1) & whole == 0
    return abs(value - whole) < 1e-6 * value and (is_full or whole in (10_000, 100_000))


def _refuse_disparities(numbers: np.ndarray) -> None:
    """Raise UnitsError if planes of the image are linear in its numbers, and not in their inverses."""
    step = max(1, math.isqrt(numbers.size // 4000))
    v, u = np.nonzero((numbers[::step, ::step] > 0) & (numbers[::step, ::step] < _NO_DISPARITY))
    value = numbers[::step, ::step][v, u].astype(float)
    low, high = 300, 1090  # half a metre, ten metres
    if value.size < 100 or np.count_nonzero((value < low) | (value > high)) > _STRAYS * value.size:
        return
    pixels = np.stack([u, v, np.ones(u.size)], axis=1)
    chosen = np.random.default_rng(0).integers(value.size, size=(300, 3))
    chosen = chosen[np.abs(np.linalg.det(pixels[chosen])) > 1]
    on_plane = []
    for form in (lambda x: x, lambda x: 1 / x):
        planes = np.linalg.solve(pixels[chosen], form(value[chosen])[..., None])[..., 0]
        with np.errstate(divide="ignore"):
            off = np.abs(form(planes @ pixels.T) - value)
        on_plane.append(np.count_nonzero(off < 2, axis=1).max())
    if on_plane[0] > max(1.2 * on_plane[1], 0.3 * value.size):
        raise UnitsError(
            "these seem to be the raw disparities of a Kinect (11 bit, 2047 = nothing), not millimetres: record depth "
            "in millimetres (freenect: FREENECT_DEPTH_REGISTERED), or convert them: z = 1 / (3.3309 - 0.0030711 raw) m"
        )


def doubt(depth: np.ndarray, camera: Camera) -> str:
    """Why depths (height, width), NaN for nothing, seem to be in another unit or of another kind; empty otherwise."""
    if not camera.is_pinhole:
        return ""
    bent = (
        "the support bends as if the image held distances to the camera's centre in place of z: --depth-kind range of "
        "commands, depth_kind of nodes"
    )
    return wrong_unit(depth) or (bent if seem_ranges(depth, camera) else "")


def seem_ranges(depth: np.ndarray, camera: Camera) -> bool:
    """Whether an image (height, width), NaN where nothing was measured, seems to hold ranges."""
    step = max(1, math.isqrt(depth.size // 2500))  # about so many readings are looked at
    v, u = np.nonzero(np.isfinite(depth[::step, ::step]))
    if not camera.is_pinhole or v.size < 100:
        return False
    number = depth[::step, ::step][v, u].astype(float)
    rays = np.stack([(step * u - camera.cx) / camera.fx, (step * v - camera.cy) / camera.fy, np.ones(u.size)], axis=1)
    length = np.linalg.norm(rays, axis=1)
    bend = np.log(length)
    if bend.std() < _LEVER:  # of the whole image, the plane's is less
        return False
    as_z, as_range = _on_plane(rays, number), _on_plane(rays, number / length)
    count = np.count_nonzero(as_range)
    if count < 0.25 * number.size or count < 1.2 * np.count_nonzero(as_z):
        return False
    # log v = k log |r| - log a.r, linearised at the plane of ranges: a shift of k against shifts of a.
    rays, number, bend, length = rays[as_range], number[as_range], bend[as_range], length[as_range]
    plane = np.linalg.lstsq(rays, length / number, rcond=None)[0]
    tilts = rays / (rays @ plane)[:, None]
    across = bend - tilts @ np.linalg.lstsq(tilts, bend, rcond=None)[0]
    left = np.log(number * (rays @ plane) / length)
    k = 1 + across @ left / (across @ across)
    return bool(np.sqrt(np.mean(across**2)) > _LEVER and 0.75 < k < 1.25)


def _on_plane(rays: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Which of the points z * rays lie on the plane that has most of them, by 600 points for each of 150 planes."""
    rng = np.random.default_rng(0)
    some = rng.permutation(z.size)[:600]
    return np.asarray(_search(rays, z, some, rng.integers(z.size, size=(150, 3))))


@kernel
def _search(rays: np.ndarray, z: np.ndarray, some: np.ndarray, drawn: np.ndarray) -> np.ndarray:
    """:func:`_on_plane` by planes a, a.r = 1/z, through three drawn points each, and the best one's least squares."""
    plane, most, refits = np.zeros(3), 0, 4
    for i, j, m in drawn:
        across = _cross(rays[j], rays[m])
        volume = (rays[i] * across).sum()
        if abs(volume) <= 1e-4:
            continue
        a = (across / z[i] + _cross(rays[m], rays[i]) / z[j] + _cross(rays[i], rays[j]) / z[m]) / volume
        count = 0
        for n in some:
            count += abs((a[0] * rays[n, 0] + a[1] * rays[n, 1] + a[2] * rays[n, 2]) * z[n] - 1.0) < _TOLERANCE
        if count > most:
            plane, most = a, count
    on = np.zeros(z.size, np.bool_)
    for step in range(refits + 1):
        square, right = np.zeros((3, 3)), np.zeros(3)
        for n in range(z.size):
            x, y, w = rays[n, 0] * z[n], rays[n, 1] * z[n], rays[n, 2] * z[n]
            on[n] = abs(plane[0] * x + plane[1] * y + plane[2] * w - 1.0) < _TOLERANCE
            if on[n]:
                row = (x, y, w)
                for k in range(3):
                    right[k] += row[k]
                    for m in range(3):
                        square[k, m] += row[k] * row[m]
        if step == refits or np.count_nonzero(on) < 3:
            break
        plane[:] = np.linalg.solve(square, right)
    return on


@inline_kernel
def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
