"""Reference trajectories y_d with their exact derivatives up to order n.

Every family is one function `f(t, p, out)`: time t in s, parameters p of shape (r,), out of shape (n+1,) receives
[y_d, y_d', ..., y_d^(n)]. The compiled environment step calls it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import product
from math import cos, isfinite, pi, sin
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mfc_gym.compiled import njit

Array = NDArray[np.float64]
Interval = tuple[float, float]


@njit
def constant(t: float, p: Array, out: Array) -> None:
    """y_d = value."""
    out[:] = 0.0
    out[0] = p[0]


@njit
def sine(t: float, p: Array, out: Array) -> None:
    """y_d = offset + amplitude sin(frequency t + phase)."""
    amplitude, frequency, phase, offset = p[0], p[1], p[2], p[3]
    s, c = sin(frequency * t + phase), cos(frequency * t + phase)
    scale = amplitude
    for k in range(out.size):
        out[k] = scale * s
        s, c = c, -s
        scale *= frequency
    out[0] += offset


@njit
def multisine(t: float, p: Array, out: Array) -> None:
    """y_d = offset + sum of three sines, p = (offset, amplitude_i, frequency_i, phase_i for i = 1, 2, 3)."""
    out[:] = 0.0
    for i in range(3):
        amplitude, frequency, phase = p[1 + 3 * i], p[2 + 3 * i], p[3 + 3 * i]
        s, c = sin(frequency * t + phase), cos(frequency * t + phase)
        for k in range(out.size):
            out[k] += amplitude * s
            s, c = c, -s
            amplitude *= frequency
    out[0] += p[0]


@njit
def step(t: float, p: Array, out: Array) -> None:
    """C^n transition from start to start + height over [begin, begin + duration].

    With s the elapsed fraction, the polynomial of degree 2n+1 whose first n derivatives vanish at both ends:
    s^(n+1) sum_(k=0..n) binom(n+k, k) (1-s)^k.
    """
    start, height, begin, duration = p[0], p[1], p[2], p[3]
    n = out.size - 1
    out[:] = 0.0
    out[0] = start
    if t <= begin:
        return
    if t >= begin + duration:
        out[0] += height
        return
    s = (t - begin) / duration
    # coefficients of s^(n+1+m): binom(n+m, m) binom(2n+1, n-m) (-1)^m
    coefficient = 1.0
    for j in range(1, n + 1):
        coefficient *= (n + 1 + j) / j
    for m in range(n + 1):
        degree = n + 1 + m
        term = height * coefficient
        for i in range(n + 1):
            power = 1.0
            for _ in range(degree - i):
                power *= s
            out[i] += term * power
            term *= (degree - i) / duration
        coefficient *= -(n + 1.0 + m) * (n - m) / ((m + 1.0) * (n + 2.0 + m))


@njit
def chirp(t: float, p: Array, out: Array) -> None:
    """y_d = offset + amplitude sin(phi), phi = frequency t + rate t^2 / 2.

    z = exp(i phi) has z' = i phi' z, hence z^(k+1) = i (phi' z^(k) + k phi'' z^(k-1)) by Leibniz' rule; y_d = Im z.
    """
    amplitude, frequency, rate, offset = p[0], p[1], p[2], p[3]
    phi = frequency * t + 0.5 * rate * t * t
    speed = frequency + rate * t
    re, im, re_before, im_before = cos(phi), sin(phi), 0.0, 0.0
    for k in range(out.size):
        out[k] = amplitude * im
        re_next = -(speed * im + k * rate * im_before)
        im_next = speed * re + k * rate * re_before
        re_before, im_before, re, im = re, im, re_next, im_next
    out[0] += offset


@dataclass(frozen=True)
class Reference:
    """A family of trajectories: its function, its parameters with defaults, and the intervals they are drawn from."""

    derivatives: Callable[..., Any]  # f(t, p, out)
    defaults: Mapping[str, float]
    sets: Mapping[str, Interval]

    def parameters(self, given: Mapping[str, float]) -> Array:
        """Parameter vector with defaults filled in, shape (r,). Raises ValueError for unknown or non-finite entries."""
        if unknown := set(given) - set(self.defaults):
            got = sorted(map(str, unknown))
            raise ValueError(f"`reference_parameters` must be among {sorted(self.defaults)}, got {got}.")
        for name, value in given.items():
            if isinstance(value, bool) or not isinstance(value, Real) or not isfinite(value):
                raise ValueError(f"`reference_parameters` must be finite numbers, got {name} = {value!r}.")
        if given.get("duration", 1.0) <= 0:
            raise ValueError(f"`duration` of the reference must be positive, got {given['duration']}.")
        return np.array([float(given.get(name, default)) for name, default in self.defaults.items()])

    def scaled(self, scale: float, offset: float, rate: float) -> "Reference":
        """The family in a plant's units: 1 stands for `scale` about `offset` in y, and for `rate` in 1/s."""

        def own(name: str, value: float) -> float:
            return UNITS[name.rstrip("0123456789")](value, scale, offset, rate)

        defaults = {name: own(name, value) for name, value in self.defaults.items()}
        sets = {name: (own(name, low), own(name, high)) for name, (low, high) in self.sets.items()}
        return replace(self, defaults=defaults, sets=sets)

    def draw(self, rng: np.random.Generator, given: Mapping[str, float]) -> Array:
        """Parameters drawn uniformly from the sets; those given stay as given."""
        drawn = {name: rng.uniform(low, high) for name, (low, high) in self.sets.items()}
        return self.parameters(drawn | dict(given))

    def extremes(self, given: Mapping[str, float]) -> list[Array]:
        """The defaults, and every corner of the sets; those given stay as given."""
        corners = (dict(zip(self.sets, ends, strict=True)) for ends in product(*self.sets.values()))
        return [self.parameters(chosen | dict(given)) for chosen in ({}, *corners)]

    def evaluate(self, time: float | Array, parameters: Array, order: int) -> Array:
        """[y_d, ..., y_d^(order)] at the times (s), shape time.shape + (order + 1,)."""
        times = np.asarray(time, dtype=float)
        out = np.empty((*times.shape, order + 1))
        for index in np.ndindex(times.shape):
            self.derivatives(float(times[index]), parameters, out[index])
        return out


_PHASE = (0.0, 2 * pi)
UNITS: dict[str, Callable[[float, float, float, float], float]] = {  # of a parameter: its value, scale, offset, rate
    **dict.fromkeys(("amplitude", "height"), lambda v, scale, offset, rate: scale * v),
    **dict.fromkeys(("value", "start", "offset"), lambda v, scale, offset, rate: offset + scale * v),
    "frequency": lambda v, scale, offset, rate: rate * v,
    "rate": lambda v, scale, offset, rate: rate**2 * v,
    **dict.fromkeys(("begin", "duration"), lambda v, scale, offset, rate: v / rate),
    "phase": lambda v, scale, offset, rate: v,
}


def _numbered(names: tuple[str, ...], *rows: tuple[Any, ...]) -> dict[str, Any]:
    return {f"{s}{i}": v for i, row in enumerate(rows, start=1) for s, v in zip(names, row, strict=True)}


REFERENCES: dict[str, Reference] = {
    "constant": Reference(constant, {"value": 0.5}, {"value": (-1.0, 1.0)}),
    "sine": Reference(
        sine,
        {"amplitude": 1.0, "frequency": 1.0, "phase": 0.0, "offset": 0.0},
        {"amplitude": (0.5, 1.0), "frequency": (0.5, 1.25), "phase": _PHASE},
    ),
    "multisine": Reference(
        multisine,
        {
            "offset": 0.0,
            **_numbered(("amplitude", "frequency", "phase"), (0.5, 0.5, 0.0), (0.3, 0.9, 1.0), (0.2, 1.3, 2.0)),
        },
        _numbered(("amplitude", "phase"), ((0.2, 0.5), _PHASE), ((0.1, 0.3), _PHASE), ((0.0, 0.2), _PHASE)),
    ),
    "step": Reference(
        step,
        {"start": 0.0, "height": 1.0, "begin": 1.0, "duration": 4.0},
        {"start": (-0.5, 0.5), "height": (-1.0, 1.0), "begin": (0.0, 5.0), "duration": (3.0, 6.0)},
    ),
    "chirp": Reference(
        chirp,
        {"amplitude": 1.0, "frequency": 0.25, "rate": 0.05, "offset": 0.0},
        {"amplitude": (0.5, 1.0), "frequency": (0.25, 0.5), "rate": (0.0, 0.04)},
    ),
}


def get(name: str) -> Reference:
    """The family `name`. Raises ValueError with the known names."""
    if not isinstance(name, str) or name not in REFERENCES:
        raise ValueError(f"`reference` must be one of {sorted(REFERENCES)}, got {name!r}.")
    return REFERENCES[name]
