"""Theorems of the differentiators. EPS is the unit round-off."""

from math import factorial

import numpy as np
import pytest
from numba import njit
from scipy.optimize import brentq

from mfc_gym.differentiators import (
    DIFFERENTIATORS,
    GAINS,
    LAMBDA,
    MU,
    N_MAX,
    STIRLING,
    bound_from_input,
    homogeneous_gains,
    homogeneous_root,
    mixed_root,
    run_time_bound,
)

NAMES = list(DIFFERENTIATORS)
EPS = np.finfo(float).eps / 2

# lt_0 ... lt_m by order m, as printed by Levant and Livne, Eur. J. Control 2020
GAIN_TABLE = {
    1: "1.1 1.5",
    2: "1.1 2.12 2",
    3: "1.1 3.06 4.16 3",
    4: "1.1 4.57 9.30 10.03 5",
    5: "1.1 6.75 20.26 32.24 23.72 7",
    6: "1.1 9.91 43.65 101.96 110.08 47.69 10",
    7: "1.1 14.13 88.78 295.74 455.40 281.37 84.14 12",
    8: "1.1 19.66 171.73 795.63 1703.9 1464.2 608.99 120.79 14",
    9: "1.1 26.93 322.31 2045.8 6002.3 7066.2 4026.3 1094.1 173.72 17",
    10: "1.1 36.34 586.78 5025.4 19895 31601 24296 8908 1908.5 251.99 20",
    11: "1.1 48.86 1061.1 12220 65053 138954 143658 70830 20406 3623.1 386.7 26",
    12: "1.1 65.22 1890.6 29064 206531 588869 812652 534837 205679 48747 6944.8 623.30 32",
}


def run(name, y, n, dt, bound=1.0, guess=None, **settings):
    """Estimates, shape (N, n), of the samples y, shape (N,), from a guess one sample before the first."""
    d = DIFFERENTIATORS[name]
    memory, estimate, x = np.zeros(d.memory_size(n)), np.zeros(n), np.empty((len(y), n))
    d.initial(memory, estimate if guess is None else np.asarray(guess, dtype=float))
    values = np.array(list({**d.settings, **settings}.values()))
    for k, (y_k, L) in enumerate(zip(y, np.broadcast_to(bound, y.shape), strict=True)):
        d.update(memory, y_k, L, dt, values, estimate)
        x[k] = estimate
    return x


def sine(t, n):
    """sin and its n-1 derivatives, shape (len(t), n)."""
    return np.sin(np.asarray(t, dtype=float)[:, None] + np.arange(n) * np.pi / 2)


def samples(T, dt):
    return np.arange(1, round(T / dt) + 1) * dt


def output_map(n):
    """c_ij of x^j in (-ln(1-x))^i = (x + x^2/2 + ...)^i, i, j = 0 ... n, multiplied out: independent of the code."""
    series = np.r_[0, 1 / np.arange(1, n + 1)]
    c = np.zeros((n + 1, n + 1))
    c[0, 0] = 1
    for i in range(1, n + 1):
        c[i] = np.convolve(c[i - 1], series)[: n + 1]
    return c


def sliding_error(n, dt):
    """E_i with y_i - y^(i) = Im(E_i e^(jt)) for y = sin t: in the sliding mode dt^i y_i = sum_(j<=m) c_ij nabla^j y."""
    nabla = 1 - np.exp(-1j * dt)
    return (output_map(n)[:n, :n] @ nabla ** np.arange(n)) / dt ** np.arange(n) - 1j ** np.arange(n)


def rounding(n, dt):
    """Round-off in the sliding mode, abs(y) <= 1: 4 roundings of eps a sample, amplified by sum_j c_ij 2^j / dt^i."""
    return 4 * EPS * output_map(n)[:n, :n] @ 2.0 ** np.arange(n) / dt ** np.arange(n)


# ---------------------------------------------------------------------------------------------------- constants


