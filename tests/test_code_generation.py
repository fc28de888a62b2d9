"""Generated kernels against SymPy, and the integrator in them against its theory."""

import re
from collections.abc import Sequence

import numpy as np
import pytest
import sympy as sp
from numpy.typing import NDArray
from plants import integrated
from scipy.integrate import solve_ivp

from mfc_gym import plant
from mfc_gym.code_generation import complete_bounds, nominal_source, plant_source
from mfc_gym.flat_system import FlatSystem
from mfc_gym.systems.perturbed_chain import perturbed_chain

Array = NDArray[np.float64]
EPS = float(np.finfo(float).eps)


class Exact:
    """Expressions at one point: the value to 30 digits, and a bound of the rounding error of evaluating it in doubles.

    First-order running error analysis, node by node: what the arguments carry, and 1 ulp per operation of this node.
    """

    def __init__(self, symbols: Sequence[sp.Symbol], numbers: Array) -> None:
        self.known = {s: (sp.Float(v, 30), 0.0) for s, v in zip(symbols, map(float, numbers), strict=True)}

    def __call__(self, e: sp.Expr) -> tuple[sp.Float, float]:
        if e not in self.known:
            self.known[e] = self._evaluate(e)
        return self.known[e]

    def _evaluate(self, e: sp.Expr) -> tuple[sp.Float, float]:
        if not e.args:
            return e.evalf(30), EPS * abs(float(e))
        if e.is_Pow and e.exp.is_Integer:
            (base, error), n = self(e.base), abs(int(e.exp))
            value = (base**e.exp).evalf(30)
            return value, n * (float(abs(value / base)) * error + EPS * float(abs(value)))
        values, errors = zip(*map(self, e.args), strict=True)
        value = e.func(*values).evalf(30)
        size, sizes = float(abs(value)), [float(abs(v)) for v in values]
        if e.is_Add:
            return value, sum(errors) + len(values) * EPS * sum(sizes)
        if e.is_Mul:
            others = [np.prod(sizes[:i] + sizes[i + 1 :]) for i in range(len(sizes))]
            return value, float(np.dot(errors, others)) + len(values) * EPS * size
        slots = sp.symbols(f"z:{len(values)}", real=True)
        at = dict(zip(slots, values, strict=True))
        slopes = [float(abs(sp.diff(e.func(*slots), s).subs(at).evalf(30))) for s in slots]
        return value, float(np.dot(slopes, errors)) + 2 * EPS * size

    def check(self, kernel: Sequence[float], expressions: Sequence[sp.Expr]) -> None:
        assert len(kernel) == len(expressions)
        for got, expression in zip(kernel, expressions, strict=True):
            value, error = self(sp.sympify(expression))
            assert abs(got - float(value)) <= 2 * error  # 2: common subexpressions may be associated otherwise


@pytest.mark.parametrize("name", ["plants:every_function", "FlexibleJoint"])
def test_kernels_are_the_equations(name: str, rng: np.random.Generator) -> None:
    built = plant.load(name)
    system, kernel, n = built.system, built.kernel, built.order
    J = sp.Matrix(n, n, lambda i, j: sp.diff(system.tau[i], system.x[j]))
    drift = [a + b for a, b in zip(system.f, system.Delta, strict=True)]
    rates = [*(J * sp.Matrix(drift)), *(J * sp.Matrix(system.g)), system.lie_f_Delta[n], system.beta + system.Delta_2]
    for _ in range(2):
        x, theta, u = rng.uniform(*built.region(50.0)), rng.uniform(*built.theta_set), float(rng.uniform(-10, 10))
        exact = Exact([*system.x, *system.theta_symbols], np.concatenate([x, theta]))
        exact.check(kernel.flow_at(x, theta), [*drift, *system.g, *system.tau_n, *system.tau, *rates])
        exact.check(np.array(kernel.output_derivatives(*x, *theta)), system.tau_n)
        exact.check(kernel.uncertainty_at(x, theta), [system.Delta_1, system.Delta_3, system.phi_m])
        exact.check(
            kernel.field(*x, *theta, u), [a + b * sp.Float(u, 30) for a, b in zip(drift, system.g, strict=True)]
        )


@pytest.mark.parametrize("name", ["plants:every_function", "FlexibleJoint"])
def test_nominal_kernels_are_the_equations(name: str, rng: np.random.Generator) -> None:
    built = plant.load(name)
    system, bounds = built.system, complete_bounds(built.system)
    low, high = built.region(50.0)
    points = rng.uniform(low, high, (2, system.order))
    wanted = [*system.tau, system.alpha, system.beta, *(bounds[k] for k in bounds_in_order()), *system.f, *system.g]
    for x, row in zip(points, built.nominal.terms_at(points), strict=True):
        exact = Exact(system.x, x)
        exact.check(row, wanted)
        exact.check(built.nominal.jacobian_at(x), list(sp.Matrix(system.tau).jacobian(system.x)))


def bounds_in_order() -> tuple[str, ...]:
    return ("delta_1", "delta_3", "delta_m", "sharp_1", "sharp_3")


def test_derived_bounds() -> None:
    """abs(Delta_i) / (1 + Delta_3) <= delta_i / (1 - delta_3), and phi_m is bounded by delta_1 unless told otherwise."""
    system = plant.load("plants:every_function").system
    bounds = complete_bounds(system)
    assert [float(bounds[k]) for k in bounds_in_order()] == pytest.approx([1e3, 0.9, 1e3, 1e4, 9.0], rel=4 * EPS)


