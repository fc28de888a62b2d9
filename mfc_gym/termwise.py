"""Proof of a bound that is itself a triangle inequality: sum_k abs(d_k(x)) with terms of its author's choice.

If the uncertain expression is sum_k r_k(theta) d_k(x) in these terms, abs(r_k) <= 1 for every admissible theta proves it.
The r_k come from an exact linear system: both sides are written in the monomials of the state and its functions.
"""

from collections.abc import Iterator, Sequence

import sympy as sp
from sympy.polys.matrices import DomainMatrix

from mfc_gym.branch_and_bound import Box, enclose
from mfc_gym.complexity import node_count
from mfc_gym.triangle import ThetaSet, coefficients

SIZE = 4000  # nodes of all expressions together


def nonnegative_terms(bound: sp.Expr) -> Iterator[sp.Expr]:
    """The summands of a bound, sums of absolute values multiplied out."""
    for term in sp.Add.make_args(bound):
        factors = sp.Mul.make_args(term)
        split = next((f for f in factors if f.is_Add and f.has(sp.Abs)), None)
        if split is None:
            yield term
        else:
            rest = sp.Mul(*(f for f in factors if f is not split))
            yield from (t for summand in split.args for t in nonnegative_terms(rest * summand))


def proves(bound: sp.Expr, expression: sp.Expr, divisor: sp.Expr, region: Box, theta: ThetaSet, tolerance: float) -> bool:
    """Whether abs(expression / divisor(theta)) <= bound (1 + tolerance) follows term by term."""
    terms = [sp.nsimplify(t, rational=True) for t in nonnegative_terms(bound) if t != 0]
    parts = coefficients(expression, list(theta.box))
    if not terms or parts is None or node_count(expression) + sum(map(node_count, terms)) > SIZE:
        return False
    if any(enclose(t, region, budget=10)[0] < 0 for t in terms):
        return False
    directions = [t.replace(sp.Abs, lambda argument: argument) for t in terms]
    solution = _solve(_monomials([*directions, *parts.values()]), len(directions))
    if solution is None:
        return False
    shares = (sp.Add(*(row[j] * p for j, p in enumerate(parts))) for row in solution)
    return all(theta.supremum(sp.cancel(share / divisor)) <= 1 + tolerance for share in shares)


def _monomials(expressions: Sequence[sp.Expr]) -> list[dict[sp.Expr, sp.Expr]]:
    """Each expression times one common denominator, as {monomial: coefficient}; cos^2 is written as 1 - sin^2."""
    fractions = [sp.fraction(sp.together(e)) for e in expressions]
    common = sp.S.One
    for _, denominator in fractions:
        common = sp.lcm(common, denominator)
    forms = []
    for numerator, denominator in fractions:
        polynomial = sp.expand(sp.expand(numerator * sp.cancel(common / denominator)).replace(_is_square_of_cosine, _as_sine))
        form: dict[sp.Expr, sp.Expr] = {}
        for term in sp.Add.make_args(polynomial):
            number, monomial = term.as_coeff_Mul()
            form[monomial] = form.get(monomial, sp.S.Zero) + number
        forms.append(form)
    return forms


def _is_square_of_cosine(e: sp.Expr) -> bool:
    return bool(e.is_Pow and isinstance(e.base, sp.cos) and e.exp.is_Integer and e.exp >= 2)


def _as_sine(e: sp.Expr) -> sp.Expr:
    half, odd = divmod(int(e.exp), 2)
    return (1 - sp.sin(e.base.args[0]) ** 2) ** half * e.base**odd


def _solve(forms: Sequence[dict[sp.Expr, sp.Expr]], unknowns: int) -> list[list[sp.Expr]] | None:
    """r with form[unknowns + j] = sum_k r[k][j] form[k], None if there is none with rational numbers."""
    monomials = sorted(set().union(*forms), key=sp.default_sort_key)
    matrix = sp.Matrix([[form.get(m, 0) for form in forms] for m in monomials])
    if not all(number.is_Rational for number in matrix):
        return None
    reduced, pivots = DomainMatrix.from_Matrix(matrix).to_field().rref()
    if any(p >= unknowns for p in pivots):
        return None
    rows = reduced.to_Matrix()
    solution = [[sp.S.Zero] * (len(forms) - unknowns) for _ in range(unknowns)]
    for i, p in enumerate(pivots):
        solution[p] = list(rows[i, unknowns:])
    return solution
