"""A trained agent as plain NumPy: affine features of the observation, a multilayer perceptron, a bounded action."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Layer = tuple[Array, Array]  # weight (outputs, inputs), bias (outputs,)


def relu(z: Array) -> Array:
    """max(z, 0)."""
    return np.maximum(z, 0.0)


def clip(z: Array) -> Array:
    """z limited to [-1, 1]."""
    return np.clip(z, -1.0, 1.0)


ACTIVATIONS: dict[str, Callable[[Array], Array]] = {"tanh": np.tanh, "relu": relu}
OUTPUTS: dict[str, Callable[[Array], Array]] = {"clip": clip, "tanh": np.tanh}


@dataclass(frozen=True, eq=False)
class Features:
    """What the network sees: matrix @ observation + offset, constants of the plant and its task."""

    matrix: Array  # (m, d)
    offset: Array  # (m,)

    def __call__(self, observations: Array) -> Array:
        """Shape (..., m) of observations (..., d)."""
        return observations @ self.matrix.T + self.offset


@dataclass(frozen=True, eq=False)
class Agent:
    """A trained policy, with Stable-Baselines3's `predict`. It acts by its mean, has no memory, and learns no more."""

    algorithm: str
    features: Features
    layers: tuple[Layer, ...]
    activation: str  # of ACTIVATIONS, after every layer but the last
    output: str  # of OUTPUTS, after the last
    environment: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))  # `id` and `options`
    training: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))  # seed, steps, versions, curve
    reads: tuple[str, ...] = ("state", "output derivatives")

    def __post_init__(self) -> None:
        size = len(self.features.offset)
        for i, (weight, bias) in enumerate(self.layers):
            if weight.ndim != 2 or weight.shape[1] != size or bias.shape != weight.shape[:1]:
                raise ValueError(f"`layers` must fit each other, got {weight.shape} and {bias.shape} in layer {i}.")
            size = len(bias)

    @property
    def observation_size(self) -> int:
        """Numbers of an observation, d."""
        return int(self.features.matrix.shape[1])

    def act(self, observations: Array) -> Array:
        """Actions in [-1, 1], shape (..., a), of observations (..., d)."""
        activation, z = ACTIVATIONS[self.activation], self.features(observations)
        for weight, bias in self.layers[:-1]:
            z = activation(z @ weight.T + bias)
        weight, bias = self.layers[-1]
        return OUTPUTS[self.output](z @ weight.T + bias)

    def predict(
        self,
        observation: Array,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], Any]:
        """(action, state), action = u / input_limit of shape (..., 1). Raises ValueError for what it was not trained on."""
        x = np.asarray(observation, dtype=float)
        if x.ndim not in (1, 2) or x.shape[-1] != self.observation_size or not np.isfinite(x).all():
            d = self.observation_size
            raise ValueError(
                f"`observation` must be finite, of shape ({d},) or (N, {d}), got {x if x.size < 50 else x.shape}."
            )
        return self.act(x).astype(np.float32), state
