from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from baselines import metrics
from baselines.metrics import METRICS, evaluate
from baselines.trajectory import Array, Trajectory

EPS = float(np.finfo(float).eps)

# Multiples of 1/1024 up to 2^10: sums, differences, squares and their sums are exact in double precision.
dyadic = st.integers(-(2**20), 2**20).map(lambda i: i / 1024)
signals = arrays(float, st.integers(2, 40), elements=dyadic)
powers = st.integers(-8, 8).map(lambda k: 2.0**k)


def episode(error: Array, control: Array, dt: float, terminated: bool = False, y_d: float = 1.0) -> Trajectory:
    """First-order plant, constant reference y_d, reward -1 per step."""
    N = control.size
    reference = np.stack([np.full(N + 1, y_d), np.zeros(N + 1)], axis=-1)
    y = (error + y_d)[:, None]
    return Trajectory(np.linspace(0, N * dt, N + 1), y, y, reference, control, -np.ones(N), terminated)


def decaying(N: int, dt: float, terminated: bool = False, y_d: float = 1.0) -> Trajectory:
    t = dt * np.arange(N + 1)
    return episode(np.exp(-t), np.sin(t[:-1]), dt, terminated, y_d)


def test_integrals_of_an_exponential_meet_the_trapezoid_bound() -> None:
    """|trapezoid - int f| <= T dt^2 max|f''| / 12, with max|f''| = 1, 4, 2 for exp(-t), exp(-2t), t exp(-t)."""
    T, dt = 4.0, 0.01
    t = np.linspace(0, T, 401)
    e = np.exp(-t)
    bound = T * dt**2 / 12
    assert abs(metrics.iae(-e, dt) - (1 - math.exp(-T))) < bound
    assert abs(metrics.ise(e, dt) - (1 - math.exp(-2 * T)) / 2) < 4 * bound
    assert abs(metrics.itae(t, -e) - (1 - (1 + T) * math.exp(-T))) < 2 * bound
    assert abs(metrics.rms(e) ** 2 * T - (1 - math.exp(-2 * T)) / 2) < 4 * bound


def test_trapezoid_is_of_order_two() -> None:
    """Euler-Maclaurin: error = dt^2/12 (f'(T) - f'(0)) (1 - dt^2/60 + ...) for exp(-t), so the slope misses 2 by
    at most dt^2 / (80 ln 2) = 0.0012 at dt = 1/4; twice that leaves room for the next term."""
    dt = 2.0 ** -np.arange(2, 7)
    error = [abs(metrics.iae(np.exp(-np.arange(0, 4 + h, h)), h) - (1 - math.exp(-4))) for h in dt]
    slopes = np.diff(np.log2(error)) / np.diff(np.log2(dt))
    np.testing.assert_allclose(slopes, 2, atol=2.4e-3)


def test_sine_over_a_period() -> None:
    """Equidistant rules are exact for trigonometric polynomials below the sampling frequency."""
    N = 64
    t = np.linspace(0, 2 * np.pi, N + 1)
    dt, e = t[1], 3 * np.sin(t)
    assert metrics.ise(e, dt) == pytest.approx(9 * np.pi, rel=N * EPS)
    assert metrics.rms(e) == pytest.approx(3 / math.sqrt(2), rel=N * EPS)
    assert metrics.max_error(e) == 3.0
    assert metrics.energy(e[:-1], dt) == pytest.approx(9 * np.pi, rel=N * EPS)
    assert metrics.total_variation(e) == pytest.approx(4 * 3, rel=N * EPS)  # N divisible by 4: the extrema are samples


def test_equivalent_control_of_the_example() -> None:
    """u = -cos(t)/.75 - |xi|^2 on xi = (sin t, cos(t)/1.5, -sin(t)/.75), a quadratic in cos t with extrema at
    cos t = 2/7 and -1, 1: variation 212/21, max|u| = 187/63 and int u^2 = 2 pi (8/9 + (29/18)^2 + 49/72) per period."""
    N = 2000
    t = np.linspace(0, 2 * np.pi, N + 1)
    u = -np.cos(t) / 0.75 - (np.sin(t) ** 2 * (1 + 1 / 0.75**2) + np.cos(t) ** 2 / 1.5**2)
    dt = t[1]
    missed = 6 * dt**2 / 8  # |u''| <= 4/3 + 14/3, an extremum is at most dt/2 away from a sample
    assert metrics.energy(u[:-1], dt) == pytest.approx(2 * np.pi * (8 / 9 + (29 / 18) ** 2 + 49 / 72), rel=N * EPS)
    assert 212 / 21 - 4 * missed <= metrics.total_variation(u) <= 212 / 21 + N * EPS
    assert 187 / 63 - missed <= metrics.peak(u) <= 187 / 63 + 4 * EPS


