"""Theorem 1 of the paper, the dynamics in both coordinates, the special cases, and what the constructor refuses."""

from functools import cache
from typing import Any

import numpy as np
import pytest
import sympy as sp

from mfc_gym.flat_system import INPUT_LIMIT, FlatSystem, is_zero, lie
from mfc_gym.systems.perturbed_chain import perturbed_chain

u = sp.Symbol("u", real=True)
RANDOM = [(2, seed) for seed in range(3)] + [(3, seed) for seed in range(3)]


def monomial(rng: np.random.Generator, variables: list[sp.Symbol]) -> sp.Expr:
    """Of degree 1 or 2, with a coefficient +-1, +-2, +-3."""
    return int(rng.choice([-3, -2, -1, 1, 2, 3])) * sp.prod(rng.choice(variables, rng.integers(1, 3)))


@cache
def strict_feedback(n: int, seed: int, kind: str) -> FlatSystem:
    """z_i' = a_i(z_1..z_i) + z_(i+1) (+ Delta_i), z_n' = a_n(z) + b(z) u in coordinates x = M z, det M = 1, y = z_1.

    `kind` of Delta: matched (g times a scalar), unmatched (row i depends on z_1..z_(i+1), nothing along g), mixed (both).
    """
    rng = np.random.default_rng(100 * n + seed)
    x = list(sp.symbols(f"x1:{n + 1}", real=True))
    lower = sp.Matrix(n, n, lambda i, j: 1 if i == j else int(rng.integers(-1, 2)) if i > j else 0)
    upper = sp.Matrix(n, n, lambda i, j: 1 if i == j else int(rng.integers(-1, 2)) if i < j else 0)
    M = lower * upper
    z = list(M.inv() * sp.Matrix(x))  # integers: det M = 1
    names = dict(zip(x, z, strict=True))
    f = sp.Matrix([monomial(rng, x[: i + 1]) + (x[i + 1] if i < n - 1 else 0) for i in range(n)])
    g = sp.Matrix([0] * (n - 1) + [1 + x[int(rng.integers(n))] ** 2])
    scalar = monomial(rng, x)
    rows = [monomial(rng, x[: i + 1]) + sp.Rational(int(rng.integers(1, 3)), 4) * x[i + 1] for i in range(n - 1)]
    Delta = sp.Matrix([*rows, 0]) if kind != "matched" else sp.zeros(n, 1)
    if kind != "unmatched":
        Delta += g * scalar

    def pulled(vector: sp.Matrix) -> tuple[sp.Expr, ...]:
        return tuple(sp.expand(e) for e in M * vector.subs(names, simultaneous=True))

    return FlatSystem("random", tuple(map(str, x)), pulled(f), pulled(g), sp.expand(z[0]), pulled(Delta))


@cache
def flexible_joint() -> FlatSystem:
    """The arm of the library with the load alone uncertain: Delta = (0, -eps sin x1, 0, 0)."""
    x1, x2, x3, x4, a, b, c, d, e, eps = sp.symbols("x1 x2 x3 x4 a b c d e eps", real=True)
    return FlatSystem(
        name="flexible joint",
        state=("x1", "x2", "x3", "x4"),
        f=(x2, -a * sp.sin(x1) - b * (x1 - x3), x4, c * (x1 - x3) - e * x4),
        g=(0, 0, 0, d),
        h=x1,
        Delta=(0, -eps * sp.sin(x1), 0, 0),
        parameters={"a": 3.33, "b": 19.5, "c": 48.6, "d": 21.6, "e": 1.25},
        theta={"eps": (-1, 1)},
    )


SYSTEMS = [
    *(pytest.param(lambda c=c, k=k: strict_feedback(*c, k), id=f"n{c[0]}-{c[1]}-{k}")
      for c in RANDOM for k in ("matched", "unmatched", "mixed")),
    pytest.param(flexible_joint, id="flexible-joint"),
    *(pytest.param(lambda n=n: perturbed_chain(n), id=f"chain-{n}") for n in (2, 3, 4)),
]  # fmt: skip


@cache
def parts(system: FlatSystem) -> tuple[tuple[sp.Expr, ...], tuple[sp.Expr, ...]]:
    return system.decomposition


def rate(system: FlatSystem, phi: sp.Expr) -> sp.Expr:
    """d phi / dt along x' = f + g u + Delta."""
    field = [a + b * u + c for a, b, c in zip(system.f, system.g, system.Delta, strict=True)]
    return lie(field, phi, system.x)


