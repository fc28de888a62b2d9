"""Stable-Baselines3: the native vector environment as its VecEnv."""

from collections.abc import Iterable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from baselines.extras import missing

try:
    from stable_baselines3.common.vec_env import VecEnv
except ModuleNotFoundError as error:
    raise missing("Stable-Baselines3", "rl") from error

Indices = int | Iterable[int] | None

OF_ONE = {"observation_space": "single_observation_space", "action_space": "single_action_space"}
OF_EACH = ("theta", "reference_parameters", "np_random", "np_random_seed")


def make_vec_env(id: str, num_envs: int = 1, seed: int | None = None, **options: Any) -> "NativeVecEnv":
    """`num_envs` environments of a registered id for Stable-Baselines3; `options` are those of the environment.

    With a seed s, environment i runs the episodes of a scalar environment seeded s + i.
    """
    envs = gym.make_vec(
        id, num_envs, vectorization_mode="vector_entry_point", autoreset_mode=AutoresetMode.SAME_STEP, **options
    )
    env = NativeVecEnv(envs)
    if seed is not None:
        env.seed(seed)
        env.action_space.seed(seed)
    return env


class NativeVecEnv(VecEnv):
    """A native vector environment, step by step the same as DummyVecEnv over scalar ones.

    Its environments are rows of one array: `set_attr` reaches only what they share, and they have no methods to call.
    """

    def __init__(self, envs: VectorEnv[Any, Any, Any]) -> None:
        if envs.metadata.get("autoreset_mode") is not AutoresetMode.SAME_STEP:
            raise ValueError(f"`envs` must have AutoresetMode.SAME_STEP, got {envs.metadata.get('autoreset_mode')}.")
        self.envs = envs
        self._actions: Any = None
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    @property
    def spec(self) -> Any:
        """The specification of the vector environment."""
        return self.envs.spec

    def reset(self) -> NDArray[np.float64]:
        seeds = None if all(seed is None for seed in self._seeds) else self._seeds
        if not any(self._options):
            observations, _ = self.envs.reset(seed=seeds)  # type: ignore[arg-type]
        else:
            for one, options in zip(np.eye(self.num_envs, dtype=bool), self._options, strict=True):
                chosen = {**options, "reset_mask": one}
                observations, _ = self.envs.reset(seed=seeds, options=chosen)  # type: ignore[arg-type]
        self.reset_infos = [{} for _ in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: NDArray[Any]) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        observations, rewards, terminated, truncated, info = self.envs.step(self._actions)
        dones = terminated | truncated
        infos: list[dict[str, Any]] = [{"TimeLimit.truncated": False} for _ in range(self.num_envs)]
        for i in np.flatnonzero(dones):
            infos[i] = {
                "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                "terminal_observation": info["final_obs"][i],
                "is_success": bool(info["final_info"]["is_success"][i]),
            }
            self.reset_infos[i] = {}
        return observations, rewards.astype(np.float32), dones, infos

    def close(self) -> None:
        self.envs.close()

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        value = getattr(self.envs, OF_ONE.get(attr_name, attr_name))
        return [value[i] if attr_name in OF_EACH else value for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        if set(self._get_indices(indices)) != set(range(self.num_envs)):
            raise ValueError(f"`indices` must be None, the environments share {attr_name!r}, got {indices}.")
        setattr(self.envs, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Indices = None, **kwargs: Any) -> list[Any]:
        if method_name == "get_wrapper_attr":
            (name,) = (*args, *kwargs.values())
            return self.get_attr(name, indices)
        raise AttributeError(f"the rows of a native vector environment have no method {method_name!r}.")

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: Indices = None
    ) -> list[bool]:
        return [False for _ in self._get_indices(indices)]
