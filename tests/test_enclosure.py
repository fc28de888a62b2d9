"""Enclosures contain what they must and are tight; bounds are proved, or refuted with a point that breaks them."""

import importlib
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from math import inf, pi, sqrt

import mpmath
import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from mfc_gym.domain import undefined_at, zero_at
from mfc_gym.enclosure import (
    check_bounds,
    check_domain,
    derive_bounds,
    enclose,
    falsify,
    prove_bound,
    region_box,
)
from mfc_gym.flat_system import FlatSystem
from mfc_gym.interval_function import REALS, IntervalFunction
from mfc_gym.systems import SYSTEMS
from mfc_gym.systems.perturbed_chain import perturbed_chain
from mfc_gym.systems.two_mass_spring import two_mass_spring
from mfc_gym.task import Task
from mfc_gym.termwise import proves
from mfc_gym.triangle import ThetaSet, round_up, triangle_bound

x, y, z, a, b = sp.symbols("x y z a b", real=True)
third = sp.Rational(1, 3)
FUNCTIONS = [
    x + y - x / 3, x * y, x**2, x**3, x**-2, 1 / x, sp.sqrt(x), x**third, x ** sp.Rational(-3, 2), sp.exp(x), sp.log(x),
    sp.sin(x), sp.cos(x), sp.tan(x), sp.atan(x), sp.asin(x), sp.acos(x), sp.tanh(x), sp.sinh(x), sp.cosh(x), sp.sign(x),
    sp.Abs(x), sp.Min(x, y, 1), sp.Max(x, y, 0), x**y, sp.pi * x + sp.E, sp.Float("0.1") * x, sp.exp(x * y) / (1 + x**2),
]  # fmt: skip
reals = st.floats(-20, 20, allow_subnormal=False)
widths = st.one_of(st.just(0.0), st.floats(0, 1e-6), st.floats(0, 5))


@cache
def exact(expression: sp.Expr) -> Callable:
    return sp.lambdify([x, y], expression, "mpmath")


@pytest.mark.parametrize("expression", FUNCTIONS, ids=str)
@settings(max_examples=40)
@given(st.tuples(reals, reals), st.tuples(widths, widths), st.tuples(st.floats(0, 1), st.floats(0, 1)))
def test_an_interval_contains_every_value(
    expression: sp.Expr, low: tuple[float, float], width: tuple[float, float], share: tuple[float, float]
) -> None:
    """Against 40 digits; where the interval is finite, the function must be defined everywhere in it."""
    box = [(p, p + w) for p, w in zip(low, width, strict=True)]
    ((bottom, top),) = IntervalFunction([expression], [x, y])(box)
    if (bottom, top) == REALS:
        return
    point = [min(p + s * w, p + w) for p, w, s in zip(low, width, share, strict=True)]
    with mpmath.workdps(40):
        value = exact(expression)(*map(mpmath.mpf, point))
        assert mpmath.im(value) == 0
        assert mpmath.mpf(bottom) <= value <= mpmath.mpf(top)


@pytest.mark.parametrize(
    ("expression", "interval", "expected"),
    [
        (x**2, (-1, 2), (0, 4)),
        (x**4, (-3, 2), (0, 81)),
        (x**3, (-1, 2), (-1, 8)),
        (1 / x, (2, 4), (0.25, 0.5)),
        (1 / x, (-1, 1), REALS),
        (1 / x, (0, 1), REALS),
        (1 / x**2, (-4, -2), (1 / 16, 0.25)),
        (sp.sqrt(x), (0, 4), (0, 2)),
        (sp.sqrt(x), (-1, 4), REALS),
        (sp.log(x), (0, 1), REALS),
        (sp.tan(x), (1, 2), REALS),
        (sp.asin(x), (0, 2), REALS),
        (sp.exp(x), (0, 1000), REALS),
        (sp.sin(x), (0, 4), (np.sin(4.0), 1)),
        (sp.cos(x), (-1, 1), (np.cos(1.0), 1)),
        (sp.sin(x), (-1e15, 1e15), (-1, 1)),
        (sp.cosh(x), (-1, 1), (1, np.cosh(1.0))),
        (sp.Abs(x), (-3, 2), (0, 3)),
        (sp.sign(x), (-3, 2), (-1, 1)),
        (sp.sign(x), (1, 2), (1, 1)),
        (sp.Max(x, 0), (-3, 2), (0, 2)),
        (sp.Min(x, 1), (-3, 2), (-3, 1)),
        (sp.gamma(x), (1, 2), REALS),  # no interval version
    ],
)
def test_the_interval_of_one_operation_is_its_range(expression: sp.Expr, interval: tuple, expected: tuple) -> None:
    (found,) = IntervalFunction([expression], [x])([interval])
    assert found == pytest.approx(expected, rel=1e-15)