# -- Theorem 1 --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("n", "seed"), RANDOM)
@pytest.mark.parametrize("kind", ["matched", "unmatched", "mixed"])
def test_theorem_1(n: int, seed: int, kind: str) -> None:
    """phi_u == 0 if and only if Delta_u == 0."""
    system = strict_feedback(n, seed, kind)
    vanishes = kind == "matched"
    assert all(map(is_zero, system.phi_u)) == vanishes
    assert all(map(is_zero, parts(system)[1])) == vanishes


@pytest.mark.parametrize(("n", "seed"), RANDOM)
def test_theorem_1_for_every_uncertainty(n: int, seed: int) -> None:
    """Its proof: phi_u = (Lambda Delta_u, 0), and the rows of Lambda together with g span the space at every point."""
    system = strict_feedback(n, seed, "mixed")
    Lambda = sp.Matrix(system.tau[:-1]).jacobian(system.x)
    product = Lambda * sp.Matrix(parts(system)[1])
    assert all(is_zero(a - b) for a, b in zip(product, system.phi_u[:-1], strict=True))
    assert system.phi_u[-1] == 0
    point = dict(zip(system.x, (sp.Rational(k + 1, 7) for k in range(n)), strict=True))
    assert Lambda.col_join(sp.Matrix([system.g])).subs(point).det() != 0


@pytest.mark.parametrize(
    "system", [strict_feedback(2, 0, "mixed"), flexible_joint(), perturbed_chain(4)], ids=lambda s: s.name
)
def test_decomposition(system: FlatSystem) -> None:
    """Delta = Delta_m + Delta_u, Delta_m along g, Delta_u orthogonal to g: eq. (10)."""
    Delta_m, Delta_u = (sp.Matrix(part) for part in parts(system))
    g = sp.Matrix(system.g)
    assert all(map(is_zero, Delta_m + Delta_u - sp.Matrix(system.Delta)))
    assert is_zero(g.dot(Delta_u))
    assert sp.Matrix.hstack(g, Delta_m).subs(dict.fromkeys(system.x, sp.Rational(1, 3))).rank() == 1 or not any(Delta_m)


def test_unmatched_uncertainty_also_enters_phi_m() -> None:
    """Delta orthogonal to g, and yet phi_m = eps (a cos x1 + b) sin x1: only the converse direction holds."""
    system = flexible_joint()
    x1, eps = system.x[0], system.theta_symbols[0]
    assert not any(parts(system)[0])
    assert not all(map(is_zero, system.phi_u))
    a, b = sp.Rational("3.33"), sp.Rational("19.5")
    assert is_zero(system.phi_m - eps * (a * sp.cos(x1) + b) * sp.sin(x1))


# -- dynamics ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("system", SYSTEMS)
def test_dynamics_of_xi(system: Any) -> None:
    """xi' = A xi + B (L_f^n h + L_g L_f^(n-1) h u + phi_m) + phi_u: eq. (7)."""
    system = system()
    ahead = [*system.tau[1:], system.alpha + system.beta * u + system.phi_m]
    for phi, right, phi_u in zip(system.tau, ahead, system.phi_u, strict=True):
        assert is_zero(rate(system, phi) - right - phi_u)


@pytest.mark.parametrize("system", SYSTEMS)
def test_dynamics_of_xi_n(system: Any) -> None:
    """xi_n' = A xi_n + B (L_f^n h + L_g L_f^(n-1) h u + Delta_1 + Delta_2 u): all uncertainty is matched."""
    system = system()
    ahead = [*system.tau_n[1:], system.alpha + system.beta * u + system.Delta_1 + system.Delta_2 * u]
    for phi, right in zip(system.tau_n, ahead, strict=True):
        assert is_zero(rate(system, phi) - right)
    assert is_zero(system.lie_f_Delta[-1] - system.alpha - system.Delta_1)
    assert is_zero(system.Delta_3 * system.beta - system.Delta_2)


@pytest.mark.parametrize(("n", "seed"), RANDOM)
def test_matched_uncertainty(n: int, seed: int) -> None:
    """Delta = Delta_m: tau_n == tau, Delta_1 = phi_m, Delta_2 = Delta_3 = 0."""
    system = strict_feedback(n, seed, "matched")
    assert all(is_zero(a - b) for a, b in zip(system.tau_n, system.tau, strict=True))
    assert is_zero(system.Delta_1 - system.phi_m)
    assert is_zero(system.Delta_2)
    assert system.Delta_3 == 0


