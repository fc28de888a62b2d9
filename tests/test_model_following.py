"""The model loop: its exact sampled solution, the interpolated reference of the nonlinear model, and the variants' relations."""

from math import factorial, pi
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import baselines
from baselines import lyapunov, model_loop
from baselines.lyapunov import Array

EPS = float(np.finfo(float).eps)
LAW: dict[str, Any] = {"design": "paper", "gain": "theorem", "switching": "sign", "margin": 1.0}
POLES: dict[int, dict[str, Any]] = {
    2: {"model_poles": (-1 + 1j, -1 - 1j), "poles": (-4, -4)},
    3: {"model_poles": (-1, -1, -1), "poles": (-4, -4, -4)},
    4: {"model_poles": (-1, -1.5, -2, -2.5), "poles": (-4, -4, -4, -4)},
}


def chain(n: int, **options: Any) -> Any:
    """For controllers alone: the plant is not stepped, and the inputs do not saturate."""
    return gym.make("mfc_gym/PerturbedChain-v0", order=n, input_limit=1e4, substeps=1, **options)


def sine(t: Any, n: int) -> Array:
    """[sin, sin', ..., sin^(n)] at the times t, shape (..., n+1)."""
    return np.sin(np.asarray(t)[..., None] + np.arange(n + 1) * pi / 2)


# -- the linear model ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [2, 3, 4])
def test_model_loop_is_sampled_exactly(n: int) -> None:
    """The sampled controller equals the law without a model loop on the reference shifted by the model's error,

    y_d^(i) + e_star^(i), here from solve_ivp of the model itself, xi_star' = A xi_star + B (y_d^(n) - k' e_star).
    Tolerance: solve_ivp's error, some 100 steps of 1e-13 and 1e-11 at most, times the gains of u to xi_star.
    """
    dt, count = 0.05, 60
    env = chain(n, dt=dt)
    start = np.linspace(0.5, -0.5, n)
    controller = baselines.make("mfc", env, **POLES[n], **LAW, initial_model_state=tuple(start))
    single = baselines.make("single-loop", env, poles=POLES[n]["poles"], **LAW)
    k, times = controller.k, dt * np.arange(count)

    def rate(t: float, xi_star: Array) -> Array:
        yd = sine(t, n)
        return np.append(xi_star[1:], yd[-1] - k @ (xi_star - yd[:-1]))

    xi_star = solve_ivp(rate, (0, times[-1]), start, method="DOP853", t_eval=times, rtol=1e-13, atol=1e-13).y.T
    yd = sine(times, n)
    e_star = xi_star - yd[:, :-1]
    shifted = yd + np.column_stack([e_star, -e_star @ k])
    x, xi_n = np.random.default_rng(n).uniform(-1, 1, (2, count, n))
    state, actions = None, []
    for row in np.hstack([x, xi_n, yd]):
        action, state = controller.predict(row, state)
        actions.append(action)
    expected, _ = single.predict(np.hstack([x, xi_n, shifted]))
    sensitivity = (np.abs(k).sum() + np.abs(controller.k_tilde).sum()) * (1 + 0.25) / (1 - 0.25)
    s = (xi_n - xi_star) @ lyapunov.surface(controller.P)
    assert np.abs(s).min() > 1e-6  # no sample so close to the surface that the sign could differ
    np.testing.assert_allclose(np.array(actions) * 1e4, expected * 1e4, rtol=0, atol=1e-11 * sensitivity)


@pytest.mark.parametrize("n", [2, 3, 4])
def test_transition_does_not_depend_on_the_sampling_time(n: int) -> None:
    """expm(2 M dt) = expm(M dt)^2: the model of every second sample is that of twice the sampling time.

    Rounding: 20 products of numbers below 10.
    """
    actions = []
    for dt in (0.1, 0.05):
        env = chain(n, dt=dt)
        controller = baselines.make("mfc", env, **POLES[n], **LAW, initial_model_state=(1.0,) * n)
        state, series = None, []
        for t in np.arange(round(1 / dt)) * dt:
            yd = sine(t, n)
            action, state = controller.predict(np.concatenate([np.zeros(n), yd[:-1] + 5, yd]), state)
            series.append(action[0] * 1e4)
        actions.append(np.array(series))
    sensitivity = np.abs(controller.k_tilde).sum() * 2
    np.testing.assert_allclose(actions[1][::2], actions[0], rtol=0, atol=2000 * EPS * sensitivity)