BOX = {x: (-1.0, 2.0), y: (-3.0, 1.0), z: (0.0, 1.0), a: (-2.0, 2.0), b: (-2.0, 2.0)}


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        (x**2 - x, (-0.25, 2)),
        (x - x**3, (-6, 2 / (3 * sqrt(3)))),
        (x * y - x**2 * y + z, (-2, 7)),
        (sp.Abs(x) - sp.Abs(x + y), (-3, 2)),
        (sp.Max(x, y) + sp.Min(x, z), (-2, 3)),
        (sp.sqrt(x + 1) * sp.exp(-(y**2)), (0, sqrt(3))),
        (x / (1 + x**2), (-0.5, 0.5)),
        (sp.sin(a) ** 2 + sp.cos(a) ** 2, (1, 1)),
        (sp.atan(a) + sp.tanh(a), (-np.arctan(2) - np.tanh(2), np.arctan(2) + np.tanh(2))),
        ((1 - a) ** 2 + 100 * (b - a**2) ** 2, (0, 3609)),
        (sp.Integer(3), (3, 3)),
    ],
)
def test_an_enclosure_is_tight(expression: sp.Expr, expected: tuple[float, float]) -> None:
    low, high = enclose(expression, BOX)
    assert low <= expected[0] + 1e-12
    assert high >= expected[1] - 1e-12
    assert (low, high) == pytest.approx(expected, rel=3e-6, abs=3e-6)


def test_an_enclosure_on_a_part_of_the_box() -> None:
    where = [x + y - 1, sp.Rational(9, 10) - x - y]  # 0.9 <= x + y <= 1
    low, high = enclose(x**2 + y**2, BOX, where=where)
    assert 0.40 < low <= 0.405
    assert 5.21 - 1e-12 <= high < 5.22
    assert enclose(x, BOX, where=[x + 10]) == (inf, -inf)


@settings(max_examples=30)
@given(
    st.lists(st.tuples(st.integers(-3, 3), st.integers(0, 3), st.integers(0, 3)), min_size=1, max_size=4),
    st.integers(0, 3),
)
def test_an_enclosure_contains_samples(terms: list[tuple[int, int, int]], kind: int) -> None:
    """Random polynomials, in Abs, Max and sine, with a small budget: whatever was not refined must still be covered."""
    p = sp.Add(*(c * x**m * y**n for c, m, n in terms))
    expression = [p, sp.Abs(p) - x, sp.Max(p, x * y), sp.sin(p) * y][kind]
    low, high = enclose(expression, BOX, budget=3000)
    grid = np.meshgrid(np.linspace(*BOX[x], 41), np.linspace(*BOX[y], 41))
    values = np.broadcast_to(sp.lambdify([x, y], expression)(*grid), grid[0].shape)
    assert low <= values.min() + 1e-12
    assert values.max() <= high + 1e-12


