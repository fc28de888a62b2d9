"""How large an expression is and how large it gets when it is multiplied out."""

from math import comb

import sympy as sp

SHORT = 20  # terms of a product that is multiplied out where it need not be


def node_count(expression: sp.Basic) -> int:
    """Number of nodes of the expression tree, shared subtrees counted every time."""
    return sum(1 for _ in sp.preorder_traversal(expression))


def expanded_terms(expression: sp.Expr) -> int:
    """Upper bound of the number of terms that `sympy.expand` makes of the expression or of any part of it."""
    if not expression.args:
        return 1
    if expression.is_Add:
        return sum(map(expanded_terms, expression.args))
    if expression.is_Mul:
        product = 1
        for factor in expression.args:
            product *= expanded_terms(factor)
        return product
    if expression.is_Pow and expression.exp.is_Integer:
        terms, n = expanded_terms(expression.base), abs(int(expression.exp))
        return comb(terms + n - 1, n)
    return max(map(expanded_terms, expression.args))


def is_short(expression: sp.Expr) -> bool:
    """Whether none of its products and powers gets long when multiplied out."""
    return all(expanded_terms(e) <= SHORT for e in expression.atoms(sp.Mul, sp.Pow))
