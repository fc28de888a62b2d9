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

VALUES = 10.0  # the discounted sum of the largest cost for ever
ESCAPE = 30.0  # leaving the region
BORDER = 5.0  # times the largest cost, at the border; it falls to 0 at INNER, relative to the region's half width
INNER = 0.6
KNEE = 20.0  # cost over precision above which the shape is linear rather than logarithmic
EPISODES = 64  # of the reference policy, which set the scale
SCALING = 2**29  # their first seed


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


def scaled(venv: VecEnv, gamma: float, horizon: float) -> "TrainingEnv":
    """What `baselines.rl_zoo3` asks of rl_zoo3: the training environment over scalar ones, scaled by episodes of `horizon`, s."""
    (spec,), (simulation,) = venv.get_attr("spec", 0), venv.get_attr("simulation", 0)
    options = {k: v for k, v in spec.kwargs.items() if k != "render_mode"} | {"horizon": horizon}
    return TrainingEnv(venv, features(spec.id, options, SCALING), gamma, simulation)


def shape(z: Any) -> Any:
    """log(1 + z) + z / KNEE of the cost z over the precision asked for.

    Of the cost alone a learner sees the transients, which outweigh what is left afterwards by a hundred; of its logarithm alone
    it does not see that it should not leave the region.
    """
    return np.log1p(z) + z / KNEE


class TrainingEnv(VecEnvWrapper):
    """Observations as features; rewards -VALUES (1 - gamma) shape(cost / precision) / shape(cost_max / precision).

    The discounted sum of the costs lies between -VALUES and 0 (cost_max for ever). The fastest transients run along the border of
    the region, a hair's breadth inside: being near it costs too, or some of them leave it. Leaving the region, for which the
    environment charges cost_max for the rest of the horizon at once, costs -ESCAPE: an undiscounted sum would drown all else.
    """

    def __init__(self, venv: VecEnv, features: Features, gamma: float, task: Simulation) -> None:
        self.features = features
        self.gamma, self.dt = gamma, task.dt
        self.cost_max = float(task.settings[4])
        self.middle, self.half = (task.low + task.high) / 2, (task.high - task.low) / 2
        self.precision = task.plant.task.success_error
        size = len(features.offset)
        super().__init__(venv, gym.spaces.Box(-np.inf, np.inf, (size,), np.float32))

    def reset(self) -> NDArray[np.float32]:
        return self._seen(self.venv.reset())  # type: ignore[arg-type]

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        observations, rewards, dones, infos = self.venv.step_wait()
        for i in np.flatnonzero(dones):
            infos[i]["terminal_observation"] = self._seen(infos[i]["terminal_observation"])
        return self._seen(observations), self._paid(rewards, layout.state(observations)), dones, infos  # type: ignore[arg-type]

    def _seen(self, observations: Array) -> NDArray[np.float32]:
        return self.features(observations).astype(np.float32)

    def _paid(self, rewards: NDArray[np.float32], x: Array) -> NDArray[np.float32]:
        cost = np.maximum(-rewards.astype(float) / self.dt, 0.0)
        relative = shape(cost / self.precision) / shape(self.cost_max / self.precision)
        nearness = (np.abs(x - self.middle) / self.half).max(axis=-1)
        border = BORDER * np.clip((nearness - INNER) / (1.0 - INNER), 0.0, 1.0)
        escaped = cost > 1.001 * self.cost_max
        return np.where(escaped, -ESCAPE, -VALUES * (1.0 - self.gamma) * (relative + border)).astype(np.float32)
