"""A controller of the registry under a learned, bounded correction."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baselines import registry
from baselines.controller import Controller
from mfc_gym import observation as layout
from mfc_gym.nominal import NominalModel

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Base:
    """What is corrected, as plain data: action = clip(controller's action + reach * correction), correction in [-1, 1].

    reach = bound * min(1, max_i abs(e_i) / fade_i), e = xi_n - [y_d ... y_d^(n-1)], or y - y_d for one width: a correction that
    fades with the error leaves the controller alone where it tracks.
    """

    controller: str = "mfc"  # of `baselines.registry`
    options: Mapping[str, Any] = field(default_factory=dict)
    bound: float = 0.1  # of the correction, in actions
    fade: tuple[float, ...] = ()  # n widths, or one for y alone, unit of xi_n; none: the reach is the bound

    def __post_init__(self) -> None:
        if not 0.0 < self.bound <= 1.0:
            raise ValueError(f"`bound` must lie in (0, 1], got {self.bound}.")
        if not all(math.isfinite(width) and width > 0 for width in self.fade):
            raise ValueError(f"`fade` must be positive and finite, got {self.fade}.")

    def reach(self, observations: Array) -> Array:
        """The correction's largest size (N,) at observations (N, d). Raises ValueError for too many or few widths."""
        if not self.fade:
            return np.full(len(observations), self.bound)
        count, n = len(self.fade), layout.order(observations)
        if count not in (1, n):
            raise ValueError(f"`fade` must be 1 or {n} widths for a plant of order {n}, got {count}.")
        error = layout.output_derivatives(observations)[:, :count] - layout.reference(observations)[:, :count]
        return self.bound * np.minimum(1.0, (np.abs(error) / np.array(self.fade)).max(axis=1))

    def build(self, nominal: NominalModel) -> Controller:
        """The controller for this nominal model. Raises ValueError for an unknown name or options it does not take."""
        return registry.build(self.controller, nominal, **self.options)
