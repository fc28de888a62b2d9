"""Elementary functions of intervals with outward rounding, on mpmath's interval arithmetic, by SymPy function.

An interval is a pair (low, high) of numbers of `mpmath.libmp`, as behind `mpmath.iv`, here always with the 53 bits of a
float. An operation that is not defined on the whole interval (a pole, a negative radicand, an overflow) raises `Undefined`.
"""

from collections.abc import Callable
from functools import partial, reduce
from typing import Any, TypeAlias

import sympy as sp
from mpmath import libmp
from mpmath.libmp import libmpi

Interval: TypeAlias = tuple[Any, Any]
BITS = 53
EXPONENT = libmp.from_int(690)  # exp of more is beyond 1e300
PHASE = libmp.from_float(1e12)  # sine and cosine of more are any value
ONE = libmp.fone


class Sign(sp.Function):
    """sign, kept as it stands."""


class Absolute(sp.Function):
    """abs, kept as it stands: SymPy's own tries to find the sign of its argument whenever it is differentiated."""

    def fdiff(self, argindex: int = 1) -> sp.Expr:
        return Sign(self.args[0])


class Undefined(ArithmeticError):
    """The operation is not defined on the whole interval."""


def require(condition: bool) -> None:
    if not condition:
        raise Undefined


def contains_zero(x: Interval) -> bool:
    return libmp.mpf_sign(x[0]) <= 0 <= libmp.mpf_sign(x[1])


def hull(x: Interval, y: Interval) -> Interval:
    return libmpi.MIN(x[0], y[0]), libmpi.MAX(x[1], y[1])


def monotone(function: Callable, x: Interval) -> Interval:
    """Increasing `function` of `mpmath.libmp`, rounded outward by more than its error in the 73rd bit."""
    low, high = (function(end, BITS + 20) for end in x)
    margin = libmp.from_man_exp(1, -BITS - 10)
    low = libmp.mpf_sub(low, libmp.mpf_mul(libmp.mpf_abs(low), margin), BITS, "f")
    return low, libmp.mpf_add(high, libmp.mpf_mul(libmp.mpf_abs(high), margin), BITS, "c")


def add(*xs: Interval) -> Interval:
    return reduce(lambda x, y: libmpi.mpi_add(x, y, BITS), xs)


def multiply(*xs: Interval) -> Interval:
    return reduce(lambda x, y: libmpi.mpi_mul(x, y, BITS), xs)


def power(n: int, x: Interval) -> Interval:
    require(n >= 0 or not contains_zero(x))
    return libmpi.mpi_pow_int(x, n, BITS)


def root_power(exponent: sp.Rational, x: Interval) -> Interval:
    """x**(p/q), monotone on x >= 0."""
    low, high = x
    require(libmp.mpf_sign(low) >= (1 if exponent < 0 else 0))
    if exponent == sp.Rational(1, 2):
        return libmpi.mpi_sqrt(x, BITS)
    if high == libmp.fzero:
        return x
    top = general_power((high, high), rational(exponent))
    return (libmp.fzero, top[1]) if low == libmp.fzero else hull(general_power((low, low), rational(exponent)), top)


def general_power(base: Interval, exponent: Interval) -> Interval:
    return exponential(multiply(logarithm(base), exponent))


def exponential(x: Interval) -> Interval:
    require(libmp.mpf_lt(x[1], EXPONENT))
    return monotone(libmp.mpf_exp, x)  # `mpi_exp` may round 1 + tiny to 1 in both directions


def logarithm(x: Interval) -> Interval:
    require(libmp.mpf_sign(x[0]) > 0)
    return monotone(libmp.mpf_log, x)


def periodic(function: Callable, x: Interval) -> Interval:
    if any(libmp.mpf_gt(libmp.mpf_abs(end), PHASE) for end in x):
        return libmp.fnone, ONE
    return function(x, BITS)


def tangent(x: Interval) -> Interval:
    require(not contains_zero(periodic(libmpi.mpi_cos, x)))
    low, high = (libmpi.mpi_tan((end, end), BITS) for end in x)
    return hull(low, high)


def hyperbolic(odd: bool, x: Interval) -> Interval:
    require(all(libmp.mpf_lt(libmp.mpf_abs(end), EXPONENT) for end in x))
    return monotone(libmp.mpf_sinh, x) if odd else monotone(libmp.mpf_cosh, libmpi.mpi_abs(x))


def arcsine(x: Interval) -> Interval:
    require(all(libmp.mpf_le(libmp.mpf_abs(end), ONE) for end in x))
    return monotone(libmp.mpf_asin, x)


def arccosine(x: Interval) -> Interval:
    return libmpi.mpi_sub(libmpi.mpi_shift(libmpi.mpi_pi(BITS + 10), -1), arcsine(x), BITS)


def step(below: Any, x: Interval) -> Interval:
    """sign (below = -1) or Heaviside (below = 0), every value in between included where x may vanish."""
    return ONE if libmp.mpf_sign(x[0]) > 0 else below, below if libmp.mpf_sign(x[1]) < 0 else ONE


def extremum(pick: Callable, *xs: Interval) -> Interval:
    low, high = zip(*xs, strict=True)
    return reduce(pick, low), reduce(pick, high)


def rational(number: sp.Rational) -> Interval:
    p, q = libmp.from_int(number.p), libmp.from_int(number.q)
    return libmp.mpf_div(p, q, BITS, "f"), libmp.mpf_div(p, q, BITS, "c")


FUNCTIONS: dict[type[sp.Expr], Callable[..., Interval]] = {
    sp.Add: add,
    sp.Mul: multiply,
    sp.Abs: libmpi.mpi_abs,
    Absolute: libmpi.mpi_abs,
    sp.Min: partial(extremum, libmpi.MIN),
    sp.Max: partial(extremum, libmpi.MAX),
    sp.exp: exponential,
    sp.log: logarithm,
    sp.sin: partial(periodic, libmpi.mpi_sin),
    sp.cos: partial(periodic, libmpi.mpi_cos),
    sp.tan: tangent,
    sp.atan: partial(monotone, libmp.mpf_atan),
    sp.asin: arcsine,
    sp.acos: arccosine,
    sp.tanh: partial(monotone, libmp.mpf_tanh),
    sp.sinh: partial(hyperbolic, True),
    sp.cosh: partial(hyperbolic, False),
    sp.sign: partial(step, libmp.fnone),
    Sign: partial(step, libmp.fnone),
    sp.Heaviside: lambda x, *_: step(libmp.fzero, x),
}
