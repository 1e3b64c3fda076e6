"""The gauge and its rays again, compiled: numba statements of :mod:`sq_perception.geometry.superquadric`.

The image loops (ray casting, IoU, fitting) evaluate the gauge some 10^5 to 10^7 times a frame, one point at a time with
early exits, which array code cannot express.  These scalar kernels are the only second copy of the equation; tests
prove them equal to the first.  All arguments are in the object's own frame.

A ray p = o + t d meets a convex g: Newton's method for g = 1, started where the ray enters the bounding box, approaches
from outside without overshooting; a slope that is not negative before g = 1 means that the ray misses.  Along a ray the
gauge of a tapered body is not convex: its first intersection is bracketed by even steps, then found by Newton's method
that never leaves the bracket.  What is thinner than a step is found where the gauge has its minimum within one.
"""

from __future__ import annotations

import hashlib
import math
import os
import re
import threading
from collections.abc import Callable
from functools import cache, wraps
from pathlib import Path
from types import FunctionType
from typing import Any, TypeAlias, TypeVar, cast

import numpy as np

from sq_perception.geometry import kernel_cache
from sq_perception.geometry.body_numbers import LEAST_CONJUGATE
from sq_perception.geometry.elementary import ROOT_OF_2, exp2, exp2_to_half, log2, log2_from_1_to_2

_F = TypeVar("_F", bound=Callable[..., Any])
Triple: TypeAlias = tuple[float, float, float]  # a point, a direction or half sizes
Form: TypeAlias = tuple[float, float, float, float, float, float, float]  # a1 a2 a3 e1 e2 k_x k_y

Support: TypeAlias = tuple[float, float, float, float, float, float, float, float]
"""A support function and its derivatives by n_x n_y n_z e1 e2 k_x k_y."""

_PROCESS, _one_at_a_time = os.getpid(), threading.Lock()
"""The process that may run parallel kernels, and the lock that makes their calls wait for each other."""
_ROOT = Path(__file__).resolve().parents[1]
_IMPORT = re.compile(rf"^ *from ({_ROOT.name}[.\w]*) import (\([^)]*\)|[^\n]*)", re.MULTILINE)
FAST = {"contract", "arcp", "reassoc", "nsz", "afn"}
"""Fast arithmetic that still treats NaN and infinity as IEEE 754 does."""


def kernel(function: _F) -> _F:
    """Compile to machine code that releases the GIL and is kept on disk; one setting for the whole package."""
    return _compiled(function)


def parallel_kernel(function: _F) -> _F:
    """Compile as :func:`kernel`, with ``numba.prange`` over all cores; for callers in Python.  numba serves one call at
    a time, and ends a process after a fork: calls wait for each other, and a fork computes on one thread."""
    alone = FunctionType(function.__code__, function.__globals__)
    alone.__qualname__ = f"{function.__qualname__}_alone"
    single, shared = _compiled(alone), _compiled(function, parallel=True)

    @wraps(function)
    def called(*arguments: Any) -> Any:
        if os.getpid() != _PROCESS:
            return single(*arguments)
        with _one_at_a_time:
            return shared(*arguments)

    return cast(_F, called)


def inline_kernel(function: _F) -> _F:
    """A kernel that becomes part of every kernel that calls it: what a loop needs in order to be vectorised."""
    return _compiled(function, forceinline=True)


def _compiled(function: _F, **more: bool) -> _F:
    function.__qualname__ += f"_{_fingerprint(Path(function.__code__.co_filename))}"
    options: dict[str, Any] = {"nogil": True, "fastmath": FAST, "error_model": "numpy", **more}
    return kernel_cache.compile_kernel(function, options)


@cache
def _fingerprint(file: Path) -> str:
    """A digest of a source file and all those of this package that it imports.  numba checks the file that holds a
    function, not those of kernels compiled into it: with the digest in the name, code of other sources is never
    found."""
    known, ahead = {file}, [file]
    while ahead:
        new = _find_imports(ahead.pop()) - known
        known |= new
        ahead += new
    digest = hashlib.sha256()
    for path in sorted(known):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


@cache
def _find_imports(file: Path) -> set[Path]:
    """The modules of this package that a source file names in its imports."""
    found = set()
    for package, names in _IMPORT.findall(file.read_text(encoding="utf-8")):
        folder = _ROOT.joinpath(*package.split(".")[1:])
        found |= {folder.with_suffix(".py"), *(folder / f"{name}.py" for name in re.findall(r"\w+", names))}
    return {path for path in found if path.is_file()}