@pytest.mark.parametrize("m", GAIN_TABLE)
def test_gains_match_the_published_table(m):
    """The recursion, to one unit in the last printed digit."""
    printed = GAIN_TABLE[m].split()
    unit = [10.0 ** -len(s.partition(".")[2]) for s in printed]
    gains = homogeneous_gains(m)
    assert np.all(np.abs(gains - np.array(printed, dtype=float)) <= unit)
    np.testing.assert_array_equal(GAINS[m, : m + 1], gains)


def test_injection_map_is_the_summed_output_map():
    """C_ij = c_ii + ... + c_ij; N_MAX additions of positive numbers lose at most N_MAX^2 eps."""
    c = output_map(N_MAX)[:N_MAX, :N_MAX]
    np.testing.assert_allclose(STIRLING, np.cumsum(c, axis=1), rtol=N_MAX**2 * EPS)


@pytest.mark.parametrize("m", range(N_MAX))
def test_linear_terms_alone_are_hurwitz(m):
    """z_0 error: s^n + M_0 s^m + ... + M_m, M_i = mu_m ... mu_(m-i). Slowest root of all orders: -0.148 at m = 3."""
    assert np.roots(np.r_[1, np.cumprod(MU[m::-1])]).real.max() < -0.14


# ------------------------------------------------------------------------------------- the published recursions


def seeber(y, n, dt, L):
    """The implicit differentiator in its own coordinates, states z and outputs c z, started at 0, shape (N, n)."""
    m, lt = n - 1, homogeneous_gains(n - 1)
    c, z, x = output_map(n), np.zeros(n), []
    shift = [[dt ** (j - i) * c[i, j] if j >= i else 0 for j in range(n)] for i in range(n)]
    for y_k in y:
        b = y_k - dt ** np.arange(n) @ z
        q, s, r = abs(b) / (L * dt**n), np.sign(b), 0.0
        if q <= lt[0]:
            z[m] += b / dt**m
        else:
            r = brentq(lambda r, q=q: r**n + lt @ r ** np.arange(n) - q, 0, q ** (1 / n), xtol=1e-15, rtol=8 * EPS)
            z[m] += dt * lt[0] * L * s
        for i in range(m - 1, -1, -1):
            z[i] += dt * z[i + 1] + (dt * lt[m - i] * L * (r * dt) ** (m - i) * s if r else 0)
        x.append(shift @ z)
    return np.array(x)


def livne_levant(y, n, dt, L):
    """The homogeneous discrete-time differentiator's states z_(k+1), predicted by y_k, from 0, shape (N, n)."""
    m, lt = n - 1, homogeneous_gains(n - 1)
    z, x = np.zeros(n), []
    for y_k in y:
        e = z[0] - y_k
        z = np.array(
            [
                sum(dt**j / factorial(j) * z[i + j] for j in range(n - i))
                - dt * lt[m - i] * L ** ((i + 1) / n) * abs(e) ** ((m - i) / n) * np.sign(e)
                for i in range(n)
            ]
        )
        x.append(z)
    return np.array(x)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5])
def test_ired_is_seebers_scheme_in_other_coordinates(n):
    """Under noise that makes it slide and leave. dt = 0.5 amplifies rounding by sum_j c_ij 4^j < 450 (n = 5), a few
    times."""
    y = np.sin(samples(20, 0.5)) + 0.05 * np.random.default_rng(0).standard_normal(40)
    np.testing.assert_allclose(run("ired", y, n, 0.5, 2.0), seeber(y, n, 0.5, 2.0), rtol=0, atol=2000 * EPS)


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_hdd_is_the_published_recursion_seen_at_the_current_sample(n):
    """z_(k+1) = Phi x_k; the start 0 is the same as a prediction and as an estimate. Chattering amplifies rounding:
    4e4 eps measured after 200 samples."""
    y, dt = np.sin(samples(20, 0.1)), 0.1
    x = run("hdd", y, n, dt)
    Phi = np.array([[dt ** (j - i) / factorial(j - i) if j >= i else 0 for j in range(n)] for i in range(n)])
    np.testing.assert_allclose(x @ Phi.T, livne_levant(y, n, dt, 1.0), rtol=0, atol=1e6 * EPS)


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_without_linear_terms_levants_nested_form_is_the_homogeneous_one(n):
    """lt is the nested lambda, so rate = 0 is `ired`, up to rounding: 1e2 eps measured."""
    y = np.sin(samples(20, 0.1)) + 0.1 * np.random.default_rng(0).standard_normal(200)
    np.testing.assert_allclose(run("ired-linear", y, n, 0.1, rate=0.0), run("ired", y, n, 0.1), rtol=0, atol=1e4 * EPS)