def test_a_bound_is_proved_refuted_or_left_undecided() -> None:
    assert prove_bound(x**2, 4, BOX).status == "proved"
    refuted = prove_bound(x**2 * y, 3.99, BOX)
    assert refuted.status == "refuted"
    assert refuted.point is not None
    assert float((x**2 * y).subs(refuted.point)) - 3.99 >= refuted.excess > 0
    undecided = prove_bound(sp.sin(3 * x * y) * sp.cos(5 * y * z), 0.99999, BOX, budget=1)
    assert undecided.status == "undecided"
    assert undecided.box is not None
    assert prove_bound(-(x**2) - 1, 0, BOX, strict=True).status == "proved"
    assert prove_bound(-(x**2), 0, BOX, strict=True).status != "proved"
    assert prove_bound(-(x**2), 0, BOX).status == "proved"
    assert prove_bound(x, 0, BOX, where=[x + y - 1, 3 - x]).status == "proved"  # nothing satisfies both
    with pytest.raises(ValueError, match="`box` must have an interval for every symbol"):
        prove_bound(sp.Symbol("q"), 0, BOX)


def test_falsify_finds_what_breaks_a_bound(rng: np.random.Generator) -> None:
    found = falsify(-((1 - a) ** 2) - 100 * (b - a**2) ** 2, -1e-8, BOX, rng)  # a banana-shaped valley
    assert found is not None
    assert [found.point[a], found.point[b]] == pytest.approx([1, 1], abs=1e-3)
    narrow = falsify(sp.exp(-1000 * (x - 0.3) ** 2 - 1000 * (y + 0.7) ** 2), 0.999, BOX, rng)
    assert narrow is not None
    assert falsify(x**2, 4, BOX, rng) is None
    part = falsify(x + y, 2, BOX, rng, where=[x - 1.5])
    assert part is not None
    assert part.point[x] <= 1.5
    assert sum(part.point.values()) > 2
    assert falsify(x, 0, BOX, rng, where=[x + y - 1, 2 - x - y]) is None
    assert falsify(sp.Integer(1), 0, {}, rng) is not None


def test_where_an_expression_is_defined() -> None:
    assert undefined_at([1 / (x + 2), sp.sqrt(x + 1), sp.log(y + 4), sp.tan(x / 2), sp.asin(z)], BOX) is None
    assert undefined_at([1 / (x**2 - 2 * x + 1 + z + sp.Rational(1, 100))], BOX) is None
    for expression, clause in [
        (1 / (x - 1), "x - 1 changes its sign or vanishes at x = "),
        (1 / x**2, "x changes its sign or vanishes"),
        (sp.sqrt(y), "y is not nonnegative at y = "),
        (sp.log(z), "z is not positive at z = 0"),
        (sp.tan(a), r"cos\(a\) changes its sign or vanishes"),
        (sp.asin(a), r"is not nonnegative at a = "),
        (1 / (sp.sin(a) ** 2 + sp.cos(a) ** 2 - 1), "vanishes or is not defined"),
    ]:
        with pytest.raises(AssertionError, match=clause):
            raise AssertionError(undefined_at([expression], BOX))
    assert zero_at(x - y + 5, BOX) is None
    assert zero_at(x - y, BOX) is not None


def test_the_triangle_inequality_over_theta() -> None:
    theta = ThetaSet({a: (-0.5, 1.0), b: (0.0, 2.0)})
    assert triangle_bound(a * x + a * b * x + b**2 * sp.sin(y), theta) == 3 * abs(x) + 4 * abs(sp.sin(y))
    assert triangle_bound(sp.sin(a * x), theta) is None
    assert triangle_bound(a * x, theta, divisor=1 + a) == abs(x)  # sup of abs(a / (1 + a)) at a = -1/2
    assert round_up(0.1 + 0.2) == sp.Rational(3, 10)
    assert round_up(pi) == sp.Rational("3.1415926536")


def test_a_constraint_on_delta_3_is_exact() -> None:
    """Of (1 + a)(1 + b) over the part of the box where abs((1 + a)(1 + b) - 1) <= 1/4: the supremum is 5/4."""
    gain = (1 + a) * (1 + b)
    theta = ThetaSet({a: (-0.5, 0.5), b: (-0.5, 0.5)}, sp.expand(gain - 1), sp.Rational(1, 4))
    assert theta.supremum(sp.expand(gain)) == sp.Rational(5, 4)
    assert theta.supremum(sp.expand(gain - 1) / gain) == round_up(1 / 3)


