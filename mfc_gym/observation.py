"""The observation vector: [x (n), xi_n (n), y_d ... y_d^(n) (n+1)]. The one place that knows its layout."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def size(n: int) -> int:
    """Number of entries for a plant of order n."""
    return 3 * n + 1


def order(observation: Array) -> int:
    """n, from the length of the last axis. Raises ValueError if no order fits."""
    entries = np.shape(observation)[-1] if np.ndim(observation) else 0
    if entries < 7 or (entries - 1) % 3:
        raise ValueError(
            f"`observation` must have 3 n + 1 entries on its last axis, got shape {np.shape(observation)}."
        )
    return (entries - 1) // 3


def state(observation: Array) -> Array:
    """x, shape (..., n)."""
    return observation[..., : order(observation)]


def output_derivatives(observation: Array) -> Array:
    """xi_n = [y, y', ..., y^(n-1)] as measured, shape (..., n)."""
    n = order(observation)
    return observation[..., n : 2 * n]


def reference(observation: Array) -> Array:
    """[y_d, y_d', ..., y_d^(n)], shape (..., n+1)."""
    return observation[..., 2 * order(observation) :]
