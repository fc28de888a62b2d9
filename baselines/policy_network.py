"""A trained agent as plain NumPy: affine features of what it sees, a multilayer perceptron, a bounded action."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baselines.controller import remembered
from baselines.interface import Interface
from mfc_gym import observation as layout

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
    """What the network sees: matrix @ signals + offset, constants of the plant and its task."""

    matrix: Array  # (m, s)
    offset: Array  # (m,)

    def __call__(self, signals: Array) -> Array:
        """Shape (..., m) of signals (..., s): observations and what an `Interface` adds."""
        return signals @ self.matrix.T + self.offset


@dataclass(frozen=True, eq=False)
class Agent:
    """A trained policy, with Stable-Baselines3's `predict`. It acts by its mean and learns no more.

    Its memory, if its interface has any, travels in `state`; one that corrects a controller must be `made_for` an environment.
    """

    algorithm: str
    features: Features  # of the interface's signals
    layers: tuple[Layer, ...]
    activation: str  # of ACTIVATIONS, after every layer but the last
    output: str  # of OUTPUTS, after the last
    environment: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))  # `id` and `options`
    training: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))  # seed, steps, versions, curve
    interface: Interface = Interface()  # noqa: RUF009 (frozen)

    def __post_init__(self) -> None:
        size = len(self.features.offset)
        for i, (weight, bias) in enumerate(self.layers):
            if weight.ndim != 2 or weight.shape[1] != size or bias.shape != weight.shape[:1]:
                raise ValueError(f"`layers` must fit each other, got {weight.shape} and {bias.shape} in layer {i}.")
            size = len(bias)
        self.observation_size  # noqa: B018 (raises)

    @property
    def reads(self) -> tuple[str, ...]:
        """As `baselines.controller.Controller.reads`."""
        return self.interface.reads

    @cached_property
    def observation_size(self) -> int:
        """Numbers of an observation, d. Raises ValueError if none gives the interface as many signals as the features have."""
        signals = self.features.matrix.shape[1]
        if self.interface.plain:
            return int(signals)
        for n in range(2, signals + 1):
            if self.interface.size(layout.size(n)) == signals:
                return layout.size(n)
        raise ValueError(f"`features` must have a column for each signal of the interface, got {signals}.")

    def made_for(self, env: Any) -> "Agent":
        """The same agent with its controller built for this environment, which tells it the nominal model and nothing else."""
        return replace(self, interface=self.interface.made_for(env))

    def network(self, signals: Array) -> Array:
        """Outputs in [-1, 1], shape (..., a), of signals (..., s)."""
        activation, z = ACTIVATIONS[self.activation], self.features(signals)
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
    ) -> tuple[NDArray[Any], Any]:
        """(action, state), action = u / input_limit of shape (..., 1): float32, or as exact as the controller it corrects.

        Raises ValueError for what it was not trained on, and for a state that does not fit the observation.
        """
        x = np.asarray(observation, dtype=float)
        if x.ndim not in (1, 2) or x.shape[-1] != self.observation_size or not np.isfinite(x).all():
            d = self.observation_size
            raise ValueError(
                f"`observation` must be finite, of shape ({d},) or (N, {d}), got {x if x.size < 50 else x.shape}."
            )
        rows = np.atleast_2d(x)
        memory, fresh = remembered((len(rows), self.interface.memory_size(x.shape[-1])), state, episode_start)
        signals, held = self.interface.see(rows, memory, fresh)
        actions = self.interface.act(self.network(signals), held, memory)
        actions = actions.astype(np.float32) if self.interface.base is None else actions
        return (actions[0], memory[0]) if x.ndim == 1 else (actions, memory)