@pytest.mark.parametrize("k", [1, 4, 8, 10, 11])
def test_a_long_product_is_bounded_as_it_stands(k: int) -> None:
    """p_k = prod(1 + a_i), i <= k, with abs(p_11 - 1) <= 1/4: p_k <= (3/2)^k and p_k <= 5/4 2^(11-k)."""
    a = sp.symbols("a1:12", real=True)
    p = [sp.prod(1 + s for s in a[:i]) for i in range(12)]
    theta = ThetaSet(dict.fromkeys(a, (-0.5, 0.5)), p[-1] - 1, sp.Rational(1, 4))
    supremum = min(sp.Rational(3, 2) ** k, sp.Rational(5, 4) * 2 ** (11 - k))
    assert triangle_bound(p[k] * x - x, theta) == round_up(float(supremum - 1)) * abs(x)


def test_a_bound_of_other_terms_is_proved_term_by_term() -> None:
    """a w_1 + (2 a + a^2) w_2 = a (w_1 + 2 w_2) + a^2 w_2, trigonometric terms included."""
    theta, region = ThetaSet({a: (-0.5, 0.5)}), {x: (-4.0, 4.0), y: (-4.0, 4.0)}
    w_1, w_2 = x * y - sp.sin(x) ** 2, sp.cos(x) ** 2 + y
    expression = sp.expand(a * w_1 + (2 * a + a**2) * w_2)
    bound = abs(sp.expand(w_1 + 2 * w_2)) / 2 + abs(w_2) / 4
    one = sp.S.One
    assert proves(bound, expression, one, region, theta, 1e-9)
    assert not proves(bound * sp.Rational(99, 100), expression, one, region, theta, 1e-9)
    assert not proves(bound - x**2, expression, one, region, theta, 1e-9)  # a summand that is not nonnegative
    assert not proves((1 + abs(x)) * abs(y), a * (1 + x) * y * 2, one, region, ThetaSet({a: (-1.0, 1.0)}), 1e-9)


def library(name: str) -> FlatSystem:
    module, _, attribute = SYSTEMS[name].partition(":")
    return getattr(importlib.import_module(module), attribute)()


@pytest.mark.parametrize("name", SYSTEMS)
def test_every_declared_bound_of_the_library_is_proved(name: str) -> None:
    system = library(name)
    check_domain(system)
    verdicts = check_bounds(system)
    assert {k: v.status for k, v in verdicts.items()} == dict.fromkeys(system.bounds, "proved")


@pytest.mark.parametrize("order", [2, 3, 4])
def test_the_bounds_of_the_chain_for_every_order(order: int) -> None:
    """delta_1 = (1 + rho) abs(x)^2 and delta_3 = rho on the admissible part of a box that reaches abs(Delta_3) > 1."""
    system = perturbed_chain(order)
    assert all(v.status == "proved" for v in check_bounds(system).values())
    rho = sp.Rational(1, 4)
    derived = derive_bounds(replace(system, bounds={"delta_3": rho}))
    norm2 = sum(s**2 for s in system.x)
    assert derived["delta_1"].expand() == ((1 + rho) * norm2).expand()
    assert derived["sharp_1"] == derived["delta_m"] == norm2


@pytest.mark.parametrize("name", ["delta_1", "delta_m", "sharp_1", "sharp_3"])
@pytest.mark.parametrize("system", ["PerturbedChain", "MagneticLevitation", "TwoMassSpring"])
def test_a_wrong_bound_is_refuted_with_a_counterexample(system: str, name: str) -> None:
    plant = library(system)
    wrong = replace(plant, bounds={**plant.bounds, name: plant.bounds[name] * 0.95})
    with pytest.raises(ValueError, match=rf"`bounds` {name} must bound abs\(.*\): .* exceeds .* at .* = ") as refusal:
        check_bounds(wrong)
    words = str(refusal.value).replace(",", "").rstrip(".").split()
    point = {words[i - 1]: float(words[i + 1]) for i, word in enumerate(words) if word == "="}
    assert float(words[words.index("exceeds") - 1]) > float(words[words.index("exceeds") + 1])
    for s, (low, high) in region_box(plant).items():
        assert low - 1e-4 <= point.get(s.name, low) <= high + 1e-4


