"""What lies between the demanded input and the plant: delay, quantisation, limited rate, lag, in this order.

The default is none of it; saturation is the environment's own. The lag of first order acts within the sampling interval, the rest
at its beginning.
"""

import math
from collections.abc import Mapping
from dataclasses import astuple, dataclass, fields
from typing import Any

from mfc_gym.compiled import njit

MOST = 1000  # samples of delay


@njit
def slewed(u: float, last: float, step: float) -> float:
    """u, at most `step` away from `last`."""
    return min(max(u, last - step), last + step)


@dataclass(frozen=True)
class Actuator:
    """What the input suffers."""

    delay: int = 0  # samples
    quantisation: float = 0.0  # step, unit of u
    rate: float = math.inf  # largest abs(u'), unit of u per s
    lag: float = 0.0  # time constant, s

    @classmethod
    def of(cls, given: Mapping[str, Any] | None) -> "Actuator":
        """From a dict of these options. Raises ValueError naming what does not fit."""
        given = {} if given is None else given
        names = [field.name for field in fields(cls)]
        if not isinstance(given, Mapping) or set(given) - set(names):
            raise ValueError(f"`actuator` must be a dict with keys among {names}, got {given!r}.")
        actuator = cls(**given)
        for name, value in zip(names, astuple(actuator), strict=True):
            number = isinstance(value, int | float) and not isinstance(value, bool)
            if not number or not value >= 0 or (name != "rate" and not math.isfinite(value)):
                raise ValueError(f"`{name}` of the actuator must be a number >= 0, got {value!r}.")
        if not actuator.rate > 0:
            raise ValueError(f"`rate` of the actuator must be positive, got {actuator.rate!r}.")
        if not isinstance(actuator.delay, int) or actuator.delay > MOST:
            raise ValueError(f"`delay` of the actuator must be an integer from 0 to {MOST}, got {actuator.delay!r}.")
        return actuator

    @property
    def memory(self) -> int:
        """Numbers per episode: the last input, the state of the lag, what is under way."""
        return 2 + self.delay

    @property
    def tuning(self) -> list[float]:
        """Its part of the step's settings."""
        return [self.quantisation, self.rate, self.lag]


IDEAL = Actuator()
