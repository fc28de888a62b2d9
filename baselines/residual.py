"""A controller of the registry under a learned, bounded correction."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from baselines import registry
from baselines.controller import Controller
from mfc_gym.nominal import NominalModel


@dataclass(frozen=True)
class Base:
    """What is corrected, as plain data: action = clip(controller's action + bound * correction), correction in [-1, 1]."""

    controller: str = "mfc"  # of `baselines.registry`
    options: Mapping[str, Any] = field(default_factory=dict)
    bound: float = 0.1  # of the correction, in actions

    def __post_init__(self) -> None:
        if not 0.0 < self.bound <= 1.0:
            raise ValueError(f"`bound` must lie in (0, 1], got {self.bound}.")

    def build(self, nominal: NominalModel) -> Controller:
        """The controller for this nominal model. Raises ValueError for an unknown name or options it does not take."""
        return registry.build(self.controller, nominal, **self.options)