def test_first_model_state() -> None:
    """v_tilde = 0 for a model started at the process; e_star = 0 for one started on the reference."""
    env = chain(3)
    observation, _ = env.reset(options={"initial_state": [1.0, 0.5, -0.5], "theta": [0.2, -0.2]})
    xi_n, yd = observation[3:6], observation[6:]
    for start, xi_star in (("process", xi_n), ("reference", yd[:-1]), ((0.5, 0.25, 0.0), np.array([0.5, 0.25, 0.0]))):
        controller = baselines.make("mfc", env, **POLES[3], **LAW, initial_model_state=start)
        np.testing.assert_allclose(controller.initial_model_error(observation), xi_star - yd[:-1], atol=2 * EPS)
        exact = baselines.filippov(
            env, controller, options={"initial_state": [1.0, 0.5, -0.5], "theta": [0.2, -0.2]}
        )  # fmt: skip
        np.testing.assert_allclose(exact(0.0)[1], xi_star, rtol=0, atol=2 * EPS)


# -- the nonlinear model -------------------------------------------------------------------------------------------------


def interpolated(before: Array, after: Array, dt: float, s: Array) -> Array:
    """The reference and its derivatives at the fractions s of the interval, shape (len(s), n+1)."""
    n = len(before) - 1
    coefficients, out = np.empty(n + 1), np.empty((len(s), n + 1))
    model_loop.hermite_coefficients(before, after, model_loop.hermite_matrix(n), dt, coefficients)
    for i, fraction in enumerate(s):
        model_loop.interpolate(before, coefficients, fraction, dt, out[i])
    return out


@pytest.mark.parametrize("n", [2, 3, 4, 5])
def test_interpolation_reproduces_polynomials(n: int) -> None:
    """Degree n + 3 on any interval.

    The i-th derivative of a polynomial of size 1 has the size (n+3)! / (n+3-i)! / dt^i, and rounding errors of that size;
    the coefficients inherit them through the matrix.
    """
    rng = np.random.default_rng(n)
    s = np.linspace(0, 1, 11)
    for dt in (0.01, 0.5, 2.0):
        p = np.polynomial.Polynomial(rng.normal(size=n + 4) / dt ** np.arange(n + 4))  # of size 1 on the interval
        exact = np.array([(p if i == 0 else p.deriv(i))(dt * s) for i in range(n + 1)]).T
        size = np.array([factorial(n + 3) / factorial(n + 3 - i) for i in range(n + 1)])
        error = np.abs(interpolated(exact[0], exact[-1], dt, s) - exact) * dt ** np.arange(n + 1) / size
        assert error.max() < 10 * EPS * (np.abs(model_loop.hermite_matrix(n)) @ size).sum()


@pytest.mark.parametrize("n", [2, 3, 4, 5])
def test_interpolation_error(n: int) -> None:
    """f^(n-2) - p^(n-2) = f^(n+4)(eta) / 6! (s (1-s))^3 dt^6, Hermite's remainder, and order n + 4 - i for f^(i).

    For f^(n+4) = cos around 0, its size varies by 1 - cos(dt / 2) on the interval: the bound holds and is met up to that,
    and the slopes miss the order by no more than dt^2 / log(2).
    """
    s = np.array([0.0, 0.2, 0.35, 0.5, 0.8, 1.0])
    errors, steps = [], (0.4, 0.2)
    for dt in steps:
        t = dt * (s - 0.5) - (n + 3) * pi / 2  # f = sin, f^(n+4) = sin(t + (n+4) pi / 2) = cos around 0
        error = sine(t, n) - interpolated(sine(t[0], n), sine(t[-1], n), dt, s)
        remainder = (s * (1 - s)) ** 3 * dt**6 / factorial(6)
        rounding = 100 * EPS
        assert (np.abs(error[:, n - 2]) <= remainder + rounding).all()
        assert (np.abs(error[:, n - 2]) >= remainder * np.cos(dt / 2) - rounding).all()
        np.testing.assert_allclose(error[0], 0, atol=rounding)  # all derivatives on the left, three on the right
        np.testing.assert_allclose(error[-1, n - 2 :], 0, atol=rounding / dt**2)
        errors.append(np.abs(error).max(axis=0))
    slopes = np.log2(errors[0] / errors[1])
    np.testing.assert_allclose(slopes, n + 4 - np.arange(n + 1), atol=steps[0] ** 2 / np.log(2))


