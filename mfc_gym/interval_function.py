"""Natural interval extension of SymPy expressions: a tape of interval operations, every subexpression evaluated once.

See Moore, Kearfott, Cloud, Introduction to Interval Analysis (SIAM 2009), chapters 5 and 6.
"""

from collections.abc import Callable, Sequence
from functools import partial

import sympy as sp
from mpmath import libmp
from mpmath.libmp import libmpi

from mfc_gym.interval import BITS, FUNCTIONS, Interval, Undefined, general_power, power, rational, root_power

Ends = tuple[float, float]
REALS: Ends = (float("-inf"), float("inf"))
HUGE, TINY = 1e300, 1e-290
CONSTANTS: dict[sp.Expr, Interval] = {sp.pi: libmpi.mpi_pi(BITS), sp.E: libmpi.mpi_exp(libmpi.mpi_one, BITS)}


class IntervalFunction:
    """`expressions` of `symbols` on boxes.

    A finite value says that the expression is defined on the whole box and, `sign` apart, continuous there; a value that
    cannot be bounded (a pole in the box, an overflow, a function without interval version) is all reals.
    """

    def __init__(self, expressions: Sequence[sp.Expr], symbols: Sequence[sp.Symbol]) -> None:
        self._index: dict[sp.Expr, int] = {s: i for i, s in enumerate(symbols)}
        self._tape: list[tuple[Callable[..., Interval], tuple[int, ...]]] = []
        self._inputs = len(symbols)
        self._outputs = [self._place(e) for e in expressions]

    def __call__(self, box: Sequence[Ends]) -> list[Ends]:
        """(low, high) of every expression over the box, one (low, high) per symbol."""
        values: list[Interval | None] = [(libmp.from_float(a), libmp.from_float(b)) for a, b in box]
        for operation, places in self._tape:
            arguments = [values[i] for i in places]
            try:
                values.append(None if any(a is None for a in arguments) else operation(*arguments))
            except Undefined:
                values.append(None)
        return [_floats(values[i]) for i in self._outputs]

    def __len__(self) -> int:
        """Number of operations."""
        return len(self._tape)

    def _place(self, e: sp.Expr) -> int:
        """Where the value of `e` stands; written to the tape if it is not there yet."""
        if e not in self._index:
            operation, arguments = _operation(e)
            places = tuple(self._place(a) for a in arguments)
            self._tape.append((operation, places))
            self._index[e] = self._inputs + len(self._tape) - 1
        return self._index[e]


def _operation(e: sp.Expr) -> tuple[Callable[..., Interval], tuple[sp.Expr, ...]]:
    if isinstance(e, sp.Rational):
        return partial(_constant, rational(e)), ()
    if isinstance(e, sp.Float):
        return partial(_constant, libmpi.mpi_pos((e._mpf_, e._mpf_), BITS)), ()
    if e in CONSTANTS:
        return partial(_constant, CONSTANTS[e]), ()
    if e.is_Symbol:
        raise ValueError(f"`box` must have an interval for every symbol of the expression, {e} has none.")
    if e.is_Pow:
        if e.exp.is_Integer:
            return partial(power, int(e.exp)), (e.base,)
        if e.exp.is_Rational:
            return partial(root_power, e.exp), (e.base,)
        return general_power, (e.base, e.exp)
    return FUNCTIONS.get(e.func, _unsupported), e.args if e.func in FUNCTIONS else ()


def _constant(value: Interval) -> Interval:
    return value


def _unsupported() -> Interval:
    raise Undefined


def _floats(x: Interval | None) -> Ends:
    if x is None:
        return REALS
    low, high = map(libmp.to_float, x)
    if not -HUGE < low <= high < HUGE:
        return REALS
    # below the normal numbers a float has fewer than 53 bits, or is zero
    signs = [libmp.mpf_sign(end) for end in x]
    return (
        low if abs(low) > TINY or signs[0] == 0 else -TINY if signs[0] < 0 else 0.0,
        high if abs(high) > TINY or signs[1] == 0 else TINY if signs[1] > 0 else 0.0,
    )
