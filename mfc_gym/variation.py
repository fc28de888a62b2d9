"""What of a plant is varied, as plain data; `mfc_gym.varying` makes the varied plant of it."""

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Variation:
    """How the uncertainty of a plant is varied, plain data; the default is not at all. See `mfc_gym.varying`."""

    unmatchedness: float = 1.0
    moving: Mapping[str, tuple[float, ...]] = field(default_factory=dict)  # theta -> bounds of its rates, k = 1 ...
    disturbances: Mapping[str, tuple[float, ...]] = field(default_factory=dict)  # channel -> bounds of d^(k), k = 0 ...


PLAIN = Variation()


def rate_name(name: str, k: int) -> str:
    """Name of the k-th derivative of a theta."""
    return f"{name}_t{k}" if k else name


def disturbance_name(channel: str) -> str:
    """Name of the theta that a disturbance is."""
    return f"d_{channel}"
