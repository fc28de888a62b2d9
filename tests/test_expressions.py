"""Expressions in text form: what is read, what is refused and where, and that nothing is ever evaluated."""

import builtins
import math
from collections.abc import Callable
from typing import Any

import pytest
import sympy as sp
from hypothesis import given
from hypothesis import strategies as st

from mfc_gym.expressions import FUNCTIONS, parse
from mfc_gym.size import expanded_terms, node_count

NAMES = ("x1", "x2", "k")
x1, x2, k = (sp.Symbol(name, real=True) for name in NAMES)
half = sp.Rational(1, 2)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("x1^2 + 1", x1**2 + 1),
        ("-x1^2", -(x1**2)),
        ("2*x1 ** -2", 2 / x1**2),
        ("  x1\n + x2", x1 + x2),
        ("1.5e-3*k", sp.Rational(3, 2000) * k),
        (".5 + 5.", half + 5),
        ("0.1", sp.Rational(1, 10)),
        ("pi*x1", sp.pi * x1),
        ("x1^(1/2)", sp.sqrt(x1)),
        ("x1^(-1/3)", x1 ** sp.Rational(-1, 3)),
        ("sqrt(x1^2)", abs(x1)),
        ("min(x1, x2, 3)", sp.Min(x1, x2, 3)),
        ("max(abs(x1), sign(x2))", sp.Max(abs(x1), sp.sign(x2))),
        ("exp(x2/(1 + x2/20))*(1 - x1)", sp.exp(x2 / (1 + x2 / 20)) * (1 - x1)),
        ("+x1 - -x2", x1 + x2),
        ("((((x1))))", x1),
    ],
)
def test_read(text: str, expected: sp.Expr) -> None:
    assert parse(text, NAMES) == expected


@pytest.mark.parametrize("name", sorted(FUNCTIONS))
def test_every_function_is_sympys_own(name: str) -> None:
    function, least, _ = FUNCTIONS[name]
    symbols = (x1, x2)[:least]
    assert parse(f"{name}({', '.join(s.name for s in symbols)})", NAMES) == function(*symbols)


HOSTILE = [  # text, column from 1, what the message says
    ("__import__('os').system('true')", 1, "the name '__import__' is unknown"),
    ("x1 + eval(x1)", 6, "the name 'eval' is unknown"),
    ("x1.real", 3, r"'\.' is not allowed"),
    ("x1[0]", 3, r"'\[' is not allowed"),
    ("lambda: x1", 1, "the name 'lambda' is unknown"),
    ("[x1 for x1 in x1]", 1, r"'\[' is not allowed"),
    ("x1 if x2 else k", 4, "the name 'if' is unknown"),
    ("x1 or x2", 4, "the name 'or' is unknown"),
    ("(x1 := 2)", 5, "':' is not allowed"),
    ("x1 < x2", 4, "'<' is not allowed"),
    ("x1 // x2", 1, "this is no arithmetic expression"),
    ("x1 % x2", 4, "'%' is not allowed"),
    ("'x1'", 1, "is not allowed"),
    ("f'{x1}'", 1, "the name 'f' is unknown"),
    ("True", 1, "the name 'True' is unknown"),
    ("sin(x1, evaluate=x2)", 9, "the name 'evaluate' is unknown"),
    ("sin(*x1)", 5, "this is no arithmetic expression"),
    ("sin(**x1)", 1, "this is no arithmetic expression"),
    ("sin(x1, x2)", 1, "sin takes one argument, got 2"),
    ("sin", 1, "this is no arithmetic expression"),
    ("x1(2)", 1, "this is no arithmetic expression"),
    ("2 x1", None, "this is not an expression"),
    ("x1, x2", 1, "this is no arithmetic expression"),
    ("", 1, "the expression is empty"),
    ("1 + ", None, "this is not an expression"),
    ("x1#", 3, "'#' is not allowed"),
    ("9**9**9", 1, "an exponent must be a number up to 16"),
    ("2 + x1^x2", 5, "an exponent must be a number up to 16"),
    ("x1^17", 1, "an exponent must be a number up to 16"),
    ("k^2 + x2^1e9", 7, "an exponent must be a number up to 16"),
    ("((x1^16)^16)^16", 2, "an exponent exceeds 16"),
    ("x1^9*x1^9", 1, "an exponent exceeds 16"),
    ("((9^16)^16)^16", 2, "not a real number of moderate size"),
    ("((x1 + x2)^16 + 1)^16", 1, "too many terms when multiplied out"),
    ("exp(exp(x1))", 1, "exp of an exponential grows too fast"),
    ("sin(1 + cosh(x1))", 1, "sin of an exponential grows too fast"),
    ("(" * 500 + "x1" + ")" * 500, 41, "too long or too deeply nested"),
    ("-" * 500 + "x1", 4, "too long or too deeply nested"),
    ("sin(cos(" * 10 + "x1" + "))" * 10, None, "too deeply nested"),
    ("x1+" * 400 + "x1", 751, "too long or too deeply nested"),
    ("1e999", 1, "the number 1e999 is out of range"),
    ("1e-999999999", 1, "is out of range"),
    ("7" * 400, 1, "is out of range"),
    ("0x1f", 1, "'0' is not allowed"),
    ("1_000", 1, "'1' is not allowed"),
    ("1j", 1, "'1' is not allowed"),
    ("012", None, "this is not an expression"),
    ("1/0", 1, "not a finite real number"),
    ("x2/(x1 - x1)", 1, "not a finite real number"),
    ("sqrt(-1)", 1, "not a finite real number"),
    ("k + asin(2)*x1", 5, "not a real number"),
    ("nan", 1, "the name 'nan' is unknown"),
    ("oo", 1, "the name 'oo' is unknown"),
    ("\u0445" + "1", 1, "is not allowed"),
    ("x\uff11", 1, "the name 'x' is unknown"),
    ("x1 + \u221e", 6, "is not allowed"),
    ("x1\x00", 3, "is not allowed"),
]


