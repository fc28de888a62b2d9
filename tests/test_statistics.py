from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from scipy.stats import t as student

from baselines.statistics import (
    Array,
    bootstrap,
    crossed_bootstrap,
    cvar,
    iqm,
    mean,
    median,
    normalised_score,
    optimality_gap,
    paired_difference,
    performance_profile,
    probability_of_improvement,
    rate,
)

EPS = float(np.finfo(float).eps)
# Multiples of 1/1024 up to 2^10: their sums are exact in double precision.
dyadic = st.integers(-(2**20), 2**20).map(lambda i: i / 1024)
matrices = arrays(float, array_shapes(min_dims=1, max_dims=2, max_side=8), elements=dyadic)
small = arrays(float, st.tuples(st.integers(1, 6), st.just(2)), elements=st.integers(0, 3).map(float))  # many ties

AGGREGATES: list[Callable[..., Array]] = [mean, median, iqm, cvar, optimality_gap]


def test_aggregates_by_hand() -> None:
    x = np.array([0.0, 1, 2, 3, 4, 5, 6, 100])
    assert iqm(x) == 3.5
    assert median(x) == 3.5
    assert mean(x) == 121 / 8
    assert cvar(x, 0.25) == 0.5
    assert cvar(x, 0.25, lower_is_better=True) == 53
    assert cvar(x, 3 / 16) == (0 + 1 / 2) / 1.5  # one sample and a half
    assert optimality_gap(x, 4.0) == 4 - (0 + 1 + 2 + 3 + 4 * 4) / 8


@settings(deadline=None)
@given(matrices)
def test_iqm_lies_between_the_quartiles(x: Array) -> None:
    """The lowest and the highest of the untrimmed scores; the sum is exact and rounding a quotient is monotone."""
    s = np.sort(x, axis=None)
    k = s.size // 4
    assert s[k] <= iqm(x) <= s[-1 - k]


@settings(deadline=None)
@given(matrices, st.integers(-8, 8).map(lambda k: 2.0**k), dyadic)
def test_aggregates_are_equivariant(x: Array, c: float, offset: float) -> None:
    """Scaling by a power of two is exact; an offset costs the rounding of sums of at most 64 scores below 2^12."""
    for aggregate in (mean, median, iqm, cvar):
        assert aggregate(c * x) == c * aggregate(x)
        assert aggregate(x + offset) == pytest.approx(aggregate(x) + offset, abs=64 * 2**12 * EPS)


@settings(deadline=None)
@given(matrices, st.sampled_from([0.01, 0.1, 0.3, 0.5, 1.0]))
def test_cvar_is_the_minimum_of_rockafellar_and_uryasev(x: Array, q: float) -> None:
    """For a cost: min over t of t + E[max(x - t, 0)]/q, attained at a sample. Terms are below 2^11/q."""
    t = x.reshape(-1, 1)
    minimum = (t[:, 0] + np.maximum(t.T - t, 0).mean(axis=1) / q).min()
    tolerance = 2**11 / q * x.size * (EPS + 1e-9)  # q N is rounded to 1e-9
    assert cvar(x, q, lower_is_better=True) == pytest.approx(minimum, abs=tolerance)
    assert cvar(-x, q) == -cvar(x, q, lower_is_better=True)
    assert cvar(x, q) <= mean(x) + 64 * 2**11 * EPS


def test_optimality_gap() -> None:
    assert optimality_gap([0.5, 0.25], 1.0) == 1 - 0.375
    assert optimality_gap([1.0, 7.0], 1.0) == 0


@settings(deadline=None)
@given(small, small)
def test_probability_of_improvement(x: Array, y: Array) -> None:
    """Against the double sum; a mean of two tasks costs a few roundings of numbers <= 1."""
    pairs = (x[:, None] > y).mean(axis=(0, 1)) + (x[:, None] == y).mean(axis=(0, 1)) / 2
    assert probability_of_improvement(x, y) == pytest.approx(pairs.mean(), abs=8 * EPS)
    assert probability_of_improvement(x, y) + probability_of_improvement(y, x) == pytest.approx(1, abs=4 * EPS)
    assert probability_of_improvement(x, x) == 0.5
    assert probability_of_improvement(x + 4, y) == 1


def test_probability_of_improvement_ranks_infinite_scores() -> None:
    assert probability_of_improvement([1.0, 2.0], [-np.inf, 3.0]) == 0.5