RAY_TOLERANCE, MAX_NEWTON_STEPS = 1e-9, 60
"""Tolerance of a ray's entry, as a share of its way through the bounding box, and of the gauge there; most steps."""
_SINES = tuple(math.sin(math.pi * k / 6) for k in range(-3, 4))
"""Points of a tapered body's profile from which its support is sought, from pole to pole."""
_SUPPORT_TOLERANCE = 1e-7  # error of the sine at which that search ends: the support is off by its square
_TINY = 1e-145  # a number whose square is still a normal one


@inline_kernel
def p_norm(u: float, v: float, e: float) -> tuple[float, float, float, float]:
    """Value of (u^(2/e) + v^(2/e))^(e/2) for u, v >= 0 and its derivatives by u, v and e.

    With the larger of u and v in front, the norm is big (1 + p)^(e/2), p = (small / big)^(2/e).  The derivatives by u
    and v are norm s / u and norm (1 - s) / v, s = u^(2/e) / (u^(2/e) + v^(2/e)) the share of u; d/de is the norm times
    the entropy of the two shares, halved.  Where the smaller is below 1e-12 of the larger, the slope by it fades to 0,
    its value on the axis.  No branch: a loop over points becomes vector code.
    """
    big, small = max(u, v), min(u, v)
    # A power below 2^-115 adds nothing to 1.
    log_power = max((2.0 / e) * log2(max(small, _TINY * _TINY) / max(big, _TINY)), -115.0)
    power = exp2(log_power)
    log_sum = log2_from_1_to_2(1.0 + power)
    norm = big * (ROOT_OF_2 * exp2_to_half(0.5 * e * log_sum - 0.5))
    share = power / (1.0 + power)
    of_big = (1.0 - share) * norm / max(big, _TINY)
    of_small = share * norm / max(small, 1e-12 * big + _TINY)
    of_e = 0.5 * math.log(2.0) * norm * (log_sum - share * log_power)
    return norm, (of_big if u >= v else of_small), (of_small if u >= v else of_big), of_e


@inline_kernel
def section(z: float, a3: float, k: float) -> float:
    """1 + k z/a3, the scale of a tapered body's section at z; beyond the narrow end that of the end."""
    return max(1.0 + k * (z / a3), 1.0 - abs(k))


@inline_kernel
def gauge(
    x: float, y: float, z: float, a1: float, a2: float, a3: float, e1: float, e2: float, k1: float, k2: float
) -> float:
    """The gauge g at a point."""
    h, _, _, _ = p_norm(abs(x / section(z, a3, k1)) / a1, abs(y / section(z, a3, k2)) / a2, e2)
    g, _, _, _ = p_norm(h, abs(z) / a3, e1)
    return g


@inline_kernel
def gauge_derivatives(
    x: float, y: float, z: float, a1: float, a2: float, a3: float, e1: float, e2: float, k1: float, k2: float
) -> tuple[float, float, float, float, float, float, float, float]:
    """g at a point and its derivatives: g, g_x, g_y, g_z, g_e1, g_e2, g_k1, g_k2.

    The derivative by a half size follows from these: dg/da1 = -x g_x / a1, dg/da3 = -z g_z / a3.
    """
    f1, f2 = section(z, a3, k1), section(z, a3, k2)
    h, h_x, h_y, h_e = p_norm(abs(x / f1) / a1, abs(y / f2) / a2, e2)
    g, g_h, g_w, g_e = p_norm(h, abs(z) / a3, e1)
    g_x, g_y = math.copysign(g_h * h_x / a1, x) / f1, math.copysign(g_h * h_y / a2, y) / f2
    x_x, y_y = x * g_x / f1, y * g_y / f2
    is_inside1, is_inside2 = 1.0 + k1 * (z / a3) >= 1.0 - abs(k1), 1.0 + k2 * (z / a3) >= 1.0 - abs(k2)
    g_z = math.copysign(g_w / a3, z) - (x_x * k1 if is_inside1 else 0.0) / a3 - (y_y * k2 if is_inside2 else 0.0) / a3
    g_k1 = -x_x * (z / a3 if is_inside1 else -math.copysign(1.0, k1))
    g_k2 = -y_y * (z / a3 if is_inside2 else -math.copysign(1.0, k2))
    return g, g_x, g_y, g_z, g_e, g_h * h_e, g_k1, g_k2


