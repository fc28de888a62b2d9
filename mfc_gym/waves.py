"""How a disturbance or a scheduled parameter moves in time, in closed form and with all its derivatives.

Every wave is one function `f(begin, s, dt, p, key, out)`: out, shape (m,), receives [d, d', ..., d^(m-1)] at `begin` + s, as
seen from the sampling interval that starts at `begin` (0 <= s <= dt): jumps are at samples. p holds the parameters, `key` seeds
what is random.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import cos, pi, sin, sqrt
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mfc_gym.compiled import njit
from mfc_gym.sensors import random

Array = NDArray[np.float64]
COMPONENTS = 8  # of the noise
CHANNEL = 1_000_000  # of its random numbers, far from those of the sensors
LARGEST = 1e12  # parameter: its powers bound the derivatives
EARLY = 1e-9  # of dt: a jump at a sample is not missed for a rounding error


@njit
def step(begin: float, s: float, dt: float, p: Array, key: float, out: Array) -> None:
    """`amplitude` from the first sample at or after `time` on."""
    out[:] = 0.0
    out[0] = p[0] if begin >= p[1] - EARLY * dt else 0.0


@njit
def impulse(begin: float, s: float, dt: float, p: Array, key: float, out: Array) -> None:
    """Of `area`, spread over the sampling interval that `time` falls into: the input of a sampled system knows no shorter one."""
    out[:] = 0.0
    out[0] = p[0] / dt if begin <= p[1] + EARLY * dt < begin + dt else 0.0


@njit
def drift(begin: float, s: float, dt: float, p: Array, key: float, out: Array) -> None:
    """A ramp from 0 at `time` to `amplitude` at `time` + `duration`, both at samples; constant before and after."""
    amplitude, start, duration = p[0], p[1], p[2]
    out[:] = 0.0
    if begin >= start + duration - EARLY * dt:
        out[0] = amplitude
    elif begin >= start - EARLY * dt:
        out[0] = amplitude * (begin + s - start) / duration
        if out.size > 1:
            out[1] = amplitude / duration


@njit
def sine(begin: float, s: float, dt: float, p: Array, key: float, out: Array) -> None:
    """amplitude sin(frequency t + phase)."""
    scale, frequency, angle = p[0], p[1], p[1] * (begin + s) + p[2]
    a, b = sin(angle), cos(angle)
    for k in range(out.size):
        out[k] = scale * a
        a, b = b, -a
        scale *= frequency


@njit
def noise(begin: float, s: float, dt: float, p: Array, key: float, out: Array) -> None:
    """White noise behind an ideal low-pass filter, in its spectral representation (Shinozuka, Deodatis, 1991): root mean square
    `rms`, frequencies up to `bandwidth` in rad/s, one in each of equal cells, with random phases. abs(d) <= 4 rms."""
    rms, bandwidth = p[0], p[1]
    out[:] = 0.0
    for i in range(COMPONENTS):
        frequency = bandwidth * (i + random(key, 0.0, CHANNEL + i)) / COMPONENTS
        angle = frequency * (begin + s) + 2.0 * pi * random(key, 1.0, CHANNEL + i)
        scale, a, b = rms * sqrt(2.0 / COMPONENTS), sin(angle), cos(angle)
        for k in range(out.size):
            out[k] += scale * a
            a, b = b, -a
            scale *= frequency


@dataclass(frozen=True)
class Wave:
    """A family: its function, its parameters with defaults, and what bounds it."""

    function: Callable[..., Any]
    defaults: Mapping[str, float]
    bound: Callable[[Mapping[str, float], int, float], float]  # (parameters, k, dt) -> bound of abs(d^(k))
    two_sided: bool = False  # whether d takes both signs

    def parameters(self, given: Mapping[str, float]) -> dict[str, float]:
        """Defaults filled in. Raises ValueError for what the family does not have, or what is not finite."""
        if unknown := set(given) - set(self.defaults):
            raise ValueError(
                f"`wave` must have parameters among {sorted(self.defaults)}, got {sorted(map(str, unknown))}."
            )
        for name, value in given.items():
            if isinstance(value, bool) or not isinstance(value, Real) or not abs(value) <= LARGEST:
                raise ValueError(f"`{name}` of a wave must be a number of at most {LARGEST:g}, got {value!r}.")
        if not given.get("duration", 1.0) > 0:
            raise ValueError(f"`duration` of a wave must be positive, got {given['duration']}.")
        return {**self.defaults, **{name: float(value) for name, value in given.items()}}

    def extent(self, p: Mapping[str, float], dt: float) -> tuple[float, float]:
        """(low, high) of d."""
        size = self.bound(p, 0, dt)
        if self.two_sided:
            return -size, size
        signed = size if p.get("amplitude", p.get("area", 1.0)) >= 0 else -size
        return min(0.0, signed), max(0.0, signed)


WAVES: dict[str, Wave] = {
    "step": Wave(step, {"amplitude": 1.0, "time": 5.0}, lambda p, k, dt: abs(p["amplitude"]) if k == 0 else 0.0),
    "impulse": Wave(impulse, {"area": 0.1, "time": 5.0}, lambda p, k, dt: abs(p["area"]) / dt if k == 0 else 0.0),
    "drift": Wave(
        drift,
        {"amplitude": 1.0, "time": 5.0, "duration": 5.0},
        lambda p, k, dt: abs(p["amplitude"]) / p["duration"] ** k if k < 2 else 0.0,
    ),
    "sine": Wave(
        sine,
        {"amplitude": 1.0, "frequency": 2.0, "phase": 0.0},
        lambda p, k, dt: abs(p["amplitude"]) * abs(p["frequency"]) ** k,
        two_sided=True,
    ),
    "noise": Wave(
        noise,
        {"rms": 0.1, "bandwidth": 5.0},
        lambda p, k, dt: sqrt(2.0 * COMPONENTS) * abs(p["rms"]) * abs(p["bandwidth"]) ** k,
        two_sided=True,
    ),
}


def of(option: str, name: str, given: Any) -> tuple[str, dict[str, float]]:
    """(family, parameters) of {"wave": family, parameter: value, ...}. Raises ValueError naming the option and what is wrong."""
    if not isinstance(given, Mapping) or given.get("wave") not in tuple(WAVES):
        raise ValueError(f'`{option}` of {name} must be a dict with "wave" one of {sorted(WAVES)}, got {given!r}.')
    family = str(given["wave"])
    try:
        return family, WAVES[family].parameters({k: v for k, v in given.items() if k != "wave"})
    except ValueError as error:
        raise ValueError(f"`{option}` of {name}: {error}") from None