@pytest.mark.parametrize("n", range(1, N_MAX + 1))
def test_newton_finds_the_roots(n):
    """What is left of b, s = p^n, and the injections add up to b, over 33 decades and up to rate dt = 10.
    The last Newton step leaves (n 1e-8)^2, and n powers a few eps each."""
    A = 1e-6
    for R in A * np.geomspace(1e-8, 1e25, 34):
        for kappa in (0.0, 1e-3, 1.0, 10.0):
            p = mixed_root(R, A, kappa, n)
            b = s = p**n
            for k in range(n, 0, -1):
                linear = kappa * MU[k - 1] * s
                s = LAMBDA[k - 1] * A ** (1 / k) * s ** (1 - 1 / k) + linear
                b += s if k > 1 else linear  # R is free of lambda_0 A, the part of the sign
            assert b == pytest.approx(R, rel=1e-13)
        assert homogeneous_root(R, A ** (1 / n), n) == pytest.approx(mixed_root(R, A, 0.0, n), rel=1e-13)


@pytest.mark.parametrize("name", ["ired", "hdd"])
@pytest.mark.parametrize("n", [1, 2, 3, 4, 5])
def test_homogeneity(name, n):
    """(y, dt) -> (k^n y, k dt) gives k^(n-i) y_i, and (y, L) -> (c y, c L) gives c y_i: hence every bound has the form
    L rho^(n-i), rho = max(dt, (noise/L)^(1/n)). Measured difference 3e-14."""
    y, k = np.random.default_rng(0).standard_normal(300), 3.0
    x = run(name, y, n, 0.1)
    np.testing.assert_allclose(
        run(name, k**n * y, n, k * 0.1) / k ** (n - np.arange(n)), x, atol=1e-12 * np.abs(x).max()
    )
    np.testing.assert_allclose(run(name, 7 * y, n, 0.1, 7.0) / 7, x, atol=1e-12 * np.abs(x).max())


# --------------------------------------------------------------------------------------------- noise-free errors


@pytest.mark.parametrize("name", ["ired", "ired-linear"])
@pytest.mark.parametrize("n", [2, 3, 4, 5])
@pytest.mark.parametrize("dt", [0.05, 0.02])
def test_ired_error_in_closed_form(name, n, dt):
    """From an exact guess abs(b) <= sup abs(n-th difference) <= L dt^n < lt_0 L dt^n: it slides from the first sample,
    and after n samples (poles at 0) the error of a sine is Im(E_i e^(jt)); y_0 = y_k."""
    t = samples(4, dt)
    error = run(name, np.sin(t), n, dt, guess=sine([0], n)[0]) - sine(t, n)
    expected = np.imag(sliding_error(n, dt) * np.exp(1j * t)[:, None])
    assert np.all(np.abs(error - expected)[n:] <= rounding(n, dt))


@pytest.mark.parametrize("n", [2, 3, 4, 5])
@pytest.mark.parametrize("dt", [0.02, 0.01])
def test_ired_error_bound_is_tight(n, dt):
    """sup error = c_in dt^(n-i) sup abs(y^(n)) (1 + O((n dt)^2)): the next term of the series, of ratio below n dt / 2,
    is in quadrature for a sine, and samples miss the peak by less than dt^2/8."""
    t = samples(8, dt)
    error = np.abs(run("ired", np.sin(t), n, dt, guess=sine([0], n)[0]) - sine(t, n))[n:].max(axis=0)
    i = np.arange(1, n)
    bound = output_map(n)[i, n] * dt ** (n - i)
    assert np.all(np.abs(error[1:] - bound) <= (n * dt) ** 2 * bound + rounding(n, dt)[1:])
    assert error[0] <= rounding(n, dt)[0]


