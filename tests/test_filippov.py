"""The event-driven solution: published values, brute force, and what theory says about every solution."""

import importlib
from functools import cache
from math import pi, sin
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pytest
from numba import njit
from scipy.linalg import expm
from scipy.optimize import brentq

import baselines
from baselines import lyapunov
from baselines.controller import Controller
from baselines.filippov import ExactSolution
from baselines.lyapunov import Array
from baselines.redesign import LyapunovRedesign
from mfc_gym import ENV_IDS

EPS = float(np.finfo(float).eps)
RHO = 0.25
RTOL = 1e-13  # of the solver, per step; the published digits ask for more than its default

# The solver's global error: at most 0.02 s per step, so some 1000 steps over 20 s with an error of RTOL max(abs(q)) each,
# times the sensitivity of the trajectory, of order 1 to 10 for the closed loops below.
ERROR = 1e4 * RTOL


class Case(NamedTuple):
    """One closed loop of the perturbed chain that follows sin(t)."""

    theta: tuple[float, ...]
    initial_state: tuple[float, ...]
    initial_model_state: tuple[float, ...]
    design: str
    gain: str
    model_poles: tuple[complex, ...]
    poles: tuple[complex, ...]
    input_limit: float = 50.0
    horizon: float = 20.0

    @property
    def n(self) -> int:
        return len(self.initial_state)

    @property
    def name(self) -> str:
        return "matched-only" if self.gain == "matched" else "mfc"

    def env(self) -> Any:
        return gym.make(
            "mfc_gym/PerturbedChain-v0", order=self.n, theta=self.theta, initial_state=self.initial_state,
            input_limit=self.input_limit, horizon=self.horizon, reference="sine",
        )  # fmt: skip

    def controller(self, env: Any) -> Any:
        return baselines.make(
            self.name, env, design=self.design, gain=self.gain, model_poles=self.model_poles, poles=self.poles,
            initial_model_state=self.initial_model_state, switching="sign", margin=1.0,
        )  # fmt: skip


PAPER = Case((0.5, -0.5), (1.0, 0.0, 0.0), (0.5, 0.0, 0.0), "paper", "paper", (-1,) * 3, (-4,) * 3)
CASES = {
    "A": PAPER,
    "B": PAPER._replace(gain="theorem"),
    "C": PAPER._replace(gain="matched"),
    "D": PAPER._replace(design="surface"),
    "n = 2": Case(
        (-0.25,), (-1.0, 0.5), (0.0, 0.3), "paper", "paper", (-1, -1.5), (-2 + 1j, -2 - 1j), horizon=5.0
    ),
    "n = 4": Case(
        (0.3, -0.2, 0.1), (0.5, 0.2, -0.1, 0.3), (0.0, 0.5, 0.0, 0.0), "surface", "theorem", (-1, -1.5, -2, -2.5),
        (-3,) * 4, horizon=5.0,
    ),
    "saturated": PAPER._replace(design="surface", input_limit=8.0, horizon=5.0),
    "saturated, Q = I": PAPER._replace(input_limit=8.0, horizon=5.0),
    "saturated, matched": PAPER._replace(gain="matched", input_limit=8.0, horizon=5.0),
}  # fmt: skip
CONVERGENT = [name for name, case in CASES.items() if case.gain != "matched"]
UNSATURATED = [name for name in CONVERGENT if not name.startswith("saturated")]


@cache
def solve(name: str) -> tuple[Any, ExactSolution]:
    """(controller, exact solution)."""
    env = CASES[name].env()
    controller = CASES[name].controller(env)
    return controller, baselines.filippov(env, controller, rtol=RTOL, atol=RTOL / 100)