@inline_kernel
def gauge_slope(x: float, y: float, z: float, dx: float, dy: float, dz: float, form: Form) -> tuple[float, float]:
    """g at a point and its derivative along (dx, dy, dz)."""
    a1, a2, a3, e1, e2, k1, k2 = form
    if k1 != 0.0 or k2 != 0.0:
        g, g_x, g_y, g_z, _, _, _, _ = gauge_derivatives(x, y, z, a1, a2, a3, e1, e2, k1, k2)
        return g, g_x * dx + g_y * dy + g_z * dz
    h, h_x, h_y, _ = p_norm(abs(x) / a1, abs(y) / a2, e2)
    g, g_h, g_w, _ = p_norm(h, abs(z) / a3, e1)
    slope = g_h * (math.copysign(h_x / a1, x) * dx + math.copysign(h_y / a2, y) * dy) + math.copysign(g_w / a3, z) * dz
    return g, slope


@inline_kernel
def conjugate(e: float) -> float:
    """The exponent of the dual norm."""
    return max(2.0 - e, LEAST_CONJUGATE)


@inline_kernel
def _by_sine(s: float, nx: float, ny: float, nz: float, form: Form) -> tuple[float, float, float, float]:
    """A tapered body's support by the point of its profile whose normal has the sine ``s``.

    The section at z = t a3 has the support sigma(t) S(t), where (t, sigma) runs on the profile, a unit ball, and S is
    the dual norm of (a1 f1 n_x, a2 f2 n_y).  Returned are n_z a3 t + sigma S, t, and A and S: at the maximum the normal
    of the profile is along (A, S), A = n_z a3 + sigma S'.
    """
    a1, a2, a3, e1, e2, k1, k2 = form
    _, sigma, t, _ = p_norm(math.sqrt(max(1.0 - s * s, 0.0)), abs(s), conjugate(e1))
    t = math.copysign(t, s)
    u, v = a1 * abs(nx), a2 * abs(ny)
    across, by_u, by_v, _ = p_norm(u * (1.0 + k1 * t), v * (1.0 + k2 * t), conjugate(e2))
    along = nz * a3 + sigma * (by_u * u * k1 + by_v * v * k2)
    return nz * a3 * t + sigma * across, t, along, across


@kernel
def profile_sines(directions: np.ndarray, form: Form) -> np.ndarray:
    """The sines (n,) of :func:`_by_sine` at the maximum for directions (3, n) in the frame of a tapered body.  The best
    of a few, then secants that never leave a bracket; loops over directions without a branch, for vector code."""
    count = directions.shape[1]
    s, low, high, best = np.zeros(count), np.zeros(count), np.zeros(count), np.full(count, -np.inf)
    before, excess_before = np.zeros(count), np.zeros(count)
    nx, ny, nz = directions[0], directions[1], directions[2]
    for k in range(len(_SINES)):
        at, left, right = _SINES[k], _SINES[max(k - 1, 0)], _SINES[min(k + 1, len(_SINES) - 1)]
        for i in range(count):
            value, _, _, _ = _by_sine(at, nx[i], ny[i], nz[i], form)
            above = value > best[i]
            best[i] = value if above else best[i]
            s[i] = at if above else s[i]
            low[i], high[i] = left if above else low[i], right if above else high[i]
    for step in range(12):  # mostly 4 do
        farthest = 0.0
        for i in range(count):
            at = s[i]
            _, _, along, across = _by_sine(at, nx[i], ny[i], nz[i], form)
            sine = along / max(math.sqrt(along * along + across * across), _TINY)
            excess = at - sine
            left, right = low[i] if excess > 0.0 else at, at if excess > 0.0 else high[i]
            change = excess - excess_before[i]
            ahead = at - excess * (at - before[i]) / (change if change != 0.0 else 1.0)
            ahead = sine if step == 0 else ahead
            ahead = ahead if (left < ahead) & (ahead < right) else 0.5 * (left + right)
            s[i] = at if abs(excess) < _SUPPORT_TOLERANCE else ahead
            low[i], high[i], before[i], excess_before[i] = left, right, at, excess
        for i in range(count):
            farthest = max(farthest, abs(excess_before[i]))
        if farthest < _SUPPORT_TOLERANCE:
            break
    return s


