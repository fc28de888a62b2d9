"""Where an expression is defined: no zero denominator, negative radicand or pole of a function in a box."""

from collections.abc import Iterable, Iterator

import sympy as sp

from mfc_gym.branch_and_bound import Box, Point, prove_bound
from mfc_gym.interval_function import REALS, IntervalFunction

BUDGET = 100_000  # interval operations per subexpression


def requirements(expression: sp.Expr) -> Iterator[tuple[sp.Expr, str]]:
    """(q, "positive", "nonnegative" or "nonzero") for every q on which the real value of `expression` depends."""
    for e in sp.preorder_traversal(expression):
        if e.is_Pow and e.exp.is_Integer:
            if e.exp < 0:
                yield e.base, "nonzero"
        elif e.is_Pow and e.base != sp.E:
            yield e.base, "nonnegative" if e.exp.is_positive else "positive"
        elif isinstance(e, sp.log):
            yield e.args[0], "positive"
        elif isinstance(e, sp.tan):
            yield sp.cos(e.args[0]), "nonzero"
        elif isinstance(e, sp.asin | sp.acos):
            yield 1 - e.args[0] ** 2, "nonnegative"


def undefined_at(expressions: Iterable[sp.Expr], box: Box) -> str | None:
    """None if all expressions are proved to be defined on `box`, else a clause that says which part is not, and where."""
    done = set()
    for expression in expressions:
        symbols = sorted(expression.free_symbols, key=lambda s: s.name)
        if IntervalFunction([expression], symbols)([box[s] for s in symbols])[0] != REALS:
            continue
        for q, kind in requirements(expression):
            if (q, kind) not in done and (clause := _violation(q, kind, box)):
                return clause
            done.add((q, kind))
    return None


def zero_at(q: sp.Expr, box: Box) -> str | None:
    """None if the continuous q is proved to have no zero in `box`, else a clause that says where it may vanish."""
    return _violation(q, "nonzero", box)


def _violation(q: sp.Expr, kind: str, box: Box) -> str | None:
    sign = 1
    if kind == "nonzero":  # q is continuous: it keeps the sign it has at the centre of the box
        symbols = sorted(q.free_symbols, key=lambda s: s.name)
        centre = {s: (box[s][0] + box[s][1]) / 2 for s in symbols}
        low, high = IntervalFunction([q], symbols)([(centre[s], centre[s]) for s in symbols])[0]
        if low <= 0 <= high:
            return f"{_short(q)} vanishes or is not defined {_place(centre)}"
        sign = 1 if low > 0 else -1
    verdict = prove_bound(-sign * q, 0, box, strict=kind != "nonnegative", budget=BUDGET)
    if verdict.status == "proved":
        return None
    changes = "changes its sign or vanishes" if kind == "nonzero" else f"is not {kind}"
    if verdict.status == "undecided":
        changes = f"could not be shown to be {kind}, e.g."
    return f"{_short(q)} {changes} {_place(verdict.point or {})}"


def _short(q: sp.Expr) -> str:
    text = str(q)
    return text if len(text) <= 80 else text[:77] + "..."


def _place(point: Point) -> str:
    return "at " + ", ".join(f"{s} = {v:.6g}" for s, v in point.items()) if point else "anywhere"