def parts(name: str, t: Array) -> dict[str, Array]:
    """The signals, and from them e, e_star, omega_star, v_tilde, s = w / 2 and V as [1] defines them."""
    controller, exact = solve(name)
    q = exact.signals(t)
    e = (q["xi"] if CASES[name].gain == "matched" else q["xi_n"]) - q["xi_star"]
    e_star = q["xi_star"] - q["reference"][..., :-1]
    return q | {
        "e": e,
        "e_star": e_star,
        "omega_star": q["reference"][..., -1] - e_star @ controller.k,
        "v_tilde": -e @ controller.k_tilde,
        "s": e @ lyapunov.surface(controller.P),
        "V": np.einsum("...i,ij,...j", e, controller.P, e),
    }


def pieces(name: str) -> list[tuple[int, float, float]]:
    """(mode, begin, end) of the stretches of constant mode, the end a rounding error before the next one."""
    _, exact = solve(name)
    edges = [0.0, *exact.switching_times, exact.end]
    return [
        (mode, a, float(np.nextafter(b, a)))
        for mode, a, b in zip(exact.modes, edges[:-1], edges[1:], strict=True)
    ]  # fmt: skip


# -- the example of [1], checked by independent solvers ----------------------------------------------------------------

SWITCHING = {
    "A": [0.0024776786, 0.9162985914, 1.3494199020, 2.3184698187, 5.9036744425, 6.6272971755],
    "B": [0.0025353060, 0.9077302750, 1.2653055371, 2.2402366015, 5.5732153375, 6.5541267936],
    "D": [0.3838028697],
}
MODES = {"A": (1, -1, 0, 1, 0, 1, 0), "B": (1, -1, 0, 1, 0, 1, 0), "D": (1, 0)}
ERRORS = {
    "A": {
        0.5: 0.4314919605, 1: -0.0930463324, 2: -0.4572379610, 5: -0.1553075186,
        10: -0.0089366078, 15: -0.0031156583, 20: -0.0017688052,
    },
    "B": {10: -0.0056993467, 20: -0.0006874170},
    "C": {5: -0.2672038249, 10: -0.2914836460, 15: 0.1297564427, 20: 0.3433098900},
    "D": {5: -0.1398123566, 10: -0.0036092944, 20: -6.379e-7},
}  # fmt: skip
METRICS = {  # value and its last digit
    "A": {
        "IAE": (2.0452315041, 1e-10), "ISE": (0.7942604718, 1e-10), "ITAE": (5.9071694461, 1e-10),
        "int u^2": (100.6591416, 1e-7), "int|u|": (36.8876220, 1e-7), "max|u|": (43.3333, 1e-4), "TV": (83.0092, 1e-4),
    },
    "B": {
        "IAE": (2.0094570524, 1e-10), "ISE": (0.7929102170, 1e-10), "ITAE": (5.5007727638, 1e-10),
        "int u^2": (101.96287, 1e-5), "max|u|": (42.3333, 1e-4), "TV": (81.6439, 1e-4),
    },
    "C": {
        "IAE": (5.4230064, 1e-7), "ISE": (1.9754230, 1e-7), "ITAE": (45.57337, 1e-5), "int u^2": (219.397, 1e-3),
        "max|u|": (31.5, 1e-12), "TV": (99.93, 1e-2),
    },
    "D": {
        "IAE": (1.9554775560, 1e-10), "ISE": (0.7798543210, 1e-10), "int u^2": (206.1238, 1e-4), "TV": (124.41, 1e-2),
    },
}  # fmt: skip


@pytest.mark.parametrize("name", ["A", "B", "D"])
def test_switching_times_of_the_example(name: str) -> None:
    """To one unit of the last published digit, 1e-10."""
    _, exact = solve(name)
    assert exact.modes == MODES[name]
    np.testing.assert_allclose(exact.switching_times, SWITCHING[name], rtol=0, atol=1e-10)


