"""What a learner sees: the native vector environment with its observations and rewards scaled by constants.

Running statistics do not serve here: what an untrained agent does to an unstable plant is far from where it ends up.
"""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from baselines import registry
from baselines.policy_network import Array, Features
from baselines.rollout import rollout
from mfc_gym import observation as layout
from mfc_gym.simulation import Simulation

VALUES = 10.0  # the value function lies between -VALUES and 0
EPISODES = 64  # of the reference policy, which set the scale


def features(id: str, options: Mapping[str, Any], seed: int) -> Features:
    """[x, xi_n, y_d ... y_d^(n), e] with e = xi_n - [y_d ... y_d^(n-1)], standardised over episodes of the reference policy."""
    envs: Any = gym.make_vec(id, EPISODES, vectorization_mode="vector_entry_point", **options)
    trajectory = rollout(envs, registry.make("mfc", envs), seed=seed)
    envs.close()
    d = trajectory.state.shape[-1] * 2 + trajectory.reference.shape[-1]
    n = layout.order(np.empty(d))
    matrix = np.vstack([np.eye(d), np.eye(n, d, n) - np.eye(n, d, 2 * n)])
    parts = (trajectory.state, trajectory.output_derivatives, trajectory.reference)
    seen = np.concatenate(parts, axis=-1).reshape(-1, d) @ matrix.T
    mean, deviation = np.nanmean(seen, axis=0), np.nanstd(seen, axis=0)
    scale = np.where(deviation > 1e-6 * deviation.max(), deviation, 1.0)  # a constant entry has no scale of its own
    return Features(matrix / scale[:, None], -mean / scale)


class TrainingEnv(VecEnvWrapper):
    """Observations as features; rewards -VALUES (1 - gamma) log(1 + cost / precision) / log(1 + cost_max / precision).

    The logarithm makes what is left of an error count as much as the error that was there: with the cost itself the transients
    of the first second outweigh the tail. The discounted sum lies between -VALUES (cost_max for ever) and 0: what the
    environment charges at once for leaving the region, cost_max for the rest of the horizon, is limited to that.
    """

    def __init__(self, venv: VecEnv, features: Features, gamma: float, task: Simulation) -> None:
        self.features = features
        self.gamma, self.dt = gamma, task.dt
        self.cost_max = float(task.settings[4])
        self.precision = task.plant.task.success_error
        size = len(features.offset)
        super().__init__(venv, gym.spaces.Box(-np.inf, np.inf, (size,), np.float32))

    def reset(self) -> NDArray[np.float32]:
        return self._seen(self.venv.reset())  # type: ignore[arg-type]

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        observations, rewards, dones, infos = self.venv.step_wait()
        for i in np.flatnonzero(dones):
            infos[i]["terminal_observation"] = self._seen(infos[i]["terminal_observation"])
        return self._seen(observations), self._paid(rewards), dones, infos  # type: ignore[arg-type]

    def _seen(self, observations: Array) -> NDArray[np.float32]:
        return self.features(observations).astype(np.float32)

    def _paid(self, rewards: NDArray[np.float32]) -> NDArray[np.float32]:
        cost = np.maximum(-rewards.astype(float) / self.dt, 0.0)
        relative = self._shape(cost / self.precision) / self._shape(self.cost_max / self.precision)
        ended = cost > 1.001 * self.cost_max
        return np.where(ended, -3 * VALUES, -VALUES * (1.0 - self.gamma) * relative).astype(np.float32)

    @staticmethod
    def _shape(z: Any) -> Any:
        return np.log1p(z) + z / 20.0
