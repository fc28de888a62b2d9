"""What a learner sees: the native vector environment with its observations and rewards scaled by constants.

Running statistics do not serve here: what an untrained agent does to an unstable plant is far from where it ends up.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from baselines import registry
from baselines.interface import Held, Interface
from baselines.policy_network import Array, Features
from baselines.rollout import rollout
from baselines.trajectory import Trajectory
from mfc_gym import observation as layout
from mfc_gym.simulation import Simulation

PLAIN = Interface()
VALUES = 10.0  # the discounted sum of the largest cost for ever
ESCAPE = 30.0  # leaving the region
BORDER = 5.0  # times the largest cost, at the border; it falls to 0 at INNER, relative to the region's half width
INNER = 0.6
KNEE = 20.0  # cost over precision above which the shape is linear rather than logarithmic
EPISODES = 64  # of the reference policy, which set the scale
SCALING = 2**29  # their first seed


def features(id: str, options: Mapping[str, Any], seed: int, interface: Interface = PLAIN) -> Features:
    """[view, e, last action, integral, backward differences of the frames, base's action] of the interface's signals, with
    e = xi_n - [y_d ... y_d^(n-1)], or y - y_d where only the output is seen.

    Standardised over episodes of the controller that is corrected, or of the reference policy. The differences, of order 1 to
    `past`, are what the frames add to each other: a derivative hidden in small differences would never be found.
    """
    envs: Any = gym.make_vec(id, EPISODES, vectorization_mode="vector_entry_point", **options)
    interface = interface.made_for(envs)
    controller = registry.make("mfc", envs) if interface.controller is None else interface.controller
    trajectory = rollout(envs, controller, seed=seed)
    envs.close()
    seen = _signals(interface, trajectory, envs.unwrapped.nominal.input_limit)
    matrix = _matrix(interface, layout.size(trajectory.state.shape[-1]))
    seen = seen.reshape(-1, seen.shape[-1]) @ matrix.T
    mean, deviation = np.nanmean(seen, axis=0), np.nanstd(seen, axis=0)
    scale = np.where(deviation > 1e-6 * deviation.max(), deviation, 1.0)  # a constant entry has no scale of its own
    return Features(matrix / scale[:, None], -mean / scale)


def scaled(venv: VecEnv, gamma: float, horizon: float) -> "TrainingEnv":
    """What `baselines.rl_zoo3` asks of rl_zoo3: the training environment over scalar ones, scaled by episodes of `horizon`, s."""
    (spec,), (simulation,) = venv.get_attr("spec", 0), venv.get_attr("simulation", 0)
    options = {k: v for k, v in spec.kwargs.items() if k != "render_mode"} | {"horizon": horizon}
    return TrainingEnv(venv, features(spec.id, options, SCALING), gamma, simulation)


def _signals(interface: Interface, trajectory: Trajectory, limit: float) -> Array:
    """The interface's signals along a batch of the controller's own episodes, shape (N+1, B, s)."""
    parts = (trajectory.state, trajectory.output_derivatives, trajectory.reference)
    observations = np.concatenate(parts, axis=-1)
    actions = np.vstack([trajectory.control / limit, np.full((1, observations.shape[1]), np.nan)])
    observer, d = interface.observer, observations.shape[-1]
    memory = np.zeros((observations.shape[1], observer.memory_size(d)))
    seen = []
    for k, (now, action) in enumerate(zip(observations, actions, strict=True)):
        signals = observer.see(now, memory, np.full(len(now), k == 0))
        observer.acted(action, memory)
        seen.append(signals if interface.base is None else np.hstack([signals, action[:, None]]))
    return np.array(seen)


def _matrix(interface: Interface, d: int) -> Array:
    """Rows of the features before they are standardised, shape (m, s)."""
    observer, size = interface.observer, interface.size(d)
    n, view, frame = layout.order(np.empty(d)), observer.view(np.empty(d)).size, observer.frame(d)
    whole = np.eye(size)
    y, yd, count = (0, 1, 1) if observer.output_only else (n, 2 * n, n)
    error = whole[y : y + count] - whole[yd : yd + count]
    start = frame + observer.integral
    frames = [whole[:frame], *(whole[start + i * frame :][:frame] for i in range(observer.past))]
    changes = []
    for _ in range(observer.past):
        frames = [now - before for now, before in pairwise(frames)]
        changes.append(frames[0])
    return np.vstack([whole[:view], error, whole[view:start], *changes, whole[observer.size(d) :]])


def widths(features: Features, interface: Interface, n: int) -> Array:
    """Standard deviation of e over the episodes that set the scale, shape (n,) or (1,)."""
    view = interface.observer.view(np.empty(layout.size(n))).size
    count = 1 if interface.observer.output_only else n
    return 1.0 / np.abs(features.matrix[view : view + count]).max(axis=1)


def shape(z: Any, fineness: float = 1.0) -> Any:
    """log(1 + fineness z) + z / KNEE of the cost z over the precision asked for.

    Of the cost alone a learner sees the transients, which outweigh what is left afterwards by a hundred; of its logarithm alone
    it does not see that it should not leave the region.
    """
    return np.log1p(z) + z / KNEE


@dataclass(frozen=True)
class Terms:
    """What differs between the modes of training in what is paid."""

    fineness: float = 1.0  # of the precision asked for, in the logarithm
    output: float = 0.0  # cost of the square of the network's output, relative to the largest cost


class TrainingEnv(VecEnvWrapper):
    """Observations as features; rewards -VALUES (1 - gamma) shape(cost / precision) / shape(cost_max / precision).

    The discounted sum of the costs lies between -VALUES and 0 (cost_max for ever). The fastest transients run along the border of
    the region, a hair's breadth inside: being near it costs too, or some of them leave it. Leaving the region, for which the
    environment charges cost_max for the rest of the horizon at once, costs -ESCAPE: an undiscounted sum would drown all else.
    """

    def __init__(
        self,
        venv: VecEnv,
        features: Features,
        gamma: float,
        task: Simulation,
        interface: Interface = PLAIN,
        terms: Terms = Terms(),
    ) -> None:
        self.features, self.interface, self.terms = features, interface.built(task.nominal), terms
        self.gamma, self.dt = gamma, task.dt
        self.cost_max = float(task.settings[4])
        self.middle, self.half = (task.low + task.high) / 2, (task.high - task.low) / 2
        self.precision = task.plant.task.success_error
        d = task.observation_space.shape[0]
        self._memory = np.zeros((venv.num_envs, self.interface.memory_size(d)))
        self._held = Held(np.zeros(venv.num_envs), np.ones(venv.num_envs))
        self._output = np.zeros(venv.num_envs)
        super().__init__(venv, gym.spaces.Box(-np.inf, np.inf, (len(features.offset),), np.float32))

    def reset(self) -> NDArray[np.float32]:
        return self._seen(np.asarray(self.venv.reset()), np.ones(self.num_envs, dtype=bool))

    def step_async(self, actions: NDArray[Any]) -> None:
        self._output = np.asarray(actions)[:, 0]
        self.venv.step_async(self.interface.act(actions, self._held, self._memory))

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        observations, rewards, dones, infos = self.venv.step_wait()
        ended = np.flatnonzero(dones)
        if ended.size:
            last = np.array([infos[i]["terminal_observation"] for i in ended])
            signals, _ = self.interface.see(last, self._memory[ended], np.zeros(ended.size, dtype=bool))
            for i, seen in zip(ended, self.features(signals).astype(np.float32), strict=True):
                infos[i]["terminal_observation"] = seen
        paid = self._paid(rewards, layout.state(np.asarray(observations)))
        if self.terms.output:
            paid -= (VALUES * (1.0 - self.gamma) * self.terms.output * self._output**2).astype(np.float32)
        return self._seen(np.asarray(observations), dones), paid, dones, infos

    def _seen(self, observations: Array, fresh: NDArray[np.bool_]) -> NDArray[np.float32]:
        signals, self._held = self.interface.see(observations, self._memory, fresh)
        return self.features(signals).astype(np.float32)

    def _paid(self, rewards: NDArray[np.float32], x: Array) -> NDArray[np.float32]:
        cost = np.maximum(-rewards.astype(float) / self.dt, 0.0)
        fineness = self.terms.fineness
        relative = shape(cost / self.precision, fineness) / shape(self.cost_max / self.precision, fineness)
        nearness = (np.abs(x - self.middle) / self.half).max(axis=-1)
        border = BORDER * np.clip((nearness - INNER) / (1.0 - INNER), 0.0, 1.0)
        escaped = cost > 1.001 * self.cost_max
        return np.where(escaped, -ESCAPE, -VALUES * (1.0 - self.gamma) * (relative + border)).astype(np.float32)