@kernel
def support_derivatives(
    nx: float, ny: float, nz: float, a1: float, a2: float, a3: float, e1: float, e2: float, k1: float, k2: float
) -> Support:
    """max n.p over the body, for a direction of any length, see :meth:`Superquadric.support`: h, h_nx, h_ny, h_nz (the
    point that is farthest), h_e1, h_e2, h_k1, h_k2.  That by a half size is dh/da1 = n_x h_nx / a1."""
    if k1 != 0.0 or k2 != 0.0:
        sines = profile_sines(np.array([[nx], [ny], [nz]]), (a1, a2, a3, e1, e2, k1, k2))
        return support_at(sines[0], nx, ny, nz, a1, a2, a3, e1, e2, k1, k2)
    return support_at(0.0, nx, ny, nz, a1, a2, a3, e1, e2, 0.0, 0.0)


@inline_kernel
def support_at(
    s: float, nx: float, ny: float, nz: float, a1: float, a2: float, a3: float, e1: float, e2: float, k1: float,
    k2: float,
) -> Support:
    """:func:`support_derivatives` where the sine of :func:`profile_sines` is known; without a taper any will do."""
    u, v = a1 * abs(nx), a2 * abs(ny)
    t, along = 0.0, nz * a3
    if k1 != 0.0 or k2 != 0.0:
        _, t, along, _ = _by_sine(s, nx, ny, nz, (a1, a2, a3, e1, e2, k1, k2))
    f1, f2 = 1.0 + k1 * t, 1.0 + k2 * t
    inner, inner_u, inner_v, inner_e = p_norm(f1 * u, f2 * v, conjugate(e2))
    h, h_inner, h_z, h_e = p_norm(inner, abs(along), conjugate(e1))
    h += (nz * a3 - along) * t
    by_u, by_v = h_inner * inner_u, h_inner * inner_v
    return (
        h,
        math.copysign(by_u * f1 * a1, nx),
        math.copysign(by_v * f2 * a2, ny),
        math.copysign(h_z, along) * a3,
        -h_e,
        -h_inner * inner_e,
        by_u * u * math.copysign(h_z, along),
        by_v * v * math.copysign(h_z, along),
    )


@kernel
def support(
    nx: float, ny: float, nz: float, a1: float, a2: float, a3: float, e1: float, e2: float, k1: float, k2: float
) -> float:
    """The first of :func:`support_derivatives`."""
    if k1 != 0.0 or k2 != 0.0:
        return support_derivatives(nx, ny, nz, a1, a2, a3, e1, e2, k1, k2)[0]
    h, _, _, _ = p_norm(a1 * abs(nx), a2 * abs(ny), conjugate(e2))
    h, _, _, _ = p_norm(h, a3 * abs(nz), conjugate(e1))
    return h


@inline_kernel
def in_object_frame(m: np.ndarray, x: float, y: float, z: float) -> Triple:
    """R^T v: a vector of the parent frame in the frame of the object, whose rotation matrix (3, 3) is ``m``."""
    return (
        m[0, 0] * x + m[1, 0] * y + m[2, 0] * z,
        m[0, 1] * x + m[1, 1] * y + m[2, 1] * z,
        m[0, 2] * x + m[1, 2] * y + m[2, 2] * z,
    )


@kernel
def box_interval(origin: Triple, way: Triple, half: Triple) -> tuple[float, float]:
    """Where the ray runs inside the box +-half: (t_in, t_out), with t_in > t_out when it misses."""
    t_in, t_out = -1e300, 1e300
    for o, d, a in zip(origin, way, half):  # noqa: B905 - numba's has no ``strict``
        if abs(d) < 1e-300:
            if abs(o) > a:
                return 1.0, -1.0
            continue
        first, second = (-a - o) / d, (a - o) / d
        if first > second:
            first, second = second, first
        t_in = max(t_in, first)
        t_out = min(t_out, second)
    return t_in, t_out


@kernel
def inside_box(origin: Triple, way: Triple, form: Form) -> tuple[float, float]:
    """Where the ray runs inside the box around a body, of a tapered one the frustum: as :func:`box_interval`."""
    a1, a2, a3, _, _, k1, k2 = form
    if k1 == 0.0 and k2 == 0.0:
        return box_interval(origin, way, (a1, a2, a3))
    ox, oy, oz = origin
    dx, dy, dz = way
    t_in, t_out = box_interval(origin, way, (a1 * (1.0 + abs(k1)), a2 * (1.0 + abs(k2)), a3))
    for sign in (-1.0, 1.0):
        for o, d, slant, a in ((ox, dx, k1 * a1 / a3, a1), (oy, dy, k2 * a2 / a3, a2)):
            # sign (o + t d) <= a + slant (oz + t dz)
            rate, room = sign * d - slant * dz, a + slant * oz - sign * o
            if abs(rate) < 1e-300:
                if room < 0.0:
                    return 1.0, -1.0
            elif rate > 0.0:
                t_out = min(t_out, room / rate)
            else:
                t_in = max(t_in, room / rate)
    return t_in, t_out