@pytest.mark.parametrize("n", [2, 3, 4, 5])
def test_interpolation_is_well_conditioned(n: int) -> None:
    """The rounding error of y_d^(n) is 60 (the third row of the inverse) eps / dt^2 times a few, whatever the order."""
    dt, s = 1e-3, np.linspace(0, 1, 11)
    for t in np.linspace(0, 6, 20):
        error = sine(t + dt * s, n) - interpolated(sine(t, n), sine(t + dt, n), dt, s)
        assert np.abs(error[:, n]).max() < 60 * 10 * EPS / dt**2


def follow(controller: Any, observations: Array) -> Array:
    """u over one episode, shape (N,)."""
    state, u = None, []
    for row in observations:
        action, state = controller.predict(row, state)
        u.append(action[0])
    return np.array(u) * controller.nominal.input_limit


def observations_of(nominal: Any, t: Array, offset: float) -> Array:
    """Smooth signals of a process far from the surface: x near the task's middle, xi_n = xi_d + offset, sine reference."""
    n = nominal.order
    yd = sine(t, n)
    x = 0.3 * np.sin(t[:, None] + np.arange(n))
    return np.hstack([x, yd[:, :-1] + offset, yd])


@pytest.mark.parametrize(
    ("system", "n"),
    [("PerturbedChain", 3), ("MotorPendulum", 3)],
)
def test_nonlinear_model_converges_to_the_linear_one(system: str, n: int) -> None:
    """Both implementations of the model are equivalent [1]. The nonlinear one, linearised by its own feedback, is integrated
    by Runge and Kutta's method of order 4, so that u differs by O(dt^4).

    Slope over a factor 8 in dt: the next term of the error is O(dt) relative, at most a third at the largest dt, so the
    slope is off by log(4/3) / log(8) = 0.14. (With pendulum, tau is nonlinear too.)
    """
    differences = []
    for dt in (0.08, 0.04, 0.02, 0.01):
        env = gym.make(f"mfc_gym/{system}-v0", dt=dt, horizon=2.4, input_limit=1e5, substeps=1)
        t = dt * np.arange(round(2.4 / dt) + 1)
        observations = observations_of(env.unwrapped.nominal, t, 2.0)
        options: dict[str, Any] = {**POLES[n], **LAW, "delta_1": 1.0, "initial_model_state": (0.2, 0.1, -0.1)}
        linear = follow(baselines.make("mfc", env, **options), observations)
        nonlinear = follow(baselines.make("mfc-conventional", env, **options), observations)
        assert np.abs(linear).max() < 1e5  # not saturated
        assert linear[0] == pytest.approx(nonlinear[0], rel=1e-10)  # tau_inverse stops at 1e-13
        differences.append(np.abs(linear - nonlinear).max())
    assert abs(np.log(differences[0] / differences[-1]) / np.log(8) - 4) < 0.15


def test_nonlinear_model_in_the_loop() -> None:
    """The two implementations drive the plant alike: what separates them is dt^4, tiny beside the error of sampling.

    The smallest difference that chattering amplifies is no longer seen with a set-valued sign.
    """
    env = gym.make("mfc_gym/PerturbedChain-v0", horizon=5.0)
    options: dict[str, Any] = {
        "gain": "theorem", "switching": "implicit", "design": "surface", "model_poles": (-1, -1, -1), "poles": (-4, -4, -4),
        "initial_model_state": (0.5, 0.0, 0.0),
    }  # fmt: skip
    linear, nonlinear = (
        baselines.rollout(env, baselines.make(name, env, **options)) for name in ("mfc", "mfc-conventional")
    )
    np.testing.assert_allclose(linear.state, nonlinear.state, rtol=0, atol=1e-6)  # (dt / 4)^4 = 4e-11, times the gains
    assert not np.array_equal(linear.state, nonlinear.state)