def test_a_plant_without_bounds_is_refused() -> None:
    system = plant.build_system("PerturbedChain", {"order": 2})
    bare = FlatSystem("bare", system.state, system.f, system.g, system.h, system.Delta, theta=system.theta)
    with pytest.raises(
        ValueError, match="`bounds` must give delta_1 and delta_3, delta_1, delta_3 missing in system 'ba"
    ):
        nominal_source(bare)


@pytest.mark.parametrize("n", range(2, 7))
def test_chain_kernels_are_exact_on_a_dyadic_grid(n: int, rng: np.random.Generator) -> None:
    """Multiples of 1/8 below 8 have 6 bits: no product of up to n of them and no sum needs more than 53."""
    built = plant.load("PerturbedChain", order=n)
    x, theta = rng.integers(-60, 61, n) / 8, rng.integers(-4, 5, n - 1) / 8
    p = np.cumprod(np.concatenate([[1.0], 1 + theta]))
    norm2 = float(x @ x)
    kernel = built.kernel
    np.testing.assert_array_equal(np.array(kernel.output_derivatives(*x, *theta)), p * x)
    np.testing.assert_array_equal(kernel.uncertainty_at(x, theta), [p[-1] * norm2, p[-1] - 1, norm2])
    np.testing.assert_array_equal(kernel.field(*x, *theta, 0.5), [*((1 + theta) * x[1:]), 0.5 + norm2])


def test_generated_text_reveals_nothing_to_the_controller() -> None:
    """The nominal model's text is the same whatever Delta and theta are, but for the bound of xi_n - xi."""
    chain = perturbed_chain(3)
    other = FlatSystem(
        "perturbed chain", chain.state, chain.f, chain.g, chain.h, (0, 0, sp.Symbol("q") * chain.x[0]),
        theta={"q": (-1, 1)}, region=chain.region, bounds=chain.bounds,
    )  # fmt: skip
    texts = [
        re.sub(r"(def spread\(.*?    return )[^\n]*", r"\1...", nominal_source(s), flags=re.S) for s in (other, chain)
    ]
    assert texts[0] == texts[1]
    assert plant_source(other) != plant_source(chain)


# -- the integrator ---------------------------------------------------------------------------------------------------

WIDE = np.full(3, 1e6)


def test_runge_kutta_is_of_order_four() -> None:
    """error = C h^4 (1 + c h + ...): what the slope misses 4 by halves with h, and is below 0.05 at 64 substeps."""
    built = plant.load("PerturbedChain")
    x, theta, u, T = np.array([1.0, -0.5, 0.25]), np.array([0.5, -0.5]), 3.0, 0.4

    def field(t: float, z: Array) -> Array:
        return np.array(built.kernel.field(*z, *theta, u))

    exact = solve_ivp(field, (0, T), x, method="DOP853", rtol=1e-13, atol=1e-15).y[:, -1]
    substeps = 2 ** np.arange(3, 7)
    ends = [integrated(built.kernel, x, theta, u, T / m, m, -WIDE, WIDE) for m in substeps]
    errors = [np.abs(end[:-1] - exact).max() for end in ends]
    miss = np.abs(-np.diff(np.log2(errors)) - 4)
    assert miss[-1] < 0.05
    np.testing.assert_allclose(miss[:-1] / miss[1:], 2, rtol=0.35)  # second-order term of the ratio at 8 substeps


def test_runge_kutta_of_a_linear_plant_is_its_taylor_polynomial() -> None:
    """x' = A x + B u with constant u: one step is sum_(j<=4) (h A)^j / j! exactly, applied to [x, u]."""
    built = plant.load("plants:oscillator")
    A = np.array([[0.0, 1.0, 0.0], [-4.0, -1.0, 1.0], [0.0, 0.0, 0.0]])
    x, u, h = np.array([0.75, -0.5]), 0.5, 0.125
    expected, term = np.array([*x, u]), np.array([*x, u])
    for j in range(1, 5):
        term = h / j * A @ term
        expected = expected + term
    end = integrated(built.kernel, x, np.empty(0), u, h, 1, *built.region(1.0))
    np.testing.assert_allclose(end, [*expected[:2], 1.0], rtol=0, atol=40 * EPS)  # at most 40 operations on numbers < 4


def test_stops_at_the_first_substep_outside() -> None:
    """x1' = x2 with x2 held up by u: the region ends at x1 = 1."""
    built = plant.load("plants:oscillator")
    low, high = built.region(1.0)
    x, none = np.array([0.95, 1.5]), np.empty(0)
    path = [integrated(built.kernel, x, none, 1.0, 0.01, m, low, high) for m in range(1, 10)]
    inside = [bool(row[-1]) for row in path]
    first = inside.index(False)
    assert 0 < first < 8
    assert not any(inside[first:])
    assert path[first][0] > 1 >= path[first - 1][0]
    for row in path[first:]:  # nothing moves any more
        np.testing.assert_array_equal(row, path[first])


@pytest.mark.parametrize("h", [3.0, 1e3, 1e200])
def test_the_state_never_leaves_twice_the_region(h: float) -> None:
    """A substep that jumps further, to infinity or nowhere at all is not taken."""
    built = plant.load("PerturbedChain")
    low, high = built.region(50.0)
    x = np.array([1.0, 2.0, 7.0])
    end = integrated(built.kernel, x, np.array([0.5, -0.5]), 50.0, h, 5, low, high)
    np.testing.assert_array_equal(end, [*x, 0.0])


def test_a_division_by_zero_leaves_the_region() -> None:
    built = plant.load("plants:reciprocal")
    low, high = built.region(50.0)
    x = np.array([0.0, 1.0])
    np.testing.assert_array_equal(integrated(built.kernel, x, np.empty(0), 0.0, 0.1, 1, low, high), [*x, 0.0])
    assert built.nominal.terms_at(x[None])[0, 2] == np.inf  # alpha = 1 / x1
