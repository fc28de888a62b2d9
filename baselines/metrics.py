"""Metrics of one sampled closed-loop episode: the error e = y - y_d at N+1 samples, the input u held over N steps.

Integrals of e are trapezoidal, O(dt^2); integrals of u are exact for the held input. The planned horizon is halved:
the transient is what the initial state costs, the tail is what the controller leaves.

An episode that leaves the region has no honest value on a window it did not complete: a shorter integral would look
better. There every metric takes its worst value, +inf for a cost: over the whole horizon, in the tail and, if it left
within the first half, in the transient. Only `return`, which the environment charges for the rest of the horizon, and
`escaped` stay as recorded. So aggregate by the median or the interquartile mean, with the mean of `escaped` beside it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.integrate import trapezoid

from baselines.trajectory import Array, Trajectory

Phase = Literal["episode", "whole", "transient", "tail"]


def iae(error: Array, dt: float) -> float:
    """int |e| dt."""
    return float(trapezoid(np.abs(error), dx=dt))


def ise(error: Array, dt: float) -> float:
    """int e^2 dt."""
    return float(trapezoid(error**2, dx=dt))


def itae(time: Array, error: Array) -> float:
    """int t |e| dt, t from the start of the episode."""
    return float(trapezoid(time * np.abs(error), time))


def rms(error: Array) -> float:
    """sqrt(ISE / T)."""
    return math.sqrt(ise(error, dt=1.0) / (error.size - 1))


def max_error(error: Array) -> float:
    """sup |e| over the samples."""
    return float(np.abs(error).max())


def settling_time(time: Array, error: Array, band: float) -> float:
    """Last sample with |e| > band: 0 if there is none, inf if it is the last of all."""
    outside = np.flatnonzero(np.abs(error) > band)
    if outside.size == 0:
        return 0.0
    return math.inf if outside[-1] == error.size - 1 else float(time[outside[-1]])


def energy(control: Array, dt: float) -> float:
    """int u^2 dt = dt sum u_k^2."""
    return float(dt * (control**2).sum())


def effort(control: Array, dt: float) -> float:
    """int |u| dt = dt sum |u_k|."""
    return float(dt * np.abs(control).sum())


def total_variation(control: Array) -> float:
    """sum |u_(k+1) - u_k|."""
    return float(np.abs(np.diff(control)).sum())


def total_variation_rate(control: Array, dt: float) -> float:
    """Total variation per second, the chattering index."""
    return total_variation(control) / (control.size * dt)


def saturation_time(control: Array, input_limit: float, dt: float) -> float:
    """Time with |u| >= input_limit."""
    return float(dt * (np.abs(control) >= input_limit).sum())


def peak(control: Array) -> float:
    """max |u|."""
    return float(np.abs(control).max())


@dataclass(frozen=True, eq=False)
class Window:
    """All that a metric may read: M steps of one episode."""

    time: Array  # (M+1,), s since the start of the episode
    error: Array  # (M+1,), y - y_d
    control: Array  # (M,), physical u
    reward: Array  # (M,)
    escaped: bool
    dt: float  # s
    input_limit: float  # bound of |u|
    band: float  # of |e|, for the settling time


@dataclass(frozen=True)
class Metric:
    """One line of the table. Units: y is the unit of the output, u that of the input."""

    unit: str
    function: Callable[[Window], float]
    phase: Phase = "whole"
    lower_is_better: bool = True

    @property
    def worst(self) -> float:
        return math.inf if self.lower_is_better else -math.inf


METRICS: dict[str, Metric] = {
    "return": Metric("1", lambda w: float(w.reward.sum()), "episode", lower_is_better=False),
    "escaped": Metric("1", lambda w: float(w.escaped), "episode"),
    "rms": Metric("y", lambda w: rms(w.error)),
    "max_error": Metric("y", lambda w: max_error(w.error)),
    "iae": Metric("y s", lambda w: iae(w.error, w.dt)),
    "ise": Metric("y^2 s", lambda w: ise(w.error, w.dt)),
    "itae": Metric("y s^2", lambda w: itae(w.time, w.error)),
    "settling_time": Metric("s", lambda w: settling_time(w.time, w.error, w.band)),
    "energy": Metric("u^2 s", lambda w: energy(w.control, w.dt)),
    "effort": Metric("u s", lambda w: effort(w.control, w.dt)),
    "total_variation": Metric("u", lambda w: total_variation(w.control)),
    "total_variation_rate": Metric("u/s", lambda w: total_variation_rate(w.control, w.dt)),
    "saturation_time": Metric("s", lambda w: saturation_time(w.control, w.input_limit, w.dt)),
    "peak": Metric("u", lambda w: peak(w.control)),
    "transient_rms": Metric("y", lambda w: rms(w.error), "transient"),
    "transient_iae": Metric("y s", lambda w: iae(w.error, w.dt), "transient"),
    "transient_max": Metric("y", lambda w: max_error(w.error), "transient"),
    "transient_total_variation": Metric("u", lambda w: total_variation(w.control), "transient"),
    "tail_rms": Metric("y", lambda w: rms(w.error), "tail"),
    "tail_max": Metric("y", lambda w: max_error(w.error), "tail"),
    "tail_total_variation": Metric("u", lambda w: total_variation(w.control), "tail"),
    "tail_total_variation_rate": Metric("u/s", lambda w: total_variation_rate(w.control, w.dt), "tail"),
}


def evaluate(trajectory: Trajectory, input_limit: float, horizon: float, band: float | None = None) -> dict[str, float]:
    """Every metric of one episode planned for `horizon` seconds, never NaN.

    `band` of the settling time: by default 2 % of max |y_d|, or of |e(0)| if the reference is zero.
    """
    if trajectory.control.ndim != 1:
        raise ValueError(f"`trajectory` must be one of `episodes()`, got control of shape {trajectory.control.shape}.")
    (episode,) = trajectory.episodes()
    e, dt, N, escaped = episode.error, episode.dt, episode.control.size, bool(episode.terminated)
    steps, missing = round(horizon / dt) if escaped else N, horizon / dt - N
    if steps < 2 or missing < -0.99 or (missing > 0.99 and not escaped):
        raise ValueError(f"`horizon` must be >= 2 dt and reached unless terminated, got {horizon} for {N * dt} s.")
    if not input_limit > 0:
        raise ValueError(f"`input_limit` must be positive, got {input_limit}.")
    if not np.isfinite(e[: N if escaped else N + 1]).all():
        raise ValueError("`trajectory` must have a finite error until it terminates, got NaN or inf.")
    if band is None:
        band = 0.02 * float(np.abs(episode.reference[:, 0]).max() or abs(e[0]))

    def window(a: int, b: int) -> Window:
        t, reward = episode.time[a : b + 1] - episode.time[0], episode.reward[a:b]
        return Window(t, e[a : b + 1], episode.control[a:b], reward, escaped, dt, input_limit, band)

    m = steps // 2
    completed: dict[Phase, Window] = {"episode": window(0, N)}
    if not escaped:
        completed |= {"whole": window(0, N), "tail": window(m, N)}
    if not escaped or m < N:
        completed |= {"transient": window(0, m)}
    return {k: M.function(completed[M.phase]) if M.phase in completed else M.worst for k, M in METRICS.items()}