@pytest.mark.parametrize("n", [3, 4])
def test_hdd_order(n):
    """O(dt^(n-i)) in y_i, where explicit Euler has O(dt) for every i >= 1. The constant of the chattering varies by
    less than 1.7 over the eightfold range: slope +- log2(1.7)/3 = 0.25."""
    dts = [0.04, 0.005]
    error = []
    for dt in dts:
        t = samples(12, dt)
        error.append(
            np.abs(run("hdd", np.sin(t), n, dt, guess=sine([0], n)[0]) - sine(t, n))[len(t) // 3 :].max(axis=0)
        )
    slope = np.log(error[0] / error[1]) / np.log(dts[0] / dts[1])
    np.testing.assert_allclose(slope, n - np.arange(n), atol=0.25)


# Measured sup errors / (L^(i/n) noise^((n-i)/n)) of +-noise at random, dt = 1e-3, L = 1, noise 1e-4, 20 s
NOISE_GAIN = {2: [1.7, 2.0], 3: [1.8, 2.7, 2.5], 4: [1.5, 3.7, 4.4, 3.0]}


@pytest.mark.parametrize("name", ["ired", "hdd"])
@pytest.mark.parametrize("n", NOISE_GAIN)
def test_noise_bound(name, n):
    """abs(y_i - y^(i)) <= mu_i L^(i/n) noise^((n-i)/n); 25 % since each figure is one draw of a supremum. From below,
    too, so that the figures mean something: no draw is less than half of another."""
    dt, noise = 1e-3, 1e-4
    t = samples(8, dt)
    y = np.sin(t) + noise * np.random.default_rng(n).choice([-1.0, 1.0], t.size)
    error = np.abs(run(name, y, n, dt, guess=sine([0], n)[0]) - sine(t, n)).max(axis=0)
    mu = error / noise ** (1 - np.arange(n) / n)
    assert np.all(mu <= 1.25 * np.array(NOISE_GAIN[n]))
    assert np.all(mu >= 0.5 * np.array(NOISE_GAIN[n]))


def test_round_off_limit_of_ired():
    """n = 5, abs(y) <= 1: rounding leaves the sliding mode alone while 4 eps 2^n <= (lt_0 - 1) L dt^n, dt >= 2.7 ms.
    There the closed form holds. At 1 ms y^(4) is off by more than 1.5 c_in dt (1.8 measured); `hdd` is worse."""
    n = 5
    t = samples(8, 5e-3)
    error = run("ired", np.sin(t), n, 5e-3, guess=sine([0], n)[0]) - sine(t, n)
    expected = np.imag(sliding_error(n, 5e-3) * np.exp(1j * t)[:, None])
    assert np.all(np.abs(error - expected)[n:] <= rounding(n, 5e-3))
    t = samples(8, 1e-3)
    ired, hdd = (
        np.abs(run(s, np.sin(t), n, 1e-3, guess=sine([0], n)[0]) - sine(t, n))[:, 4].max() for s in ("ired", "hdd")
    )
    assert 1.5 * output_map(n)[4, n] * 1e-3 < ired < hdd


# --------------------------------------------------------------------------------------------------- convergence


@pytest.mark.parametrize("name", ["ired", "hdd", "ired-linear"])
@pytest.mark.parametrize(("n", "T"), [(2, 3.7), (3, 5.5), (4, 6.8)])
@pytest.mark.parametrize("offset", [1.0, -1.0])
def test_finite_time_convergence(name, n, T, offset):
    """From an error 1 in y, L = 1, within the measured T, 10 % more for another sampling time; then the accuracy is
    that of the sampling, mu_i dt^(n-i) with mu_i < 9 (`hdd` 7.2, as measured)."""
    dt = 1e-2
    t = samples(1.1 * T + 2, dt)
    error = np.abs(run(name, np.sin(t), n, dt, guess=sine([0], n)[0] + offset * np.eye(n)[0]) - sine(t, n))
    assert np.all(error[t > 1.1 * T] <= 9 * dt ** (n - np.arange(n)))


@pytest.mark.parametrize("n", [2, 3, 4, 5])
def test_linear_terms_converge_from_far(n):
    """Error 100 in every derivative, L = 1. The homogeneous ones move y^(m) by at most lt_0 L dt a sample: at t its
    error is still 100 - (lt_0 + 1) t or more. With linear terms it is c_in dt^(n-i) after 13 s (10.4 measured), and 1 %
    for the (n dt)^2 of the formula."""
    dt, m = 1e-2, n - 1
    t = samples(14, dt)
    guess = sine([0], n)[0] + 100
    for name in ("ired", "hdd"):
        error = np.abs(run(name, np.sin(t), n, dt, guess=guess) - sine(t, n))
        assert np.all(error[:, m] >= 100 - (LAMBDA[0] + 1) * t)
    error = np.abs(run("ired-linear", np.sin(t), n, dt, guess=guess) - sine(t, n))
    bound = output_map(n)[:n, n] * dt ** (n - np.arange(n))
    assert np.all(error[t > 13] <= 1.01 * bound + rounding(n, dt))


@pytest.mark.parametrize("n", range(1, 9))
def test_linear_terms_are_stable_at_any_sampling_time(n):
    """rate dt = 10, ten times the limit of explicit terms or more: from 1e6 into the sliding mode, where y_0 = y_k."""
    t = samples(400, 10.0)
    x = run("ired-linear", np.sin(0.01 * t), n, 10.0, bound=0.01**n, guess=np.full(n, 1e6))
    np.testing.assert_allclose(x[-5:, 0], np.sin(0.01 * t)[-5:], rtol=0, atol=4 * EPS)


# ------------------------------------------------------------------------------------------------- varying bound


@pytest.mark.parametrize("n", [2, 3, 4])
def test_bound_may_follow_the_signal(n):
    """y = exp t, L_k = 1.2 y_k: slides from the start, with the relative error c_in dt^(n-i), less what y grows over
    the n samples of a difference, n dt. A bound that stays behind, L = 12, loses the signal."""
    dt = 1e-2
    t = samples(8, dt)
    y = np.exp(t)
    error = np.abs(run("ired", y, n, dt, bound=1.2 * y, guess=np.ones(n)) / y[:, None] - 1)[n:]
    c = output_map(n)[:n, n] * dt ** (n - np.arange(n))
    assert np.all(error <= c + rounding(n, dt))
    assert np.all(error >= (1 - n * dt) * c - rounding(n, dt))
    assert np.abs(run("ired", y, n, dt, bound=12.0, guess=np.ones(n))[-1, -1] / y[-1] - 1) > 0.9


def test_sliding_estimate_does_not_depend_on_the_bound():
    """In the sliding mode only g_m = b is injected: any L >= sup abs(y^(n)), varying or not, gives the same bits."""
    t = samples(5, 1e-2)
    bounds = np.random.default_rng(0).uniform(1, 200, t.size)
    guess = sine([0], 3)[0]
    x = run("ired", np.sin(t), 3, 1e-2, bound=1.0, guess=guess)
    np.testing.assert_array_equal(run("ired", np.sin(t), 3, 1e-2, bound=bounds, guess=guess), x)
    np.testing.assert_array_equal(run("ired-linear", np.sin(t), 3, 1e-2, bound=bounds, guess=guess), x)


def test_run_time_bound():
    """By hand: 1.2 (2 + 0.5 + 1.25 (|-2 + 3 - 5| + 6)) = 18; the floor; and it bounds y^(n) for all admissible
    uncertainties."""
    assert run_time_bound(2.0, 0.5, 0.25, 3.0, -5.0, 6.0, 1.0) == pytest.approx(18, rel=4 * EPS)
    assert run_time_bound(2.0, 0.5, 0.25, 3.0, -5.0, 6.0, 40.0) == 40
    assert bound_from_input(2.0, -10.0, 0.5, 0.25, 1.0) == run_time_bound(2.0, 0.5, 0.25, 3.0, -5.0, 6.0, 1.0)
    rng = np.random.default_rng(0)
    for _ in range(200):
        alpha, omega_star, v_tilde, Delta_1, v_L = rng.normal(0, 5, 5)
        Delta_3 = rng.uniform(-1, 1)
        y_n = alpha + Delta_1 + (1 + Delta_3) * (-alpha + omega_star + v_tilde + v_L)
        L = run_time_bound(alpha, abs(Delta_1), abs(Delta_3), omega_star, v_tilde, abs(v_L), 0.0)
        assert abs(y_n) <= L / 1.2 * (1 + 8 * EPS)


# ------------------------------------------------------------------------------------------ linear differentiators


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 6])
def test_high_gain_poles(n):
    """Error map A in Taylor coordinates (dt = 1): (A - zeta I)^n = 0 and, observable from one output, no lower power.
    Rounding: n factors, n eps each."""
    omega = 0.7
    A = np.column_stack([run("high-gain", np.zeros(1), n, 1.0, guess=row, bandwidth=omega)[0] for row in np.eye(n)])
    N = A - np.exp(-omega) * np.eye(n)
    scale = (np.linalg.norm(A, 2) + 1) ** n
    assert np.abs(np.linalg.matrix_power(N, n)).max() <= n**2 * EPS * scale
    assert np.abs(np.linalg.matrix_power(N, n - 1)).max() > 1e3 * n**2 * EPS * scale


