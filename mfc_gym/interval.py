"""Elementary functions of intervals with outward rounding, on `mpmath.iv`, by SymPy function.

An operation that is not defined on the whole interval (a pole, a negative radicand, an overflow) raises `Undefined`.
"""

from collections.abc import Callable
from functools import partial, reduce
from operator import add, mul
from typing import Any

import sympy as sp
from mpmath import iv, libmp

Interval = Any  # mpmath.iv.mpf
EXPONENT = libmp.from_int(690)  # exp of more is beyond 1e300


class Undefined(ArithmeticError):
    """The operation is not defined on the whole interval."""


def make(low: Any, high: Any) -> Interval:
    """[low, high] from two numbers of `mpmath.libmp`."""
    return iv.make_mpf((low, high))


def ends(x: Interval) -> tuple[Any, Any]:
    """(low, high) as numbers of `mpmath.libmp`."""
    return x._mpi_


def contains_zero(x: Interval) -> bool:
    low, high = ends(x)
    return libmp.mpf_sign(low) <= 0 <= libmp.mpf_sign(high)


def require(condition: bool) -> None:
    if not condition:
        raise Undefined


def monotone(function: Callable, x: Interval) -> Interval:
    """Increasing `function` from `mpmath.libmp`, rounded outward by more than its error of a unit in the 73rd bit."""
    low, high = (function(end, iv.prec + 20) for end in ends(x))
    margin = libmp.from_man_exp(1, -iv.prec - 10)
    low = libmp.mpf_sub(low, libmp.mpf_mul(libmp.mpf_abs(low), margin), iv.prec, "f")
    return make(low, libmp.mpf_add(high, libmp.mpf_mul(libmp.mpf_abs(high), margin), iv.prec, "c"))


def power(n: int, x: Interval) -> Interval:
    if n < 0:
        require(not contains_zero(x))
    return iv.make_mpf(libmp.libmpi.mpi_pow_int(ends(x), n, iv.prec))


def root_power(exponent: sp.Rational, x: Interval) -> Interval:
    """x**(p/q), increasing or decreasing on x >= 0."""
    low, high = ends(x)
    require(libmp.mpf_sign(low) >= (1 if exponent < 0 else 0))
    if exponent == sp.Rational(1, 2):
        return iv.sqrt(x)
    if high == libmp.fzero:
        return x
    top = exponential(iv.mpf(exponent.p) * iv.log(make(high, high)) / exponent.q)
    if low == libmp.fzero:
        return make(libmp.fzero, ends(top)[1])
    bottom = exponential(iv.mpf(exponent.p) * iv.log(make(low, low)) / exponent.q)
    return hull(bottom, top)


def hull(x: Interval, y: Interval) -> Interval:
    (a, b), (c, d) = ends(x), ends(y)
    return make(a if libmp.mpf_le(a, c) else c, b if libmp.mpf_ge(b, d) else d)


def exponential(x: Interval) -> Interval:
    require(libmp.mpf_lt(ends(x)[1], EXPONENT))
    return iv.exp(x)


def logarithm(x: Interval) -> Interval:
    require(libmp.mpf_sign(ends(x)[0]) > 0)
    return iv.log(x)


def periodic(function: Callable, x: Interval) -> Interval:
    low, high = ends(x)
    bound = libmp.from_float(1e12)
    if libmp.mpf_gt(high, bound) or libmp.mpf_lt(low, libmp.mpf_neg(bound)):
        return iv.mpf([-1, 1])
    return function(x)


def tangent(x: Interval) -> Interval:
    require(not contains_zero(periodic(iv.cos, x)))
    low, high = (iv.tan(make(end, end)) for end in ends(x))
    return hull(low, high)


def hyperbolic(odd: bool, x: Interval) -> Interval:
    require(all(libmp.mpf_lt(libmp.mpf_abs(end), EXPONENT) for end in ends(x)))
    return monotone(libmp.mpf_sinh, x) if odd else monotone(libmp.mpf_cosh, abs(x))


def arc(function: Callable, x: Interval) -> Interval:
    require(all(libmp.mpf_le(libmp.mpf_abs(end), libmp.fone) for end in ends(x)))
    return monotone(function, x)


def step(below: int, x: Interval) -> Interval:
    """sign (below = -1) or Heaviside (below = 0), every value in between included where x may vanish."""
    low, high = ends(x)
    return iv.mpf([1 if libmp.mpf_sign(low) > 0 else below, below if libmp.mpf_sign(high) < 0 else 1])


def extremum(compare: Callable, *xs: Interval) -> Interval:
    pick: Callable[[Any, Any], Any] = lambda a, b: a if compare(a, b) else b  # noqa: E731
    return make(*(reduce(pick, values) for values in zip(*map(ends, xs), strict=True)))


FUNCTIONS: dict[type[sp.Expr], Callable[..., Interval]] = {
    sp.Add: lambda *xs: reduce(add, xs),
    sp.Mul: lambda *xs: reduce(mul, xs),
    sp.Abs: abs,
    sp.Min: partial(extremum, libmp.mpf_le),
    sp.Max: partial(extremum, libmp.mpf_ge),
    sp.exp: exponential,
    sp.log: logarithm,
    sp.sin: partial(periodic, iv.sin),
    sp.cos: partial(periodic, iv.cos),
    sp.tan: tangent,
    sp.atan: partial(monotone, libmp.mpf_atan),
    sp.asin: partial(arc, libmp.mpf_asin),
    sp.acos: lambda x: iv.pi / 2 - arc(libmp.mpf_asin, x),
    sp.tanh: partial(monotone, libmp.mpf_tanh),
    sp.sinh: partial(hyperbolic, True),
    sp.cosh: partial(hyperbolic, False),
    sp.sign: partial(step, -1),
}
