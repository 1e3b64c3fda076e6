"""Powers of two and their logarithms in plain arithmetic, so that loops over them become vector code.

The mathematics library answers one number at a time, which keeps a compiler from working on several points at once;
these few lines of arithmetic without a branch are ten times as fast in a loop, on any processor with vector units.

    log2 x = k + log2 m,    x = m 2^k,   1 <= m < 2,    k and m from the bits of the number (IEEE 754 binary64)
    log2 m = 1/2 + (2 / ln 2) artanh s,   s = (m - sqrt 2) / (m + sqrt 2),   |s| < 0.172
    2^x    = 2^n 2^r,       n the nearest integer,   |r| <= 1/2,    2^r by its Taylor series

Both series are cut where their terms fall below 1e-14.  Arguments are not checked: ``log2`` wants a positive normal
number, ``exp2`` one within -1022 and 1023.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numba import types
from numba.extending import intrinsic

from sq_perception.geometry import kernel_cache

_F = TypeVar("_F", bound=Callable[..., Any])

ROOT_OF_2 = math.sqrt(2.0)
_BIAS = 2.0**52 + 1023.0
"""A number between 2^52 and 2^53 has its integer value in its lowest bits: adding this is a conversion."""
_LOG2 = tuple(2 / math.log(2) / (2 * k + 1) for k in range(9))  # coefficients of (log2 m - 1/2) / s, by powers of s^2
_EXP2 = tuple(math.log(2) ** k / math.factorial(k) for k in range(13))  # coefficients of 2^r, by powers of r
_OPTIONS: dict[str, Any] = {
    "nogil": True,
    "forceinline": True,
    "error_model": "numpy",
    # Sums must keep their order here: the bias would swallow a term that is added to it first.
    "fastmath": {"contract"},
}


def _elementary(function: _F) -> _F:
    return kernel_cache.compile_kernel(function, _OPTIONS)


def _bitcast(source: Any, target: Any) -> Any:
    """A function of compiled code that takes the bits of a number of one type for one of another type."""

    def typed(_context: Any, _number: Any) -> Any:
        def generate(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
            return builder.bitcast(arguments[0], context.get_value_type(target))

        return target(source), generate

    return intrinsic(typed)


_bits = _bitcast(types.float64, types.int64)
_number = _bitcast(types.int64, types.float64)


@_elementary
def log2_from_1_to_2(m: float) -> float:
    """The logarithm to base 2 of 1 <= m <= 2."""
    a = _LOG2
    s = (m - ROOT_OF_2) / (m + ROOT_OF_2)
    q = s * s
    q2 = q * q
    q4 = q2 * q2
    even = (a[0] + a[1] * q) + (a[2] + a[3] * q) * q2
    return 0.5 + s * (even + ((a[4] + a[5] * q) + (a[6] + a[7] * q) * q2 + a[8] * q4) * q4)


@_elementary
def log2(x: float) -> float:
    """The logarithm to base 2 of a positive normal number."""
    bits = _bits(x)
    # The exponent as the low bits of a number from 2^52; the other bits with the exponent of a number from 1 to 2.
    exponent = _number((bits >> 52) | 0x4330_0000_0000_0000) - _BIAS
    return exponent + log2_from_1_to_2(_number((bits & 0x000F_FFFF_FFFF_FFFF) | 0x3FF0_0000_0000_0000))


@_elementary
def exp2_to_half(r: float) -> float:
    """2^r for |r| <= 1/2."""
    a = _EXP2
    r2 = r * r
    r4 = r2 * r2
    low = ((a[0] + a[1] * r) + (a[2] + a[3] * r) * r2) + ((a[4] + a[5] * r) + (a[6] + a[7] * r) * r2) * r4
    return low + ((a[8] + a[9] * r) + (a[10] + a[11] * r) * r2 + a[12] * r4) * (r4 * r4)


@_elementary
def exp2(x: float) -> float:
    """2^x for -1022 <= x <= 1023."""
    n = np.floor(x + 0.5)
    return exp2_to_half(x - n) * _number(_bits(n + _BIAS) << 52)
