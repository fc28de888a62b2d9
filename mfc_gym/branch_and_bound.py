"""Rigorous range of an expression over a box, and proof of a bound: interval branch and bound.

Each box is bounded by the natural interval extension, the mean value form and the monotonicity test; the box with the
largest upper end is bisected first. See Moore, Kearfott, Cloud, Introduction to Interval Analysis (SIAM 2009), chapters 5,
6 and 11; for the mean value theorem with Abs, Min and Max: Clarke, Optimization and Nonsmooth Analysis, theorem 2.3.7.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from heapq import heappop, heappush
from itertools import count
from math import inf, isfinite
from typing import Literal

import sympy as sp

from mfc_gym.interval import Absolute
from mfc_gym.interval_function import Ends, IntervalFunction

Box = Mapping[sp.Symbol, Ends]
Point = Mapping[sp.Symbol, float]
BUDGET = 400_000  # interval operations, some 2.5 microseconds each


@dataclass(frozen=True)
class Verdict:
    """Whether expr <= bound holds over a box."""

    status: Literal["proved", "refuted", "undecided"]
    excess: float  # of expr over bound: at most this (proved, undecided), at least this at `point` (refuted)
    point: Point | None = None  # refuted: a counterexample; undecided: the centre of `box`
    box: Box | None = None  # undecided: the worst box that is left


def enclose(
    expr: sp.Expr, box: Box, *, where: Sequence[sp.Expr] = (), tolerance: float = 1e-6, budget: int = BUDGET
) -> Ends:
    """(low, high) containing every value of `expr` on the part of `box` where every expression of `where` is <= 0.

    Refined until both ends are attained up to `tolerance` (relative above 1) or the budget is spent; valid in either case.
    (inf, -inf) says that no point of the box satisfies `where`.
    """
    problem = _Problem(sp.sympify(expr), box, where)
    low, high = (_Search(problem, sign, -inf, budget // 2) for sign in (-1, 1))
    for search in (low, high):
        search.run(lambda s: s.upper <= s.attained + tolerance * max(1.0, abs(s.attained)))
    return 0.0 - low.upper, high.upper


def prove_bound(
    expr: sp.Expr,
    bound: sp.Expr | float,
    box: Box,
    *,
    where: Sequence[sp.Expr] = (),
    tolerance: float = 0.0,
    strict: bool = False,
    budget: int = BUDGET,
) -> Verdict:
    """expr <= bound + tolerance, or expr < bound if `strict`, on the part of `box` where every `where` is <= 0."""
    limit = -1e-280 if strict else tolerance
    search = _Search(_Problem(sp.sympify(expr) - sp.sympify(bound), box, where), 1, limit, budget)
    search.run(lambda s: s.upper <= limit or s.attained > limit)
    if search.attained >= 0 if strict else search.attained > limit:
        return Verdict("refuted", search.attained, search.point)
    if search.upper <= limit:
        return Verdict("proved", search.upper)
    left = search.worst
    return Verdict("undecided", search.upper, {s: (a + b) / 2 for s, (a, b) in left.items()}, left)


class _Problem:
    """`expr` with its gradient, and the expressions `where`, as interval functions on a box."""

    def __init__(self, expr: sp.Expr, box: Box, where: Sequence[sp.Expr]) -> None:
        self.symbols = sorted(expr.free_symbols.union(*(w.free_symbols for w in where)), key=lambda s: s.name)
        if missing := [s.name for s in self.symbols if s not in box]:
            raise ValueError(f"`box` must have an interval for every symbol of the expression, {missing} have none.")
        expr = expr.replace(sp.Abs, Absolute)
        self.gradient = IntervalFunction([expr, *(sp.diff(expr, s) for s in self.symbols)], self.symbols)
        self.value = IntervalFunction([expr], self.symbols)
        self.where = IntervalFunction(where, self.symbols)
        self.constrained = len(where) > 0
        self.box = [(float(a), float(b)) for a, b in (box[s] for s in self.symbols)]
        self.cost = 2 * (len(self.gradient) + 3 * len(self.value) + 2 * len(self.where) + 40)  # of a bisection


class _Search:
    """Best-first search for the supremum of sign * expr over the part of the box where every `where` is <= 0."""

    def __init__(self, problem: _Problem, sign: int, limit: float, budget: int) -> None:
        self.problem, self.sign = problem, sign
        self.limit = limit  # a box that does not exceed it needs no further bisection
        self.bisections = max(5, budget // problem.cost)
        self.attained, self.point = -inf, dict[sp.Symbol, float]()  # the largest value found, and where
        self.settled = -inf  # the largest upper end of the boxes put aside
        self.heap: list[tuple[float, int, list[Ends], list[Ends]]] = []
        self.order = count()
        self._push(problem.box)

    @property
    def upper(self) -> float:
        """Upper bound of the supremum."""
        return max(self.settled, self.attained, -self.heap[0][0] if self.heap else -inf)

    @property
    def worst(self) -> Box:
        return dict(zip(self.problem.symbols, self.heap[0][2] if self.heap else self.problem.box, strict=True))

    def run(self, done: Callable[["_Search"], bool]) -> None:
        for _ in range(self.bisections):
            if not self.heap or done(self):
                return
            _, _, box, slope = heappop(self.heap)
            i = self._direction(box, slope)
            low, high = box[i]
            for half in ((low, (low + high) / 2), ((low + high) / 2, high)):
                self._push([*box[:i], half, *box[i + 1 :]])

    def _signed(self, values: list[Ends]) -> list[Ends]:
        return values if self.sign > 0 else [(-b, -a) for a, b in values]

    def _push(self, box: list[Ends]) -> None:
        """Bound the box from above, look for a large value in it, and keep it if it may contain a larger one."""
        if any(low > 0 for low, _ in self.problem.where(box)):
            return
        (_, upper), *slope = self._signed(self.problem.gradient(box))
        if isfinite(upper):
            face = [_end(ends, s) for ends, s in zip(box, slope, strict=True)]
            upper = min(upper, self._signed(self.problem.value(face))[0][1])
            box = box if self.problem.constrained else face
            upper = min(upper, self._visit([(a + b) / 2 for a, b in face], face, slope))
        if self.problem.constrained or not isfinite(upper):
            self._visit([(a + b) / 2 for a, b in box], box, slope)
        if upper <= self.limit or all(a == b or not a < (a + b) / 2 < b for a, b in box):
            self.settled = max(self.settled, upper)
        elif upper > self.attained:
            heappush(self.heap, (-upper, next(self.order), box, slope))

    def _visit(self, point: list[float], box: list[Ends], slope: list[Ends]) -> float:
        """Upper end of the mean value form about `point`; its value counts as attained if `where` certainly holds."""
        degenerate = [(p, p) for p in point]
        low, high = self._signed(self.problem.value(degenerate))[0]
        if low > self.attained and all(w <= 0 for _, w in self.problem.where(degenerate)):
            self.attained, self.point = low, dict(zip(self.problem.symbols, point, strict=True))
        changes = zip(box, slope, point, strict=True)
        terms = [max(s * (b - p), r * (a - p)) if a < b else 0.0 for (a, b), (r, s), p in changes]
        # the last term covers the rounding of this sum
        return high + sum(terms) + 1e-14 * (abs(high) + sum(map(abs, terms)))

    def _direction(self, box: list[Ends], slope: list[Ends]) -> int:
        """The coordinate to bisect: largest estimated change; relative width where the slope says nothing."""
        width = [b - a for a, b in box]
        change = [w * max(-r, s) if w > 0 else 0.0 for w, (r, s) in zip(width, slope, strict=True)]
        share = [w / (b - a) if b > a else 0.0 for w, (a, b) in zip(width, self.problem.box, strict=True)]
        total = sum(change)
        if not isfinite(total) or total == 0:
            return share.index(max(share))
        score = [c / total + 0.5 * self.problem.constrained * s for c, s in zip(change, share, strict=True)]
        return score.index(max(score))


def _end(ends: Ends, slope: Ends) -> Ends:
    """Where a function with this slope is largest."""
    low, high = ends
    return (high, high) if slope[0] >= 0 else (low, low) if slope[1] <= 0 else ends