@pytest.mark.parametrize("n", [2, 3, 4])
def test_high_gain_is_exact_on_polynomials(n):
    """y = t^m from the wrong guess 0: 60 samples leave 60^m zeta^60 <= 60^3 e^-48 = 3e-16 of the error."""
    dt, m = 0.1, n - 1
    t = samples(6, dt)
    powers = [factorial(m) / factorial(m - i) * t[-1] ** (m - i) for i in range(n)]
    x = run("high-gain", t**m, n, dt, bandwidth=8.0)[-1]
    np.testing.assert_allclose(x, powers, rtol=1e-15, atol=rounding(n, dt).max() * t[-1] ** m)


def test_high_gain_with_all_poles_at_zero_is_the_sliding_ired():
    """zeta = exp(-1000) underflows against 1: g_m = b."""
    t = samples(5, 1e-2)
    guess = sine([0], 4)[0]
    x = run("high-gain", np.sin(t), 4, 1e-2, guess=guess, bandwidth=1e5)
    np.testing.assert_array_equal(x, run("ired", np.sin(t), 4, 1e-2, guess=guess))


@pytest.mark.parametrize("n", [2, 3, 4])
def test_high_gain_tends_to_the_continuous_observer(n):
    """One step from 0 with y = 1: y_i = binom(n, i+1) (omega dt)^(i+1) / dt^i (1 + O(n omega dt))."""
    omega, dt = 2.0, 1e-5
    x = run("high-gain", np.ones(1), n, dt, bandwidth=omega)[0]
    gains = [factorial(n) / factorial(i + 1) / factorial(n - i - 1) * omega ** (i + 1) * dt for i in range(n)]
    np.testing.assert_allclose(x, gains, rtol=2 * n * omega * dt * n)