def test_modes_of_the_matched_design() -> None:
    """It crosses the surface twice, then slides in seven short intervals only; digits as published."""
    _, exact = solve("C")
    crossings, rest = exact.switching_times[:2], exact.switching_times[2:]
    assert exact.modes[:3] == (1, -1, 1)
    assert exact.modes[3::2] == (0,) * 7
    np.testing.assert_allclose(crossings, [0.0025780981, 0.9035971324], rtol=0, atol=1e-10)
    slides = [
        [2.1172, 2.3975], [2.8108, 2.9768], [5.6381, 5.7681], [9.1367, 9.1733], [11.9271, 12.0495], [15.4203, 15.4577],
        [18.2104, 18.3326],
    ]  # fmt: skip
    np.testing.assert_allclose(rest.reshape(7, 2), slides, rtol=0, atol=0.5e-4)


@pytest.mark.parametrize("name", ERRORS)
def test_tracking_error_of_the_example(name: str) -> None:
    """To one unit of the last published digit, 1e-10."""
    _, exact = solve(name)
    times, errors = np.array(list(ERRORS[name])), list(ERRORS[name].values())
    np.testing.assert_allclose(exact.signals(times)["error"], errors, rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("name", "Gamma", "u"), [("A", 77 / 6, -130 / 3), ("B", 71 / 6, -127 / 3), ("C", 1.0, -31.5)]
)  # fmt: skip
def test_first_instant_of_the_example(name: str, Gamma: float, u: float) -> None:
    """w = 1/128, omega_star = 3/2, v_tilde = -32, V = 337/256, in fractions; P has the error of the Lyapunov solver, 2e-11."""
    q = parts(name, np.array(0.0))
    assert q["w"] == pytest.approx(1 / 128, abs=2e-11)
    assert q["V"] == pytest.approx(337 / 256, abs=2e-11)
    assert q["omega_star"] == pytest.approx(1.5, rel=4 * EPS)
    assert q["v_tilde"] == pytest.approx(-32, rel=4 * EPS)
    assert q["Gamma"] == pytest.approx(Gamma, rel=10 * EPS)
    assert q["u"] == pytest.approx(u, rel=10 * EPS)


def metrics(name: str) -> dict[str, float]:
    """Integrals by Gauss and Legendre with 10 nodes on panels of 0.1 s, split at all kinks; variation on a grid of 1 ms.

    Kinks: changes of mode, and sign changes of error, u and the terms whose absolute value stands in Gamma. In between
    the integrands are analytic with rates below 50 1/s: the rule's error, 50^20 0.1^21 (10!)^4 / (21 (20!)^3) times
    their size, is below 1e-17. An extremum is missed by 1 ms / 2 at most, which costs abs(u'') (0.5e-3)^2 < 1e-5 each.
    """
    nodes, weights = np.polynomial.legendre.leggauss(10)
    signals = ("error", "u", "omega_star", "v_tilde", "nominal")

    def at(t: Any) -> dict[str, Array]:
        q = parts(name, np.asarray(t))
        return q | {"nominal": q["omega_star"] + q["v_tilde"]}

    def value(t: float, signal: str) -> float:
        return float(at(t)[signal])

    cuts = [0.0]
    total_variation, largest, before = 0.0, 0.0, None
    for _, a, b in pieces(name):
        grid = np.linspace(a, b, max(10, int((b - a) / 1e-3)))
        q = at(grid)
        for signal in signals:
            brackets = np.flatnonzero(q[signal][:-1] * q[signal][1:] < 0)
            cuts += [brentq(value, grid[i], grid[i + 1], args=(signal,), xtol=1e-14) for i in brackets]
        u = q["u"]
        total_variation += np.abs(np.diff(u)).sum() + (0.0 if before is None else abs(u[0] - before))
        largest, before = max(largest, np.abs(u).max()), u[-1]
        cuts += [*np.arange(a, b, 0.1), b]
    cuts = np.unique(cuts)
    a, b = cuts[:-1, None], cuts[1:, None]
    times, weight = (a + b) / 2 + (b - a) / 2 * nodes, (b - a) / 2 * weights
    q = at(times)
    e, u = np.abs(q["error"]), np.abs(q["u"])
    integrands = {"IAE": e, "ISE": e**2, "ITAE": times * e, "int u^2": u**2, "int|u|": u}
    integrals = {key: float((weight * values).sum()) for key, values in integrands.items()}
    return integrals | {"max|u|": float(largest), "TV": float(total_variation)}