def test_performance_profile() -> None:
    x, tau = np.array([[0.0, 1.0], [2.0, 3.0]]), np.array([-1.0, 0.0, 1.5, 3.0])
    np.testing.assert_array_equal(performance_profile(x, tau), [1, 0.75, 0.5, 0])
    band = bootstrap(partial(performance_profile, tau=tau), x, reps=2000)
    np.testing.assert_array_equal(band.value, [1, 0.75, 0.5, 0])
    # task 1 has scores 0 or 2, task 2 has 1 or 3: each is drawn twice, so both extremes have probability 1/4 per task
    np.testing.assert_array_equal(band.low, [1, 0.5, 0, 0])
    np.testing.assert_array_equal(band.high, [1, 1, 1, 0])


def test_normalised_score() -> None:
    np.testing.assert_array_equal(normalised_score([8.0, 2.0, 5.0, np.inf], 8.0, 2.0), [0, 1, 0.5, -np.inf])
    np.testing.assert_array_equal(normalised_score([[1.0, 1.0]], [3.0, 5.0], [2.0, 1.0]), [[2, 1]])  # one per task


def test_interval_of_two_runs_by_hand() -> None:
    """The mean of two draws from {0, 1} is 0, 1/2, 1 with probability 1/4, 1/2, 1/4."""
    np.testing.assert_array_equal(bootstrap(mean, [0.0, 1.0], reps=1000), (0.5, 0, 1))
    narrow = bootstrap(mean, [0.0, 1.0], reps=1000, level=0.4)  # from the quantile 0.3, 3.7 deviations above 1/4
    np.testing.assert_array_equal(narrow, (0.5, 0.5, 0.5))


def test_bootstrap_is_reproducible_and_chunked(monkeypatch: pytest.MonkeyPatch) -> None:
    x = np.random.default_rng(1).normal(size=(10, 3))
    assert bootstrap(iqm, x, reps=500, seed=7) == bootstrap(iqm, x, reps=500, seed=np.random.default_rng(7))
    assert bootstrap(iqm, x, reps=500, seed=7) != bootstrap(iqm, x, reps=500, seed=8)
    sizes: list[int] = []

    def recorded(scores: Array) -> Array:
        sizes.append(scores.size)
        return mean(scores)

    monkeypatch.setattr("baselines.statistics.CHUNK", 100)
    bootstrap(recorded, x, reps=500)
    assert max(sizes) <= 100
    assert sum(sizes) == (500 + 1) * x.size  # the replicates and the estimate itself


def test_bootstrap_is_stratified() -> None:
    """Runs are drawn independently per task: Var = sum of the tasks' variances / (runs tasks^2), not that of whole
    rows, `tasks` times larger here. The sample variance has the relative deviation sqrt(2/reps) = 1 %: 5 of them."""
    column = np.arange(8.0)
    x = np.stack([column] * 4, axis=1)
    replicates: list[Array] = []

    def recorded(scores: Array) -> Array:
        replicates.append(mean(scores))
        return replicates[-1]

    bootstrap(recorded, x, reps=20_000)
    assert np.var(replicates[0]) == pytest.approx(column.var() / (8 * 4), rel=0.05)
    single = x[:1] + np.arange(4.0)  # with one run per task nothing is left to draw
    assert len(set(map(float, bootstrap(mean, single, reps=100)))) == 1


def test_crossed_bootstrap_draws_runs_and_episodes() -> None:
    """For x_ij = a_i + b_j: Var = var(a)/R + var(b)/M. The sample variance has the deviation sqrt(2/reps) = 1 %: 5 of them."""
    a, b = np.arange(6.0), np.arange(0.0, 40.0, 4.0)
    replicates: list[Array] = []

    def recorded(scores: Array) -> Array:
        replicates.append(mean(scores))
        return replicates[-1]

    crossed_bootstrap(recorded, a[:, None] + b, reps=20_000)
    assert np.var(replicates[0]) == pytest.approx(a.var() / 6 + b.var() / 10, rel=0.05)
    tasks = (a[:, None] + b)[..., None] + np.arange(3.0)  # the same runs and episodes in all tasks: none averages out
    crossed_bootstrap(recorded, tasks, reps=20_000)
    assert np.var(replicates[-2]) == pytest.approx(a.var() / 6 + b.var() / 10, rel=0.05)


def test_crossed_bootstrap_keeps_the_pairs() -> None:
    y = np.random.default_rng(0).integers(-100, 100, size=(1, 20)).astype(float)
    found = crossed_bootstrap(lambda p, q: mean(p) - mean(q), np.vstack([y + 1, y + 1, y + 1]), y, reps=200)
    np.testing.assert_allclose(found, (1, 1, 1), rtol=0, atol=100 * EPS * 60)  # roundings of means of 60 numbers <= 100