def test_dirty_derivative_of_a_ramp():
    """[y_k, slope, 0, 0] once the poles tau/(tau+dt) = 2/3 have decayed: 200^2 (2/3)^200 = 2e-31."""
    t = samples(2, 0.01)
    x = run("dirty", 3 * t + 1, 4, 0.01, time_constant=0.02)[-1]
    np.testing.assert_allclose(x, [7, 3, 0, 0], atol=8 * 7 * EPS * (2 / 0.03) ** 3)


@pytest.mark.parametrize("tau", [0.0, 0.02, 0.3])
def test_dirty_derivative_of_a_sine(tau):
    """y_i = Im(H^i e^(jt)), H = (1 - z^-1) / (tau + dt - tau z^-1), z = e^(j dt); the slowest pole, 0.3/0.32, leaves
    1000^2 0.94^1000 < 1e-21 of the start. A stage amplifies rounding by 2 / (tau + dt); its own adds up."""
    dt, n = 0.02, 4
    t = samples(30, dt)
    x = run("dirty", np.sin(t), n, dt, time_constant=tau)
    H = (1 - np.exp(-1j * dt)) / (tau + dt - tau * np.exp(-1j * dt))
    expected = np.imag(H ** np.arange(n) * np.exp(1j * t)[:, None])
    assert np.all(np.abs(x - expected)[1000:] <= 16 * EPS * (2 / (tau + dt)) ** np.arange(n) * (1 + tau / dt))


