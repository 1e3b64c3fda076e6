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

_EXPONENT_BITS = 52
_MANTISSA = np.int64(0x000F_FFFF_FFFF_FFFF)
_BITS_OF_ONE = np.int64(0x3FF0_0000_0000_0000)
_BITS_OF_2_TO_52 = np.int64(0x4330_0000_0000_0000)
_BIAS = 2.0**52 + 1023.0
"""A number between 2^52 and 2^53 has its integer value in its lowest bits: adding this is a conversion."""
_ROOT = math.sqrt(2.0)
_A0, _A1, _A2, _A3, _A4, _A5, _A6, _A7, _A8 = (2 / math.log(2) / (2 * k + 1) for k in range(9))
_E0, _E1, _E2, _E3, _E4, _E5, _E6, _E7, _E8, _E9, _E10, _E11, _E12 = (
    math.log(2) ** k / math.factorial(k) for k in range(13)
)
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
    s = (m - _ROOT) / (m + _ROOT)
    q = s * s
    q2 = q * q
    q4 = q2 * q2
    even = (_A0 + _A1 * q) + (_A2 + _A3 * q) * q2
    return 0.5 + s * (even + ((_A4 + _A5 * q) + (_A6 + _A7 * q) * q2 + _A8 * q4) * q4)


@_elementary
def log2(x: float) -> float:
    """The logarithm to base 2 of a positive normal number."""
    bits = _bits(x)
    exponent = _number((bits >> _EXPONENT_BITS) | _BITS_OF_2_TO_52) - _BIAS
    return exponent + log2_from_1_to_2(_number((bits & _MANTISSA) | _BITS_OF_ONE))


@_elementary
def exp2_to_half(r: float) -> float:
    """2^r for |r| <= 1/2."""
    r2 = r * r
    r4 = r2 * r2
    low = ((_E0 + _E1 * r) + (_E2 + _E3 * r) * r2) + ((_E4 + _E5 * r) + (_E6 + _E7 * r) * r2) * r4
    return low + ((_E8 + _E9 * r) + (_E10 + _E11 * r) * r2 + _E12 * r4) * (r4 * r4)


@_elementary
def exp2(x: float) -> float:
    """2^x for -1022 <= x <= 1023."""
    n = np.floor(x + 0.5)
    return exp2_to_half(x - n) * _number(_bits(n + _BIAS) << _EXPONENT_BITS)
