"""Expressions in text form, read without ever evaluating text: `ast` gives the structure, a table says what it may mean.

The tokens are checked first (nothing but numbers, known names and operators reaches `ast`), then every node, then every
SymPy object as it is built, so that no input can make the reading or the later symbolic work explode.
"""

import ast
import re
from collections.abc import Callable, Collection
from decimal import Decimal

import sympy as sp

from mfc_gym.size import expanded_terms

Meaning = tuple[Callable[..., sp.Expr], int, int]  # function, least and largest number of its arguments
FUNCTIONS: dict[str, Meaning] = {
    **{
        f: (getattr(sp, f), 1, 1)
        for f in ("sin", "cos", "tan", "exp", "log", "sqrt", "tanh", "atan", "asin", "acos", "sinh", "cosh", "sign")
    },
    "abs": (sp.Abs, 1, 1),
    "min": (sp.Min, 2, 4),
    "max": (sp.Max, 2, 4),
}
OPERATORS: dict[type[ast.AST], Callable[[sp.Expr, sp.Expr], sp.Expr]] = {
    ast.Add: lambda a, b: a + b,
    ast.Sub: lambda a, b: a - b,
    ast.Mult: lambda a, b: a * b,
    ast.Div: lambda a, b: a / b,
    ast.Pow: lambda a, b: a**b,
}
LENGTH, TOKENS, DEPTH, TERMS = 2000, 500, 80, 2000  # of the text, in it, of the tree, after multiplying out
CALL = 15  # what a function call counts for in depth: at most 5 calls within each other
EXPONENT, DENOMINATOR = 16, 12  # largest abs(exponent), and denominator of a fractional one
MAGNITUDE = 30  # decimal orders of a constant other than 0
TOKEN = re.compile(
    r"(?P<number>(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?(?![\w.]))|(?P<name>[A-Za-z_]\w*)|\*\*|[-+*/^(),]", re.ASCII
)
GROWING = (sp.exp, sp.sinh, sp.cosh)
PERIODIC = (sp.sin, sp.cos, sp.tan, sp.tanh)


def parse(text: str, names: Collection[str]) -> sp.Expr:
    """The expression that `text` spells in the real symbols `names`; anything else is a ValueError naming the column."""
    if len(text) > LENGTH:
        raise ValueError(f"an expression may have {LENGTH} characters, this one has {len(text)}.")
    reader = _Reader(text, names)
    reader.check_tokens()
    python = re.sub(r"\s", " ", text).replace("^", "**")
    start = len(python) - len(python.lstrip())
    try:
        tree = ast.parse(python.lstrip(), mode="eval")
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        column = reader.column((getattr(error, "offset", None) or 1) - 1 + start)
        raise reader.refusal("this is not an expression", column) from None
    reader.shift = start
    return reader.build(tree.body, 0)


