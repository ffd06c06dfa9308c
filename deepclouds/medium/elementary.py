"""Elementary functions of arguments that are known to lie in a small range, at a third of the cost of those of any argument."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

import drjit as dr

# Polynomials, lowest power first, by least squares at Chebyshev's points: sin(2 pi y) / y and -cos(2 pi y) of y^2 for |y| <= 1/4, and
# log(1 + f) / f of f for 1 + f between the root of 1/2 and that of 2.
_SINE = (6.28318528, -41.34168067, 81.60248074, -76.58128456, 39.76072207)
_MINUS_COSINE = (-0.99999995, 19.73917132, -64.93458165, 85.24010036, -56.24054044)
_LOG = (0.999999943, -0.500003631, 0.333351141, -0.249700717, 0.19898565, -0.172470133, 0.162341898, -0.101340568)
_ROOT_OF_HALF, _MANTISSA = 0x3F3504F3, 23
_LOG_OF_2 = 0.6931471805599453
# `value` or, where `sign` is negative, its opposite: (value, sign). Dr.Jit's, which has no types.
with_sign: Callable[[Any, Any], Any] = dr.mulsign


def circle(u: Any) -> tuple[Any, Any]:
    """Cosine and sine of ``2 pi u`` for u in [0, 1], within 3e-7."""
    x = u - 0.5
    y = dr.abs(x) - 0.25
    square = y * y
    return y * _polynomial(_SINE, square), with_sign(_polynomial(_MINUS_COSINE, square), x)


def log_of_share(types: ModuleType, v: Any) -> Any:
    """Natural logarithm of a Float from 1e-37 to 1, within 4e-7 of its value."""
    bits: Any = dr.reinterpret_array(types.Int32, v)
    exponent = (bits - _ROOT_OF_HALF) >> _MANTISSA
    mantissa: Any = dr.reinterpret_array(types.Float, bits - (exponent << _MANTISSA))
    rest = mantissa - 1
    return dr.fma(types.Float(exponent), _LOG_OF_2, rest * _polynomial(_LOG, rest))


def whole(types: ModuleType, value: Any) -> Any:
    """A Float from 0 to 2^31 as a UInt32, rounded down: by way of signed numbers, which processors know how to convert."""
    return types.UInt32(types.Int32(value))


def _polynomial(coefficients: tuple[float, ...], x: Any) -> Any:
    total = dr.fma(x, coefficients[-1], coefficients[-2])
    for coefficient in coefficients[-3::-1]:
        total = dr.fma(total, x, coefficient)
    return total
