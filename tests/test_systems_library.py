"""Every plant of the library: what [1] assumes, the closed forms, the bounds of its uncertainty, and its task."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
import pytest
import sympy as sp
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from mfc_gym.flat_system import INPUT_LIMIT, FlatSystem, is_zero, lie
from mfc_gym.references import REFERENCES
from mfc_gym.systems.chua import chua
from mfc_gym.systems.cstr import cstr
from mfc_gym.systems.duffing import duffing
from mfc_gym.systems.electric_flexible_joint import electric_flexible_joint
from mfc_gym.systems.flexible_joint import flexible_joint
from mfc_gym.systems.genesio_tesi import genesio_tesi
from mfc_gym.systems.magnetic_levitation import magnetic_levitation
from mfc_gym.systems.motor_pendulum import motor_pendulum
from mfc_gym.systems.perturbed_chain import perturbed_chain
from mfc_gym.systems.rossler import rossler
from mfc_gym.systems.two_mass_spring import two_mass_spring
from mfc_gym.systems.van_der_pol import van_der_pol

SAMPLES = 10_000
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Case:
    """Closed forms of a plant, in its own letters; `det` of d tau / dx, `det_n` of d tau_n / dx divided by `det`."""

    make: Callable[[], FlatSystem]
    beta: str
    det: str
    Delta_3: str
    det_n: str
    pole: float  # -pole: where the error is driven in the test of feasibility, 1/s


def chain(order: int) -> Case:
    factors = [f"(1 + alpha{i})" for i in range(1, order)]
    det_n = "*".join(f"{p}**{order - i}" for i, p in enumerate(factors, start=1))
    return Case(partial(perturbed_chain, order), "1", "1", "*".join(factors) + " - 1", det_n, 1.0)


R_2 = "Da*(1 - x1)*exp(x2/(1 + x2/ga))/(1 + x2/ga)**2"
CASES = {
    **{f"perturbed_chain_{n}": chain(n) for n in (2, 3, 4, 5)},
    "flexible_joint": Case(flexible_joint, "b*d", "b**2", "eps_k", "(1 + eps_k)**2", 3.0),
    "motor_pendulum": Case(motor_pendulum, "1/(L*M)", "1/M", "eps_J", "1 + eps_J", 5.0),
    "electric_flexible_joint": Case(
        electric_flexible_joint,
        "b*d/L",
        "b**3*d",
        "(1 + eps_k)*(1 + eps_d) - 1",
        "(1 + eps_k)**3*(1 + eps_d)",
        3.0,
    ),
    "two_mass_spring": Case(two_mass_spring, "k0/(m1*m2)", "-k0**2/m2**2", "eps_k", "(1 + eps_k)**2", 1.5),
    "genesio_tesi": Case(genesio_tesi, "1", "1", "(1 + eps_1)*(1 + eps_2) - 1", "(1 + eps_1)**2*(1 + eps_2)", 2.0),
    "rossler": Case(rossler, "-1", "1", "eps_k", "1 + eps_k", 2.0),
    "chua": Case(chua, "A", "A**2", "eps_A", "(1 + eps_A)**2", 3.0),
    "van_der_pol": Case(van_der_pol, "1", "1", "eps_1", "1 + eps_1", 2.0),
    "duffing": Case(duffing, "1", "1", "eps_1", "1 + eps_1", 2.0),
    "magnetic_levitation": Case(
        magnetic_levitation,
        "-L0*a*x3/(m*(a + x1)**2*(L1 + L0*a/(a + x1)))",
        "-L0*a*x3/(m*(a + x1)**2)",
        "eps_F",
        "1 + eps_F",
        15.0,
    ),
    "cstr": Case(cstr, f"be*{R_2}", R_2, "eps_r", "1 + eps_r", 2.0),
}
LOCAL = {"magnetic_levitation", "cstr"}

every_plant = pytest.mark.parametrize("name", CASES)


@cache
def build(name: str) -> FlatSystem:
    return CASES[name].make()


def closed_form(text: str, system: FlatSystem) -> sp.Expr:
    """The expression with the values of the known parameters, read as exact decimals."""
    values = {k: sp.nsimplify(v, rational=True) for k, v in system.parameters.items()}
    symbols = {s.name: s for s in (*system.x, *system.theta_symbols)}
    return sp.sympify(text, locals={**values, **symbols})


def limits(system: FlatSystem) -> Array:
    """The operating region, shape (n, 2)."""
    ends = [[sp.sympify(e).subs(INPUT_LIMIT, system.task.input_limit) for e in system.region[x]] for x in system.state]
    return np.array(ends, dtype=float)


def samples(system: FlatSystem) -> tuple[Array, Array]:
    """(x, theta), shapes (n, SAMPLES) and (p, SAMPLES); half of the theta are corners of the box.

    The box of the perturbed chain is larger than the set for which its bounds are declared, abs(p - 1) <= rho.
    """
    rng = np.random.default_rng(0)
    low, high = limits(system).T[..., None]
    x = rng.uniform(low, high, (system.order, SAMPLES))
    low, high = np.array(list(system.theta.values()), dtype=float).T[..., None]
    theta = rng.uniform(low, high, (len(system.theta), SAMPLES))
    corner = np.where(rng.integers(0, 2, theta.shape), high, low)
    theta[:, ::2] = corner[:, ::2]
    if system.name == "perturbed chain":
        keep = np.abs(np.prod(1 + theta, axis=0) - 1) <= 0.25
        x, theta = x[:, keep], theta[:, keep]
    return x, theta


def evaluate(system: FlatSystem, expressions: sp.Expr | list[sp.Expr], x: Array, theta: Array) -> Array:
    """Values at points on the last axis, shape (..., points)."""
    value = sp.lambdify((*system.x, *system.theta_symbols), expressions, cse=True)(*x, *theta)
    if isinstance(expressions, list):
        return np.stack([np.broadcast_to(v, x.shape[1:]) for v in value])
    return np.broadcast_to(value, x.shape[1:])


def scenario(system: FlatSystem) -> tuple[Array, Array]:
    """(theta, x(0)) of the fixed scenario; every plant of the library names them."""
    theta, x0 = system.task.theta, system.task.initial_state
    assert theta is not None
    assert x0 is not None
    return np.array(theta), np.array(x0)


def bounds(system: FlatSystem) -> dict[str, sp.Expr]:
    """The declared bounds and what takes their place if left out."""
    delta_1, delta_3 = system.bounds["delta_1"], system.bounds["delta_3"]
    defaults = {"delta_m": delta_1, "sharp_1": delta_1 / (1 - delta_3), "sharp_3": delta_3 / (1 - delta_3)}
    return defaults | dict(system.bounds)


# -- the assumptions of [1] and the closed forms ----------------------------------------------------------------------


@every_plant
def test_relative_degree(name: str) -> None:
    system = build(name)
    for series in (system.lie_f, system.lie_f_Delta):
        terms = [lie(system.g, phi, system.x) for phi in series[:-1]]
        assert all(is_zero(term) for term in terms[:-1])
        assert not is_zero(terms[-1])


@every_plant
def test_input_gain(name: str) -> None:
    system, case = build(name), CASES[name]
    assert is_zero(system.beta - closed_form(case.beta, system))
    assert is_zero(system.Delta_3 - closed_form(case.Delta_3, system))


@every_plant
def test_jacobians(name: str) -> None:
    system, case = build(name), CASES[name]
    det, det_n = (sp.Matrix(t).jacobian(system.x).det(method="berkowitz") for t in (system.tau, system.tau_n))
    expected = closed_form(case.det, system)
    assert is_zero(det - expected)
    assert is_zero(det_n - expected * closed_form(case.det_n, system))
    assert (not expected.free_symbols) == (name not in LOCAL)


@every_plant
def test_regular_over_the_region(name: str) -> None:
    """beta and both determinants keep one sign; with a constant det tau this is a global statement."""
    system, case = build(name), CASES[name]
    x, theta = samples(system)
    for text in (case.beta, case.det, f"({case.det})*({case.det_n})", f"1 + {case.Delta_3}"):
        values = evaluate(system, closed_form(text, system), x, theta)
        assert np.all(values > 0) or np.all(values < 0)


@every_plant
def test_no_unmatched_uncertainty_at_theta_zero(name: str) -> None:
    system = build(name)
    zero = dict.fromkeys(system.theta_symbols, 0)
    assert all(is_zero(phi.subs(zero)) for phi in system.phi_u)
    assert all(low <= 0 <= high for low, high in system.theta.values())


# -- bounds -----------------------------------------------------------------------------------------------------------


@every_plant
def test_bounds_hold_and_are_not_wasteful(name: str) -> None:
    """Tolerance: rounding of sums of terms of either sign, 1e-12 of the bound and 1e-12 of the largest bound."""
    system = build(name)
    x, theta = samples(system)
    Delta_3 = evaluate(system, system.Delta_3, x, theta)
    Delta_1 = evaluate(system, system.Delta_1, x, theta)
    true = {
        "delta_1": Delta_1,
        "delta_3": Delta_3,
        "delta_m": evaluate(system, system.phi_m, x, theta),
        "sharp_1": Delta_1 / (1 + Delta_3),
        "sharp_3": Delta_3 / (1 + Delta_3),
    }
    declared = {key: evaluate(system, value, x, theta) for key, value in bounds(system).items()}
    assert np.all(declared["delta_3"] < 1)
    assert np.all(Delta_3 > -1)
    for key, value in true.items():
        bound = declared[key]
        assert np.all(np.abs(value) <= bound * (1 + 1e-12) + 1e-12 * bound.max()), key
        assert np.max(np.abs(value[bound > 0]) / bound[bound > 0]) > 0.7, key


@every_plant
def test_sharp_bounds_are_sharper(name: str) -> None:
    """sharp_3 everywhere; sharp_1, which groups the terms otherwise, in the mean over the region."""
    system = build(name)
    x, theta = samples(system)
    delta_1, delta_3 = (evaluate(system, system.bounds[key], x, theta) for key in ("delta_1", "delta_3"))
    value = {key: evaluate(system, bound, x, theta) for key, bound in bounds(system).items()}
    assert np.all(value["sharp_3"] <= delta_3 / (1 - delta_3) * (1 + 1e-12))
    assert np.mean(value["sharp_1"]) <= np.mean(delta_1 / (1 - delta_3)) * (1 + 1e-12)


# -- Theorem 1 of [1] -------------------------------------------------------------------------------------------------


@every_plant
def test_theorem_1(name: str) -> None:
    """phi_u = 0 if and only if Delta_u = 0; then tau_n = tau, Delta_1 = phi_m and Delta_2 = 0."""
    system = build(name)
    assert not all(is_zero(e) for e in system.phi_u)
    assert not all(is_zero(e) for e in system.decomposition[1])

    psi = sum((k + 1) * sp.sin(x) for k, x in enumerate(system.x))
    matched = replace(system, Delta=tuple(v * psi for v in system.g), theta={})
    assert all(is_zero(e) for e in matched.phi_u)
    assert all(is_zero(e) for e in matched.decomposition[1])
    assert all(is_zero(a - b) for a, b in zip(matched.tau_n, matched.tau, strict=True))
    assert is_zero(matched.Delta_1 - matched.phi_m)
    assert is_zero(matched.Delta_1 - matched.beta * psi)
    assert is_zero(matched.Delta_2)


def test_an_uncertainty_orthogonal_to_g_reaches_phi_m() -> None:
    """Of the converse of Theorem 1: Delta_m = 0 does not make phi_m vanish."""
    joint = build("flexible_joint")
    x1, eps = joint.x[0], sp.Symbol("eps", real=True)
    unmatched = replace(joint, Delta=(0, -eps * sp.sin(x1), 0, 0), theta={"eps": (-1, 1)})
    assert all(is_zero(e) for e in unmatched.decomposition[0])
    assert is_zero(unmatched.phi_m - eps * closed_form("(a*cos(x1) + b)*sin(x1)", joint))
    assert not is_zero(unmatched.phi_m)


# -- the derivatives of the output, against an integration of the plant -----------------------------------------------


@every_plant
def test_output_derivatives_along_a_trajectory(name: str) -> None:
    """(d/dt) y^(k) = y^(k+1) for k < n - 1, and y^(n) = L_f^n h + Delta_1 + beta (1 + Delta_3) u.

    Central difference of order 4 with step h: error h^4 y^(k+5) / 30, here below 1e-7 of the largest derivative, and
    the error of the integration, rtol / h = 1e-9 of the value.
    """
    system = build(name)
    theta, x0 = scenario(system)
    u, h = 0.1 * system.task.input_limit, 1e-3 / CASES[name].pole
    field = [f + g * u + D for f, g, D in zip(system.f, system.g, system.Delta, strict=True)]
    rhs = sp.lambdify((*system.x, *system.theta_symbols), field)
    t = h * np.arange(5)
    result = solve_ivp(lambda _, x: rhs(*x, *theta), (0, t[-1]), x0, method="DOP853", t_eval=t, rtol=1e-13, atol=1e-13)
    columns = np.broadcast_to(theta[:, None], (len(theta), len(t)))
    xi_n = evaluate(system, list(system.tau_n), result.y, columns)
    y_n = system.alpha + system.Delta_1 + system.beta * (1 + system.Delta_3) * u
    slope = xi_n @ np.array([1, -8, 0, 8, -1]) / (12 * h)
    expected = [*xi_n[1:, 2], evaluate(system, y_n, result.y, columns)[2]]
    np.testing.assert_allclose(slope, expected, rtol=1e-6, atol=1e-6 * np.max(np.abs(xi_n)))


# -- task -------------------------------------------------------------------------------------------------------------


@every_plant
def test_task(name: str) -> None:
    system = build(name)
    task, region = system.task, limits(system)
    theta, x0 = scenario(system)
    assert np.any(theta)
    assert all(low <= value <= high for value, (low, high) in zip(theta, system.theta.values(), strict=True))
    for (low, high), value, state in zip(region, x0, system.state, strict=True):
        start = task.initial_set.get(state, (value, value))
        assert low < start[0] <= value <= start[1] < high
    assert task.input_limit > 0
    assert task.horizon / task.dt == pytest.approx(round(task.horizon / task.dt), abs=1e-9)
    assert task.reference in REFERENCES


@pytest.mark.parametrize("name", [name for name in CASES if "chain" not in name])
def test_task_is_feasible(name: str) -> None:
    """Exact linearisation, knowing theta, follows the reference from every corner of the two boxes.

    It stays in the region, needs at most half of the input in the second half of the horizon (the rest is the margin of
    the switching gain; 2/3 for the magnet, which has to hold the ball) and never all of it on the way there.
    """
    system, task, n = build(name), build(name).task, build(name).order
    box = [task.initial_set[state] for state in system.state]
    corners = np.array(np.meshgrid(*system.theta.values(), *box)).reshape(len(system.theta) + n, -1)
    theta, x = np.split(corners, [len(system.theta)])
    A, w, offset = task.reference_scale, task.reference_rate, task.reference_offset
    gains = np.poly(n * [-CASES[name].pole])[:0:-1]

    u = sp.Symbol("u", real=True)
    rows = [*system.tau_n, system.lie_f_Delta[-1], system.beta + system.Delta_2]
    linear = sp.lambdify((*system.x, *system.theta_symbols), rows, cse=True)
    field = [f + g * u + D for f, g, D in zip(system.f, system.g, system.Delta, strict=True)]
    rhs = sp.lambdify((*system.x, *system.theta_symbols, u), field, cse=True)

    def control(t: float, x: Array) -> Array:
        *xi_n, drift, gain = linear(*x, *theta)
        yd = [(k == 0) * offset + A * w**k * np.sin(w * t + k * np.pi / 2) for k in range(n + 1)]
        v = yd[n] - sum(k * (xi - y) for k, xi, y in zip(gains, xi_n, yd[:n], strict=True))
        return np.asarray((v - drift) / gain)

    def slope(t: float, x: Array) -> Array:
        return np.stack([np.broadcast_to(v, x.shape[1:]) for v in rhs(*x, *theta, control(t, x))])

    h, low, high = min(0.1 / CASES[name].pole, 0.02), *limits(system).T[..., None]
    share = 2 / 3 if name == "magnetic_levitation" else 1 / 2
    for k in range(round(task.horizon / h)):
        k1 = slope(k * h, x)
        k2 = slope((k + 0.5) * h, x + h / 2 * k1)
        k3 = slope((k + 0.5) * h, x + h / 2 * k2)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope((k + 1) * h, x + h * k3))
        assert np.all((low < x) & (x < high))
        limit = task.input_limit * (share if (k + 1) * h > task.horizon / 2 else 1)
        assert np.max(np.abs(control((k + 1) * h, x))) < limit
