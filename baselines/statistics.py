"""Statistics of few runs on several tasks, after [1].

Scores have shape (runs, tasks), higher is better unless said otherwise; one axis alone is the runs of one task. Every
statistic also takes (..., runs, tasks) and returns (...): so the bootstrap evaluates many resamples in one call.
An infinite score is allowed and counts as such; NaN is an error.

[1] Agarwal et al.: Deep reinforcement learning at the edge of the statistical precipice, NeurIPS 2021.
[2] Rockafellar, Uryasev: Optimization of conditional value-at-risk, Journal of Risk 2, 2000.
[3] Owen: The pigeonhole bootstrap, Annals of Applied Statistics 1, 2007.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.stats import binomtest, rankdata, trim_mean

Array = npt.NDArray[np.float64]

CHUNK = 2**20  # scores resampled at a time: 8 MB of indices and 8 MB of scores


class Estimate(NamedTuple):
    """A statistic and its interval, each of the statistic's own shape."""

    value: Array
    low: Array
    high: Array


def _matrix(name: str, scores: npt.ArrayLike) -> Array:
    """Scores as floats of shape (..., runs, tasks)."""
    x = np.asarray(scores, dtype=np.float64)
    if x.ndim == 0 or x.size == 0:
        raise ValueError(f"`{name}` must have shape (runs,) or (runs, tasks) and not be empty, got {x.shape}.")
    if np.isnan(x).any():
        raise ValueError(f"`{name}` must not contain NaN, got {np.isnan(x).sum()} of {x.size}.")
    return x[:, None] if x.ndim == 1 else x


def _pooled(name: str, scores: npt.ArrayLike) -> Array:
    """Runs and tasks in one axis, shape (..., runs * tasks)."""
    x = _matrix(name, scores)
    return x.reshape(*x.shape[:-2], -1)


def mean(scores: npt.ArrayLike) -> Array:
    """Mean over runs and tasks."""
    return np.asarray(_pooled("scores", scores).mean(axis=-1))


def median(scores: npt.ArrayLike) -> Array:
    """Median over runs and tasks."""
    return np.asarray(np.median(_pooled("scores", scores), axis=-1))


def iqm(scores: npt.ArrayLike) -> Array:
    """Interquartile mean over runs and tasks: a quarter trimmed at each end [1]."""
    return np.asarray(trim_mean(_pooled("scores", scores), 0.25, axis=-1))


def cvar(scores: npt.ArrayLike, q: float = 0.1, lower_is_better: bool = False) -> Array:
    """Mean of the worst fraction q; the last of its samples counts with the weight that is left [2]."""
    if not 0 < q <= 1:
        raise ValueError(f"`q` must be in (0, 1], got {q}.")
    sign = -1.0 if lower_is_better else 1.0
    x = np.sort(sign * _pooled("scores", scores), axis=-1)
    size = round(q * x.shape[-1], 9)  # q N is rarely a float's integer
    k = math.ceil(size)
    weight = np.minimum(size - np.arange(k), 1.0)
    return np.asarray(sign * (x[..., :k] * weight).sum(axis=-1) / size)


def optimality_gap(scores: npt.ArrayLike, gamma: float = 1.0) -> Array:
    """gamma - mean(min(s, gamma)): what is missing up to the score gamma, lower is better [1]."""
    return np.asarray(gamma - np.minimum(_pooled("scores", scores), gamma).mean(axis=-1))


def performance_profile(scores: npt.ArrayLike, tau: npt.ArrayLike) -> Array:
    """Fraction of the scores > tau for every tau of shape (K,), shape (..., K) [1]."""
    x = _pooled("scores", scores)
    return np.stack([(x > t).mean(axis=-1) for t in np.atleast_1d(tau)], axis=-1)


def probability_of_improvement(x: npt.ArrayLike, y: npt.ArrayLike) -> Array:
    """P(X > Y) + P(X = Y)/2, mean over the tasks: U / (Nx Ny) of Mann and Whitney from the rank sum [1].

    For costs exchange x and y. The numbers of runs may differ, the tasks may not.
    """
    x, y = _matrix("x", x), _matrix("y", y)
    if x.shape[:-2] != y.shape[:-2] or x.shape[-1] != y.shape[-1]:
        raise ValueError(f"`y` must have the tasks of `x`, got shapes {x.shape} and {y.shape}.")
    nx, ny = x.shape[-2], y.shape[-2]
    R = rankdata(np.concatenate([x, y], axis=-2), axis=-2)[..., :nx, :].sum(axis=-2)
    return np.asarray(((R - nx * (nx + 1) / 2) / (nx * ny)).mean(axis=-1))