# -- without a model loop --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("switching", "gain"), [("sign", "theorem"), ("implicit-observer", "sharp")])
def test_model_on_the_reference_is_the_single_loop(switching: str, gain: str) -> None:
    """xi_star(0) = xi_d(0): xi_star = xi_d forever, eq. (25) of [1], to the last bit."""
    env = gym.make("mfc_gym/PerturbedChain-v0", horizon=5.0)
    options: dict[str, Any] = {"switching": switching, "gain": gain, "design": "paper", "poles": (-4, -4, -4)}
    single = baselines.rollout(env, baselines.make("single-loop", env, **options))
    controller = baselines.make("mfc", env, **options, model_poles=(-1, -1, -1), initial_model_state="reference")
    following = baselines.rollout(env, controller)
    np.testing.assert_array_equal(single.control, following.control)
    np.testing.assert_array_equal(single.state, following.state)
    assert np.ptp(single.control) > 1


def test_single_loop_reads_no_model() -> None:
    """Neither the model's poles nor its start change anything."""
    env = gym.make("mfc_gym/PerturbedChain-v0", horizon=1.0)
    rollouts = [
        baselines.rollout(env, baselines.make("single-loop", env, **LAW, poles=(-4, -4, -4), **options))
        for options in ({}, {"model_poles": (-9, -9, -9), "initial_model_state": (1.0, 2.0, 3.0)})
    ]
    np.testing.assert_array_equal(rollouts[0].control, rollouts[1].control)


def test_matched_uncertainty_needs_no_derivatives() -> None:
    """theta = 0: Delta is matched, xi_n = xi, Delta_3 = 0; with the same gain both designs of [1] are one, bit by bit."""
    env = gym.make("mfc_gym/PerturbedChain-v0", theta=(0.0, 0.0), horizon=2.0)
    options: dict[str, Any] = {
        "gain": "matched", "switching": "sign", "design": "paper", "model_poles": (-1,) * 3, "poles": (-4,) * 3,
    }  # fmt: skip
    on_derivatives, on_state = (
        baselines.rollout(env, baselines.make("mfc", env, feedback=feedback, **options))
        for feedback in ("output derivatives", "state")
    )
    np.testing.assert_array_equal(on_derivatives.state, on_state.state)
    np.testing.assert_array_equal(
        on_state.control, baselines.rollout(env, baselines.make("matched-only", env, **options)).control
    )


def test_hermite_matrix_inverts_the_derivatives_of_the_powers() -> None:
    """M[i, m] = d^i/ds^i s^(n+1+m) at s = 1 in integers, i = n-2 ... n; NumPy's inverse is off by the condition number."""
    for n in (2, 3, 4, 5):
        powers = [np.polynomial.Polynomial.basis(n + 1 + m) for m in range(3)]
        M = np.array([[(p if i == 0 else p.deriv(i))(1.0) for p in powers] for i in range(n - 2, n + 1)])
        hermite = model_loop.hermite_matrix(n)
        assert np.abs(hermite[:3, n - 2 :] @ M - np.eye(3)).max() < 10 * np.linalg.cond(M) * EPS
        hermite[:3, n - 2 :] = 0
        assert not hermite.any()


def test_transition_matrix_solves_the_error_dynamics() -> None:
    """expm of a companion matrix with an n-fold pole: e_star_1 = (0.5 - 0.5 t - 0.75 t^2) exp(-t) from (0.5, -1, 0).

    Rounding: products of numbers below 100.
    """
    motion = lyapunov.closed_loop(lyapunov.place([-1.0, -1.0, -1.0]))
    for t in (0.01, 1.0, 5.0):
        e = expm(motion * t) @ [0.5, -1.0, 0.0]
        assert e[0] == pytest.approx((0.5 - 0.5 * t - 0.75 * t**2) * np.exp(-t), rel=0, abs=1000 * EPS)