def test_derived_bounds_are_rigorous_and_tight_for_the_springs() -> None:
    """Delta_3 = k / k0 - 1, Delta_1 = -2 (k^2 - k0^2) (x1 - x2) for k0 = 5/4, k in [1/2, 2]."""
    bounds = derive_bounds(replace(two_mass_spring(), bounds={}))
    x1, x2 = two_mass_spring().x[:2]
    assert bounds["delta_3"] == sp.Rational(3, 5)
    assert bounds["delta_1"].subs({x1: 1, x2: 0}) == pytest.approx(2 * (4 - 25 / 16))


def springs(nominal: float, interval: tuple[float, float]) -> FlatSystem:
    x1, x2, v1, v2 = state = sp.symbols("x1 x2 v1 v2", real=True)
    k, k0 = sp.symbols("k k0", real=True)
    force, error = k0 * (x1 - x2), (k - k0) * (x1 - x2)
    return FlatSystem(
        name="springs",
        state=tuple(map(str, state)),
        f=(v1, v2, -force, force),
        g=(0, 0, 1, 0),
        h=x2,
        Delta=(0, 0, -error, error),
        parameters={"k0": nominal},
        theta={"k": interval},
    )


def test_too_large_a_theta_is_refused_and_a_better_nominal_gain_proposed() -> None:
    message = r"`theta` .* with k in \[0\.5, 2\.0\] .* over \[0\.5, 2\] .* is 1\.25 times the present one .* <= 0\.6\)"
    for refused in (check_bounds, derive_bounds):
        with pytest.raises(ValueError, match=message):
            refused(springs(1.0, (0.5, 2.0)))
    assert derive_bounds(springs(1.25, (0.5, 2.0)))["delta_3"] == sp.Rational(3, 5)
    with pytest.raises(ValueError, match=r"over \[-0\.5, 2\] times the nominal one: narrow the interval"):
        derive_bounds(springs(1.0, (-0.5, 2.0)))
    with pytest.raises(ValueError, match=r"with alpha1 in .* is 1\.25 times"):
        derive_bounds(replace(perturbed_chain(), bounds={}))


def test_what_delta_3_must_be() -> None:
    plant = springs(1.25, (0.5, 2.0))
    with pytest.raises(ValueError, match=r"`bounds` must have delta_3 < 1 .* got 1"):
        check_bounds(replace(plant, bounds={"delta_3": 1}))
    with pytest.raises(
        ValueError, match=r"`theta` of the task must keep abs\(Delta_3\) <= delta_3 = 0\.5.*, got \(2\.0,\)"
    ):
        check_bounds(replace(plant, bounds={"delta_3": 0.5}, task=Task(theta=(2.0,))))
    with pytest.raises(ValueError, match="must admit some theta"):
        check_bounds(replace(springs(1.0, (1.5, 1.9)), bounds={"delta_3": 0.25}))


def test_a_gain_error_that_depends_on_the_state() -> None:
    """x1' = x2 (1 + k x1^2 / 100), abs(x1) <= 5: Delta_3 = k x1^2 / 100 is bounded by a function of the state."""
    x1, x2 = sp.symbols("x1 x2", real=True)
    k = sp.Symbol("k", real=True)
    system = FlatSystem(
        name="state-dependent",
        state=("x1", "x2"),
        f=(x2, -x1),
        g=(0, 1),
        h=x1,
        Delta=(k * x1**2 * x2 / 100, 0),
        theta={"k": (-1.0, 2.0)},
        region={"x1": (-5, 5), "x2": (-1, 1)},
    )
    bounds = derive_bounds(system)
    assert bounds["delta_3"] == x1**2 / 50
    assert all(v.status == "proved" for v in check_bounds(replace(system, bounds=bounds)).values())
    with pytest.raises(ValueError, match=r"delta_3 must bound abs\(Delta_3\): .* exceeds 0\.4"):
        check_bounds(replace(system, bounds={"delta_3": 0.4}))
