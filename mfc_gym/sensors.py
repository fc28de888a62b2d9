"""What the sensors make of x and y: noise, quantisation, dropouts, delay; all random numbers from the episode's own key.

The numbers are a function of (key, sample, channel), not a stream: an episode is the same alone and in a batch, in any order.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from mfc_gym.compiled import njit

KEYS = 2**53  # keys are integers below this, exact in float64
DROPOUT, OUTPUT, STATE = 0, 1, 2  # channels; the entries of x follow STATE

_STEP, _MIX_1, _MIX_2 = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_30, _27, _31, _11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)


@njit
def mix(z: np.uint64) -> np.uint64:
    """The finaliser of SplitMix64 (Steele, Lea, Flood 2014): a bijection of 64-bit integers."""
    z = (z ^ (z >> _30)) * _MIX_1
    z = (z ^ (z >> _27)) * _MIX_2
    return z ^ (z >> _31)


@njit
def random(key: float, sample: float, channel: int) -> float:
    """Uniform in (0, 1), 53 bits."""
    z = mix(np.uint64(key) + _STEP)
    z = mix(z + np.uint64(sample) * _STEP + _STEP)
    z = mix(z + np.uint64(channel) * _STEP + _STEP)
    return (float(z >> _11) + 0.5) / 9007199254740992.0


@njit
def uniform(key: float, sample: float, channel: int) -> float:
    """Uniform in (-1, 1): the amplitude bounds the noise."""
    return 2.0 * random(key, sample, channel) - 1.0


@njit
def gaussian(key: float, sample: float, channel: int) -> float:
    """Standard normal (Box, Muller): the amplitude is the standard deviation."""
    radius = math.sqrt(-2.0 * math.log(random(key, sample, 2 * channel + 1000)))
    return radius * math.cos(2.0 * math.pi * random(key, sample, 2 * channel + 1001))


@njit
def quantised(value: float, step: float) -> float:
    """The nearest multiple of step; the value itself for step = 0."""
    return step * math.floor(value / step + 0.5) if step > 0.0 else value


DISTRIBUTIONS: dict[str, Callable[[float, float, int], float]] = {"uniform": uniform, "gaussian": gaussian}


@dataclass(frozen=True)
class Sensors:
    """How x and y are measured. The default is ideal."""

    noise: float = 0.0  # amplitude of the noise on y, unit of y
    state_noise: float = 0.0  # amplitude of the noise on each entry of x
    distribution: str = "uniform"  # or "gaussian"
    quantisation: float = 0.0  # step of y, unit of y
    dropout: float = 0.0  # probability that a sample of y is lost; the last one is held
    delay: int = 0  # samples of x and y

    @classmethod
    def of(cls, given: Mapping[str, Any] | None) -> "Sensors":
        """From a dict of these options. Raises ValueError naming what does not fit."""
        given = {} if given is None else given
        names = [field.name for field in fields(cls)]
        if not isinstance(given, Mapping) or set(given) - set(names):
            raise ValueError(f"`sensors` must be a dict with keys among {names}, got {given!r}.")
        sensors = cls(**given)
        for name in ("noise", "state_noise", "quantisation"):
            value = getattr(sensors, name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value < math.inf:
                raise ValueError(f"`{name}` of the sensors must be finite and >= 0, got {value!r}.")
        if (
            isinstance(sensors.dropout, bool)
            or not isinstance(sensors.dropout, (int, float))
            or not 0 <= sensors.dropout < 1
        ):
            raise ValueError(f"`dropout` of the sensors must lie in [0, 1), got {sensors.dropout!r}.")
        if isinstance(sensors.delay, bool) or not isinstance(sensors.delay, int) or not 0 <= sensors.delay <= 1000:
            raise ValueError(f"`delay` of the sensors must be an integer from 0 to 1000, got {sensors.delay!r}.")
        if sensors.distribution not in tuple(DISTRIBUTIONS):
            raise ValueError(
                f"`distribution` of the sensors must be one of {sorted(DISTRIBUTIONS)}, got {sensors.distribution!r}."
            )
        return sensors