# ------------------------------------------------------------------------------------------------------ contract


@pytest.mark.parametrize("name", ["ired", "ired-linear", "high-gain"])
@pytest.mark.parametrize("n", [2, 3, 4])
def test_no_latency(name, n):
    """From an exact guess a polynomial of degree m is exact at every sample, the first one included."""
    dt, m = 0.1, n - 1
    t = samples(1, dt)
    guess = np.eye(n)[m] * factorial(m)
    expected = np.column_stack([factorial(m) / factorial(m - i) * t ** (m - i) for i in range(n)])
    np.testing.assert_allclose(run(name, t**m, n, dt, guess=guess), expected, atol=rounding(n, dt).max())


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("n", range(1, N_MAX + 1))
def test_finite_input_gives_finite_estimates(name, n):
    """Jumps up to the largest number, from a wild guess, with any bound."""
    y = np.array([0, 1e300, -1e300, 1.7e308, -1.7e308, 5e-324, 0, 1, -1e10, 1e100, -1e100] * 4)
    for bound in (1e-300, 1.0, 1.7e308):
        for dt in (1e-6, 1e-2, 10.0):
            assert np.isfinite(run(name, y, n, dt, bound=bound, guess=np.full(n, 1.7e308))).all()


@pytest.mark.parametrize("name", NAMES)
def test_memory_is_the_estimate_and_nothing_else_is_written(name):
    d = DIFFERENTIATORS[name]
    n = 3
    guess, settings = np.array([1.0, 2.0, 3.0]), np.array(list(d.settings.values()))
    memory, estimate = np.full(d.memory_size(n), np.nan), np.full(n, np.nan)
    d.initial(memory, guess)
    before = settings.copy()
    np.testing.assert_array_equal(memory, guess)
    d.update(memory, 1.1, 1.0, 0.1, settings, estimate)
    np.testing.assert_array_equal(settings, before)
    np.testing.assert_array_equal(guess, [1, 2, 3])
    np.testing.assert_array_equal(memory, estimate)
    assert not np.shares_memory(memory, estimate)
    held = estimate.copy()
    estimate[:] = np.nan  # the next estimate depends on the memory alone
    d.update(memory, 1.2, 1.0, 0.1, settings, estimate)
    assert np.isfinite(estimate).all()
    assert not np.array_equal(estimate, held)


@pytest.mark.parametrize("name", NAMES)
def test_bound_matters_exactly_if_needed(name):
    y = np.random.default_rng(0).standard_normal(20)
    same = np.array_equal(run(name, y, 3, 0.1, 1.0), run(name, y, 3, 0.1, 2.0))
    assert same != DIFFERENTIATORS[name].needs_bound


@njit
def batch(update, memory, y, bound, dt, settings, estimate):
    for k in range(y.shape[0]):
        for row in range(y.shape[1]):
            update(memory[row], y[k, row], bound, dt, settings, estimate[row])


@pytest.mark.parametrize("name", NAMES)
def test_batch_and_scalar_agree_bit_for_bit(name):
    d, n = DIFFERENTIATORS[name], 3
    y = np.random.default_rng(0).standard_normal((50, 4))
    memory, estimate = np.zeros((4, d.memory_size(n))), np.zeros((4, n))
    batch(d.update, memory, y, 1.0, 0.1, np.array(list(d.settings.values())), estimate)
    np.testing.assert_array_equal(estimate, [run(name, column, n, 0.1)[-1] for column in y.T])


@pytest.mark.parametrize("n", [0, N_MAX + 1])
def test_memory_size_names_what_it_wants(n):
    with pytest.raises(ValueError, match=rf"`n` must lie in 1 \.\.\. {N_MAX}, got {n}"):
        DIFFERENTIATORS["ired"].memory_size(n)
