"""The gauge and its rays again, compiled: numba statements of :mod:`sq_perception.geometry.superquadric`.

The image loops (ray casting, IoU, fitting) evaluate the gauge some 10^5 to 10^7 times a frame, one point at a time with
early exits, which array code cannot express.  These scalar kernels are the only second copy of the equation; tests
prove them equal to the first.  All arguments are in the object's own frame.

A ray p = o + t d meets a convex g: Newton's method for g = 1, started where the ray enters the bounding box, approaches
from outside without overshooting; a slope that is not negative before g = 1 means that the ray misses.
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
from sq_perception.geometry.elementary import exp2, exp2_to_half, log2, log2_from_1_to_2

_F = TypeVar("_F", bound=Callable[..., Any])
Triple: TypeAlias = tuple[float, float, float]
"""A point, a direction or half sizes."""
Form: TypeAlias = tuple[float, float, float, float, float]
"""a1 a2 a3 e1 e2."""

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
    """Compile as :func:`kernel`, with ``numba.prange`` over all cores; for callers in Python.

    Threads of numba may serve one call at a time, and end the process that calls them after a fork: calls wait for each
    other, and a forked process computes on one thread.
    """
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
    return kernel_cache.compiled(function, options)


@cache
def _fingerprint(file: Path) -> str:
    """A digest of a source file and all those of this package that it imports, directly or through others.

    numba keeps machine code under the name of a function and checks the file that holds it, but not the files of the
    kernels that were compiled into it: an update of this module alone would leave the old code at work elsewhere.  With
    the digest in the name, code of other sources is never found.
    """
    known, ahead = {file}, [file]
    while ahead:
        new = _imported(ahead.pop()) - known
        known |= new
        ahead += new
    digest = hashlib.sha256()
    for path in sorted(known):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


@cache
def _imported(file: Path) -> set[Path]:
    """The modules of this package that a source file names in its imports."""
    found = set()
    for package, names in _IMPORT.findall(file.read_text(encoding="utf-8")):
        folder = _ROOT.joinpath(*package.split(".")[1:])
        found |= {folder.with_suffix(".py"), *(folder / f"{name}.py" for name in re.findall(r"\w+", names))}
    return {path for path in found if path.is_file()}


RAY_TOLERANCE, MAX_NEWTON_STEPS = 1e-9, 60
"""Tolerance of a ray's entry, as a share of its way through the bounding box, and of the gauge there; most steps."""
_NEGLIGIBLE_LOG2 = -115.0
"""A power below 2^this adds nothing to 1."""
_TINIEST, _TINY = 1e-290, 1e-145
_FLAT = 1e-12
"""Below this share of the larger coordinate, the slope by the smaller one fades to 0, its value on the axis."""
_ROOT_OF_2 = math.sqrt(2.0)
_HALF_LN_2 = 0.5 * math.log(2.0)


@inline_kernel
def p_norm(u: float, v: float, e: float) -> tuple[float, float, float, float]:
    """Value of (u^(2/e) + v^(2/e))^(e/2) for u, v >= 0 and its derivatives by u, v and e.

    With the larger of u and v in front, the norm is big (1 + p)^(e/2), p = (small / big)^(2/e).  The derivatives by u
    and v are norm s / u and norm (1 - s) / v, s = u^(2/e) / (u^(2/e) + v^(2/e)) the share of u; d/de is the norm times
    the entropy of the two shares, halved.  No branch: a loop over points becomes vector code.
    """
    big, small = max(u, v), min(u, v)
    log_power = max((2.0 / e) * log2(max(small, _TINIEST) / max(big, _TINY)), _NEGLIGIBLE_LOG2)
    power = exp2(log_power)
    log_sum = log2_from_1_to_2(1.0 + power)
    norm = big * (_ROOT_OF_2 * exp2_to_half(0.5 * e * log_sum - 0.5))
    share = power / (1.0 + power)
    of_big = (1.0 - share) * norm / max(big, _TINY)
    of_small = share * norm / max(small, _FLAT * big + _TINY)
    of_e = _HALF_LN_2 * norm * (log_sum - share * log_power)
    return norm, (of_big if u >= v else of_small), (of_small if u >= v else of_big), of_e