def test_settling_time() -> None:
    dt = 0.01
    t = np.linspace(0, 10, 1001)
    e = np.exp(-t)
    assert 0 <= math.log(50) - metrics.settling_time(t, e, 0.02) < dt  # last sample before exp(-t) = 0.02
    assert metrics.settling_time(t, e, 1.0) == 0  # |e| = band is inside
    assert metrics.settling_time(t, e, 1e-9) == math.inf
    assert metrics.settling_time(t, np.where(t == t[700], 1, 0), 0.02) == t[700]  # a late peak counts


def test_held_input_by_hand() -> None:
    u, dt = np.array([2.0, 2.0, -2.0, 1.0]), 0.5
    assert metrics.energy(u, dt) == 6.5
    assert metrics.effort(u, dt) == 3.5
    assert metrics.total_variation(u) == 7
    assert metrics.total_variation_rate(u, dt) == 3.5
    assert metrics.saturation_time(u, 2.0, dt) == 1.5
    assert metrics.peak(-u) == 2


@settings(deadline=None)
@given(signals, powers)
def test_scaling(x: Array, c: float) -> None:
    """Degree one or two in the signal; a power of two scales without rounding."""
    for degree_one in (metrics.max_error, metrics.rms, metrics.total_variation, metrics.peak):
        assert degree_one(-c * x) == c * degree_one(x)
    for integral, degree in ((metrics.iae, 1), (metrics.effort, 1), (metrics.ise, 2), (metrics.energy, 2)):
        assert integral(-c * x, 0.25) == c**degree * integral(x, 0.25)
        assert integral(x, 0.25 * c) == c * integral(x, 0.25)


@settings(deadline=None)
@given(signals, dyadic)
def test_variation_and_norms(x: Array, offset: float) -> None:
    assert metrics.total_variation(x + offset) == metrics.total_variation(x) == metrics.total_variation(x[::-1])
    assert metrics.total_variation(x) >= np.ptp(x)
    assert metrics.rms(x) <= metrics.max_error(x) * (1 + 2 * EPS)
    assert metrics.iae(x, 1.0) ** 2 <= (x.size - 1) * metrics.ise(x, 1.0) * (1 + 4 * EPS)  # Cauchy-Schwarz


def test_windows_add_up() -> None:
    N, dt = 400, 0.01
    run = decaying(N, dt)
    m = evaluate(run, 50.0, N * dt)
    assert m["rms"] ** 2 == pytest.approx((m["transient_rms"] ** 2 + m["tail_rms"] ** 2) / 2, rel=N * EPS)
    assert m["max_error"] == max(m["transient_max"], m["tail_max"]) == 1
    assert m["tail_max"] == pytest.approx(math.exp(-N * dt / 2), abs=2 * EPS)  # y = e + y_d is rounded
    jump = abs(run.control[200] - run.control[199])  # at T/2, in neither half
    parts = m["transient_total_variation"] + jump + m["tail_total_variation"]
    assert m["total_variation"] == pytest.approx(parts, rel=N * EPS)
    assert m["return"] == -N
    assert m["escaped"] == 0


def test_band_is_two_percent_of_the_reference() -> None:
    dt, N = 0.01, 1000
    assert 0 <= math.log(50 / 4) - evaluate(decaying(N, dt, y_d=-4.0), 50.0, 10.0)["settling_time"] < dt
    assert 0 <= math.log(50) - evaluate(decaying(N, dt, y_d=0.0), 50.0, 10.0)["settling_time"] < dt  # of |e(0)|
    assert 0 <= math.log(2) - evaluate(decaying(N, dt), 50.0, 10.0, band=0.5)["settling_time"] < dt