def test_coverage_of_a_normal_mean() -> None:
    """The bootstrap interval is the mean -+ z s sqrt((n-1)/n) / sqrt(n), which covers with Student's probability p. The
    count over M samples is binomial: 4 deviations, and 2/reps for the percentiles of a finite number of replicates."""
    M, n, reps = 1000, 40, 1000
    rng = np.random.default_rng(0)
    estimates = [bootstrap(mean, x, reps=reps, seed=rng) for x in rng.normal(3.0, 2.0, size=(M, n))]
    covered = np.mean([low <= 3 <= high for _, low, high in estimates])
    p = 2 * student.cdf(1.96 * math.sqrt((n - 1) / n), n - 1) - 1
    assert covered == pytest.approx(p, abs=4 * math.sqrt(p * (1 - p) / M) + 2 / reps)


def test_infinite_scores_leave_the_interval_defined() -> None:
    costs = np.array([1.0, 2, 3, 4, 5, 6, 7, np.inf])
    assert iqm(costs) == 4.5
    assert median(costs) == 4.5
    assert mean(costs) == cvar(costs, 0.1, lower_is_better=True) == np.inf
    value, low, high = bootstrap(iqm, costs, reps=2000)
    assert 1 <= low <= value <= high == np.inf


def test_paired_difference_uses_the_pairs() -> None:
    """Common noise cancels: the interval of y + 1 against y is one point, that of the unpaired means is not."""
    y = np.random.default_rng(0).integers(-100, 100, size=(20, 2)).astype(float)
    np.testing.assert_array_equal(paired_difference(y + 1, y, reps=500), (1, 1, 1))
    unpaired = bootstrap(lambda a, b: mean(a) - mean(b), y + 1, y, reps=500)
    assert unpaired.low < 1 < unpaired.high


def test_interval_of_the_probability_of_improvement() -> None:
    rng = np.random.default_rng(0)
    x, y = rng.normal(1.0, 1.0, size=(10, 3)), rng.normal(size=(12, 3))
    value, low, high = bootstrap(probability_of_improvement, x, y, reps=1000)
    assert 0 <= low < value < high <= 1


BAD: list[tuple[Callable[..., Any], tuple[Any, ...], str]] = [
    *[(f, ([],), r"`scores` must have shape .* and not be empty, got \(0,\)") for f in AGGREGATES],
    *[(f, (1.0,), r"`scores` must have shape .* got \(\)") for f in AGGREGATES],
    *[(f, ([1.0, np.nan],), "`scores` must not contain NaN, got 1 of 2") for f in AGGREGATES],
    (cvar, ([1.0], 0.0), r"`q` must be in \(0, 1\], got 0.0"),
    (bootstrap, (mean, np.ones((2, 2, 2))), r"`scores` must have shape .* got \[\(2, 2, 2\)\]"),
    (bootstrap, (mean,), r"`scores` must have shape .* got \[\]"),
    (crossed_bootstrap, (mean, [1.0]), r"`scores` must have shape \(runs, episodes\[, tasks\]\).* got \[\(1,\)\]"),
    (crossed_bootstrap, (mean, np.ones((1, 3)), np.ones((1, 2))), "with the same episodes, got"),
    (partial(bootstrap, reps=0), (mean, [1.0]), "`reps` must be at least 1, got 0"),
    (partial(bootstrap, level=1.0), (mean, [1.0]), r"`level` must be in \(0, 1\), got 1.0"),
    (paired_difference, ([1.0, 2.0], [1.0]), "`y` must have the shape of `x`"),
    (paired_difference, ([np.inf], [np.inf]), "`x` and `y` must be finite"),
    (probability_of_improvement, (np.ones((3, 2)), np.ones((3, 1))), "`y` must have the tasks of `x`"),
    (probability_of_improvement, ([1.0], [np.nan]), "`y` must not contain NaN"),
    (normalised_score, (1.0, 2.0, 2.0), "`cost_ref` must be finite and below a finite `cost_zero`, got 2.0 and 2.0"),
    (normalised_score, (1.0, np.inf, 2.0), "`cost_ref` must be finite"),
    (normalised_score, (np.nan, 3.0, 2.0), "`cost` must not contain NaN"),
]


@pytest.mark.parametrize(("function", "arguments", "message"), BAD)
def test_bad_input(function: Callable[..., Any], arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        function(*arguments)


def test_rate_of_events_is_clopper_and_pearsons() -> None:
    """None of n: the upper end is 1 - (alpha / 2)^(1/n); all of n: the lower end (alpha / 2)^(1/n)."""
    for n in (6, 200):
        none, every = rate(np.zeros(n)), rate(np.ones(n), level=0.9)
        assert none.value == none.low == 0
        assert none.high == pytest.approx(1 - 0.025 ** (1 / n), rel=1e-12)
        assert every.value == every.high == 1
        assert every.low == pytest.approx(0.05 ** (1 / n), rel=1e-12)
