"""What every controller is: an object with Stable-Baselines3's `predict`, its memory travelling in `state`."""

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from mfc_gym import observation as layout
from mfc_gym.nominal import NominalModel

Array = NDArray[np.float64]


class Controller(ABC):
    """Maps observations to actions; works on one observation or on a batch (leading axis)."""

    name: str
    nominal: NominalModel
    reads: tuple[str, ...]  # of: "output", "output derivatives", "state", "nominal model", "bounds", "true model"

    @property
    @abstractmethod
    def memory_size(self) -> int:
        """Numbers of memory per episode, m."""

    @abstractmethod
    def control(self, observations: Array, memory: Array, fresh: NDArray[np.bool_]) -> Array:
        """Input u, shape (N,), abs(u) <= input_limit, from observations (N, 3 n + 1).

        `memory` (N, m) is updated in place; where `fresh` (N,) is True the episode begins and the old memory is void.
        """

    def predict(
        self,
        observation: Array,
        state: Array | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[Array, Array]:
        """(action, state), action = u / input_limit of shape (..., 1).

        Deterministic in any case. Raises ValueError for an observation that is not finite or does not fit the plant, and for a
        state or episode_start that does not fit the observation.
        """
        observation = numbers("observation", observation)
        n = self.nominal.order
        if (
            observation.ndim not in (1, 2)
            or observation.shape[-1] != layout.size(n)
            or not np.isfinite(observation).all()
        ):
            raise ValueError(
                f"`observation` must be finite, of shape ({layout.size(n)},) or (N, {layout.size(n)}) for a plant of order {n}, "
                f"got {observation if observation.size < 50 else observation.shape}."
            )
        rows = np.ascontiguousarray(np.atleast_2d(observation))
        memory, fresh = remembered((len(rows), self.memory_size), state, episode_start)
        action = self.control(rows, memory, fresh)[:, None] / self.nominal.input_limit
        return (action[0], memory[0]) if observation.ndim == 1 else (action, memory)


def numbers(name: str, value: object) -> Array:
    """The array. Raises ValueError for what is none."""
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise ValueError(f"`{name}` must be an array of numbers, got {value!r}.") from error


def remembered(
    shape: tuple[int, int], state: Array | None, episode_start: NDArray[np.bool_] | None
) -> tuple[Array, NDArray[np.bool_]]:
    """(memory (N, m), a copy of the state or zeros; fresh (N,)) of what `predict` was given.

    Raises ValueError for a state that does not fit the observation.
    """
    fresh = np.full(shape[0], state is None)
    if episode_start is not None:
        starts = np.asarray(episode_start, dtype=bool).reshape(-1)
        if starts.size not in (1, shape[0]):
            raise ValueError(f"`episode_start` must be one for each of {shape[0]} observations, got {starts.size}.")
        fresh |= starts
    memory = np.zeros(shape)
    if state is not None:
        given = np.atleast_2d(numbers("state", state))
        if given.shape != shape:
            raise ValueError(f"`state` must be what `predict` returned, of shape {shape}, got {given.shape}.")
        memory[:] = given
    return memory, fresh
