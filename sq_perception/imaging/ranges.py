"""Whether an image holds distances to the camera's centre in place of z: its planes then bend like spheres around it.

With r the ray (x, y, 1) of a pixel and a plane n.p + d = 0, the number v of its pixels is, for a and k,

    1/v = a.r / |r|^k            k = 0: z,   k = 1: range,   a = -n / d

linear in a for each k.  The plane with most readings is sought for both; ranges are those where k = 1 has clearly more
of them and k, fitted to them, is 1.  A table that itself bends by 1 or 2 % of its length is none of them, and where the
support spans so little of the image that such a bend would do, nothing is said.
"""

from __future__ import annotations

import math

import numpy as np

from sq_perception.geometry.kernels import inline_kernel, kernel
from sq_perception.imaging.camera import Camera

RANGES = (
    "the support bends as if the image held distances to the camera's centre in place of z: --depth-kind range of "
    "commands, depth_kind of nodes"
)
_TOLERANCE = 0.006  # of a plane, as a share of the distance
_LEVER = 0.01  # root mean square of log |r| on the plane, beside what a tilt explains


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
