"""Proof of a bound that is itself a triangle inequality: sum_k abs(d_k(x)) with terms of its author's choice.

If the uncertain expression is sum_k r_k(theta) d_k(x) in these terms, abs(r_k) <= 1 for every admissible theta proves it.
The r_k come from an exact linear system: both sides are written in the monomials of the state and its functions.
"""

from collections.abc import Iterator, Sequence
from fractions import Fraction

import numpy as np
import sympy as sp
from numpy.typing import NDArray
from scipy.optimize import linprog
from sympy.polys.matrices import DomainMatrix

from mfc_gym.branch_and_bound import Box, enclose
from mfc_gym.size import node_count
from mfc_gym.triangle import ThetaSet, coefficients

Array = NDArray[np.float64]
Row = list[sp.Expr]
SIZE = 4000  # nodes of the bound
UNKNOWNS, ROWS = 500, 4000  # of the linear programme


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


def proves(
    bound: sp.Expr, expression: sp.Expr, divisor: sp.Expr, region: Box, theta: ThetaSet, tolerance: float
) -> bool:
    """Whether abs(expression / divisor(theta)) <= bound (1 + tolerance) follows term by term."""
    terms = [sp.nsimplify(t, rational=True) for t in nonnegative_terms(bound) if t != 0]
    parts = coefficients(expression, theta)
    if not terms or parts is None or sum(map(node_count, terms)) > SIZE:
        return False
    if any(enclose(t, region, budget=4000)[0] < 0 for t in terms):
        return False
    numbers, rests = zip(*(t.as_coeff_Mul() for t in terms), strict=True)
    directions = [sp.Mul(*map(_without_abs, sp.Mul.make_args(rest))) for rest in rests]
    forms = _monomials([*directions, *parts.values()])
    weights = theta.sample([p / divisor for p in parts])
    solution = _solve(forms, [float(abs(number)) for number in numbers], weights)
    if solution is None:
        return False
    shares = (theta.quotient(sp.Add(*(r * p for r, p in zip(row, parts, strict=True))), divisor) for row in solution)
    return all(theta.supremum(s) <= abs(number) * (1 + tolerance) for s, number in zip(shares, numbers, strict=True))


def _without_abs(factor: sp.Expr) -> sp.Expr:
    base, exponent = factor.as_base_exp()
    return base.args[0] ** exponent if isinstance(base, sp.Abs) and exponent.is_Integer else factor


def _monomials(expressions: Sequence[sp.Expr]) -> list[dict[sp.Expr, sp.Expr]]:
    """Each expression times one common denominator, as {monomial: coefficient}; cos^2 is written as 1 - sin^2."""
    fractions = [sp.fraction(sp.together(e)) for e in expressions]
    common = sp.S.One
    for _, denominator in fractions:
        common = sp.lcm(common, denominator)
    forms = []
    for numerator, denominator in fractions:
        polynomial = sp.expand(
            sp.expand(numerator * sp.cancel(common / denominator)).replace(_is_square_of_cosine, _as_sine)
        )
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


def _solve(forms: Sequence[dict[sp.Expr, sp.Expr]], limits: Sequence[float], weights: Array) -> list[Row] | None:
    """r with form[K + j] = sum_k r[k][j] form[k] exactly, K = len(limits); None if there is none with rational numbers.

    Where r is not unique, a linear programme says which of its entries to make zero.
    """
    monomials = sorted(set().union(*forms), key=sp.default_sort_key)
    matrix = sp.Matrix([[form.get(m, 0) for form in forms] for m in monomials])
    if not all(number.is_Rational for number in matrix):
        return None
    reduced, pivots = DomainMatrix.from_Matrix(matrix).to_field().rref()
    unknowns = range(len(limits))
    if any(p not in unknowns for p in pivots):
        return None
    rows = reduced.to_Matrix()[: len(pivots), :]
    free = [k for k in unknowns if k not in pivots]
    particular, null = rows[:, len(limits) :], rows[:, free]
    choice = sp.zeros(len(free), particular.cols)
    if free:
        order = [*free, *pivots]
        few = weights[:: 1 + len(order) * len(weights) // ROWS]
        best = _sparsest(np.array(particular, float), np.array(null, float), few, np.array(limits)[order])
        choice = sp.Matrix.hstack(*(_exact(z, particular[:, j], null) for j, z in enumerate(best.T)))
    solved = particular - null * choice
    return [list(solved[pivots.index(k), :] if k in pivots else choice[free.index(k), :]) for k in unknowns]


def _exact(z: Array, particular: sp.Matrix, null: sp.Matrix) -> sp.Matrix:
    """The rational numbers meant by z: those for which the entries of z and particular - null @ z that are tiny vanish."""
    free = len(z)
    equations = sp.Matrix.vstack(sp.eye(free), null)
    right = sp.Matrix.vstack(sp.zeros(free, 1), particular)
    entries = np.array(right, float)[:, 0] - np.array(equations, float) @ z
    tiny = np.flatnonzero(np.abs(entries) <= 1e-9 * (1 + np.abs(entries).max())).tolist()
    reduced, pivots = DomainMatrix.from_Matrix(equations[tiny, :].row_join(right[tiny, :])).to_field().rref()
    if pivots == tuple(range(free)):
        return reduced.to_Matrix()[:free, -1]
    return sp.Matrix([sp.Rational(Fraction(v).limit_denominator(10**6)) for v in z])


def _sparsest(particular: Array, null: Array, weights: Array, limits: Array) -> Array:
    """z of shape (free, j): least sum of abs r[k][j] max_s abs weights[s, j] / limits[k], abs(r @ weights.T) <= limits.

    r consists of the rows of z and of particular - null @ z. Its least 1-norm leaves few entries, as an author's own terms do.
    """
    free, terms = null.shape[1], particular.shape[1]
    if len(limits) * terms > UNKNOWNS:
        return np.zeros((free, terms))

    def rows(scale: Array) -> tuple[Array, Array]:
        """(M, c) with M @ z.ravel() + c = (r @ scale.T / limits).ravel()."""
        matrix = np.concatenate([np.kron(np.eye(free), scale), -np.kron(null, scale)])
        offset = np.concatenate([np.zeros(free * len(scale)), (particular @ scale.T).ravel()])
        inverse = np.repeat(1 / limits, len(scale))
        return matrix * inverse[:, None], offset * inverse

    (size, size_0), (share, share_0) = rows(np.diag(np.abs(weights).max(axis=0, initial=0.0))), rows(weights)
    slack = np.eye(len(size))
    none = np.zeros((len(share), len(size)))
    matrix = np.block([[size, -slack], [-size, -slack], [share, none], [-share, none]])
    limit = np.concatenate([-size_0, size_0, 1 - share_0, 1 + share_0]) + 1e-10
    cost = np.concatenate([np.zeros(free * terms), np.ones(len(size))])
    solution = linprog(cost, A_ub=matrix, b_ub=limit, bounds=(None, None))
    return (
        np.zeros((free, terms)) if solution.x is None else np.asarray(solution.x[: free * terms]).reshape(free, terms)
    )