@kernel
def ray_entry(origin: Triple, way: Triple, form: Form) -> tuple[bool, float]:
    """First intersection of the ray with the surface, over all t: (hit, t)."""
    t_in, t_out = inside_box(origin, way, form)
    return _first(t_in, t_out, origin, way, form)


@kernel
def ray_interval(origin: Triple, way: Triple, form: Form) -> tuple[bool, float, float]:
    """First and last intersection of the ray with the surface: (hit, t_first, t_last)."""
    t_in, t_out = inside_box(origin, way, form)
    hit, first = _first(t_in, t_out, origin, way, form)
    if not hit:
        return False, 0.0, 0.0
    dx, dy, dz = way
    hit, last = _first(-t_out, -t_in, origin, (-dx, -dy, -dz), form)
    return hit, first, -last


@kernel
def _first(t_in: float, t_out: float, origin: Triple, way: Triple, form: Form) -> tuple[bool, float]:
    if t_in > t_out:
        return False, 0.0
    if form[5] == 0.0 and form[6] == 0.0:
        return _newton(t_in, t_out, origin, way, form)
    return _intersect_tapered(t_in, t_out, origin, way, form)


@kernel
def _intersect_tapered(t_in: float, t_out: float, origin: Triple, way: Triple, form: Form) -> tuple[bool, float]:
    """The first intersection of a ray with a tapered body, in even steps from where it enters the frustum."""
    ox, oy, oz = origin
    dx, dy, dz = way
    g, slope = gauge_slope(ox + t_in * dx, oy + t_in * dy, oz + t_in * dz, dx, dy, dz, form)
    if g <= 1.0 + RAY_TOLERANCE:
        return True, t_in
    strides = 12
    stride, low = (t_out - t_in) / strides, t_in
    for k in range(strides):
        high = t_in + (k + 1) * stride
        g_high, s_high = gauge_slope(ox + high * dx, oy + high * dy, oz + high * dz, dx, dy, dz, form)
        right, inner = high, g_high
        if g_high > 1.0 and slope < 0.0 < s_high:  # the smallest gauge of this step may be below 1
            left, s_left, s_right = low, slope, s_high
            for _ in range(MAX_NEWTON_STEPS):
                ahead = left + (right - left) * min(max(s_left / (s_left - s_right), 0.1), 0.9)
                inner, s = gauge_slope(ox + ahead * dx, oy + ahead * dy, oz + ahead * dz, dx, dy, dz, form)
                if s < 0.0:
                    left, s_left = ahead, s
                else:
                    right, s_right = ahead, s
                if inner <= 1.0 or right - left <= RAY_TOLERANCE * stride:
                    right = ahead
                    break
        if inner <= 1.0:
            return True, _crossing(low, right, origin, way, form)
        low, slope = high, s_high
    return False, 0.0


@kernel
def _crossing(low: float, high: float, origin: Triple, way: Triple, form: Form) -> float:
    """Where g = 1 between a point outside and one inside the body: Newton's method, kept in the bracket."""
    ox, oy, oz = origin
    dx, dy, dz = way
    enough = RAY_TOLERANCE * (high - low)
    t = low
    for _ in range(MAX_NEWTON_STEPS):
        g, slope = gauge_slope(ox + t * dx, oy + t * dy, oz + t * dz, dx, dy, dz, form)
        if g > 1.0:
            low = t
        else:
            high = t
        ahead = t + (1.0 - g) / slope if slope < 0.0 else low
        if not low < ahead < high:
            ahead = 0.5 * (low + high)
        if abs(ahead - t) <= enough:
            return ahead
        t = ahead
    return t


@kernel
def _newton(t_in: float, t_out: float, origin: Triple, way: Triple, form: Form) -> tuple[bool, float]:
    ox, oy, oz = origin
    dx, dy, dz = way
    t = t_in
    enough = RAY_TOLERANCE * (t_out - t_in)
    for _ in range(MAX_NEWTON_STEPS):
        g, slope = gauge_slope(ox + t * dx, oy + t * dy, oz + t * dz, dx, dy, dz, form)
        if g <= 1.0 + RAY_TOLERANCE:
            return True, t
        if slope >= 0.0:
            return False, 0.0
        step = (1.0 - g) / slope
        t += step
        if t > t_out:
            return False, 0.0
        if step <= enough:
            return True, t
    return False, 0.0
