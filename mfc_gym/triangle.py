"""Bound of an expression in the state and uncertain constants by the triangle inequality over the constants' intervals.

abs(sum_j p_j(theta) c_j(x)) <= sum_j sup abs(p_j) abs(c_j(x)): a function of the state, as tight as the state lets it be,
where a constant would hold the worst case of the whole region against every state.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from decimal import ROUND_CEILING, Context, Decimal
from itertools import islice, product
from math import inf

import numpy as np
import sympy as sp
from numpy.typing import NDArray

from mfc_gym.branch_and_bound import Box, enclose
from mfc_gym.interval_function import Ends
from mfc_gym.size import is_short, node_count

SIZE, FACTORED = 800, 200  # nodes of an expression that is multiplied out, and of one that is factored
Array = NDArray[np.float64]
DIGITS = Context(prec=11, rounding=ROUND_CEILING)
BUDGET = 40_000  # interval operations per supremum
ROUNDING = 1e-12  # relative; the decimal ends of a declared interval are only known to 1e-16 as floats
LIFTED = sp.Dummy("Delta_3", real=True)


@dataclass(frozen=True)
class ThetaSet:
    """The uncertain constants: a box, and in it the part where abs(Delta_3) <= delta_3 if `delta_3` is given."""

    box: Box
    Delta_3: sp.Expr = sp.S.Zero
    delta_3: sp.Expr | None = None

    @property
    def where(self) -> list[sp.Expr]:
        return [] if self.delta_3 is None else [self.Delta_3 - self.delta_3, -self.Delta_3 - self.delta_3]

    def supremum(self, p: sp.Expr) -> sp.Expr:
        """sup abs(p(theta)) over the set, rounded up to eleven digits; oo if no bound was found."""
        low, high = self._range(p)
        return sp.oo if max(-low, high) == inf else round_up(max(-low, high, 0.0))

    def _range(self, p: sp.Expr) -> Ends:
        if self.delta_3 is None:
            return enclose(p, self.box, tolerance=1e-9, budget=BUDGET)
        if not is_short(self.Delta_3):
            return _intersection(self._unconstrained(form) for form in {p, self._substituted(p)})
        lifted = self._lift(p)
        found = self._unconstrained(lifted)
        if lifted.free_symbols - {LIFTED}:
            found = _intersection([found, enclose(p, self.box, where=self.where, budget=BUDGET)])
        return found

    def _unconstrained(self, p: sp.Expr) -> Ends:
        return enclose(p, self._lifted_box, tolerance=1e-9, budget=BUDGET)

    def sample(self, functions: Sequence[sp.Expr]) -> Array:
        """The functions of theta at the corners, edge and face centres of the box (the admissible ones), shape (m, functions)."""
        axes = [(low, (low + high) / 2, high) for low, high in self.box.values()]
        points = np.array(list(islice(product(*axes), 729)), dtype=float).reshape(-1, len(axes))
        compiled = sp.lambdify(list(self.box), [*functions, *self.where], "numpy", dummify=True)
        with np.errstate(all="ignore"):
            values = np.stack([np.broadcast_to(v, len(points)).astype(float) for v in compiled(*points.T)], axis=-1)
        admissible = (values[:, len(functions) :] <= ROUNDING).all(axis=-1) & np.isfinite(values).all(axis=-1)
        return values[admissible, : len(functions)]

    @property
    def _lifted_box(self) -> Box:
        if self.delta_3 is None:
            return self.box
        low, high = enclose(self.Delta_3, self.box)
        bound = float(self.delta_3)
        return {**self.box, LIFTED: (max(low, -bound), min(high, bound))}

    def keeps(self, p: sp.Expr) -> bool:
        """Whether p is left as it stands instead of multiplied out: it or Delta_3 has long products."""
        return not (is_short(p) and is_short(self.Delta_3))

    def quotient(self, p: sp.Expr, divisor: sp.Expr) -> sp.Expr:
        """p / divisor, common factors cancelled unless that means to multiply out what is to be kept."""
        return p / divisor if self.keeps(p) or self.keeps(divisor) else sp.cancel(p / divisor)

    def _substituted(self, p: sp.Expr) -> sp.Expr:
        """p, nothing multiplied out, with a factor of Delta_3 - c, c a number, as (Delta_3 - c) / (the other factors)."""
        c, gain = self.Delta_3.as_coeff_Add()
        number, factors = gain.as_coeff_mul()
        factor = next((f for f in factors if p.has(f)), None)
        if factor is None:
            return p
        return p.xreplace({factor: (LIFTED - c) / sp.Mul(number, *(f for f in factors if f != factor))})

    def _lift(self, p: sp.Expr) -> sp.Expr:
        """p with Delta_3 as a variable of its own, in which the constraint abs(Delta_3) <= delta_3 is an interval."""
        theta = list(self.box)
        parts = p.as_numer_denom()
        if not all(part.is_polynomial(*theta) for part in (*parts, self.Delta_3)):
            return p
        numerator, denominator = (sp.reduced(part, [self.Delta_3 - LIFTED], *theta)[1] for part in parts)
        return sp.cancel(numerator / denominator)


def round_up(value: float) -> sp.Expr:
    """The next decimal of eleven digits, as a rational number."""
    return sp.Rational(str(DIGITS.create_decimal(Decimal(value * (1 - ROUNDING)))))


def _intersection(ranges: Iterable[Ends]) -> Ends:
    low, high = zip(*ranges, strict=True)
    return max(low), min(high)


def coefficients(expression: sp.Expr, theta: ThetaSet) -> dict[sp.Expr, sp.Expr] | None:
    """{p_j(theta): c_j(x)} with expression = sum_j p_j c_j, None if theta is not separated by multiplying out."""
    if node_count(expression) > SIZE:
        return None
    symbols: dict[sp.Expr, sp.Symbol] = {}
    shortened = _shortened(sp.factor_terms(expression), theta, symbols)
    kept = {symbol: p for p, symbol in symbols.items()}
    parts: dict[sp.Expr, sp.Expr] = {}
    for term in sp.Add.make_args(sp.expand(shortened if kept else expression)):
        c, p = term.as_independent(*theta.box, *kept, as_Add=False)
        p = p.xreplace(kept)
        if p.free_symbols - set(theta.box):
            return None
        parts[p] = parts.get(p, sp.S.Zero) + c
    return parts


def _shortened(e: sp.Expr, theta: ThetaSet, symbols: dict[sp.Expr, sp.Symbol]) -> sp.Expr:
    """`e` with a symbol for every factor in it that is a function of theta and kept: `symbols` says which for what."""
    if e.is_Mul:
        own, rest = e.as_independent(*(e.free_symbols - set(theta.box)), as_Add=False)
        if own.free_symbols and theta.keeps(own):
            return symbols.setdefault(own, sp.Dummy(real=True)) * _shortened(rest, theta, symbols)
    return e.func(*(_shortened(a, theta, symbols) for a in e.args)) if e.args else e


def triangle_bound(expression: sp.Expr, theta: ThetaSet, divisor: sp.Expr = sp.S.One) -> sp.Expr | None:
    """A bound of abs(expression / divisor(theta)) for every admissible theta, None if it cannot be found this way."""
    parts = coefficients(expression, theta)
    if parts is None:
        return None
    separated: dict[sp.Expr, sp.Expr] = {}  # the parts whose c_j differ by a number only are taken together
    for p, c in parts.items():
        number, direction = (sp.factor(c) if node_count(c) <= FACTORED else c).as_coeff_Mul()
        if direction.could_extract_minus_sign():
            number, direction = -number, -direction
        separated[direction] = separated.get(direction, sp.S.Zero) + number * p
    suprema = [theta.supremum(theta.quotient(p, divisor)) for p in separated.values()]
    # SymPy tries hard to find the sign of what it does not know to be real
    absolute = [sp.Abs(c, evaluate=bool(c.is_real)) for c in separated]
    return None if sp.oo in suprema else sp.Add(*(s * c for s, c in zip(suprema, absolute, strict=True)))