@pytest.mark.parametrize("name", METRICS)
def test_metrics_of_the_example(name: str) -> None:
    """To one unit of the last published digit."""
    measured = metrics(name)
    for key, (value, digit) in METRICS[name].items():
        assert measured[key] == pytest.approx(value, rel=0, abs=digit), key


def test_lyapunov_function_of_the_example() -> None:
    """V(5) = 1.2e-3, V(15) = 4.3e-5 with Q = I, and V(5) = 4.9e-13 with the sliding poles at -4: to the digits published."""
    assert parts("A", np.array(5.0))["V"] == pytest.approx(1.2e-3, rel=0, abs=0.5e-4)
    assert parts("A", np.array(15.0))["V"] == pytest.approx(4.3e-5, rel=0, abs=0.5e-6)
    assert parts("D", np.array(5.0))["V"] == pytest.approx(4.9e-13, rel=0, abs=0.5e-14)


# -- brute force ---------------------------------------------------------------------------------------------------------


@njit
def euler(theta, k, k_tilde, c, gain, x, e_star, limit, dt, every, samples):  # type: ignore[no-untyped-def]
    """Explicit Euler of the closed loop with the plain sign, written from [1]: x at each of the samples, (samples + 1, n)."""
    n = x.size
    out = np.empty((samples + 1, n))
    x_dot, e_star_dot = np.empty(n), np.empty(n)
    for m in range(samples * every + 1):
        if m % every == 0:
            for i in range(n):
                out[m // every, i] = x[i]
        t = m * dt
        norm2, v_tilde, s, p, v = 0.0, 0.0, 0.0, 1.0, 0.0
        for i in range(n):
            e = (x[i] if gain == 2 else p * x[i]) - sin(t + i * pi / 2) - e_star[i]
            norm2 += x[i] ** 2
            v_tilde -= k_tilde[i] * e
            s += c[i] * e
            v -= k[i] * e_star[i]
            if i < n - 1:
                p *= 1 + theta[i]
                x_dot[i] = (1 + theta[i]) * x[i + 1]
                e_star_dot[i] = e_star[i + 1]
        omega_star = sin(t + n * pi / 2) + v
        if gain == 0:
            Gamma = ((1 + RHO) * norm2 + RHO * (abs(omega_star) + abs(v_tilde))) / (1 - RHO)
        elif gain == 1:
            Gamma = ((1 + RHO) * norm2 + RHO * abs(omega_star + v_tilde)) / (1 - RHO)
        else:
            Gamma = norm2
        v_L = -Gamma if s > 0 else Gamma if s < 0 else 0.0
        x_dot[n - 1] = min(max(omega_star + v_tilde + v_L, -limit), limit) + norm2
        e_star_dot[n - 1] = v
        for i in range(n):
            x[i] += dt * x_dot[i]
            e_star[i] += dt * e_star_dot[i]
    return out


@pytest.mark.parametrize(
    "name", ["A", "C", "D", "n = 2", "n = 4", "saturated", "saturated, Q = I", "saturated, matched"]
)
def test_brute_force_converges_to_the_solution(name: str) -> None:
    """Explicit Euler with the plain sign, 5 s: the output's error is O(dt), slope 1 from dt = 1e-3 to 1e-6.

    The phase of the chattering changes the constant from one dt to the next: by less than 2, the slope over three decades is
    off by log10(2) / 3 = 0.1. The state jumps by up to 2 Gamma dt in each step, Gamma < 25 here.
    """
    controller, exact = solve(name)
    case, gain = CASES[name], ("paper", "theorem", "matched").index(CASES[name].gain)
    q = exact.signals(np.linspace(0, 5, 51))
    steps, errors = (1e-3, 1e-6), []
    for dt in steps:
        e_star = np.array(case.initial_model_state) - q["reference"][0, :-1]
        x = euler(
            np.array(case.theta), controller.k, controller.k_tilde, lyapunov.surface(controller.P).copy(), gain,
            np.array(case.initial_state), e_star, case.input_limit, dt, round(0.1 / dt), 50,
        )  # fmt: skip
        errors.append(np.abs(x[:, 0] - q["xi"][:, 0]).max())
        assert np.abs(x - q["x"]).max() < 50 * dt
    assert abs(np.log10(errors[0] / errors[1]) / 3 - 1) < 0.1
    assert errors[1] < 3e-6  # with constants below 3 in units of dt, at this dt


# -- what holds along every solution ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", CASES)
def test_modes_tell_the_side_of_the_surface(name: str) -> None:
    """s > 0 in mode +1, s < 0 in mode -1; in sliding s is the solver's error, c' times ERROR at most."""
    controller, _ = solve(name)
    tolerance = ERROR * np.abs(lyapunov.surface(controller.P)).sum()
    for mode, a, b in pieces(name):
        s = parts(name, np.linspace(a, b, 400)[1:-1])["s"]
        if mode:
            assert (mode * s > -tolerance).all()
            assert mode * s[len(s) // 2] > tolerance
        else:
            assert (np.abs(s) < tolerance).all()


@pytest.mark.parametrize("name", CASES)
def test_input_belongs_to_the_set_valued_law(name: str) -> None:
    """u = sat(omega_star + v_tilde - Gamma mode) off the surface, any value between those of the two modes on it.

    Rounding: a few errors of the largest term. In sliding the condition may be off by the slack of its event, 1e-12 of the
    rates, which are below 1e3 times the input here.
    """
    limit = CASES[name].input_limit
    for mode, a, b in pieces(name):
        q = parts(name, np.linspace(a, b, 400))
        base, Gamma = q["omega_star"] + q["v_tilde"], q["Gamma"]
        low, high = np.clip(base - Gamma, -limit, limit), np.clip(base + Gamma, -limit, limit)
        rounding = 40 * EPS * (np.abs(q["v_tilde"]).max() + np.abs(q["omega_star"]).max() + Gamma.max())
        if mode:
            np.testing.assert_allclose(q["u"], low if mode > 0 else high, rtol=0, atol=rounding)
        else:
            assert (q["u"] >= low - 1e-9 * limit).all()
            assert (q["u"] <= high + 1e-9 * limit).all()


@pytest.mark.parametrize("name", ["saturated", "saturated, Q = I", "saturated, matched"])
def test_saturation_is_active_and_respected(name: str) -> None:
    u = np.concatenate([parts(name, np.linspace(a, b, 400))["u"] for _, a, b in pieces(name)])
    limit = CASES[name].input_limit
    assert np.abs(u).max() == limit
    assert (np.abs(u) == limit).mean() > 0.1


@pytest.mark.parametrize("name", CASES)
def test_state_is_continuous(name: str) -> None:
    """The state at both sides of a switching time, a rounding error apart in time: ERROR, mostly of the dense output."""
    _, exact = solve(name)
    for (_, _, before), after in zip(pieces(name)[:-1], exact.switching_times, strict=True):
        np.testing.assert_allclose(exact.state(before), exact.state(after), rtol=0, atol=ERROR)


@pytest.mark.parametrize("name", CASES)
def test_model_is_linear(name: str) -> None:
    """xi_star = xi_d + expm((A - B k') t) e_star(0), with the model started where it was told to."""
    controller, exact = solve(name)
    times = np.linspace(0, exact.end, 21)
    e_star = parts(name, times)["e_star"]
    np.testing.assert_allclose(exact(0.0)[1], CASES[name].initial_model_state, rtol=0, atol=2 * EPS)
    expected = [expm(lyapunov.closed_loop(controller.k) * t) @ e_star[0] for t in times]
    np.testing.assert_allclose(e_star, expected, rtol=0, atol=ERROR)


@pytest.mark.parametrize("name", UNSATURATED)
def test_lyapunov_function_decreases(name: str) -> None:
    """V(t + h) <= V(t) exp(-r h) with the decay rate r of V' <= -W, the smallest eigenvalue of Q relative to P.

    Where V is below the solver's error, norm(P) ERROR (2 abs(e) + ERROR), nothing is left to see.
    """
    controller, exact = solve(name)
    Q = lyapunov.dissipation(controller.P, controller.k_tilde)
    rate = np.linalg.eigvals(np.linalg.solve(controller.P, Q)).real.min()
    times = np.linspace(0, exact.end, 2001)
    q = parts(name, times)
    V, h = q["V"], times[1]
    size = np.linalg.norm(controller.P) * ERROR * (2 * np.linalg.norm(q["e"], axis=1) + ERROR)
    assert rate > 0.1
    assert (V[1:] <= V[:-1] * np.exp(-rate * h) + size[:-1]).all()


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_lyapunov_function_decreases_on_every_plant(env_id: str) -> None:
    """The theorem of [1] with each plant's own bounds, wherever the input is not saturated, as above for the chain."""
    env = gym.make(env_id, horizon=2.0, substeps=1)
    controller: Any = baselines.make(
        "mfc", env, gain="theorem", margin=1.0, switching="sign", initial_model_state="reference"
    )
    exact = baselines.filippov(env, controller)
    Q = lyapunov.dissipation(controller.P, controller.k_tilde)
    rate = np.linalg.eigvals(np.linalg.solve(controller.P, Q)).real.min()
    times = np.linspace(0, exact.end, 2001)
    q = exact.signals(times)
    e = q["xi_n"] - q["xi_star"]
    V, h = np.einsum("ti,ij,tj->t", e, controller.P, e), times[1]
    # the solver's default tolerance, 1e-12 of the largest of the numbers that e is made of
    error = 1e4 * 1e-12 * max(np.abs(q["x"]).max(), np.abs(q["xi_n"]).max())
    size = np.linalg.norm(controller.P) * error * (2 * np.linalg.norm(e, axis=1) + error)
    free = np.abs(q["u"]) < controller.nominal.input_limit * (1 - 1e-9)
    free = free[1:] & free[:-1]
    assert not exact.terminated
    assert free.mean() > 0.5
    assert rate > 0
    assert (V[1:] <= V[:-1] * np.exp(-rate * h) + size[:-1])[free].all()


@pytest.mark.parametrize("name", CONVERGENT)
def test_sliding_motion_in_closed_form(name: str) -> None:
    """c_n e^(n-1) + ... + c_1 e = 0: e is the exponential of a companion matrix, and with it the whole state of the chain,

    x_(i+1) = (y_d + e_star + e)^(i) / prod_(j <= i) (1 + theta_j).
    """
    controller, exact = solve(name)
    c, n = lyapunov.surface(controller.P), CASES[name].n
    motion = np.eye(n - 1, k=1)
    motion[-1] -= c[:-1] / c[-1]
    p = np.cumprod([1.0, *(1 + np.array(CASES[name].theta))])
    assert 0 in exact.modes
    for mode, a, b in pieces(name):
        if mode:
            continue
        times = np.linspace(a, b, 50)
        q = parts(name, times)
        e = np.array([expm(motion * (t - a)) @ q["e"][0, :-1] for t in times])
        e = np.column_stack([e, -e @ c[:-1] / c[-1]])
        tolerance = ERROR * np.abs(c).sum() / c[-1]
        np.testing.assert_allclose(q["e"], e, rtol=0, atol=tolerance)
        np.testing.assert_allclose(exact.state(times), (q["xi_star"] + e) / p, rtol=0, atol=tolerance)


def test_model_following_is_the_single_loop_on_a_shifted_reference() -> None:
    """The law at x with y_d + (expm((A - B k') t) e_star(0))_1 for reference and no model loop, off the surface; its two
    values enclose the equivalent control on it. Errors of e_star are amplified by abs(k) + abs(k_tilde) (1 + rho) / (1 - rho).
    """
    case = CASES["A"]
    env = case.env()
    controller, exact = solve("A")
    single = baselines.make(
        "single-loop", env, design=case.design, gain=case.gain, poles=case.poles, switching="sign", margin=1.0
    )
    e_star_0 = parts("A", np.array(0.0))["e_star"]
    tolerance = ERROR * (np.abs(controller.k).sum() + np.abs(controller.k_tilde).sum() * (1 + RHO) / (1 - RHO))
    for mode, a, b in pieces("A"):
        for t in np.linspace(a, b, 12)[1:-1]:
            q = exact.signals(t)
            e_star = expm(lyapunov.closed_loop(controller.k) * t) @ e_star_0
            shifted = q["reference"] + np.append(e_star, -controller.k @ e_star)
            values = []
            for side in (0.0, 1.0, -1.0):  # on either side of the surface, where s is told by a tiny last derivative
                nudged = q["xi_n"] + np.array([0.0, 0.0, side * 1e-8])
                action, _ = single.predict(np.concatenate([q["x"], nudged, shifted]))
                values.append(case.input_limit * action[0])
            if mode:
                assert q["u"] == pytest.approx(values[0], rel=0, abs=tolerance)
            else:
                assert values[1] - 1e-6 <= q["u"] <= values[2] + 1e-6  # the nudge times k_tilde, with room


def test_permanent_sliding_leaves_the_model_transient_alone() -> None:
    """Case D: y - y_d -> first entry of e_star = (0.5 - 0.5 t - 0.75 t^2) exp(-t), for poles -1 from (0.5, -1, 0)."""
    t = np.linspace(8, 20, 50)
    transient = (0.5 - 0.5 * t - 0.75 * t**2) * np.exp(-t)
    # e has decayed like (1 + 4 t) exp(-4 t) from below 0.5, since t = 0.384: at t = 8 it is below 1e-12
    np.testing.assert_allclose(parts("D", t)["error"], transient, rtol=0, atol=ERROR)


# -- the end of an episode, repetition, errors -----------------------------------------------------------------------------


def test_leaving_the_region_ends_the_solution() -> None:
    """From x_3 with x_3^2 + x_1^2 > input_limit the input cannot stop the escape: the end lies on x_3 = sqrt(input_limit)."""
    env = gym.make(
        "mfc_gym/PerturbedChain-v0", theta=(0.0, 0.0), initial_state=(1.0, 0.0, 1.5), input_limit=3.0, horizon=5.0
    )
    controller = PAPER.controller(env)
    exact = baselines.filippov(env, controller)
    assert exact.terminated
    assert 0 < exact.end < 5
    assert exact.state(exact.end)[2] == pytest.approx(np.sqrt(3), abs=1e-12)  # brentq's tolerance times the speed
    # x_3' = norm(x)^2 - 3 >= x_1^2 + x_3^2 - 3 > 1.5^2 + 1 - 3 = 0.25 at first and growing: gone within 1 s
    assert exact.end < (np.sqrt(3) - 1.5) / 0.25
    trajectory = baselines.rollout(env, controller)
    assert trajectory.terminated
    assert len(trajectory.control) == np.ceil(exact.end / 0.01)


def test_starting_on_the_edge_of_the_region_and_leaving_at_once() -> None:
    """x_3 = sqrt(input_limit) with x_3' = u + norm(x)^2 >= x_1^2 > 0."""
    env = gym.make(
        "mfc_gym/PerturbedChain-v0", theta=(0.0, 0.0), initial_state=(1.0, 0.0, 2.0), input_limit=4.0, horizon=5.0
    )
    exact = baselines.filippov(env, PAPER.controller(env))
    assert exact.terminated
    assert exact.end == 0
    np.testing.assert_array_equal(exact.state(0.0), [1, 0, 2])


def test_starting_on_the_surface() -> None:
    """With the model started at the process e = 0: sliding from the first instant, V = 0 forever, y - y_d the model's error."""
    env = CASES["B"].env()
    controller = baselines.make(
        "mfc",
        env,
        design="paper",
        gain="theorem",
        model_poles=(-1,) * 3,
        poles=(-4,) * 3,
        initial_model_state="process",
    )
    exact = baselines.filippov(env, controller)
    assert exact.modes == (0,)
    assert exact.switching_times.size == 0
    t = np.linspace(0, 20, 101)
    xi, xi_star, _ = exact(t)
    np.testing.assert_allclose(exact.output_derivatives(t), xi_star, rtol=0, atol=ERROR)
    np.testing.assert_allclose(xi[:, 0], xi_star[:, 0], rtol=0, atol=ERROR)


def test_solution_is_repeatable_and_belongs_to_the_seed() -> None:
    env = gym.make("mfc_gym/PerturbedChain-v0", scenario="random", horizon=2.0)
    controller = PAPER.controller(env)
    t = np.linspace(0, 2, 50)
    first, again, other = (baselines.filippov(env, controller, seed=seed).signals(t) for seed in (3, 3, 4))
    for signal, values in first.items():
        np.testing.assert_array_equal(values, again[signal])
    assert not np.array_equal(first["x"], other["x"])
    observation, _ = env.reset(seed=3)
    np.testing.assert_array_equal(first["x"][0], observation[:3])
    np.testing.assert_array_equal(first["xi_n"][0], observation[3:6])
    np.testing.assert_array_equal(first["reference"][0], observation[6:])


def test_options_reach_the_episode() -> None:
    env = CASES["A"].env()
    options = {"initial_state": [0.5, 0.1, -0.2], "theta": [0.1, 0.1]}
    exact = baselines.filippov(env, PAPER.controller(env), options=options)
    np.testing.assert_array_equal(exact.state(0.0), options["initial_state"])
    # xi_n = (x_1, 1.1 x_2, 1.21 x_3)
    np.testing.assert_allclose(exact.output_derivatives(0.0), [0.5, 0.11, -0.242], rtol=4 * EPS)


def test_shapes() -> None:
    _, exact = solve("A")
    for t in (0.5, np.zeros(4), np.zeros((2, 3))):
        xi, xi_star, u = exact(t)
        assert xi.shape == xi_star.shape == exact.state(t).shape == (*np.shape(t), 3)
        assert np.shape(u) == np.shape(t)
        assert exact.signals(t)["reference"].shape == (*np.shape(t), 4)


@pytest.mark.parametrize("t", [-1e-3, 20.001, np.nan, [0.0, 21.0]])
def test_times_outside_the_solution(t: Any) -> None:
    _, exact = solve("A")
    with pytest.raises(ValueError, match=r"`t` must lie in \[0, 20.0\], got"):
        exact(t)


class Constant(Controller):
    """Always the same input."""

    name = "constant"
    reads = ()
    memory_size = 0

    def __init__(self, nominal: Any) -> None:
        self.nominal = nominal

    def control(self, observations: Array, memory: Array, fresh: Any) -> Array:
        return np.zeros(len(observations))


def test_only_redesign_laws_have_an_exact_solution() -> None:
    env = PAPER.env()
    with pytest.raises(TypeError, match="`controller` must be of the redesign family, got Constant"):
        baselines.filippov(env, Constant(env.unwrapped.nominal))


def test_controller_of_another_plant() -> None:
    controller, _ = solve("n = 2")
    assert isinstance(controller, LyapunovRedesign)
    with pytest.raises(ValueError, match="`controller` must be made for this environment's plant, got one for"):
        baselines.filippov(PAPER.env(), controller)


def test_endless_switching_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """Case A changes its mode six times."""
    env = PAPER.env()
    monkeypatch.setattr(importlib.import_module("baselines.filippov"), "MAX_EVENTS", 3)
    with pytest.raises(RuntimeError, match="more than 3 changes of mode before t = "):
        baselines.filippov(env, PAPER.controller(env))
