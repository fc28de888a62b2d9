"""From the scores of all runs and episodes to the numbers of a comparison, with intervals, as plain data.

An escaped episode has infinite costs (`baselines.metrics`), so a mean may be infinite and so may the end of an interval:
that is what null stands for in the data. Nothing is ever NaN.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baselines import statistics
from baselines.comparison import MEASURES
from baselines.metrics import METRICS
from baselines.statistics import Estimate

Array = NDArray[np.float64]
Data = dict[str, Any]

STATISTICS = ("iqm", "mean", "median", "cvar")  # with intervals; the worst episode is a fact, not an estimate
RATIOS = ("tail_rms", "transient_iae", "tail_total_variation_rate")  # >= 0, and spread over orders of magnitude
CVAR = 0.1  # fraction of the worst episodes
POINTS = 60  # of a performance profile


@dataclass(frozen=True)
class Bootstrap:
    """How intervals are found."""

    reps: int = 2000
    level: float = 0.95
    seed: int = 0

    def __call__(self, statistic: Callable[..., Array], *scores: Array) -> Estimate:
        """The crossed bootstrap over runs and episodes."""
        return statistics.crossed_bootstrap(statistic, *scores, reps=self.reps, level=self.level, seed=self.seed)


def describe(scores: Mapping[str, Array], bootstrap: Bootstrap) -> Data:
    """Every metric of one policy on one task; scores (runs, episodes)."""
    found: Data = {name: _aggregates(name, scores[name], bootstrap) for name in MEASURES if name != "escaped"}
    return found | {"escaped": _escapes(scores["escaped"], bootstrap)}


def against(x: Mapping[str, Array], y: Mapping[str, Array], bootstrap: Bootstrap) -> Data:
    """A policy x beside the reference policy y on the same episodes, per metric.

    `difference`: median of x - y over the pairs (mean for the return); `ratio`: median of x / y, for the metrics that have
    one; `size`: mean of abs(y), for the return; `improvement`: probability that x is better than y on an episode.
    """
    found: Data = {}
    for name in (name for name in MEASURES if name != "escaped"):
        better = statistics.probability_of_improvement
        a, b = (y[name], x[name]) if METRICS[name].lower_is_better else (x[name], y[name])
        middle = statistics.mean if name == "return" else lower_median
        found[name] = {
            "difference": plain(bootstrap(partial(_of_pairs, difference, middle), x[name], y[name])),
            "improvement": plain(bootstrap(better, a, b)),
        }
        if name == "return":
            found[name]["size"] = number(np.abs(y[name]).mean())
        if name in RATIOS:
            found[name]["ratio"] = plain(bootstrap(partial(_of_pairs, ratio, lower_median), x[name], y[name]))
    return found


def profile(scores: Array, tau: Array, bootstrap: Bootstrap) -> Data:
    """Fraction of the episodes whose cost is below tau, shape (K,), with a pointwise band."""
    found = bootstrap(partial(statistics.performance_profile, tau=-tau), -scores)
    return {name: list(map(float, values)) for name, values in found._asdict().items()}


def thresholds(scores: list[Array]) -> Array:
    """Costs at which profiles are evaluated: logarithmic over all that is finite, shape (K,)."""
    finite = np.concatenate([x[np.isfinite(x) & (x > 0)] for x in scores])
    low, high = (finite.min(), finite.max()) if finite.size else (1e-3, 1.0)
    return np.asarray(np.geomspace(low / 1.1, high * 1.1, POINTS))


def normalised(costs: Mapping[str, Array], zero: Mapping[str, Array], reference: Mapping[str, Array]) -> Data | None:
    """Scores over the tasks: 0 for the zero input, 1 for the reference policy, from the mean costs of these two.

    Costs (runs, episodes) by task; None if no task can be normalised. See `aggregate` for the statistics.
    """
    scores = {}
    for name, cost in costs.items():
        J_zero, J_ref = zero[name].mean(), reference[name].mean()
        if math.isfinite(J_zero) and J_ref < J_zero:
            scores[name] = statistics.normalised_score(cost, J_zero, J_ref)
    return scores or None


def aggregate(scores: Mapping[str, Array], bootstrap: Bootstrap) -> Data:
    """Interquartile mean and mean over runs, episodes and tasks; an agent and an episode's seed are the same in all tasks."""
    every = np.stack(list(scores.values()), axis=-1)
    both = bootstrap(lambda x: np.stack([statistics.iqm(x), statistics.mean(x)], axis=-1), every)
    return {name: plain(Estimate(*(part[i] for part in both))) for i, name in enumerate(("iqm", "mean"))}


def difference(x: Array, y: Array) -> Array:
    """x - y, 0 where both are infinite: an episode that both leave tells nothing."""
    both = np.isinf(x) & (x == y)
    return np.where(both, 0.0, np.where(both, 0.0, x) - np.where(both, 0.0, y))


def ratio(x: Array, y: Array) -> Array:
    """x / y of costs >= 0, 1 where both are infinite or both zero."""
    same = x == y
    with np.errstate(divide="ignore"):
        return np.where(same, 1.0, np.where(same, 1.0, x) / np.where(same, 1.0, y))


def lower_median(x: Array) -> Array:
    """The lower of the two middle values: defined for infinities of both signs."""
    flat = x.reshape(*x.shape[:-2], -1)
    middle = (flat.shape[-1] - 1) // 2
    return np.asarray(np.partition(flat, middle, axis=-1)[..., middle])


def plain(estimate: Estimate) -> Data:
    """As JSON has it: infinity is null. Raises ValueError for NaN."""
    return {name: number(value) for name, value in estimate._asdict().items()}


def number(value: Any) -> float | None:
    """A finite number, or None for an infinite one. Raises ValueError for NaN."""
    if math.isnan(value):
        raise ValueError("a result must be a number, got NaN.")
    return float(value) if math.isfinite(value) else None


def _of_pairs(
    compare: Callable[[Array, Array], Array], statistic: Callable[[Array], Array], x: Array, y: Array
) -> Array:
    """Statistic over every run of x beside every run of y, on the same episode; (..., runs, episodes)."""
    pairs = compare(x[..., :, None, :], y[..., None, :, :])
    return statistic(pairs.reshape(*pairs.shape[:-3], -1, pairs.shape[-1]))


def _aggregates(name: str, x: Array, bootstrap: Bootstrap) -> Data:
    lower = METRICS[name].lower_is_better
    functions = {"cvar": partial(statistics.cvar, q=CVAR, lower_is_better=lower)}
    functions |= {s: getattr(statistics, s) for s in STATISTICS if s != "cvar"}
    parts = bootstrap(lambda z: np.stack([functions[s](z) for s in STATISTICS], axis=-1), x)
    found: Data = {s: plain(Estimate(*(part[i] for part in parts))) for i, s in enumerate(STATISTICS)}
    return found | {"worst": number(x.max() if lower else x.min())}


def _escapes(x: Array, bootstrap: Bootstrap) -> Data:
    """Count, number of episodes, and the rate; its interval covers the exact binomial one, which is not empty at 0."""
    count, rate = round(x.sum()), bootstrap(statistics.mean, x)
    exact = statistics.rate(x, bootstrap.level)
    hull = Estimate(rate.value, min(rate.low, exact.low), max(rate.high, exact.high))
    return {"count": count, "episodes": x.size, "rate": plain(hull)}
