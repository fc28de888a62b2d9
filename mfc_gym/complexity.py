"""Whether the equations of a plant file stay of moderate size: asked before anything is multiplied out or simplified."""

from collections.abc import Sequence

import numpy as np
import sympy as sp

from mfc_gym.flat_system import lie
from mfc_gym.interval import FUNCTIONS
from mfc_gym.size import expanded_terms, node_count

NODES = 3000  # of a Lie derivative
TERMS = 5000  # of a Lie derivative when multiplied out
SIMPLIFIED = 25  # nodes of an expression that may be handed to `sympy.simplify`
DETERMINANT = 20_000  # terms of a Jacobian determinant when multiplied out


def check_derivatives(
    f: Sequence[sp.Expr], g: Sequence[sp.Expr], h: sp.Expr, Delta: Sequence[sp.Expr], x: Sequence[sp.Symbol]
) -> None:
    """The relative degree conditions of `FlatSystem`, each step of bounded cost: eq. (2) and (3) of its reference.

    Raises ValueError, naming the entry, for a condition that does not hold, and for an expression that grows too large or
    has no derivative (abs, min, max and sign in the places that are differentiated more than once).
    """
    n = len(x)
    drift = [a + b for a, b in zip(f, Delta, strict=True)]
    for field, name, label in ((f, "f", "f"), (drift, "Delta", "(f+Delta)")):
        phi = h
        gradients = []
        for k in range(n):
            gradients.append([sp.diff(phi, s) for s in x])
            term = lie(g, phi, x)
            _require_moderate([phi, term], name if k else "h")
            zero = _vanishes(term, name if k else "h")
            if zero != (k < n - 1):
                culprit = "Delta" if name == "Delta" else "g" if zero else "h"
                raise ValueError(
                    f"`{culprit}` must give relative degree n = {n}: L_g L_{label}^{k} h must be "
                    f"{'zero' if k < n - 1 else 'nonzero'}, got {'0' if zero else str(term)[:80]}."
                )
            phi = lie(field, phi, x)
        _require_moderate([phi], name)
        if _permanent(np.array([[0 if e == 0 else expanded_terms(e) for e in row] for row in gradients])) > DETERMINANT:
            raise ValueError(f"`{name}` must be simpler: the Jacobian of tau is too large to be checked.")


def _require_moderate(expressions: Sequence[sp.Expr], name: str) -> None:
    if any(function.func not in FUNCTIONS for e in expressions for function in e.atoms(sp.Function)):
        raise ValueError(f"`{name}` must be smoother: the Lie derivatives of h do not exist everywhere.")
    if any(node_count(e) > NODES or expanded_terms(e) > TERMS for e in expressions):
        raise ValueError(f"`{name}` must be simpler: the Lie derivatives of h grow too large.")


def _vanishes(term: sp.Expr, name: str) -> bool:
    """Whether `term` is identically zero, without simplifying anything large."""
    expanded = sp.expand(term)
    if expanded == 0:
        return True
    symbols = sorted(expanded.free_symbols, key=lambda s: s.name)
    for i in range(1, 6):
        value = expanded.subs({s: sp.Rational(7 * i + 3 * j + 1, 11 + i * j) for j, s in enumerate(symbols)}).evalf(30)
        if value.is_finite and abs(value) > sp.Float("1e-20"):
            return False
    if node_count(expanded) > SIMPLIFIED:
        raise ValueError(f"`{name}` must be simpler: whether {str(term)[:60]} vanishes cannot be decided.")
    return bool(sp.simplify(expanded) == 0)


def _permanent(matrix: np.ndarray) -> float:
    """Number of terms of a determinant whose entries have so many terms each (expansion over subsets of columns)."""
    counts = {0: 1.0}
    for row in matrix:
        following: dict[int, float] = {}
        for used, terms in counts.items():
            for j in np.flatnonzero(row):
                if not used >> int(j) & 1:
                    following[used | 1 << int(j)] = following.get(used | 1 << int(j), 0.0) + terms * float(row[j])
        counts = following
    return sum(counts.values())