@pytest.mark.parametrize("name", METRICS)
def test_every_metric_of_a_complete_episode_is_finite(name: str) -> None:
    value = evaluate(decaying(1000, 0.01), 0.5, 10.0)[name]
    assert type(value) is float
    assert math.isfinite(value)


@pytest.mark.parametrize("name", METRICS)
@pytest.mark.parametrize(("N", "half"), [(499, False), (500, False), (501, True), (1000, True)])
def test_escaped_episode_takes_the_worst_value(name: str, N: int, half: bool) -> None:
    run = decaying(N, 0.01, terminated=True)
    run.output_derivatives[-1] = np.nan  # the plant may have overflown in its last step
    value = evaluate(run, 0.5, 10.0)[name]
    recorded = METRICS[name].phase == "episode" or (METRICS[name].phase == "transient" and half)
    assert math.isfinite(value) if recorded else value == METRICS[name].worst


def test_evaluate_rejects() -> None:
    run = decaying(100, 0.01)
    with pytest.raises(ValueError, match=r"`horizon` must be >= 2 dt and reached unless terminated, got 2\.0"):
        evaluate(run, 1.0, 2.0)
    with pytest.raises(ValueError, match="`horizon` must be"):
        evaluate(run, 1.0, 0.5)
    with pytest.raises(ValueError, match="`horizon` must be"):
        evaluate(decaying(1, 0.01), 1.0, 0.01)
    with pytest.raises(ValueError, match="`input_limit` must be positive, got 0"):
        evaluate(run, 0.0, 1.0)
    with pytest.raises(ValueError, match=r"must be one of `episodes\(\)`, got control of shape \(5, 2\)"):
        evaluate(batch(), 1.0, 5.0)
    run.output_derivatives[-1] = np.inf
    with pytest.raises(ValueError, match="must have a finite error"):
        evaluate(run, 1.0, 1.0)


def batch() -> Trajectory:
    """Two episodes of a second-order plant: the first terminates after 3 of 5 steps, the second lasts."""
    N, B, n = 5, 2, 2
    state = np.arange((N + 1) * B * n, dtype=float).reshape(N + 1, B, n)
    control, reward = np.ones((N, B)), -np.ones((N, B))
    state[4:, 0], control[3:, 0], reward[3:, 0] = np.nan, np.nan, np.nan
    reference = np.ones((N + 1, B, n + 1))
    return Trajectory(np.arange(N + 1.0), state, 2 * state, reference, control, reward, np.array([True, False]))


def test_episodes_are_cut_to_their_own_length() -> None:
    runs = batch()
    np.testing.assert_array_equal(runs.steps, [3, 5])
    assert runs.error.shape == (6, 2)
    first, second = runs.episodes()
    assert (first.steps, first.terminated, second.steps, second.terminated) == (3, True, 5, False)
    assert (first.state.shape, first.reference.shape, first.dt) == ((4, 2), (4, 3), 1.0)
    np.testing.assert_array_equal(first.error, 2 * runs.state[:4, 0, 0] - 1)
    np.testing.assert_array_equal(second.state, runs.state[:, 1])
    (again,) = first.episodes()
    np.testing.assert_array_equal(again.state, first.state)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"time": np.zeros((6, 1))}, r"`time` must have shape \(N\+1,\) with N >= 1, got \(6, 1\)"),
        ({"time": np.arange(6.0) ** 2}, "`time` must be equidistant and increasing, got steps 1.0 to 9.0"),
        ({"time": -np.arange(6.0)}, "`time` must be equidistant and increasing"),
        ({"control": np.ones((5, 2, 1))}, r"`control` must have shape \(N,\) or \(N, B\), got \(5, 2, 1\)"),
        ({"state": np.ones((6, 2))}, r"`state` must have shape \('N\+1', 2, 'n'\), got \(6, 2\)"),
        ({"reference": np.ones((6, 2, 2))}, r"`reference` must have shape \(6, 2, 3\), got \(6, 2, 2\)"),
        ({"terminated": True}, r"`terminated` must have shape \(2,\), got \(\)"),
        ({"reward": np.full((5, 2), np.nan)}, "`reward` may be NaN only after an episode's end, got 10 NaN of 10"),
        ({"control": np.ones((5, 2))}, "`control` must be NaN exactly where `reward` is"),
    ],
)
def test_trajectory_rejects(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(batch(), **change)