def normalised_score(cost: npt.ArrayLike, cost_zero: npt.ArrayLike, cost_ref: npt.ArrayLike) -> Array:
    """(J_zero - J) / (J_zero - J_ref): 0 for the zero input, 1 for the reference policy; arguments broadcast."""
    J, J_zero, J_ref = (np.asarray(a, dtype=np.float64) for a in (cost, cost_zero, cost_ref))
    if not (np.isfinite(J_zero).all() and np.isfinite(J_ref).all() and (J_ref < J_zero).all()):
        raise ValueError(f"`cost_ref` must be finite and below a finite `cost_zero`, got {J_ref} and {J_zero}.")
    if np.isnan(J).any():
        raise ValueError(f"`cost` must not contain NaN, got {np.isnan(J).sum()} of {J.size}.")
    return np.asarray((J_zero - J) / (J_zero - J_ref))


def rate(events: npt.ArrayLike, level: float = 0.95) -> Estimate:
    """Rate of independent events (0 or 1), with Clopper and Pearson's interval, which is not empty where none happened."""
    x = np.asarray(events)
    exact = binomtest(round(x.sum()), x.size).proportion_ci(level, method="exact")
    return Estimate(np.asarray(x.mean()), np.asarray(exact.low), np.asarray(exact.high))


def bootstrap(
    statistic: Callable[..., Array],
    *scores: npt.ArrayLike,
    reps: int = 50_000,
    level: float = 0.95,
    seed: int | np.random.Generator = 0,
) -> Estimate:
    """Stratified percentile bootstrap: runs are drawn with replacement, independently in each task and each array [1].

    The interval ends at order statistics, outwards, so that it is defined for infinite scores too.
    A band of a profile: `bootstrap(lambda x: performance_profile(x, tau), scores, reps=2000)`, pointwise in tau.
    """
    arrays = [_matrix("scores", x) for x in scores]
    if not arrays or any(x.ndim != 2 for x in arrays):
        raise ValueError(f"`scores` must have shape (runs,) or (runs, tasks), got {[x.shape for x in arrays]}.")
    rng = np.random.default_rng(seed)

    def resample(c: int) -> list[Array]:
        return [x[rng.integers(len(x), size=(c, *x.shape)), np.arange(x.shape[1])] for x in arrays]

    return _percentiles(statistic, arrays, resample, reps, level)


def crossed_bootstrap(
    statistic: Callable[..., Array],
    *scores: npt.ArrayLike,
    reps: int = 2000,
    level: float = 0.95,
    seed: int | np.random.Generator = 0,
) -> Estimate:
    """Percentile bootstrap where every run plays every episode: both are drawn with replacement, independently [3].

    Scores of shape (runs, episodes) or (runs, episodes, tasks); `statistic` gets (..., runs, episodes * tasks). The arrays
    share the episodes, which are drawn once for all of them (common random numbers) and for all tasks; each array has its
    own runs. With one run it is the bootstrap over the episodes.
    """
    arrays = [np.asarray(x, dtype=np.float64) for x in scores]
    shapes = [x.shape for x in arrays]
    if not arrays or any(x.ndim not in (2, 3) or x.size == 0 or x.shape[1:] != arrays[0].shape[1:] for x in arrays):
        raise ValueError(f"`scores` must have shape (runs, episodes[, tasks]) with the same episodes, got {shapes}.")
    rng = np.random.default_rng(seed)

    def resample(c: int) -> list[Array]:
        episodes = rng.integers(shapes[0][1], size=(c, 1, shapes[0][1]))
        drawn = [x[rng.integers(len(x), size=(c, len(x), 1)), episodes] for x in arrays]
        return [x.reshape(c, x.shape[1], -1) for x in drawn]

    return _percentiles(statistic, [x.reshape(len(x), -1) for x in arrays], resample, reps, level)


def _percentiles(
    statistic: Callable[..., Array],
    arrays: list[Array],
    resample: Callable[[int], list[Array]],
    reps: int,
    level: float,
) -> Estimate:
    """The statistic and the percentiles of its replicates, many resamples at a time."""
    if reps < 1:
        raise ValueError(f"`reps` must be at least 1, got {reps}.")
    if not 0 < level < 1:
        raise ValueError(f"`level` must be in (0, 1), got {level}.")
    chunk = max(1, CHUNK // sum(x.size for x in arrays))
    sizes = [min(chunk, reps - i) for i in range(0, reps, chunk)]
    z = np.sort(np.concatenate([statistic(*resample(c)) for c in sizes]), axis=0)
    k = math.floor((1 - level) / 2 * (reps - 1))
    return Estimate(statistic(*arrays), z[k], z[reps - 1 - k])


def paired_difference(
    x: npt.ArrayLike,
    y: npt.ArrayLike,
    statistic: Callable[[Array], Array] = mean,
    reps: int = 50_000,
    level: float = 0.95,
    seed: int | np.random.Generator = 0,
) -> Estimate:
    """Statistic of x - y with its interval, for scores paired by common random numbers, of one shape."""
    x, y = _matrix("x", x), _matrix("y", y)
    if x.shape != y.shape:
        raise ValueError(f"`y` must have the shape of `x`, got {y.shape} and {x.shape}.")
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise ValueError("`x` and `y` must be finite for a difference, got inf.")
    return bootstrap(statistic, x - y, reps=reps, level=level, seed=seed)