@pytest.mark.parametrize(("text", "column", "message"), HOSTILE, ids=[h[0][:24] or "empty" for h in HOSTILE])
def test_refused(text: str, column: int | None, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: Any, **__: Any) -> None:
        raise AssertionError("something was evaluated")

    monkeypatch.setattr(builtins, "eval", never)
    monkeypatch.setattr(builtins, "exec", never)
    place = rf", in column {column or '[0-9]+'} of "
    with pytest.raises(ValueError, match=rf"{message}.*{place}.*; allowed are .*k, x1, x2.* sin cos .*\.$"):
        parse(text, NAMES)


def test_too_long() -> None:
    with pytest.raises(ValueError, match="may have 2000 characters, this one has 3001"):
        parse("1" * 3001, NAMES)


@given(st.text(alphabet="x12k+-*/^().,e 0", max_size=30) | st.text(max_size=12))
def test_any_text_is_read_or_refused(text: str) -> None:
    try:
        expression = parse(text, NAMES)
    except ValueError:
        return
    assert expression.free_symbols <= {x1, x2, k}
    assert expanded_terms(expression) <= 2000


Meaning = tuple[str, Callable[[float, float], float]]


def meanings() -> st.SearchStrategy[Meaning]:
    """Texts together with what they mean, put together independently of the parser."""
    leaf: st.SearchStrategy[Meaning] = st.sampled_from(
        [("x1", lambda a, b: a), ("x2", lambda a, b: b), ("0.5", lambda a, b: 0.5), ("3", lambda a, b: 3.0)]
    )

    def extend(inner: st.SearchStrategy[Meaning]) -> st.SearchStrategy[Meaning]:
        def unary(m: Meaning) -> list[Meaning]:
            text, value = m
            return [
                (f"-({text})", lambda a, b: -value(a, b)),
                (f"({text})^2", lambda a, b: value(a, b) ** 2),
                (f"sin({text})", lambda a, b: math.sin(value(a, b))),
                (f"abs({text})", lambda a, b: abs(value(a, b))),
            ]

        def binary(m: Meaning, w: Meaning) -> list[Meaning]:
            (left, v), (right, u) = m, w
            return [
                (f"{left} + ({right})", lambda a, b: v(a, b) + u(a, b)),
                (f"{left} - ({right})", lambda a, b: v(a, b) - u(a, b)),
                (f"({left}) * ({right})", lambda a, b: v(a, b) * u(a, b)),
                (f"max({left}, {right})", lambda a, b: max(v(a, b), u(a, b))),
            ]

        return inner.flatmap(lambda m: st.sampled_from(unary(m))) | st.tuples(inner, inner).flatmap(
            lambda mw: st.sampled_from(binary(*mw))
        )

    return st.recursive(leaf, extend, max_leaves=5)


@given(meanings(), st.floats(-2, 2), st.floats(-2, 2))
def test_a_text_means_what_it_says(meaning: Meaning, a: float, b: float) -> None:
    text, value = meaning
    try:
        expression = parse(text, NAMES)
    except ValueError as error:
        assert "too" in str(error) or "exceeds" in str(error)  # noqa: PT017 (a limit of size may be hit)
        return
    expected = value(a, b)
    assert float(expression.subs({x1: a, x2: b})) == pytest.approx(expected, rel=1e-9, abs=1e-9)


@given(st.integers(1, 4), st.integers(1, 5))
def test_expanded_terms_bounds_what_expand_makes(n: int, m: int) -> None:
    expression = (x1 + x2 + k * x1) ** n * (1 + x1) ** m + sp.sin(x1 + k)
    assert len(sp.Add.make_args(sp.expand(expression))) <= expanded_terms(expression)
    assert node_count(x1 * (1 + x2)) == 5