@pytest.mark.parametrize("n", range(2, 7))
def test_closed_forms_of_the_chain(n: int) -> None:
    """Section 6: y^(k) = p_k x_(k+1), Delta_1 = p_(n-1) phi_m, Delta_2 = Delta_3 = p_(n-1) - 1, phi_m = abs(x)^2."""
    system = perturbed_chain(n)
    x, alpha = system.x, system.theta_symbols
    p = [sp.prod(1 + a for a in alpha[:k]) for k in range(n)]
    norm2 = sum(s**2 for s in x)
    assert (system.tau, system.alpha, system.beta) == (x, 0, 1)
    assert all(is_zero(a - b * c) for a, b, c in zip(system.tau_n, p, x, strict=True))
    assert is_zero(system.phi_m - norm2)
    assert all(is_zero(a - b * c) for a, b, c in zip(system.phi_u, [*alpha, 0], [*x[1:], 0], strict=True))
    assert is_zero(system.Delta_1 - p[-1] * norm2)
    assert is_zero(system.Delta_2 - p[-1] + 1)
    assert is_zero(system.Delta_3 - p[-1] + 1)


# -- what goes in -----------------------------------------------------------------------------------------------------

s1, s2, c, k = sp.symbols("x1 x2 c k")
GOOD: dict[str, Any] = {
    "name": "test plant",
    "state": ("x1", "x2"),
    "f": (s2, -k * s1),
    "g": (0, 1),
    "h": s1,
    "Delta": (c * s2, 0),
    "parameters": {"k": 0.1},
    "theta": {"c": (-0.5, 0.5)},
}


def test_symbols_become_real_and_parameters_exact() -> None:
    system = FlatSystem(**GOOD)
    x1, x2 = system.x
    assert all(s.is_real for s in (*system.x, *system.theta_symbols))
    assert system.f == (x2, -x1 / 10)  # the decimal 0.1, not the double next to it
    assert {name: tuple(map(float, ends)) for name, ends in system.region.items()} == {"x1": (-10, 10), "x2": (-10, 10)}


def test_input_limit_may_bound_the_region() -> None:
    system = FlatSystem(**GOOD, region={"x2": (-INPUT_LIMIT, sp.sqrt(INPUT_LIMIT))})
    assert system.region["x2"] == (-INPUT_LIMIT, sp.sqrt(INPUT_LIMIT))


