"""Experience for PPO without PyTorch in the loop: what Stable-Baselines3's `collect_rollouts` stores, to the rounding of float32.

For networks as small as these a call into PyTorch costs more than the arithmetic in it. The weights are copied once per rollout;
the actor alone is evaluated at every step, the critic on the whole rollout at its end. The random numbers are PyTorch's, drawn
as Stable-Baselines3 draws them.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import stable_baselines3
import torch
from numpy.typing import NDArray
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import VecEnv

from baselines.policy_network import ACTIVATIONS

Array = NDArray[np.float32]
MODULES = {torch.nn.Tanh: "tanh", torch.nn.ReLU: "relu"}


class PPO(stable_baselines3.PPO):
    """Stable-Baselines3's PPO. Where actor and critic are perceptrons it collects experience in NumPy, else as it always does."""

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        networks = perceptrons(self.policy)
        if networks is None or self.use_sde or type(rollout_buffer) is not RolloutBuffer:
            return super().collect_rollouts(env, callback, rollout_buffer, n_rollout_steps)
        return collect(self, networks, env, callback, rollout_buffer, n_rollout_steps)


@dataclass(frozen=True, eq=False)
class Perceptron:
    """Linear layers, each but the last followed by its activation, in float32."""

    layers: tuple[tuple[Array, Array], ...]  # weight (inputs, outputs), bias (outputs,)
    activations: tuple[str, ...]  # of ACTIVATIONS, one fewer

    def __call__(self, x: Array) -> Array:
        """Shape (N, outputs) of x (N, inputs)."""
        for (weight, bias), activation in zip(self.layers[:-1], self.activations, strict=True):
            x = ACTIVATIONS[activation](x @ weight + bias)  # type: ignore[arg-type,assignment]
        weight, bias = self.layers[-1]
        return x @ weight + bias


def perceptrons(policy: Any) -> tuple[Perceptron, Perceptron, Array] | None:
    """(actor, critic, log of the standard deviation (a,)) as they are now; None if they are something else."""
    plain = type(policy) is ActorCriticPolicy and type(policy.action_dist) is DiagGaussianDistribution
    if not plain or policy.squash_output or policy.device.type != "cpu" or len(policy.observation_space.shape) != 1:
        return None
    if policy.features_extractor_class is not FlattenExtractor:
        return None
    actor = perceptron([*policy.mlp_extractor.policy_net, policy.action_net])
    critic = perceptron([*policy.mlp_extractor.value_net, policy.value_net])
    if actor is None or critic is None:
        return None
    return actor, critic, policy.log_std.detach().numpy().copy()


def perceptron(modules: Iterable[torch.nn.Module]) -> Perceptron | None:
    """These modules as a perceptron; None if they are not one."""
    *hidden, last = modules
    linear, activations = [*hidden[::2], last], hidden[1::2]
    if len(hidden) % 2 or not all(type(m) is torch.nn.Linear and m.bias is not None for m in linear):
        return None
    if not all(type(m) in MODULES for m in activations):
        return None
    layers = tuple((_copy(m.weight.T), _copy(m.bias)) for m in linear)
    return Perceptron(layers, tuple(MODULES[type(m)] for m in activations))


def collect(
    model: Any,
    networks: tuple[Perceptron, Perceptron, Array],
    env: VecEnv,
    callback: BaseCallback,
    buffer: RolloutBuffer,
    steps: int,
) -> bool:
    """Fill the buffer with `steps` steps of every environment; False if the callback has stopped it.

    The callback sees the local variables of Stable-Baselines3's loop but `values` and `log_probs`, which are not known yet.
    """
    (actor, critic, log_std), space = networks, model.action_space
    buffer.reset()
    callback.on_rollout_start()
    scale, means = np.exp(log_std), np.empty_like(buffer.actions)
    timeouts: list[tuple[int, int, Any]] = []  # step, environment, where its episode was cut off
    dones = model._last_episode_starts
    for k in range(steps):
        means[k] = actor(_float32(model._last_obs))
        actions = means[k] + scale * torch.randn(means[k].shape).numpy()
        clipped_actions = np.clip(actions, space.low, space.high)
        new_obs, rewards, dones, infos = env.step(clipped_actions)
        model.num_timesteps += env.num_envs
        callback.update_locals(locals())
        if not callback.on_step():
            return False
        model._update_info_buffer(infos, dones)
        cut = [i for i in np.flatnonzero(dones).tolist() if infos[i].get("TimeLimit.truncated")]
        timeouts += [(k, i, infos[i]["terminal_observation"]) for i in cut]
        buffer.observations[k], buffer.actions[k], buffer.rewards[k] = model._last_obs, actions, rewards
        buffer.episode_starts[k] = model._last_episode_starts
        model._last_obs, model._last_episode_starts = new_obs, dones
    buffer.pos, buffer.full = steps, steps == buffer.buffer_size
    buffer.log_probs[:steps] = log_density(buffer.actions[:steps], means[:steps], log_std)
    seen = _float32(buffer.observations[:steps])
    buffer.values[:steps] = critic(seen.reshape(-1, seen.shape[-1])).reshape(steps, -1)
    if timeouts:  # the value of what would have come, as of https://github.com/DLR-RM/stable-baselines3/issues/633
        at, who, last = zip(*timeouts, strict=True)
        buffer.rewards[list(at), list(who)] += model.gamma * critic(_float32(last))[:, 0]
    buffer.compute_returns_and_advantage(torch.from_numpy(critic(_float32(model._last_obs))), dones)
    callback.update_locals(locals())
    callback.on_rollout_end()
    return True


def log_density(actions: Array, means: Array, log_std: Array) -> Array:
    """Logarithm of the density of a normal distribution with a diagonal covariance, shape (...), actions (..., a)."""
    z = (actions - means) ** 2 / (2 * np.exp(log_std) ** 2) + log_std + np.float32(0.5 * np.log(2 * np.pi))
    return np.asarray(-z.sum(axis=-1), dtype=np.float32)


def _float32(observations: Any) -> Array:
    return np.asarray(observations, dtype=np.float32)


def _copy(tensor: Any) -> Array:
    return np.ascontiguousarray(tensor.detach().numpy()).copy()