class _Reader:
    """One text on its way to an expression."""

    def __init__(self, text: str, names: Collection[str]) -> None:
        self.text, self.names, self.shift = text, names, 0
        # column in the text of every column after `^` has become `**`
        self.columns = [i for i, c in enumerate(text) for _ in range(2 if c == "^" else 1)]

    def column(self, position: int) -> int:
        return self.columns[position] if position < len(self.columns) else len(self.text)

    def refusal(self, reason: str, column: int) -> ValueError:
        text = self.text if len(self.text) <= 60 else self.text[max(0, column - 30) : column + 30]
        names = sorted(self.names)
        known = ", ".join(names[:20]) + (", ..." if len(names) > 20 else "")
        return ValueError(
            f"{reason}, in column {column + 1} of {text!a}; allowed are decimal numbers, pi, the names {known}, "
            f"the operators + - * / ** ^, and the functions {' '.join(FUNCTIONS)}."
        )

    def check_tokens(self) -> None:
        position = count = depth = 0
        signs = 0  # operators in a row
        while position < len(self.text):
            if self.text[position] in " \t\n\r":
                position += 1
                continue
            token = TOKEN.match(self.text, position)
            if token is None:
                raise self.refusal(f"{self.text[position]!a} is not allowed here", position)
            word, count = token.group(), count + 1
            depth += (word == "(") - (word == ")")
            signs = signs + 1 if word in ("+", "-") else 0
            if count > TOKENS or depth > DEPTH // 2 or signs > 3:
                raise self.refusal("the expression is too long or too deeply nested", position)
            if token["name"] and word not in self.names and word not in FUNCTIONS and word != "pi":
                raise self.refusal(f"the name {word!r} is unknown", position)
            if token["number"] and not _moderate(word):
                raise self.refusal(
                    f"the number {word[:40]} is out of range, 0 or 1e-{MAGNITUDE} to 1e{MAGNITUDE}", position
                )
            position = token.end()
        if count == 0:
            raise self.refusal("the expression is empty", 0)

    def build(self, node: ast.AST, depth: int) -> sp.Expr:
        column = self.column(getattr(node, "col_offset", 0) + self.shift)
        if depth > DEPTH:
            raise self.refusal("the expression is too deeply nested", column)
        expression = self._build(node, depth + 1, column)
        if reason := reason_against(expression):
            raise self.refusal(reason, column)
        return expression

    def _build(self, node: ast.AST, depth: int, column: int) -> sp.Expr:
        match node:
            case ast.Constant():
                end = (node.end_col_offset or 0) + self.shift
                return sp.Rational(self.text[column : self.column(end)].strip())
            case ast.Name(id="pi"):
                return sp.pi
            case ast.Name(id=name) if name in self.names:
                return sp.Symbol(name, real=True)
            case ast.UnaryOp(op=ast.USub() | ast.UAdd(), operand=operand):
                value = self.build(operand, depth)
                return -value if isinstance(node.op, ast.USub) else value
            case ast.BinOp(left=left, op=op, right=right) if type(op) in OPERATORS:
                a, b = self.build(left, depth), self.build(right, depth)
                if isinstance(op, ast.Pow) and not _small_rational(b):
                    raise self.refusal(f"an exponent must be a number up to {EXPONENT} (or such a fraction)", column)
                return OPERATORS[type(op)](a, b)
            case ast.Call(func=ast.Name(id=name), args=args, keywords=[]) if name in FUNCTIONS:
                function, least, largest = FUNCTIONS[name]
                if not least <= len(args) <= largest:
                    wanted = f"{least} to {largest} arguments" if largest > 1 else "one argument"
                    raise self.refusal(f"{name} takes {wanted}, got {len(args)}", column)
                values = [self.build(arg, depth + CALL) for arg in args]
                if function in GROWING + PERIODIC and any(v.has(*GROWING) for v in values):
                    raise self.refusal(f"{name} of an exponential grows too fast", column)
                return function(*values)
        raise self.refusal("this is no arithmetic expression", column)


def _moderate(number: str) -> bool:
    value = Decimal(number)
    return len(number) <= 2 * MAGNITUDE and (value == 0 or abs(value.adjusted()) <= MAGNITUDE)


def _small_rational(exponent: sp.Expr) -> bool:
    return isinstance(exponent, sp.Rational) and abs(exponent) <= EXPONENT and exponent.q <= DENOMINATOR


def reason_against(expression: sp.Expr) -> str | None:
    """Why an expression is not a finite real one of moderate size, None if it is."""
    if expression.has(sp.zoo, sp.nan, sp.oo, -sp.oo, sp.I):
        return "this is not a finite real number"
    if any(not _small_rational(power.exp) for power in expression.atoms(sp.Pow)):
        return f"an exponent exceeds {EXPONENT}"
    if expanded_terms(expression) > TERMS:
        return "the expression has too many terms when multiplied out"
    if expression.is_number:
        value = expression.evalf(15)
        if not value.is_real or abs(value) > sp.Integer(10) ** MAGNITUDE:
            return "this is not a real number of moderate size"
    return None