REFUSED = {
    "one-state": ({"state": ("x1",)}, r"`state` must have at least 2 entries, got \('x1',\)"),
    "state-twice": ({"state": ("x1", "x1")}, r"distinct names, got \['x1', 'x1', 'k', 'c'\]"),
    "state-and-theta": ({"theta": {"x1": (0, 1)}}, r"distinct names, got \['x1', 'x2', 'k', 'x1'\]"),
    "parameter-and-theta": ({"parameters": {"c": 1.0}}, "`state`, `parameters` and `theta` must have distinct names"),
    "f-short": ({"f": (s2,)}, "`f` must have 2 entries, one per state, got 1"),
    "g-long": ({"g": (0, 1, 0)}, "`g` must have 2 entries, one per state, got 3"),
    "Delta-empty": ({"Delta": ()}, "`Delta` must have 2 entries, one per state, got 0"),
    "f-unknown": ({"f": (s2, sp.Symbol("q"))}, r"`f` must be an expression in \['x1', 'x2'\], it contains q"),
    "g-unknown": ({"g": (0, sp.Symbol("q"))}, "`g` must be an expression in .*, it contains q"),
    "h-unknown": ({"h": s1 + sp.Symbol("q")}, "`h` must be an expression in .*, it contains q"),
    "theta-in-f": ({"f": (s2, c * s1)}, r"`f` must be an expression in \['x1', 'x2'\], it contains c"),
    "Delta-unknown": ({"Delta": (0, sp.Symbol("q"))}, r"`Delta` .* in \['c', 'x1', 'x2'\], it contains q"),
    "theta-in-bound": ({"bounds": {"delta_1": c}}, "`bounds` must be an expression in .*, it contains c"),
    "bound-unknown": ({"bounds": {"delta_2": 1}}, r"`bounds` may have the entries .*, got \['delta_2'\]"),
    "region-of-x": ({"region": {"x1": (0, s2)}}, r"`region` .* in \['input_limit'\], it contains x2"),
    "region-unknown": ({"region": {"q": (0, 1)}}, r"`region` may have the entries \('x1', 'x2'\), got \['q'\]"),
    "region-reversed": ({"region": {"x1": (1, -1)}}, r"`region` must map .* \(low, high\), got x1: \(1, -1\)"),
    "region-infinite": ({"region": {"x1": (0, sp.oo)}}, "`region` must hold finite real .* numbers, got oo"),
    "theta-reversed": ({"theta": {"c": (1, -1)}}, r"`theta` must map names to intervals .*, got c: \(1, -1\)"),
    "theta-infinite": ({"theta": {"c": (0, float("inf"))}}, r"`theta` must map .*, got c: \(0, inf\)"),
    "theta-single": ({"theta": {"c": (0.5,)}}, r"`theta` must map .*, got c: \(0.5,\)"),
    "parameter-nan": ({"parameters": {"k": float("nan")}}, "`parameters` must be finite numbers, got k = nan"),
    "parameter-text": ({"parameters": {"k": "1"}}, "`parameters` must be finite numbers, got k = '1'"),
    "text": ({"f": ("x2", "exit()")}, "`f` must hold finite real SymPy expressions or numbers, got 'x2'"),
    "complex": ({"h": s1 + sp.I * s2}, r"`h` must hold finite real .*, got x1 \+ I\*x2"),
    "nan": ({"Delta": (0, float("nan"))}, "`Delta` must hold finite real .*, got nan"),
    "none": ({"h": None}, "`h` must hold finite real .*, got None"),
    "unknown-function": ({"h": sp.Function("F")(s1)}, r"`h` must hold finite real .*, got F\(x1\)"),
    "degree-too-low": ({"g": (1, 1)}, r"relative degree n = 2: L_g L_f\^0 h must be zero \(order k = 0\), got 1"),
    "degree-too-high": ({"g": (0, 0)}, r"L_g L_f\^1 h must be nonzero \(order k = 1\), got 0 in system 'test plant'"),
    "no-output": ({"h": sp.Integer(3)}, r"the nominal system .*: L_g L_f\^1 h must be nonzero"),
    "degree-lost": (
        {"state": ("x1", "x2", "x3"), "f": (s2, sp.Symbol("x3"), 0), "g": (0, 0, 1), "Delta": (sp.Symbol("x3"), 0, 0)},
        r"Delta must keep the relative degree = 3: L_g L_\(f\+Delta\)\^1 h must be zero \(order k = 1\), got 1",
    ),
    "gain-lost": (
        {"Delta": (-s2, 0)},
        r"Delta must keep .* = 2: L_g L_\(f\+Delta\)\^1 h must be nonzero \(order k = 1\), got 0",
    ),
}


@pytest.mark.parametrize(("changes", "message"), REFUSED.values(), ids=REFUSED)
def test_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FlatSystem(**GOOD | changes)


def test_singular_jacobian_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the relative degree right the rows of the Jacobian are independent: only a wrong check would get so far."""
    system = FlatSystem(**GOOD)
    singular = {"lie_f": (s1, s1, s1), "lie_f_Delta": (s1, s2, s1)}
    for name, label in (("lie_f", "`tau`"), ("lie_f_Delta", "`tau_n`")):
        with monkeypatch.context() as m:
            m.setitem(system.__dict__, name, tuple(e.subs({s1: system.x[0], s2: system.x[0]}) for e in singular[name]))
            with pytest.raises(
                ValueError, match=f"{label} must have a nonsingular Jacobian, .* in system 'test plant'"
            ):
                system._check_diffeomorphism()


def test_identity_test() -> None:
    x = sp.Symbol("x", real=True)
    assert is_zero(sp.Integer(0))
    assert is_zero(sp.sin(x) ** 2 + sp.cos(x) ** 2 - 1)
    assert is_zero((x**2 - 1) / (x - 1) - x - 1)
    assert is_zero(sp.sqrt(x**2) - sp.Abs(x))
    assert not is_zero(sp.Rational(1, 10**15) * x)
    assert not is_zero(sp.sqrt(x - 100))  # complex at every test point
    assert not is_zero(sp.Abs(x) - x)  # zero wherever x > 0