@inline_kernel
def gauge(x: float, y: float, z: float, a1: float, a2: float, a3: float, e1: float, e2: float) -> float:
    """The gauge g at a point."""
    h, _, _, _ = p_norm(abs(x) / a1, abs(y) / a2, e2)
    g, _, _, _ = p_norm(h, abs(z) / a3, e1)
    return g


@inline_kernel
def gauge_derivatives(
    x: float, y: float, z: float, a1: float, a2: float, a3: float, e1: float, e2: float
) -> tuple[float, float, float, float, float, float]:
    """g at a point and its derivatives: g, g_x, g_y, g_z, g_e1, g_e2.

    The derivative by a half size follows from these: dg/da1 = -x g_x / a1.
    """
    h, h_x, h_y, h_e = p_norm(abs(x) / a1, abs(y) / a2, e2)
    g, g_h, g_w, g_e = p_norm(h, abs(z) / a3, e1)
    return (
        g,
        math.copysign(g_h * h_x / a1, x),
        math.copysign(g_h * h_y / a2, y),
        math.copysign(g_w / a3, z),
        g_e,
        g_h * h_e,
    )


@inline_kernel
def gauge_slope(
    x: float, y: float, z: float, dx: float, dy: float, dz: float, a1: float, a2: float, a3: float, e1: float, e2: float
) -> tuple[float, float]:
    """g at a point and its derivative along (dx, dy, dz)."""
    h, h_x, h_y, _ = p_norm(abs(x) / a1, abs(y) / a2, e2)
    g, g_h, g_w, _ = p_norm(h, abs(z) / a3, e1)
    slope = g_h * (math.copysign(h_x / a1, x) * dx + math.copysign(h_y / a2, y) * dy) + math.copysign(g_w / a3, z) * dz
    return g, slope


@inline_kernel
def conjugate(e: float) -> float:
    """The exponent of the dual norm."""
    return max(2.0 - e, LEAST_CONJUGATE)


@kernel
def support(nx: float, ny: float, nz: float, a1: float, a2: float, a3: float, e1: float, e2: float) -> float:
    """max n.p over the body, for a direction of any length: the dual norm, see :meth:`Superquadric.support`."""
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
def ray_entry(origin: Triple, way: Triple, form: Form) -> tuple[bool, float]:
    """First intersection of the ray with the surface, over all t: (hit, t)."""
    t_in, t_out = box_interval(origin, way, form[:3])
    if t_in > t_out:
        return False, 0.0
    return _newton(t_in, t_out, origin, way, form)


@kernel
def ray_interval(origin: Triple, way: Triple, form: Form) -> tuple[bool, float, float]:
    """Both intersections of the ray with the surface: (hit, t_first, t_last)."""
    t_in, t_out = box_interval(origin, way, form[:3])
    if t_in > t_out:
        return False, 0.0, 0.0
    hit, first = _newton(t_in, t_out, origin, way, form)
    if not hit:
        return False, 0.0, 0.0
    dx, dy, dz = way
    hit, last = _newton(-t_out, -t_in, origin, (-dx, -dy, -dz), form)
    if not hit:
        return False, 0.0, 0.0
    return True, first, -last


@kernel
def _newton(t_in: float, t_out: float, origin: Triple, way: Triple, form: Form) -> tuple[bool, float]:
    ox, oy, oz = origin
    dx, dy, dz = way
    a1, a2, a3, e1, e2 = form
    t = t_in
    enough = RAY_TOLERANCE * (t_out - t_in)
    for _ in range(MAX_NEWTON_STEPS):
        g, slope = gauge_slope(ox + t * dx, oy + t * dy, oz + t * dz, dx, dy, dz, a1, a2, a3, e1, e2)
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
